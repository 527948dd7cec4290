"""What a physical parameter is: unit, support, prior, spread.

A parameter is declared once, as a field of a model, and used five times: fitted (its support
gives the unconstrained transform), sampled (its prior), randomised in training (its spread),
written to disk and printed in reports (its unit and meaning):

    class Pendulum(Model):
        length: Float[Array, ""] = parameter(
            "m", prior=LogNormal(1.0, 0.5), spread=0.1, about="pivot to centre of mass"
        )

Free values are *whitened*: zero is the prior's centre and one is its standard deviation, so that
one learning rate suits a stiffness of 1e3 N/m and a drag of 1e-4 N s/m, a weak prior is half the
squared norm, and a posterior as wide as the prior is easy to see.
"""

import dataclasses
import math
from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from palpate.errors import PalpateError
from palpate.numerics.arrays import as_array

_METADATA = "palpate.parameter"


@dataclasses.dataclass(frozen=True)
class LogNormal:
    """A positive quantity known to an order of magnitude.

    `median` is in the parameter's unit (None: the instance's own value, element by element) and
    `sigma` is the standard deviation of the natural logarithm.
    """

    median: float | None
    sigma: float

    def __post_init__(self) -> None:
        if self.sigma <= 0 or (self.median is not None and self.median <= 0):
            raise PalpateError(f"a LogNormal needs a positive median and sigma, got {self}")

    @property
    def centre(self) -> float | None:
        """The median, None where it is the instance's own value."""
        return self.median

    def to_free(self, value: Array, reference: Array) -> Array:
        """Whitened coordinate of a value; `reference` is the instance's value."""
        return jnp.log(value / _centre(self, reference)) / self.sigma

    def to_value(self, free: Array, reference: Array) -> Array:
        """Value at a whitened coordinate."""
        return _centre(self, reference) * jnp.exp(self.sigma * free)


@dataclasses.dataclass(frozen=True)
class Normal:
    """A real quantity: mean (None: the instance's own value) and standard deviation."""

    mean: float | None
    sigma: float

    def __post_init__(self) -> None:
        if self.sigma <= 0:
            raise PalpateError(f"a Normal needs a positive sigma, got {self}")

    @property
    def centre(self) -> float | None:
        """The mean, None where it is the instance's own value."""
        return self.mean

    def to_free(self, value: Array, reference: Array) -> Array:
        """Whitened coordinate of a value; `reference` is the instance's value."""
        return (value - _centre(self, reference)) / self.sigma

    def to_value(self, free: Array, reference: Array) -> Array:
        """Value at a whitened coordinate."""
        return _centre(self, reference) + self.sigma * free


def _centre(prior: LogNormal | Normal, reference: Array) -> Array | float:
    return reference if prior.centre is None else prior.centre


@dataclasses.dataclass(frozen=True)
class Uniform:
    """A quantity anywhere between two bounds; the free value is the normal quantile."""

    lower: float
    upper: float

    def __post_init__(self) -> None:
        if not self.lower < self.upper:
            raise PalpateError(f"a Uniform needs lower < upper, got {self}")

    @property
    def centre(self) -> float:
        """The middle."""
        return 0.5 * (self.lower + self.upper)

    def to_free(self, value: Array, reference: Array) -> Array:
        """Whitened coordinate of a value inside the bounds."""
        return jax.scipy.special.ndtri((value - self.lower) / (self.upper - self.lower))

    def to_value(self, free: Array, reference: Array) -> Array:
        """Value at a whitened coordinate."""
        return self.lower + (self.upper - self.lower) * jax.scipy.special.ndtr(free)


Prior = LogNormal | Normal | Uniform


@dataclasses.dataclass(frozen=True)
class Parameter:
    """The declaration of one physical parameter.

    `spread` is the half-width of the uniform relative perturbation in training (0.5: 50 %).
    `fixed` parameters are not identified; `shared` ones have one free value for all elements.
    """

    unit: str
    about: str
    prior: Prior
    spread: float = 0.0
    fixed: bool = False
    shared: bool = False

    def __post_init__(self) -> None:
        if not 0.0 <= self.spread < 1.0:
            raise PalpateError(f"a spread is a share between 0 and 1, got {self.spread}")


def as_floating(value: Any) -> Array:
    """Convert to a floating array: kept when it is one, else JAX's default float.

    Never a weak dtype: an int here and a float there would be traced anew each time.
    """
    kept = isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jnp.floating)
    return as_array(value, value.dtype if kept else jnp.zeros(()).dtype)


