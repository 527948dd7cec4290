"""What a rope is made of: its parameters, and how many elements each of them has."""

from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from palpate.errors import PalpateError
from palpate.family import check_name
from palpate.models.model import Model
from palpate.parameters import LogNormal, Normal, Parameter, axes_of, parameter


class RopeState(eqx.Module):
    """Node positions (m, world frame) and velocities (m/s), from the first driven end."""

    position: Float[Array, "*batch nodes 3"]
    velocity: Float[Array, "*batch nodes 3"]


class RopeParameters(Model):
    """Everything that is declared of a rope; `Rope` says how it moves.

    Raises `PalpateError` for arrays whose elements do not fit each other.
    """

    node_mass: Float[Array, "*batch nodes"] = parameter(
        "kg",
        prior=LogNormal(None, 0.3),
        spread=0.25,
        fixed=True,
        about="mass of each node; without force data only the other parameters per mass are seen",
    )
    rest_length: Float[Array, "*batch segments"] = parameter(
        "m", prior=LogNormal(None, 0.03), spread=0.1, about="length of each segment at rest"
    )
    stretch_stiffness: Float[Array, "*batch segments"] = parameter(
        "N/m",
        prior=LogNormal(1e3, 1.0),
        about="tension per metre of stretch; a stiff rope's is bounded by the time step",
    )
    stretch_damping: Float[Array, "*batch segments"] = parameter(
        "N s/m", prior=LogNormal(1e-1, 1.0), about="tension per rate of stretch"
    )
    bend_stiffness: Float[Array, "*batch joints"] = parameter(
        "N m/rad",
        prior=LogNormal(1e-2, 1.5),
        spread=0.5,
        about="restoring torque per radian between neighbouring segments",
    )
    bend_damping: Float[Array, "*batch joints"] = parameter(
        "N m s/rad",
        prior=LogNormal(5e-4, 1.5),
        spread=0.5,
        about="torque against the rate of bending",
    )
    twist_stiffness: Float[Array, "*batch torsions"] = parameter(
        "N m/rad",
        prior=LogNormal(1e-5, 1.0),
        spread=0.5,
        about="torque per radian between the planes of neighbouring joints",
    )
    grip_stiffness: Float[Array, "*batch"] = parameter(
        "N m/rad",
        prior=LogNormal(1e-5, 1.5),
        spread=0.5,
        about="torque per radian by which a grip at node 0 turns the first segment down",
    )
    grip_damping: Float[Array, "*batch"] = parameter(
        "N m s/rad",
        prior=LogNormal(1e-4, 1.5),
        spread=0.5,
        about="torque of a grip at node 0 against turning of the first segment",
    )
    air_drag: Float[Array, "*batch"] = parameter(
        "N s/m",
        prior=LogNormal(1e-3, 1.5),
        spread=0.5,
        about="drag force per node and velocity, linear part",
    )
    quadratic_drag: Float[Array, "*batch"] = parameter(
        "N s^2/m^2",
        prior=LogNormal(1e-4, 1.5),
        spread=0.5,
        about="drag force per node and squared velocity",
    )
    gravity: Float[Array, "*batch"] = parameter(
        "m/s^2",
        prior=Normal(9.81, 0.3),
        about="acceleration of free fall; identified, it also absorbs what the model leaves out",
    )
    rest_bend: Float[Array, "*batch joints 3"] = parameter(
        "rad",
        prior=Normal(0.0, 0.15),
        fixed=True,
        about="bend at rest along the chord between the ends, across it, and up; ignored unless "
        "both ends are driven",
    )
    driven: tuple[int, ...] = eqx.field(static=True, default=(0,))
    drive: Literal["position", "velocity", "acceleration"] = eqx.field(
        static=True, default="velocity"
    )
    control_period: float = eqx.field(static=True, default=0.01)
    substeps: int = eqx.field(static=True, default=10)
    overrides: tuple[tuple[str, Parameter], ...] = eqx.field(static=True, default=())

    def __check_init__(self) -> None:
        nodes = self.nodes
        expected = {"rest_length": nodes - 1} | self._elements(nodes)
        if nodes < 4:
            raise PalpateError(f"a rope needs at least 4 nodes, got {nodes}")
        for name, count in expected.items():
            shape = getattr(self, name).shape
            if count and shape[-1:] != (count,):
                raise PalpateError(
                    f"{name} of a rope of {nodes} nodes must have {count} elements, "
                    f"got shape {shape}"
                )
        if self.rest_bend.shape[-2:] != (nodes - 2, 3):
            raise PalpateError(
                f"rest_bend of a rope of {nodes} nodes must have the shape ({nodes - 2}, 3), "
                f"got {self.rest_bend.shape}"
            )
        check_name("drive", self.drive, ("position", "velocity", "acceleration"))
        if not self.driven or any(not 0 <= node < nodes for node in self.driven):
            raise PalpateError(
                f"driven nodes must lie in 0 to {nodes - 1} and be at least one, got {self.driven}"
            )
        if len(set(self.driven)) < len(self.driven):
            raise PalpateError(f"driven nodes must differ from each other, got {self.driven}")
        if self.substeps < 1 or not self.control_period > 0:
            raise PalpateError(
                "a rope needs at least one time step in a positive control period, "
                f"got {self.substeps} in {self.control_period} s"
            )

    @staticmethod
    def _elements(nodes: int) -> dict[str, int]:
        """How many elements each of the remaining parameters has; 0: one number for the rope."""
        missing = {"segments": 1, "joints": 2, "torsions": 3}
        counts = {}
        for name, axes in axes_of(RopeParameters).items():
            if name not in ("node_mass", "rest_length", "rest_bend"):
                counts[name] = nodes - missing[axes[0]] if axes else 0
        return counts

    @property
    def nodes(self) -> int:
        """Number of nodes, N + 1."""
        return self.node_mass.shape[-1]

    @property
    def time_step(self) -> float:
        """Integration time step, s."""
        return self.control_period / self.substeps

    @property
    def held_at_both_ends(self) -> bool:
        """Whether the first and the last node are driven."""
        return 0 in self.driven and self.nodes - 1 in self.driven

    def free_nodes(self) -> Float[Array, " nodes"]:
        """One for each node that forces move, zero for the driven ones."""
        free = np.ones(self.nodes)
        free[list(self.driven)] = 0.0
        return jnp.asarray(free, self.node_mass.dtype)
