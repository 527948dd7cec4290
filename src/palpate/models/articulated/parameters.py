"""What a tree of links is: its parameters, and its structure as data."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from palpate.errors import PalpateError
from palpate.models.model import Model
from palpate.parameters import LogNormal, Normal, Parameter, as_floating, axes_of, parameter

Each = Float[Array, "*batch links"]
Vectors = Float[Array, "*batch links 3"]
Matrices = Float[Array, "*batch links 3 3"]

# Of a hinge or of a slide.
FORCE, DAMPING, STIFFNESS = "N m or N", "N m s or N s/m", "N m/rad or N/m"


class ArticulatedState(eqx.Module):
    """Position of each joint (rad or m, from where the tree was described) and its rate."""

    position: Each
    velocity: Each


def _data(dtype: type = float) -> Any:
    """A field that is structure as data: neither a parameter, nor compiled in."""
    if dtype is int:
        return eqx.field(converter=lambda value: jnp.asarray(value, jnp.int32))
    return eqx.field(converter=as_floating)


class TreeParameters(Model):
    """Everything that is declared of a tree of links; `Articulated` says how it moves.

    Link i hangs on its `parent` (a lower number, -1 for the world) by one joint, whose frame the
    parent carries at `origin` (m) and `rotation`, and along whose `axis` it turns (`revolute` is
    one) or slides (`prismatic` is one); it is fixed where both are zero. A link's own frame is the
    joint's, moved. `solid` is zero for a link that has no mass, whatever `mass` says: those between
    the joints of one link, and those that only fill up a size, which are fixed too.

    Raises `PalpateError` for arrays that do not fit each other, and a parent that comes after.
    """

    mass: Each = parameter("kg", prior=LogNormal(None, 0.7), spread=0.3, about="of the link")
    centre_of_mass: Vectors = parameter(
        "m", prior=Normal(None, 0.03), about="of the link, in its frame"
    )
    gyration: Each = parameter(
        "1",
        prior=LogNormal(1.0, 0.2),
        spread=0.1,
        about="radii of gyration about the centre of mass, in those of the link's shape",
    )
    damping: Each = parameter(
        DAMPING,
        prior=LogNormal(0.1, 1.5),
        spread=0.3,
        about="viscous friction of the joint",
    )
    friction: Each = parameter(
        FORCE, prior=LogNormal(0.1, 1.5), spread=0.3, about="dry friction of the joint"
    )
    stiffness: Each = parameter(
        STIFFNESS,
        prior=LogNormal(0.1, 2.0),
        fixed=True,
        about="of a spring at the joint",
    )
    rest: Each = parameter(
        "rad or m", prior=Normal(None, 0.5), fixed=True, about="where that spring is at rest"
    )
    lower: Each = parameter(
        "rad or m", prior=Normal(None, 0.02), fixed=True, about="where the joint's range begins"
    )
    upper: Each = parameter(
        "rad or m", prior=Normal(None, 0.02), fixed=True, about="where the joint's range ends"
    )
    stop_stiffness: Each = parameter(
        STIFFNESS,
        prior=LogNormal(1e3, 1.5),
        fixed=True,
        about="of the stops at both ends",
    )
    stop_damping: Each = parameter(
        DAMPING,
        prior=LogNormal(10.0, 1.5),
        fixed=True,
        about="of the stops, while a link runs into them",
    )
    armature: Each = parameter(
        "kg m^2 or kg", prior=LogNormal(0.01, 1.0), fixed=True, about="inertia of a geared motor"
    )
    # structure
    solid: Each = _data()
    shape_inertia: Matrices = _data()
    parent: Int[Array, "*batch links"] = _data(int)
    rotation: Matrices = _data()
    origin: Vectors = _data()
    axis: Vectors = _data()
    revolute: Each = _data()
    prismatic: Each = _data()
    gravity: Float[Array, "*batch 3"] = _data()
    control_period: float = eqx.field(static=True, default=0.02)
    substeps: int = eqx.field(static=True, default=10)
    resisted: bool = eqx.field(static=True, default=True)
    slip: float = eqx.field(static=True, default=1e-3)
    overrides: tuple[tuple[str, Parameter], ...] = eqx.field(static=True, default=())

    def __check_init__(self) -> None:
        links = getattr(self.parent, "shape", None)
        if not links:  # a tree of something else
            return
        for name, axis in _LINKS_AXIS.items():
            shape = getattr(getattr(self, name), "shape", None)
            if shape is not None and (len(shape) < axis or shape[-axis] != links[-1]):
                raise PalpateError(
                    f"'{name}' has the shape {shape}: expected as many links as 'parent' has, "
                    f"{links[-1]}"
                )

    @property
    def links(self) -> int:
        """Number of links, those included that only fill up a size."""
        return self.parent.shape[-1]


# Which axis from the last is that of the links.
_LINKS_AXIS = {
    name: len(axes) for name, axes in axes_of(TreeParameters).items() if axes[:1] == ["links"]
}
