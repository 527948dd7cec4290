"""Options of the commands that ropes take part in, and what they do."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from tyro.conf import arg

from palpate.errors import PalpateError
from palpate.families.options import (
    Identify,
    Number,
    Reading,
    Record,
    Track,
    Tracked,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from palpate.models.model import Model
    from palpate.models.rope import Rope
    from palpate.recordings import Aligned, Recording
    from palpate.runs import Run

NOISE = 5e-4  # m, standard deviation of a marker's coordinate in the simulated world
GRIP = "grip"  # the channel that is made of gripped markers
# Parameters of which each segment, or each joint, of a rope has its own.
ALONG = ("rest_length", "stretch_stiffness", "stretch_damping", "bend_stiffness", "bend_damping",
         "twist_stiffness")  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class RecordRope(Record):
    """Record a simulated rope whose gripper moves at random, and then holds still.

    The world is a MuJoCo cable. The file holds the markers as a camera sees them, the gripper's
    position as its encoder shows it, and the velocity it was ordered.

    1. The default rope, 1 m and 100 g:         palpate record rope --out R.npz
    2. A heavier one, with fewer markers:       palpate record rope --mass 0.2 --markers 11
    """

    family: ClassVar[str] = "rope"

    length: float = 1.0
    """Of the rope, m."""
    mass: float = 0.1
    """Of the rope without tip mass, kg."""
    tip_mass: float = 0.0
    """A point at its end, kg."""
    bending_stiffness: float = 1e-4
    """E I, N m^2."""
    joint_damping: float = 3e-3
    """Against bending, N m s/rad at each of 40 joints."""
    air_viscosity: float = 3e-3
    """Effective viscosity of the air, Pa s."""
    markers: int = 21
    """Spread evenly, gripper and tip included."""
    observation_noise: float = NOISE
    """Standard deviation of a marker's coordinate, m."""

    def record(self) -> Recording:
        """Trials of smooth random motion and stillness, each from hanging."""
        import numpy as np

        from palpate.families.rope.recording import record_rope
        from palpate.worlds.rope.configuration import RopeConfiguration

        constants = {field.name for field in dataclasses.fields(RopeConfiguration)}
        given = {name: value for name, value in vars(self).items() if name in constants}
        seeds = np.random.SeedSequence(self.seed).generate_state(self.trials)
        return record_rope(RopeConfiguration(**given), seeds.tolist(), self.duration)


@dataclass(frozen=True, kw_only=True)
class TrackRope(Track):
    """Follow a rope through a calibrated camera's pictures, with its identified model.

    PICTURES is a folder with camera.json, times.csv, and colour/ (PNG or JPEG) or colour.mp4;
    depth/ (16-bit PNG, millimetres) if the camera has it. docs/rope.md says what stands in them.

    1. An orange rope, 1 cm thick:              palpate track rope PICTURES --colour 0.9 0.5 0.2
                                                    --radius 0.005 --model M --out R.npz
    """

    family: ClassVar[str] = "rope"

    colour: Annotated[tuple[float, float, float], arg(metavar="RED GREEN BLUE")]
    """Of the rope in good light, each from 0 to 1."""
    radius: float
    """Of the rope, m."""

    def track(self, model: Model, run: Run) -> Tracked:
        from palpate.families.rope.tracking import track
        from palpate.perception.rope.segmentation import Appearance

        return track(model, Appearance(self.colour, self.radius), self.pictures, run)


