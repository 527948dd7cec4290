"""Options of the commands for what somebody has in a Python file: a model, a task.

`palpate identify door.py:Door` and `palpate train door.py:CloseDoor`: nothing is registered.
"""

from __future__ import annotations

import dataclasses
import math
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import arg

from palpate.errors import PalpateError
from palpate.families.options import Identify, Train

if TYPE_CHECKING:
    from collections.abc import Sequence

    from palpate.models.model import Model
    from palpate.recordings import Aligned, Channel, Recording, Trial
    from palpate.tasks.task import Task

Channels = Annotated[tuple[str, ...], arg(metavar="CHANNEL ...", help_behavior_hint="(required)")]


@dataclass(frozen=True, kw_only=True)
class IdentifyOwnModel(Identify):
    """Identify a model of your own: a class of a Python file, of which nothing is registered.

    It starts with each parameter at the centre of its prior. Channels of a recording of palpate, or
    columns of a CSV file with a header such as time,angle [rad],torque, or numbers in a robot's
    log such as /joint_states.position[0], are what is observed and what acts; an action is in force
    from its time to the next.

    1. A door, from angles and torques:         palpate identify door.py:Door R.csv
                                                    --observe angle --act torque
    2. Draws of a posterior:                    palpate identify door.py:Door R.csv
                                                    --observe angle --act torque --method nuts
    """

    observe: Channels
    """What is predicted; several stand side by side as the model's observation."""
    act: Channels
    """What drives the model; several stand side by side as its action."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if both := sorted(set(self.observe) & set(self.act)):
            raise PalpateError(f"'{both[0]}' cannot be both observed and what acts")

    @property
    def observed(self) -> tuple[str, ...]:
        return self.observe

    def reading(self) -> dict[str, Any]:
        return {**super().reading(), "columns": (*self.observe, *self.act)}

    def check(self) -> None:
        start_of(self._kind(), 1.0)

    def prepare(self, recording: Recording) -> Recording:
        """The recording with the named channels as what is observed and what acts."""
        from palpate.recordings import Role

        model = start_of(self._kind(), 1.0)  # for its shapes
        named = {name: model.observation_shape for name in self.observe}
        named |= {name: model.action_shape for name in self.act}
        trials = []
        for trial in recording.trials:
            channels = dict(trial.channels)
            for name, shape in named.items():
                alone = len(self.observe if name in self.observe else self.act) == 1
                role = Role.OBSERVATION if name in self.observe else Role.COMMAND
                channel = _shape(trial[name], shape) if alone else trial[name]
                if role is Role.OBSERVATION or channel.role is not Role.DRIVEN:
                    channel = dataclasses.replace(channel, role=role)
                channels[name] = channel
            trials.append(dataclasses.replace(trial, channels=channels))
        self._check_units(trials[0], model)
        return dataclasses.replace(recording, trials=tuple(trials))

    def action(self, recording: Recording) -> tuple[str, ...]:
        return self.act

    def reference(self, recordings: Sequence[Recording], aligned: Aligned) -> Model:
        """Every parameter at its prior's centre."""
        return start_of(self._kind(), aligned.period)

    def _kind(self) -> type[Model]:
        from palpate.models.model import Model
        from palpate.models.python_files import load_class

        return load_class(self.place, Model)

    def _check_units(self, trial: Trial, model: Model) -> None:
        """Raise `PalpateError` where the model says another unit than the recording."""
        said: list[tuple[str, str]] = []
        for name in self.observe:
            channel = trial[name]
            numbers, own = math.prod(channel.values.shape[1:]), channel.unit.split(", ")
            said += [(name, unit) for unit in (own if len(own) == numbers else own * numbers)]
        for (name, came), wanted in zip(said, model.observation_units, strict=False):
            if came and wanted and came != wanted:
                raise PalpateError(
                    f"'{name}' is in {came} and {type(model).__name__} observes {wanted}: expected "
                    "the same unit"
                )


@dataclass(frozen=True, kw_only=True)
class TrainOwnTask(Train):
    """Train a controller for a task of your own: a class of a Python file.

    The model's class stands in the same file, or is imported into it.

    1. After `palpate identify door.py:Door`:   palpate train door.py:CloseDoor
                                                    --model runs/identify-door-001
    """

    def prepare(self, model: Model) -> Model:
        return model

    def wanted(self) -> Task:
        from palpate.models.python_files import blame, file_of, load_class
        from palpate.tasks.task import Task

        kind: Any = load_class(self.place, Task)
        try:
            task = kind()
            assert isinstance(task.name, str)
        except Exception as error:
            raise PalpateError(
                f"a task {kind.__name__} cannot be made: {blame(error, file_of(self.place))}; "
                "expected a `name`, and a default for every field"
            ) from error
        return task


def identify_options(place: str) -> type[IdentifyOwnModel]:
    """The options of `palpate identify file.py:Class`; the file is not run yet."""
    return _options_of(IdentifyOwnModel, place, "family")


def train_options(place: str) -> type[TrainOwnTask]:
    """The options of `palpate train file.py:Class`; the file is not run yet."""
    return _options_of(TrainOwnTask, place, "task")


def start_of(kind: type[Model], period: float) -> Model:
    """A model of this kind with every parameter at its prior's centre, and this control period.

    Raises `PalpateError` for a prior without one, for axes of unknown length, for other fields
    without defaults, and as `check_model`.
    """
    import inspect

    import numpy as np

    from palpate.models.contract import check_model
    from palpate.models.python_files import blame
    from palpate.parameters import axes_of, parameters_of

    values, axes = {}, axes_of(kind)
    for name, declared in parameters_of(kind).items():
        of = axes.get(name, [])
        if declared.prior.centre is None or not all(axis.isdigit() for axis in of):
            lacks = f"the axes ({', '.join(of)})" if of else f"the prior {declared.prior}"
            raise PalpateError(
                f"'{name}' of {kind.__name__} has {lacks}, which does not say where to start: "
                "expected a prior with a median or mean, and axes with their lengths as numbers"
            )
        values[name] = np.full([int(axis) for axis in of], declared.prior.centre)
    try:
        model = kind(**values, control_period=period)
    except Exception as error:
        raise PalpateError(
            f"a model {kind.__name__} cannot be made: {blame(error, inspect.getfile(kind))}; "
            "expected fields `control_period` and `overrides`, and defaults for all that are no "
            "parameters"
        ) from error
    check_model(model)
    return model.constrain()


def _options_of(base: Any, place: str, called: str) -> Any:
    """`base` for a place, `called` as the class is in words: of SlidingDoor sliding-door."""
    name = place.rpartition(":")[2]
    words = re.sub(r"(?<=[a-z0-9])(?=[A-Z])|_", "-", name).lower()
    return type(base.__name__, (base,), {"place": place, called: words, "__doc__": base.__doc__})


def _shape(channel: Channel, shape: tuple[int, ...]) -> Channel:
    """A channel of as many numbers in the model's shape: one number is (1,)."""
    own = channel.values.shape
    if own[1:] == shape or math.prod(own[1:]) != math.prod(shape):
        return channel
    return dataclasses.replace(channel, values=channel.values.reshape(own[0], *shape))