def axes_of(kind: type) -> dict[str, list[str]]:
    """The axes of a module's array fields as they are annotated, without a batch's."""
    annotations: dict[str, Any] = {field.name: field.type for field in dataclasses.fields(kind)}
    return {
        name: [axis for axis in annotation.dim_str.split() if not axis.startswith("*")]
        for name, annotation in annotations.items()
        if hasattr(annotation, "dim_str")
    }


def parameter(
    unit: str,
    *,
    about: str,
    prior: Prior,
    spread: float = 0.0,
    fixed: bool = False,
    shared: bool = False,
) -> Any:
    """Declare a model field as a physical parameter. Arguments as in `Parameter`."""
    declaration = Parameter(unit, about, prior, spread, fixed, shared)
    return eqx.field(converter=as_floating, metadata={_METADATA: declaration})


def parameters_of(model: Any) -> dict[str, Parameter]:
    """The declared parameters of a model and its parts, by dotted path, overrides applied.

    Of a model class: what it declares itself.
    """
    return dict(_walk(model, "", {}))


def _walk(module: Any, prefix: str, outer: dict[str, Parameter]) -> Iterator[tuple[str, Parameter]]:
    own = () if isinstance(module, type) else getattr(module, "overrides", ())
    overrides = {prefix + name: declaration for name, declaration in own} | outer
    for field in dataclasses.fields(module):
        path = prefix + field.name
        if declared := field.metadata.get(_METADATA):
            yield path, overrides.get(path, declared)
        elif isinstance(part := getattr(module, field.name, None), eqx.Module):
            yield from _walk(part, path + ".", overrides)


def declare(model: Any, **changes: dict[str, Any]) -> Any:
    """A copy of the model whose instance declares some parameters differently.

    `declare(rope, node_mass={"fixed": True}, gravity={"prior": Normal(9.81, 0.1)})`: a rope that
    was weighed. Raises `PalpateError` for a parameter the model does not have.
    """
    declared = parameters_of(model)
    overrides = dict(model.overrides)
    for name, change in changes.items():
        if name not in declared:
            raise PalpateError(
                f"unknown parameter '{name}'; {type(model).__name__} has: {', '.join(declared)}"
            )
        overrides[name] = dataclasses.replace(declared[name], **change)
    return dataclasses.replace(model, overrides=tuple(sorted(overrides.items())))


def value_of(model: Any, path: str) -> Any:
    """The value of a parameter, an array, by its dotted path."""
    for name in path.split("."):
        model = getattr(model, name)
    return model


def with_values(model: Any, values: dict[str, Array]) -> Any:
    """A copy of the model with some parameters replaced; shapes may gain leading batch axes."""
    if not values:
        return model
    paths = list(values)
    return eqx.tree_at(
        lambda m: [value_of(m, path) for path in paths], model, [values[path] for path in paths]
    )


class FreeParameters(eqx.Module):
    """The coordinates an identification works in, about a reference model.

    Free values are a dict of arrays by parameter path (shape of the parameter, or scalar where it
    is shared); `build` maps any real free values to a legal model, through each parameter's
    transform and then the model's own `constrain`.
    """

    reference: Any

    def __check_init__(self) -> None:
        if not self.declarations:
            raise PalpateError(
                f"every parameter of {type(self.reference).__name__} is fixed: "
                "free at least one to identify"
            )

    @property
    def declarations(self) -> dict[str, Parameter]:
        """The parameters that are free, by path."""
        return {
            path: declaration
            for path, declaration in parameters_of(self.reference).items()
            if not declaration.fixed and value_of(self.reference, path).size
        }

    @property
    def initial(self) -> dict[str, Array]:
        """Free values of the reference model (the mean over the elements of a shared one)."""
        free = self._initial()
        return {path: free[path] for path in self.declarations}  # compiled functions sort a dict

    @eqx.filter_jit
    def _initial(self) -> dict[str, Array]:
        free = {}
        for path, declaration in self.declarations.items():
            value = value_of(self.reference, path)
            coordinate = declaration.prior.to_free(value, value)
            coordinate = jnp.mean(coordinate) if declaration.shared else coordinate
            # not weakly typed, as of a model that was given Python's numbers: what is computed
            # of it is not, and would be compiled once more
            free[path] = coordinate.astype(coordinate.dtype)
        return free

    def build(self, free: dict[str, Array]) -> Any:
        """The legal model at these free values."""
        return self.unconstrained(free).constrain()

    @eqx.filter_jit
    def project(self, free: dict[str, Array]) -> dict[str, Array]:
        """The free values of the legal model at these: a descent that leaves the legal set returns.

        Without it a value beyond a limit would feel no gradient, and never come back.
        """
        proposed = self.unconstrained(free)
        legal = proposed.constrain()
        projected = {}
        for path, declaration in self.declarations.items():
            reference = value_of(self.reference, path)
            value, before = value_of(legal, path), value_of(proposed, path)
            coordinate = declaration.prior.to_free(value, reference)
            # A few roundings inside: what they leave just beyond a limit would not come back.
            rounding = 4 * jnp.finfo(coordinate.dtype).eps * jnp.maximum(jnp.abs(coordinate), 1)
            coordinate -= jnp.sign(free[path] - coordinate) * rounding
            # What was legal stays as it is: the way back through a value may overflow.
            coordinate = jnp.where(value == before, free[path], coordinate)
            projected[path] = jnp.mean(coordinate) if declaration.shared else coordinate
        return projected

    def unconstrained(self, free: dict[str, Array]) -> Any:
        """As `build`, before what couples several parameters is applied."""
        return with_values(self.reference, self._values(free))

    @eqx.filter_jit
    def _values(self, free: dict[str, Array]) -> dict[str, Array]:
        values = {}
        for path, declaration in self.declarations.items():
            reference = value_of(self.reference, path)
            value = declaration.prior.to_value(free[path], reference)
            values[path] = jnp.broadcast_to(value, reference.shape).astype(reference.dtype)
        return values

    @eqx.filter_jit
    def penalty(self, free: dict[str, Array]) -> Float[Array, ""]:
        """Minus the logarithm of the prior density, up to a constant: half the squared norm."""
        return 0.5 * sum(
            (jnp.sum(jnp.square(value)) for value in free.values()), start=jnp.zeros(())
        )


