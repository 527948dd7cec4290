"""What a person declares of a model before it is identified: what is free, priors, a start."""

from collections.abc import Iterable
from typing import Any, TypeVar

from palpate.errors import PalpateError
from palpate.family import check_name
from palpate.models.model import Model
from palpate.parameters import (
    LogNormal,
    Normal,
    Uniform,
    declare,
    parameters_of,
    value_of,
    with_values,
)

SomeModel = TypeVar("SomeModel", bound=Model)

_NUMBERS = {
    LogNormal: "median and standard deviation of the logarithm",
    Normal: "mean and standard deviation",
    Uniform: "lower and upper bound",
}


def with_declarations(
    model: SomeModel,
    free: Iterable[str] = (),
    fixed: Iterable[str] = (),
    shared: Iterable[str] = (),
    priors: Iterable[str] = (),
) -> SomeModel:
    """The model with some parameters freed, fixed or shared by name, and priors of its own.

    `priors`: "NAME=A,B", where A and B are the median and the standard deviation of the logarithm
    of a positive parameter, mean and standard deviation of any number, the bounds of one between
    two. Raises `PalpateError` for a name the model does not have, one that is both free and fixed,
    or a prior that is none.
    """
    free, fixed, shared = tuple(free), tuple(fixed), tuple(shared)
    declared = parameters_of(model)
    changes: dict[str, dict[str, Any]] = {}
    for names, change in (
        (free, {"fixed": False}),
        (fixed, {"fixed": True}),
        (shared, {"shared": True}),
    ):
        for name in names:
            changes.setdefault(check_name("parameter", name, declared), {}).update(change)
    if both := sorted(set(fixed) & {*free, *shared}):
        raise PalpateError(f"'{both[0]}' cannot be fixed and identified at the same time")
    for words in priors:
        name, _, numbers = words.partition("=")
        prior = type(declared[check_name("parameter", name, declared)].prior)
        try:
            first, second = map(float, numbers.split(","))
        except ValueError as error:
            raise PalpateError(
                f"'{words}' is no prior: expected NAME=A,B, here the {_NUMBERS[prior]}"
            ) from error
        changes.setdefault(name, {})["prior"] = prior(first, second)
    return declare(model, **changes)


def with_values_of(model: SomeModel, other: Model) -> SomeModel:
    """The model with all parameter values of another of its kind, to start from them.

    Raises `PalpateError` where the other is of another kind or has other elements.
    """
    if type(other) is not type(model):
        raise PalpateError(
            f"expected a {type(model).__name__} to start from, got a {type(other).__name__}"
        )
    values = {path: value_of(other, path) for path in parameters_of(model)}
    for path, value in values.items():
        expected = value_of(model, path).shape
        if value.shape != expected:
            raise PalpateError(
                f"{path} of the model to start from has the shape {value.shape}: expected "
                f"{expected}, as the recording has it"
            )
    return with_values(model, values)
