"""The stages that experiments with the nominal MuJoCo rope share, each in a run of its own.

It is recorded, identified and a policy is trained through what was found; or the policy that ships
is taken.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from importlib import resources
from pathlib import Path
from typing import Any

from palpate.commands.folders import POLICY
from palpate.commands.train import constants as task_constants
from palpate.commands.train import train_policy
from palpate.errors import PalpateError
from palpate.experiments.experiment import Experiment
from palpate.families.rope.recording import GRIPPER, MARKERS, constants, record_rope, starting_rope
from palpate.identification.gradient.descent import Settings, identify
from palpate.learning import Training
from palpate.models.files import load_model, save_model
from palpate.models.rope import Rope
from palpate.networks import CommandPolicy, load_policy
from palpate.parameters import describe
from palpate.recordings import Aligned
from palpate.recordings.files import read_recording, write_recording
from palpate.tasks.task import Task
from palpate.worlds.rope.rope import RopeConfiguration

BASE = RopeConfiguration()  # the rope that is recorded, and the middle of those evaluated
NODES, SUBSTEPS = 11, 4  # of the model: every second marker, in steps of 2.5 ms
RECORDED_DURATION = 5.0  # s
SHIPPED = "assets/rope-stabilization.safetensors"
SHIPPED_SPLIT = "shipped weights, see the policy's manifest in the settings"


@dataclasses.dataclass(frozen=True)
class Size:
    """How much work a reproduction is."""

    recorded_trials: int
    identification: tuple[int, ...]  # iterations at each horizon
    training: Training
    ropes: int
    minutes: dict[str, int]  # what each stage takes on two cores

    def part(self, *stages: str) -> dict[str, int]:
        """The minutes of some stages."""
        return {stage: self.minutes[stage] for stage in stages}


_NOISE = BASE.observation_noise
FULL = Size(
    8,
    Settings().iterations,
    Training(iterations=2000, observation_noise=_NOISE),
    125,
    {"recording": 1, "identification": 3, "training": 10, "evaluation": 25},
)
QUICK = Size(
    4,
    (15, 15, 40),
    Training(iterations=250, starts=4000, observation_noise=_NOISE),
    4,
    {"recording": 1, "identification": 1, "training": 2, "evaluation": 1},
)


def identified_rope(experiment: Experiment, size: Size) -> Rope:
    """The nominal rope as a model driven by velocity, from "record" and "identify"."""
    trials = size.recorded_trials
    first = experiment.uses(0, trials)
    with experiment.stage("record", {"trials": trials, "world": constants(BASE)}) as stage:
        if not stage.finished:
            recording = record_rope(BASE, range(first, first + trials), RECORDED_DURATION)
            write_recording(stage.path / "recording.npz", recording)
    aligned = recorded_markers(experiment.out)
    start = starting_rope(aligned, mass=BASE.mass)
    start = dataclasses.replace(start, substeps=SUBSTEPS).constrain()
    return fitted_rope(experiment, "identify", size, start, aligned)


def fitted_rope(
    experiment: Experiment, folder: str, size: Size, start: Rope, aligned: Aligned
) -> Rope:
    """The rope fitted in a stage from `start` on, driven by velocity."""
    settings = Settings(iterations=size.identification, seed=experiment.seed)
    about = {"recorded_trials": size.recorded_trials, "nodes": NODES, "substeps": SUBSTEPS}
    with experiment.stage(folder, about | dataclasses.asdict(settings)) as stage:
        path = stage.path / "model.json"
        if not stage.finished:
            model = identify(start, aligned, settings, stage.run)
            save_model(path, model)
            stage.content = {"parameters": describe(model)}
        model, _ = load_model(path)
        if not isinstance(model, Rope):
            raise PalpateError(f"{path} is no rope but {type(model).__name__}: give another --out")
        return dataclasses.replace(model, drive="velocity")


def recorded_markers(path: Path) -> Aligned:
    """The recording below `path`, the folder of an experiment, at the model's nodes."""
    recording = read_recording(path / "record" / "recording.npz")
    aligned = recording.align(BASE.control_period, MARKERS, GRIPPER)
    every = (aligned.observation.shape[2] - 1) // (NODES - 1)
    return dataclasses.replace(aligned, observation=aligned.observation[:, :, ::every])


def trained_policy(
    experiment: Experiment, folder: str, task: Task, model: Rope, training: Training
) -> tuple[CommandPolicy, dict[str, Any]]:
    """The policy trained in a stage, and its manifest. Its actions are the gripper's velocity."""
    configuration = {
        "model": {row["name"]: row["value"] for row in describe(model)},
        "task": task_constants(task),
        **dataclasses.asdict(training),
    }
    with experiment.stage(folder, configuration) as stage:
        if not stage.finished:
            command = experiment.command
            train_policy(task, model, training, experiment.seed, stage.run, command=command)
        return load_policy(stage.path / POLICY)


def sizes_within(
    experiment: Experiment,
    budget: float,
    methods: Mapping[str, Callable[..., tuple[int, float]]],
    decision: Callable[[str, int], Callable[[], Any]],
) -> dict[str, int]:
    """How many samples or iterations each planner has within the budget (s) on this machine.

    From a stage; 0 where not even the least fits. `decision(method, size)` gives a function that
    takes one, and each of the `methods` finds the size, as `samples_within` does.
    """

    def found() -> dict[str, Any]:
        sizes = {}
        for method, within in methods.items():
            try:
                sizes[method], _ = within(budget, functools.partial(decision, method))
            except PalpateError as error:
                print(f"{method} has no place within {budget:g} s: {error}", flush=True)
                sizes[method] = 0
        return {"sizes": sizes}

    return experiment.found("planners", {"budget_s": budget}, found)["sizes"]


def shipped_policy() -> tuple[CommandPolicy, dict[str, Any]]:
    """The policy that comes with palpate, and its manifest.

    Raises `PalpateError` when this installation has none.
    """
    file = resources.files("palpate") / SHIPPED
    if not file.is_file():
        raise PalpateError(
            f"this installation has no {SHIPPED}: expected a policy that ships with palpate; "
            "reproduce without --weights shipped to train one"
        )
    with resources.as_file(file) as path:
        return load_policy(path)


def identified_split(size: Size, seed: int) -> str:
    """Of what the model was identified, for a result."""
    return f"the nominal rope, {size.recorded_trials} motions, seeds from {seed}"