@dataclass(frozen=True, kw_only=True)
class IdentifyRope(Identify, Reading):
    """Identify a rope: stiffness, damping and drag from recorded markers.

    A recording of `palpate record` says itself how the gripper moved. In any other, one or more
    markers are gripped: their positions are given to the model and the others are predicted.

    1. A recording of palpate:                  palpate identify rope R.npz
    2. Motion capture, both ends gripped:       palpate identify rope train.npz
                                                    --validate eval.npz
                                                    --driven 0 1 -2 -1 --rate 100
    3. A rope that was weighed, 120 g:          palpate identify rope R.npz --mass 0.12
    4. A rope that is the same all along:       palpate identify rope R.npz --uniform
    5. Draws of a posterior, of few nodes:      palpate identify rope R.npz --nodes 6
                                                    --substeps 8 --method local-global
    """

    family: ClassVar[str] = "rope"
    observation: ClassVar[str] = "markers"
    one_object: ClassVar[bool] = True
    piece: ClassVar[float] = 5.0  # a rope forgets where it began, and the fewer starts the better

    driven: Annotated[
        tuple[int, ...],
        arg(metavar="N ...", help_behavior_hint="(default: the recorded gripper, else 0)"),
    ] = ()
    """Markers that are gripped; negative ones count from the end."""
    mass: Number = None
    """Of the whole rope, kg; unknown, a node has 4 g, and only what is found per mass counts."""
    nodes: Annotated[
        int | None, arg(metavar="N", help_behavior_hint="(default: one for each marker, or fewer)")
    ] = None
    """Of the model, spread evenly over the markers; fewer where markers are so close together that
    its time steps could not integrate the bending damping of a rope."""
    substeps: Annotated[
        int | None, arg(metavar="N", help_behavior_hint="(default: of about 1 ms)")
    ] = None
    """Steps of the model in a control period; few are fast and bound the stiffness."""
    uniform: bool = False
    """The rope is the same all along: all its segments share their parameters, all its joints."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.uniform:
            object.__setattr__(self, "shared", tuple(dict.fromkeys((*self.shared, *ALONG))))

    def check(self) -> None:
        """See `Identify.check`."""
        if self.nodes is not None and self.nodes < 4:
            raise PalpateError(f"a rope has at least 4 nodes, not {self.nodes}")

    def reading(self) -> dict[str, Any]:
        topics = self.topics or ()
        return {**super().reading(), "unit": self.unit, "up": self.up, "topics": topics}

    def prepare(self, recording: Recording) -> Recording:
        """Say how many markers there are, and make those that are gripped a driven channel."""
        from palpate.families.rope.counterpart import SEEN_MARKERS
        from palpate.families.rope.recording import GRIPPER
        from palpate.recordings.markers import with_driven

        count = recording.trials[0][self.observation].values.shape[1]
        provenance = {**recording.provenance, SEEN_MARKERS: count}
        recording = dataclasses.replace(recording, provenance=provenance)
        if self.driven or GRIPPER not in recording.trials[0].channels:
            return with_driven(recording, self.driven or (0,), self.observation, GRIP)
        return recording

    def action(self, recording: Recording) -> str:
        """The gripped markers where there are any, else the gripper that was recorded."""
        from palpate.families.rope.recording import GRIPPER

        return GRIP if GRIP in recording.trials[0].channels else GRIPPER

    def repair(self, recording: Recording) -> Recording:
        from palpate.recordings.markers import repair_markers

        return repair_markers(recording, self.observation)

    def reference(self, recordings: Sequence[Recording], aligned: Aligned) -> Rope:
        from palpate.families.rope.recording import starting_rope

        one_length = "rest_length" in self.shared
        rope = starting_rope(aligned, self._driven(aligned), self.mass, one_length=one_length)
        if self.substeps is not None:
            rope = dataclasses.replace(rope, substeps=self.substeps).constrain()
        return rope

    def problems(self, aligned: Aligned) -> list[str]:
        from palpate.families.rope.recording_check import problems

        return problems(aligned, self._driven(aligned), self.mass)

    def reduced(self, *aligned: Aligned) -> tuple[Aligned, ...]:
        """See `Identify.reduced`: the nodes of the model."""
        from palpate.families.rope.recording import choose_node_count
        from palpate.perception.rope.nodes import at_nodes

        fitted, nodes = aligned[0], self.nodes
        markers = fitted.observation.shape[2]
        inside = set(self._driven(fitted)) - {0, markers - 1}
        if nodes is None and not inside:
            nodes = choose_node_count(fitted, self.substeps)
            if nodes < markers:
                print(
                    f"note: the model has {nodes} nodes between the ends of {markers} markers: "
                    "closer ones could not be integrated with as much bend damping as ropes have"
                )
        if nodes is None or nodes == markers:
            return aligned
        if inside:
            raise PalpateError(
                "--nodes spreads nodes between the ends, so only the ends can be driven: expected "
                f"--driven 0, -1 or both with it, got {' '.join(map(str, self.driven))}"
            )
        return tuple(
            dataclasses.replace(one, observation=at_nodes(one.observation, nodes))
            for one in aligned
        )

    def misfit(self, aligned: Aligned, error: float) -> str:
        from palpate.families.rope.recording_check import misfit

        return misfit(aligned, error)

    def bounds(self, model: Rope) -> list[str]:
        """See `Identify.bounds`: how stiff a rope its time step can integrate."""
        from palpate.models.rope.stability import LIMIT, heaviest, load

        if float(load(model).max()) < 0.97 * LIMIT:
            return []
        name, twice = heaviest(model), 2 * model.substeps
        more = "twice" if name.endswith("damping") else "four times"
        return [
            f"the {name.replace('_', ' ')} is as great as {model.substeps} steps in "
            f"{1e3 * model.control_period:.3g} ms can integrate: it may be greater, others may "
            f"make up for it, and no interval knows; --substeps {twice} allows {more} as much, "
            "and fewer --nodes far more"
        ]

    def _driven(self, aligned: Aligned) -> list[int]:
        from palpate.recordings.recording import resolve_indices

        return resolve_indices(self.driven or (0,), aligned.observation.shape[2], "marker")
