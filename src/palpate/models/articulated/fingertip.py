"""A tree of links that a fingertip presses: where the finger goes is the action, not its force."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from palpate.errors import PalpateError
from palpate.models.articulated.articulated import Articulated
from palpate.models.articulated.kinematics import poses
from palpate.models.articulated.lanes import lanes_first, lanes_last
from palpate.models.articulated.parameters import ArticulatedState
from palpate.models.articulated.touch import Face, Tip, touch_of
from palpate.models.model import Wrapper
from palpate.parameters import LogNormal, Parameter, as_floating, parameter, parameters_of

Number = Float[Array, "*batch"]


class Fingertip(Wrapper):
    """The tree `inner`, pressed by a compliant fingertip on one flat face of a link.

    The face goes through `place` (m) and its outward `normal` (of length one), both in the frame of
    the link number `link`. An action (6,) is where the finger is when a control period begins (m)
    and how fast it moves in it (m/s), in the world's axes; the tree's own joints have no torques.
    The face is a plane without an end or a back: a finger beyond an edge still presses.

    A finger that is d within the face, with d growing at d', presses with max(0, k d + c d'), and
    rubs with Coulomb's friction against the sliding of its point, 0.7 of it at `inner.slip` m/s.
    Stiffness and damping are those of finger, hand and face in series.

    Parameters of the tree are declared by it, as `inner.mass`. Observed are joint positions.
    """

    inner: Articulated
    place: Float[Array, "3"] = eqx.field(converter=as_floating)
    normal: Float[Array, "3"] = eqx.field(converter=as_floating)
    link: int = eqx.field(static=True)
    stiffness: Number = parameter("N/m", prior=LogNormal(1e3, 1.5), about="of finger and face")
    damping: Number = parameter("N s/m", prior=LogNormal(10.0, 1.5), about="of finger and face")
    friction: Number = parameter("1", prior=LogNormal(0.5, 0.5), about="between finger and face")
    overrides: tuple[tuple[str, Parameter], ...] = eqx.field(static=True, default=())

    @property
    def action_shape(self) -> tuple[int]:
        """(6,): position (m) and velocity (m/s) of the finger."""
        return (6,)

    @property
    def control_period(self) -> float:
        """That of the tree, s."""
        return self.inner.control_period

    def step(self, state: ArticulatedState, action: Array) -> ArticulatedState:
        return self.stepper()(state, action)

    def stepper(self) -> Callable[[ArticulatedState, Array], ArticulatedState]:
        advance = self.inner.period_stepper(self.face())

        def step(state: ArticulatedState, action: Array) -> ArticulatedState:
            none = jnp.zeros_like(lanes_last(state.position, 1))
            return advance(state, none, tip=_tip(action))

        return step

    def face(self) -> Face:
        """Its face, as a step uses it."""
        one = jnp.zeros(self.inner.links, self.place.dtype).at[self.link].set(1.0)
        yields = (lanes_last(one, 0) for one in (self.stiffness, self.damping, self.friction))
        return Face(one, lanes_last(self.place, 1), lanes_last(self.normal, 1), *yields)

    @eqx.filter_jit
    def force(self, state: ArticulatedState, action: Array) -> Float[Array, "*batch 3"]:
        """What the finger exerts on the link when a control period begins, N, in the world."""
        system, face = self.inner.system(), self.face()
        pose = poses(system.joints, lanes_last(state.position, 1))
        touch = touch_of(face, _tip(action), system.joints, pose, system.carried)
        deeper, sliding = touch.motion(lanes_last(state.velocity, 1))
        force = touch.pressing(deeper, 0.0)
        speed = jnp.sqrt(jnp.sum(jnp.square(sliding), axis=0) + self.inner.slip**2)
        found = -touch.normal * force - touch.face.friction * force / speed * sliding
        return lanes_first(found, state.position.ndim == 1)

    def constrain(self) -> "Fingertip":
        return eqx.tree_at(lambda one: one.inner, self, self.inner.constrain())


def with_fingertip(
    tree: Articulated,
    link: int,
    place: Sequence[float],
    normal: Sequence[float],
    **values: float,
) -> Fingertip:
    """The tree with a finger at `place` (m) of a face whose outward normal is `normal`.

    Both are in the frame of the link of that number. `values` are `stiffness` (N/m), `damping`
    (N s/m) and `friction`, else their priors' medians.

    Raises `PalpateError` for a link that is not there, a normal without a direction, values that
    are unknown, negative or not finite, and trees that differ in structure.
    """
    if tree.parent.ndim != 1:
        raise PalpateError("a fingertip presses trees of one structure, not several")
    if not 0 <= link < tree.links:
        raise PalpateError(f"there is no link {link}: expected one of 0 to {tree.links - 1}")
    outward, point = np.asarray(normal, float), np.asarray(place, float)
    size = float(np.linalg.norm(outward))
    if outward.shape != (3,) or point.shape != (3,) or not np.isfinite(point).all():
        raise PalpateError(f"a face is a point and a normal of 3 numbers, not {place} and {normal}")
    if not 0.0 < size < np.inf:
        raise PalpateError(f"the normal of a face has a direction, not {normal}")
    fields: dict[str, Any] = {
        name: declared.prior.centre for name, declared in parameters_of(Fingertip).items()
    }
    if unknown := sorted(values.keys() - fields.keys()):
        raise PalpateError(f"a fingertip has no {unknown[0]}; it has {', '.join(fields)}")
    for name, value in values.items():
        if not 0.0 <= value < np.inf:
            raise PalpateError(f"the {name} of a fingertip is at least 0, not {value}")
    fields |= {"place": point, "normal": outward / size, "link": link} | values
    return Fingertip(inner=tree, **fields)


def _tip(action: Float[Array, "*batch 6"]) -> Tip:
    laned = lanes_last(action, 1)
    return Tip(laned[:3], laned[3:])
