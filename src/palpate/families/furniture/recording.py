"""What a recording of furniture says of itself, and the model that is fitted to it."""

import dataclasses
import math
import re
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
import shapely

from palpate.errors import PalpateError, quote
from palpate.models.planar import Planar, furniture
from palpate.models.planar.geometry import Shapes, nearest
from palpate.models.planar.shapes import rectangle
from palpate.parameters import as_floating
from palpate.recordings import Channel, Labels, Polygons, Recording, Role
from palpate.worlds.furniture.furniture import FurnitureWorld
from palpate.worlds.furniture.handling import record_handling, record_pushes
from palpate.worlds.furniture.pieces import Piece

POSE, WRENCH = "pose", "wrench"
FRAMES = 256  # looked at together
CONTACT_RANGE = 0.3  # m between outlines, beyond which nothing touches before it is seen again
SPACING = 2.5  # m between pieces that are handled, so that they do not meet
UNITS = {POSE: "m, m, rad", WRENCH: "N, N, N m"}
MAX_PERIOD = 0.25  # s between frames: a push shows nothing in fewer frames
MAX_LENGTH = 50.0  # m of an outline
MAX_DIFFERENCE = 1e-3  # m between corners of the same outline


def prepare(recording: Recording) -> Recording:
    """The recording, with both channels of the shape that `Planar` needs; one body gets an axis.

    Angles are unwrapped over the frames that a body is seen in, so that what lies between two
    frames is between them.

    Raises `PalpateError` where the channel "pose" (frames, bodies, 3) or "wrench" of that shape is
    missing, says that it is in other units or in a frame of its own, or is too slow, and where
    their numbers of bodies differ.
    """
    bodies, trials = set(), []
    for trial in recording.trials:
        channels = dict(trial.channels)
        for name, unit in UNITS.items():
            channel = trial[name]
            shape = channel.values.shape[1:]
            if shape[-1:] != (3,) or len(shape) > 2:
                raise PalpateError(
                    f"trial '{trial.name}' has a channel '{name}' of shape (frames, "
                    f"{', '.join(map(str, shape))}): expected (frames, bodies, 3) in {unit}"
                )
            _check_convention(trial.name, channel, unit, trial[POSE].frame)
            bodies.add(shape[0] if len(shape) == 2 else 1)
            values = channel.values.reshape(len(channel.values), -1, 3)
            if name == POSE:
                values = _unwrap(values)
            channels[name] = dataclasses.replace(channel, values=values)
        trials.append(dataclasses.replace(trial, channels=channels))
    if len(bodies) > 1:
        raise PalpateError(
            f"poses and wrenches are of {' and '.join(map(str, sorted(bodies)))} bodies: expected "
            "the same bodies in every channel of every trial"
        )
    return dataclasses.replace(recording, trials=tuple(trials))


def _check_convention(trial: str, channel: Channel, unit: str, frame: str) -> None:
    """Refuse what is said to be in another unit or frame, and clocks that are not in seconds."""
    each = ", ".join(dict.fromkeys(unit.split(", ")))  # "m, rad" says as much as "m, m, rad"
    if channel.unit and _normalise(channel.unit) not in (_normalise(unit), _normalise(each)):
        raise PalpateError(
            f"channel '{channel.name}' of trial '{trial}' is in '{channel.unit}': expected {unit}"
        )
    if channel.frame and frame and channel.frame != frame:
        raise PalpateError(
            f"channel '{channel.name}' of trial '{trial}' is in the frame '{channel.frame}' and "
            f"the poses are in '{frame}': expected both in the same"
        )
    if channel.role is Role.OBSERVATION and not channel.nominal_period <= MAX_PERIOD:
        count, spaced = len(channel.time), f", {channel.nominal_period:.3g} s apart as a rule"
        raise PalpateError(
            f"channel '{channel.name}' of trial '{trial}' has "
            f"{f'{count} frames{spaced}' if count > 1 else 'one frame'}: expected many, at most "
            f"{MAX_PERIOD:g} s apart, with stamps in seconds"
        )


def _normalise(unit: str) -> str:
    """Without what may be written one way or another."""
    return re.sub(r"[\s*·⋅.()\[\]-]", "", unit.replace("radians", "rad"))


def names_of(recording: Recording) -> tuple[str, ...]:
    """What the bodies are called: as the fact "bodies" says, else "body 1" and so on."""
    count = recording.trials[0][POSE].values.shape[1]
    bodies = recording.fact("bodies", Labels)
    if bodies is None:
        return tuple(f"body {number + 1}" for number in range(count))
    if len(bodies.labels) != count:
        raise PalpateError(
            f'the recording\'s "bodies" are {quote(bodies.labels)}: expected names of its {count} '
            "bodies"
        )
    return tuple(bodies.labels)


def check_alike(*recordings: Recording, sized: bool = False) -> None:
    """Raise `PalpateError` unless all are of as many bodies, of the same names and outlines.

    Bodies that are `sized` in another way may have any outlines.
    """
    names = [names_of(recording) for recording in recordings]
    named = {of for of, each in zip(names, recordings, strict=True) if each.fact("bodies", Labels)}
    if len(named) > 1 or len(set(map(len, names))) > 1:
        bodies = " and of ".join(dict.fromkeys(", ".join(of) for of in names))
        raise PalpateError(
            f"the recordings are of {bodies}: expected the same bodies in what is fitted and in "
            "what is scored"
        )
    outlines = [] if sized else [each.fact("outlines", Polygons) for each in recordings]
    for name in names[0]:
        corners = [shapely.MultiPoint(one[name]) for one in outlines if one and name in one.names]
        if any(corners[0].hausdorff_distance(other) > MAX_DIFFERENCE for other in corners[1:]):
            raise PalpateError(
                f"'{name}' has another outline in what is scored than in what is fitted: expected "
                "the same body"
            )


