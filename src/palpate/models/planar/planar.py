"""Rigid bodies in the plane on wheels, pivots and links (physics-based RL, Scholz et al. 2014)."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from palpate.models.planar.checks import coupled_groups
from palpate.models.planar.drawing import drawing
from palpate.models.planar.integration import advance
from palpate.models.planar.links import project_onto_links, turn
from palpate.models.planar.parameters import PlanarParameters, PlanarState
from palpate.models.planar.system import System, links_of, system_of
from palpate.parameters import axes_of


class Planar(PlanarParameters):
    """Rigid bodies in the plane, pushed about on a floor (Scholz et al., ICML 2014).

    An action is a wrench on each body, held for one control period: force (N) in the world's axes
    and torque (N m) about the origin of the body's frame. What resists it:

    - the floor under every body: dry friction at four feet that share its weight, and damping in
      proportion to its mass about its centre of mass. The whole weight counts, whatever wheels
      carry: what rolls on casters has a small floor friction, and a wheel takes its own;
    - wheels, each with a symmetric tensor of friction F: a dry one (`dry` = 1) takes the power
      |F v|, and so gives way along the axes of F at forces that are its eigenvalues, in any other
      direction on the ellipse between them. A viscous one (`dry` = 0, the law of the thesis)
      resists with F v. Both eigenvalues large: a locked caster. One small: a fixed wheel, which
      rolls along that axis;
    - links: a pivot holds a point of the body at a point of the world or of another body, a
      distance keeps two such points as far apart as they are at `link_pose`.

    Lengths that place something on a body are shares of its half width and half depth, so that one
    prior serves a stool and a couch.

    The parameters of a wheel are the entries of the logarithm of F in the body's axes: the
    logarithms of `wheel_along` and `wheel_across` on the diagonal, and `wheel_shear`. So a wheel
    has one set of parameters (an angle and two forces would have two, and no angle where it resists
    alike in all directions). Square to the body the shear is zero and the others are the wheel's
    own forces; `models.planar.wheels` turns those of one that is not.

    Which wheels and links there are, their law, what a link leads to (-1: the world) and which
    bodies are bolted down, at `bolted_pose`, is data: hypotheses about it are a batch axis. Batch
    axes of parameters and structure lead, as those of states and actions do.

    Raises `PalpateError` as `PlanarParameters`.
    """

    @property
    def action_shape(self) -> tuple[int, int]:
        """(bodies, 3): force x and y (N) and torque (N m)."""
        return self.bodies, 3

    @property
    def observation_shape(self) -> tuple[int, int]:
        """(bodies, 3): poses."""
        return self.bodies, 3

    @property
    def observation_units(self) -> tuple[str, str, str]:
        """Of x, y and theta."""
        return "m", "m", "rad"

    def observe(self, state: PlanarState) -> Float[Array, "*batch bodies 3"]:
        """Poses of the bodies."""
        return state.pose

    def drawing(self, observation: Float[Array, "*batch bodies 3"]) -> dict[str, Array]:
        """See `palpate.models.planar.drawing`."""
        return drawing(self, observation)

    def difference(
        self,
        predicted: Float[Array, "*#batch bodies 3"],
        observed: Float[Array, "*#batch bodies 3"],
    ) -> Float[Array, "*_ bodies 3"]:
        """Predicted minus observed poses, angles between -pi and pi."""
        off = predicted - observed
        return off.at[..., 2].set(wrap_angle(off[..., 2]))

    @eqx.filter_jit
    def initial_state(self, observations: Float[Array, "*batch frames bodies 3"]) -> PlanarState:
        """The state at the last of a few frames: on the straight line that fits them best.

        With one frame at rest. Angles may be wrapped or not. Noise s of a pose becomes
        sqrt(12 / n^3) s / period in the velocity of n frames. It is the nearest that is allowed.
        """
        frames = observations.shape[-3]
        last = observations[..., -1, :, :]
        if frames < 2:
            return self._nearest_allowed(PlanarState(last, jnp.zeros_like(last)))
        steps = self.difference(observations[..., 1:, :, :], observations[..., :-1, :, :])
        back = jnp.flip(jnp.cumsum(jnp.flip(steps, axis=-3), axis=-3), axis=-3)
        change = jnp.concatenate([-back, jnp.zeros_like(back[..., :1, :, :])], axis=-3)
        time = self.control_period * jnp.arange(1 - frames, 1, dtype=last.dtype)[:, None, None]
        centred = time - jnp.mean(time)
        slope = jnp.sum(centred * change, axis=-3) / jnp.sum(jnp.square(centred))
        offset = jnp.mean(change, axis=-3) - slope * jnp.mean(time)
        return self._nearest_allowed(PlanarState(last + (offset if frames > 2 else 0.0), slope))

    def step(self, state: PlanarState, action: Float[Array, "*batch bodies 3"]) -> PlanarState:
        """The state one control period later."""
        return self.stepper()(state, action)

    def stepper(self) -> Callable[[PlanarState, Array], PlanarState]:
        if self.link_to.shape[-1] or self.pairs.shape[-2]:
            return self._step_each
        leaves, structure = jax.tree.flatten(self)
        axes = _AXES[: len(leaves)]
        own = _side_by_side(leaves, axes)
        system = system_of(jax.tree.unflatten(structure, own))
        batched = any(leaf.ndim > count for leaf, count in zip(leaves, axes, strict=True))

        def step(state: PlanarState, action: Array) -> PlanarState:
            given = state.pose, state.velocity, action
            after = self._advance(system, *_side_by_side(given, [2, 2, 2], own[0].shape[-1]))
            if batched or any(leaf.ndim > 2 for leaf in given):
                return PlanarState(*(jnp.moveaxis(leaf, -1, 0) for leaf in after))
            return PlanarState(*(leaf[..., 0] for leaf in after))

        return step

    @property
    def correction_shape(self) -> tuple[int, int]:
        """(bodies, 3): see `models.residual.Correctable`."""
        return self.bodies, 3

    @property
    def correction_neighbours(self) -> Int[np.ndarray, "bodies 1 1"]:
        """Each body sees itself alone: how bodies act on each other is left to the physics."""
        return np.arange(self.bodies)[:, None, None]

    def residual_features(
        self, state: PlanarState, action: Float[Array, "*batch bodies 3"]
    ) -> Float[Array, "*batch bodies 6"]:
        """Velocity and wrench of each body in its own axes: m/s, m/s, rad/s, N, N, N m."""
        own = [rotate(each, -state.pose[..., 2]) for each in (state.velocity, action)]
        return jnp.concatenate(own, axis=-1)

    def corrected(
        self, state: PlanarState, correction: Float[Array, "*batch bodies 3"]
    ) -> PlanarState:
        """The state with velocities added to what is not bolted.

        In m/s along each body's own axes, and in m/s at `even_gyration` from its origin.
        """
        turning = correction[..., 2] / self.even_gyration
        added = rotate(correction.at[..., 2].set(turning), state.pose[..., 2])
        return PlanarState(state.pose, state.velocity + (1.0 - self.bolted[..., None]) * added)

    def correction_between(
        self, state: PlanarState, following: PlanarState
    ) -> Float[Array, "*batch bodies 3"]:
        """Change of the velocities of what is not bolted, as `corrected` adds them."""
        change = (1.0 - self.bolted[..., None]) * (following.velocity - state.velocity)
        change = rotate(change, -state.pose[..., 2])
        return change.at[..., 2].set(change[..., 2] * self.even_gyration)

    def independent_parts(self) -> tuple[tuple["Planar", tuple[int, ...]], ...]:
        """Groups of bodies that no link and no contact couples; without links, no room for them."""
        groups = coupled_groups(self)
        return tuple((self._only(of) if len(groups) > 1 else self, of) for of in groups)

    def _only(self, group: tuple[int, ...]) -> "Planar":
        """The model of a group of bodies that nothing couples to others."""
        rows, number = np.array(group), np.full(self.bodies, -1)
        number[rows] = np.arange(len(group))
        own = [name for name, axes in axes_of(Planar).items() if axes[0] == "bodies"]
        parts = {name: getattr(self, name)[rows] for name in own}
        to = np.asarray(parts["link_to"])
        parts["link_to"] = np.where(to < 0, to, number[to])
        if not np.any(np.asarray(parts["pivot"])) and not np.any(np.asarray(parts["distance"])):
            linked = [name for name in parts if "links" in axes_of(Planar)[name]]
            parts |= {name: parts[name][:, :0] for name in linked}
        pairs = np.asarray(self.pairs)
        pairs = pairs[np.isin(pairs[:, 0], rows)].copy()
        pairs[:, 0] = number[pairs[:, 0]]
        pairs[:, 2] = np.where(pairs[:, 2] < 0, -1, number[pairs[:, 2]])
        return dataclasses.replace(self, pairs=pairs, **parts)

    def linked_at(self, poses: Float[Array, "bodies 3"]) -> "Planar":
        """The model whose links hold as they stand at these poses."""
        poses = jnp.asarray(poses, self.link_pose.dtype)
        other = poses[self.link_to]
        own = jnp.broadcast_to(poses[:, None], other.shape)
        cosine, sine = jnp.cos(other[..., 2]), -jnp.sin(other[..., 2])
        offset = own - other
        x, y = turn(offset[..., 0], offset[..., 1], cosine, sine)
        relative = jnp.stack([x, y, offset[..., 2]], axis=-1)
        to_world = (self.link_to < 0)[..., None]
        return dataclasses.replace(self, link_pose=jnp.where(to_world, own, relative))

    def _step_each(self, state: PlanarState, action: Array) -> PlanarState:
        """`step` of bodies that links or contacts couple."""

        def step(model: Planar, state: PlanarState, action: Array) -> tuple[Array, Array]:
            return model._advance(system_of(model), state.pose, state.velocity, action)

        return _one_by_one(step, self, state, action)

    def _nearest_allowed(self, state: PlanarState) -> PlanarState:
        """The nearest state that bolts and links allow."""
        stands = self.bolted[..., None] > 0.0
        pose = jnp.where(stands, self.bolted_pose, state.pose)
        state = PlanarState(pose, jnp.where(stands, 0.0, state.velocity))

        def nearest(model: Planar, state: PlanarState) -> tuple[Array, Array]:
            links, loose = links_of(model), 1.0 - model.bolted
            return project_onto_links(links, model.even_gyration, loose, state.pose, state.velocity)

        return _one_by_one(nearest, self, state) if self.link_to.shape[-1] else state

    def _advance(
        self, system: System, pose: Array, velocity: Array, wrench: Array
    ) -> tuple[Array, Array]:
        """Poses and rates one control period later, (bodies, 3) and then lanes, if any."""
        time_step = self.control_period / self.substeps

        def advanced(state: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
            return advance(system, *state, wrench, time_step, self.iterations), None

        state = pose, system.loose[:, None] * velocity
        if self.substeps == 1:
            return advanced(state, None)[0]
        return jax.lax.scan(advanced, state, length=self.substeps)[0]


def _one_by_one(function: Callable[..., tuple[Array, Array]], *given: Any) -> PlanarState:
    """A function of a model, a state and an action at most: what batch there is, one by one."""
    leaves, structure = jax.tree.flatten(given)
    batched = [leaf.ndim > axes for leaf, axes in zip(leaves, _AXES, strict=False)]

    def one(*leaves: Array) -> PlanarState:
        return PlanarState(*function(*jax.tree.unflatten(structure, leaves)))

    if not any(batched):
        return one(*leaves)
    return jax.vmap(one, in_axes=[0 if axis else None for axis in batched])(*leaves)


def _side_by_side(arrays: Sequence[Array], axes: Sequence[int], lanes: int = 1) -> list[Array]:
    """Arrays of so many axes without a batch's, with the batch axis last, of one length in all.

    What lies last is taken together by a processor's vectors, and bodies have few elements.
    """
    last = [
        jnp.moveaxis(array, 0, -1) if array.ndim > count else array[..., None]
        for array, count in zip(arrays, axes, strict=True)
    ]
    lanes = max(lanes, *(array.shape[-1] for array in last))
    return [jnp.broadcast_to(array, (*array.shape[:-1], lanes)) for array in last]


def rotate(vectors: Array, angle: Array) -> Array:
    """(..., 2 or 3) points, velocities or wrenches after their body was turned by an angle."""
    x, y = turn(vectors[..., 0], vectors[..., 1], jnp.cos(angle), jnp.sin(angle))
    rest = jnp.broadcast_to(vectors[..., 2:], (*x.shape, vectors.shape[-1] - 2))
    return jnp.concatenate([jnp.stack([x, y], axis=-1), rest], axis=-1)


def wrap_angle(angle: Array) -> Array:
    """The angle between -pi and pi that points the same way."""
    return angle - 2.0 * jnp.pi * jnp.round(angle / (2.0 * jnp.pi))


_AXES = [*(len(axes) for kind in (Planar, PlanarState) for axes in axes_of(kind).values()), 2]