def sample_prior(model: Any, key: PRNGKeyArray) -> Any:
    """One model drawn from the priors of its free parameters, made legal by `constrain`."""
    coordinates = FreeParameters(model)
    initial = coordinates.initial
    keys = jax.random.split(key, len(initial))
    return coordinates.build(
        {
            path: jax.random.normal(k, value.shape, value.dtype)
            for (path, value), k in zip(initial.items(), keys, strict=True)
        }
    )


def randomise(
    model: Any, key: PRNGKeyArray, amplitude: Float[Array, ""] | float, batch: int
) -> Any:
    """A batch of models perturbed within each parameter's spread, made legal by `constrain`.

    Each parameter is multiplied by 1 + amplitude x spread x U(-1, 1), one factor for all its
    elements, drawn anew for each of the `batch` models (leading axis). An amplitude of 1 is the
    declared spread; domain randomisation lets it grow (seed 1, Algorithm 2).
    """
    values = {}
    for index, (path, declaration) in enumerate(parameters_of(model).items()):
        if declaration.spread == 0.0:
            continue
        value = value_of(model, path)
        noise = jax.random.uniform(
            jax.random.fold_in(key, index), (batch,) + (1,) * value.ndim, value.dtype, -1.0, 1.0
        )
        values[path] = value * (1.0 + amplitude * declaration.spread * noise)
    return with_values(model, values).constrain()


def describe(model: Any) -> list[dict[str, Any]]:
    """Rows for files and reports: name, value(s), unit, meaning, fixed and shared."""
    return [
        {
            "name": path,
            "value": value_of(model, path).tolist(),
            "unit": declaration.unit,
            "about": declaration.about,
            "fixed": declaration.fixed,
            "shared": declaration.shared,
        }
        for path, declaration in parameters_of(model).items()
    ]


def table(model: Any) -> str:
    """The parameters of a model for a person: name, value, meaning, and whether fixed or shared."""
    rows = []
    for path, declared in parameters_of(model).items():
        value = value_of(model, path)
        try:
            shown = format_value(value, declared.unit) if np.size(value) else "none"
        except (TypeError, ValueError):  # while it is traced, or in a tree of something else
            shown = f"{value} {declared.unit}"
        said = ("fixed", declared.fixed), ("shared", declared.shared and np.size(value) > 1)
        notes = ", ".join(name for name, true in said if true)
        rows.append((path, shown, declared.about + (f" ({notes})" if notes else "")))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  " + "  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip()
        for row in rows
    )


def format_value(value: Any, unit: str) -> str:
    """A value or the range of an array's values, with its unit, to three figures."""
    elements = [float(v) for v in jnp.ravel(jnp.asarray(value))]
    low, high = min(elements), max(elements)
    if math.isclose(low, high, rel_tol=5e-4):
        return f"{low:.3g} {unit}".strip()
    return f"{low:.3g} to {high:.3g} {unit}".strip()