def starting_furniture(
    recording: Recording, period: float, size: tuple[float, float] | None = None, **structure: Any
) -> Planar:
    """The planar model of the bodies in a recording, every parameter at its prior's centre.

    Outlines and walls are the facts "outlines" and "walls" of the recording; where it has no
    outlines, every body is a rectangle of `size` (m along x and y of its frame). `structure` as in
    `furniture`.

    Raises `PalpateError` when there are neither, or an outline is longer than 50 m.
    """
    names = names_of(recording)
    facts = None if size is not None else recording.fact("outlines", Polygons)
    if size is not None:
        if not all(math.isfinite(s) and s > 0 for s in size):
            raise PalpateError(f"a size is two positive lengths in m, not {size}")
        outlines = [rectangle(*size)] * len(names)
    elif facts is not None and set(names) <= set(facts.names):
        outlines = [facts[name] for name in names]
    else:
        raise PalpateError(
            'the recording does not say how large the bodies are: expected a fact "outlines" of '
            "polygons with their names, or --size LENGTH WIDTH"
        )
    for name, outline in zip(names, outlines, strict=True):
        if (length := np.ptp(outline, axis=0).max()) > MAX_LENGTH:
            raise PalpateError(
                f"the outline of '{name}' is {length:.4g} m long: expected at most "
                f"{MAX_LENGTH:g} m, so its corners may not be in m"
            )
    walls = recording.fact("walls", Polygons)
    return furniture(
        outlines,
        walls.polygons if walls else (),
        control_period=period,
        poses=_first_poses(recording),
        **structure,
    )


def prune_contacts(model: Planar, *recordings: Recording) -> Planar:
    """The model without contacts of what never comes within `CONTACT_RANGE` of each other.

    A step with contacts takes ten times as long to differentiate as one without, whether they
    happen or not. A body counts as on a straight way between the frames that it is seen in, and as
    where it is seen next before the first and after the last of them. Recordings come from
    `prepare`; one that never shows a body leaves all contacts in.
    """
    near = np.zeros(len(model.pairs), bool)
    if not len(near):
        return model
    shapes = Shapes(model.outline, model.walls, model.pairs)
    gaps = jax.jit(
        lambda poses: jax.lax.map(
            lambda pose: nearest(shapes, pose).gap.min(axis=1), poses, batch_size=FRAMES
        )
    )
    for trial in (trial for recording in recordings for trial in recording.trials):
        poses = np.array(trial[POSE].values, float)
        seen = np.asarray(np.isfinite(poses).all(axis=2))
        if not seen.any(axis=0).all():
            return model  # nobody knows where a body was
        time = trial[POSE].time
        for body in range(model.bodies):
            of = seen[:, body]
            for axis in range(3):
                poses[~of, body, axis] = np.interp(time[~of], time[of], poses[of, body, axis])
        near |= (np.asarray(gaps(as_floating(poses))) < CONTACT_RANGE).any(axis=0)
    return dataclasses.replace(model, pairs=model.pairs[near])


def record_pieces(
    kinds: Sequence[str], seed: int, trials: int, duration: float, pushes: bool
) -> Recording:
    """Furniture of the MuJoCo world, handled or pushed: `trials` for each piece in turn.

    The pieces stand in a row, too far from each other to touch. Raises `PalpateError` for a kind
    that does not exist.
    """
    reach = [Piece(kind).made_as.radius for kind in kinds]
    across = np.concatenate([[0.0], np.cumsum(np.add(reach[1:], reach[:-1]) + SPACING)])
    world = FurnitureWorld(
        [Piece(kind, (0.0, float(y), 0.0)) for kind, y in zip(kinds, across, strict=True)]
    )
    if pushes:
        return record_pushes(world, seed, trials * len(kinds), duration)
    parts = [
        record_handling(world, seed, duration, number * len(kinds)) for number in range(trials)
    ]
    named = [
        dataclasses.replace(trial, name=f"{trial.name} {number + 1}" if trials > 1 else trial.name)
        for number, part in enumerate(parts)
        for trial in part.trials
    ]
    return dataclasses.replace(parts[0], trials=tuple(named))


def one_body(recording: Recording, body: int) -> Recording:
    """A recording as if one of its bodies had been alone."""
    name = Labels((names_of(recording)[body],))
    trials = [
        dataclasses.replace(
            trial,
            channels={
                of: dataclasses.replace(trial[of], values=trial[of].values[:, body : body + 1])
                for of in (POSE, WRENCH)
            },
            facts={**trial.facts, "bodies": name},
        )
        for trial in recording.trials
    ]
    return dataclasses.replace(recording, trials=tuple(trials))


def _first_poses(recording: Recording) -> np.ndarray:
    """Where each body is seen first, (bodies, 3)."""
    poses = recording.trials[0][POSE].values.astype(float)
    complete = np.isfinite(poses).all(axis=2)
    if not complete.any(axis=0).all():
        raise PalpateError("a body is never seen in the first trial: expected some of its poses")
    return poses[complete.argmax(axis=0), np.arange(poses.shape[1])]


def _unwrap(poses: np.ndarray) -> np.ndarray:
    """Poses (frames, bodies, 3) without jumps of the angle by a whole turn."""
    poses = np.array(poses, float)
    for body in range(poses.shape[1]):
        seen = np.isfinite(poses[:, body, 2])
        poses[seen, body, 2] = np.unwrap(poses[seen, body, 2])
    return poses
