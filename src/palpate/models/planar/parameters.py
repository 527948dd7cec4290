"""What bodies in the plane are: their parameters, and their structure as data."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from palpate.models.model import Model
from palpate.models.planar.checks import check_axes, check_indices
from palpate.parameters import LogNormal, Normal, Parameter, Uniform, as_floating, parameter


class PlanarState(eqx.Module):
    """Pose (x, y in m, theta in rad, not wrapped) of each body's frame in the world, and its rate.

    A frame's origin is the centroid of the body's outline. Velocities are in the world's axes.
    """

    pose: Float[Array, "*batch bodies 3"]
    velocity: Float[Array, "*batch bodies 3"]


def _data(dtype: type = float) -> Any:
    """A field that is structure as data: neither a parameter, nor compiled in."""
    if dtype is int:
        return eqx.field(converter=lambda value: jnp.asarray(value, jnp.int32))
    return eqx.field(converter=as_floating)


class PlanarParameters(Model):
    """Everything that is declared of bodies in the plane; `Planar` says how they move.

    Raises `PalpateError` for arrays that do not fit each other, and links or contacts of bodies,
    parts or walls that do not exist.
    """

    mass: Float[Array, "*batch bodies"] = parameter(
        "kg", prior=LogNormal(15.0, 1.0), spread=0.3, about="mass of the body"
    )
    centre_of_mass: Float[Array, "*batch bodies 2"] = parameter(
        "half extent",
        prior=Normal(0.0, 0.25),
        about="centre of mass from the outline's centroid, in half extents along x and y",
    )
    gyration: Float[Array, "*batch bodies"] = parameter(
        "1",
        prior=LogNormal(1.0, 0.3),
        spread=0.1,
        about="radius of gyration about the centre of mass, in that of the outline filled evenly",
    )
    restitution: Float[Array, "*batch bodies"] = parameter(
        "1",
        prior=Uniform(0.0, 1.0),
        about="speed after an impact per speed before; of two bodies the geometric mean",
    )
    contact_friction: Float[Array, "*batch bodies"] = parameter(
        "1",
        prior=Uniform(0.0, 1.0),
        about="friction where bodies touch; of two bodies the geometric mean",
    )
    floor_friction: Float[Array, "*batch bodies"] = parameter(
        "1",
        prior=LogNormal(0.05, 1.5),
        spread=0.3,
        about="dry friction on the floor per weight of the body",
    )
    floor_damping: Float[Array, "*batch bodies"] = parameter(
        "1/s",
        prior=LogNormal(0.1, 1.5),
        spread=0.3,
        about="viscous friction on the floor per mass: the rate at which a glide fades",
    )
    floor_spread: Float[Array, "*batch bodies"] = parameter(
        "1",
        prior=LogNormal(0.8, 0.2),
        about="where the feet stand that the floor holds, in half extents along x and y",
    )
    wheel_position: Float[Array, "*batch bodies wheels 2"] = parameter(
        "half extent",
        prior=Normal(0.0, 0.6),
        about="where the wheel touches the floor from the centroid, in half extents along x and y",
    )
    wheel_along: Float[Array, "*batch bodies wheels"] = parameter(
        "N",
        prior=LogNormal(5.0, 2.0),
        spread=0.3,
        about="force at which a dry wheel that stands square gives way along the body's x axis; of "
        "a viscous one the force at 1 m/s",
    )
    wheel_across: Float[Array, "*batch bodies wheels"] = parameter(
        "N",
        prior=LogNormal(5.0, 2.0),
        spread=0.3,
        about="as wheel_along, along the body's y axis",
    )
    wheel_shear: Float[Array, "*batch bodies wheels"] = parameter(
        "1",
        prior=Normal(0.0, 1.4),
        about="how the wheel's axes are turned from the body's: the entry off the diagonal of its "
        "friction's logarithm",
    )
    link_anchor: Float[Array, "*batch bodies links 2"] = parameter(
        "half extent",
        prior=Normal(0.0, 0.7),
        about="where a link holds the body, from the centroid in half extents along x and y",
    )
    link_other_anchor: Float[Array, "*batch bodies links 2"] = parameter(
        "half extent",
        prior=Normal(None, 0.7),
        about="where a distance holds the other body, or a point of the world in m; a pivot's "
        "follows from its own anchor",
    )
    # structure
    outline: Float[Array, "*batch bodies parts corners 2"] = _data()
    walls: Float[Array, "*batch walls corners 2"] = _data()
    half_extent: Float[Array, "*batch bodies 2"] = _data()
    even_gyration: Float[Array, "*batch bodies"] = _data()
    bolted: Float[Array, "*batch bodies"] = _data()
    bolted_pose: Float[Array, "*batch bodies 3"] = _data()
    wheel: Float[Array, "*batch bodies wheels"] = _data()
    dry: Float[Array, "*batch bodies wheels"] = _data()
    pivot: Float[Array, "*batch bodies links"] = _data()
    distance: Float[Array, "*batch bodies links"] = _data()
    link_to: Int[Array, "*batch bodies links"] = _data(int)
    link_pose: Float[Array, "*batch bodies links 3"] = _data()
    pairs: Int[Array, "*batch pairs 4"] = _data(int)
    control_period: float = eqx.field(static=True, default=0.02)
    substeps: int = eqx.field(static=True, default=1)
    iterations: int = eqx.field(static=True, default=5)
    overrides: tuple[tuple[str, Parameter], ...] = eqx.field(static=True, default=())

    def __check_init__(self) -> None:
        check_axes(self)
        check_indices(self)

    @property
    def bodies(self) -> int:
        """Number of bodies."""
        return self.mass.shape[-1]
