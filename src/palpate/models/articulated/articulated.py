"""Trees of rigid links, whose joints damp, rub, spring and stop."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.ad_checkpoint import checkpoint_name
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from palpate.models.articulated import integration
from palpate.models.articulated.dynamics import Bodies, in_world, motion
from palpate.models.articulated.integration import Resistance, System
from palpate.models.articulated.kinematics import (
    axial,
    carriers,
    fields,
    joints_of,
    outer,
    poses,
)
from palpate.models.articulated.lanes import in_blocks, lanes_first, lanes_last
from palpate.models.articulated.parameters import ArticulatedState, TreeParameters
from palpate.models.articulated.touch import Face, Tip
from palpate.models.model import KEPT

ACTION = 7  # of a link: torque or force of its joint, a force on it, and where


class Articulated(TreeParameters):
    """A tree of rigid links in the world, one joint each: what `TreeParameters` declares, moving.

    An action is, for each link and for one control period, the torque (N m) or force (N) of its
    joint, a force on the link (N, in the world's axes) and the point of the link's frame (m) where
    it acts. Joint positions are observed. Dynamics as in `dynamics`, steps as in `integration`,
    `substeps` of them in a control period; `resisted` says whether any joint has dry friction or a
    stop: without, a step costs a third. A free body is a link on six joints in a row, see
    `free_links`.

    Batch axes lead everywhere: parameters and states of a batch of trees lie side by side. The
    structure has a batch axis where the trees differ in it. What is no step is compiled by itself.
    """

    @property
    def action_shape(self) -> tuple[int, int]:
        """(links, 7): of the joint, of the force on the link x y z, and of its point x y z."""
        return self.links, ACTION

    @property
    def observation_shape(self) -> tuple[int]:
        """(links,): joint positions."""
        return (self.links,)

    @property
    def observation_units(self) -> tuple[str, ...]:
        """rad of a hinge, m of a slide; of a batch those of the first tree."""
        if isinstance(self.prismatic, Tracer):  # compiled code has no use for words
            return super().observation_units
        slides = np.asarray(self.prismatic).reshape(-1, self.links)[0]
        return tuple("m" if slide else "rad" for slide in slides)

    def step(self, state: ArticulatedState, action: Array) -> ArticulatedState:
        return self.stepper()(state, action)

    def stepper(self) -> Callable[[ArticulatedState, Array], ArticulatedState]:
        if self.parent.ndim > 1:
            return self._one_by_one
        advance = self.period_stepper()
        return lambda state, action: advance(state, *_forces(action))

    def period_stepper(self, face: Face | None = None) -> Callable[..., ArticulatedState]:
        """What moves a state over a control period, by torques, pushes and a `Tip`.

        Torques, pushes and the tip have their lanes last, as in `integration`; pushes and the tip
        may be None. The tip is where it is when the period begins, and may touch `face`.
        """
        system = self.system()
        time_step = self.control_period / self.substeps

        def advanced(shared: tuple[System, Face | None], own: Any) -> tuple[Array, Array]:
            """Positions and velocities a control period later, lanes last."""
            system, face = shared
            position, velocity, torque, push, tip = own

            def once(carry: Any) -> Any:
                position, velocity, tip = carry
                finger = None if face is None else (face, tip)
                following = integration.advance(
                    system, position, velocity, torque, push, time_step,
                    resisted=self.resisted, slip=self.slip, finger=finger,
                )  # fmt: skip
                if tip is not None:
                    tip = Tip(tip.position + time_step * tip.velocity, tip.velocity)
                return (*following, tip)

            # the inside of a time step is computed again on the way back: keeping it costs more
            again = jax.checkpoint(once, prevent_cse=False)

            def kept(carry: Any, _: None) -> tuple[Any, None]:
                # where each step begins is kept: else a rollout would compute all steps once more
                return again(jax.tree.map(lambda part: checkpoint_name(part, KEPT), carry)), None

            return jax.lax.scan(kept, (position, velocity, tip), None, length=self.substeps)[0][:2]

        def step(
            state: ArticulatedState,
            torque: Array,
            push: tuple[Array, Array] | None = None,
            tip: Tip | None = None,
        ) -> ArticulatedState:
            own = (lanes_last(state.position, 1), lanes_last(state.velocity, 1), torque, push, tip)
            found = in_blocks(advanced, (system, face), own)
            return ArticulatedState(
                *(lanes_first(part, state.position.ndim == 1) for part in found)
            )

        return step

    def _one_by_one(self, state: ArticulatedState, action: Array) -> ArticulatedState:
        """The step of trees that differ in structure, one axis of a batch."""
        axes = jax.tree.map(lambda leaf: 0 if leaf.ndim > 1 else None, self)
        return jax.vmap(type(self).step, in_axes=(axes, 0, 0))(self, state, action)

    def system(self) -> System:
        """Its parameters as a step uses them: lanes last, one of them where there is no batch."""
        mass = lanes_last(self.mass * self.solid, 1)
        centre, unit = lanes_last(self.centre_of_mass, 2), lanes_last(self.shape_inertia, 3)
        inertia = (mass * jnp.square(lanes_last(self.gyration, 1)))[:, None, None] * unit
        trace = inertia[:, 0, 0] + inertia[:, 1, 1] + inertia[:, 2, 2]
        identity = jnp.eye(3, dtype=mass.dtype)[None, :, :, None]
        first = mass[:, None] * centre
        revolute, prismatic = lanes_last(self.revolute, 1), lanes_last(self.prismatic, 1)
        resistance = (lanes_last(getattr(self, name), 1) for name in Resistance._fields)
        return System(
            joints=joints_of(
                self.parent,
                lanes_last(self.rotation, 3),
                lanes_last(self.origin, 2),
                lanes_last(self.axis, 2),
                revolute,
                prismatic,
            ),
            bodies=Bodies(
                mass,
                first,
                0.5 * trace[:, None, None] * identity - inertia + outer(first, centre),
            ),
            resistance=Resistance(*resistance),
            carried=carriers(self.parent, mass.dtype),
            gravity=lanes_last(self.gravity, 1),
            fixed=1.0 - revolute - prismatic,
        )

    @eqx.filter_jit
    def acceleration(self, state: ArticulatedState, action: Array) -> Float[Array, "*batch links"]:
        """Of the joints (rad/s^2 or m/s^2), without dry friction and stops."""
        torque, push = _forces(action)
        position, velocity = lanes_last(state.position, 1), lanes_last(state.velocity, 1)
        found = integration.acceleration(self.system(), position, velocity, torque, push)
        return lanes_first(found, state.position.ndim == 1)

    @eqx.filter_jit
    def energy(self, state: ArticulatedState) -> Float[Array, "*batch"]:
        """Kinetic energy, and that in gravity (zero at the world's origin) and springs, J."""
        system = self.system()
        position, velocity = lanes_last(state.position, 1), lanes_last(state.velocity, 1)
        joints, bodies, resistance = system.joints, system.bodies, system.resistance
        still = jnp.zeros_like(velocity)
        now = motion(joints, bodies, system.carried, system.gravity, position, still)
        moving = jnp.sum(now.matrix * velocity[None, :] * velocity[:, None], axis=(0, 1))
        moving = moving + jnp.sum(resistance.armature * jnp.square(velocity), axis=0)
        stretched = position - resistance.rest
        springs = jnp.sum(resistance.stiffness * jnp.square(stretched), axis=0)
        first = in_world(bodies, now.pose)[1]
        lifted = -jnp.sum(first * system.gravity, axis=(0, 1))
        total = 0.5 * (moving + springs) + lifted
        return total[0] if state.position.ndim == 1 else total

    @eqx.filter_jit
    def link_poses(
        self, position: Float[Array, "*batch links"]
    ) -> tuple[Float[Array, "*batch links 3 3"], Float[Array, "*batch links 3"]]:
        """World from link: rotations and origins (m) of the links' frames."""
        pose = poses(self.system().joints, lanes_last(position, 1))
        single = position.ndim == 1
        return lanes_first(pose.matrix, single), lanes_first(pose.vector, single)

    @eqx.filter_jit
    def screws(self, position: Float[Array, "*batch links"]) -> Float[Array, "*batch links 6"]:
        """Twist of the links that each joint carries per rad/s or m/s: angular, then linear.

        In the world's axes, at the world's origin.
        """
        joints = self.system().joints
        field = fields(joints, poses(joints, lanes_last(position, 1)))
        found = jnp.concatenate([axial(field.matrix), field.vector], axis=1)
        return lanes_first(found, position.ndim == 1)

    def observe(self, state: ArticulatedState) -> Float[Array, "*batch links"]:
        """Joint positions, rad or m."""
        return state.position

    def initial_state(self, observations: Float[Array, "*batch frames links"]) -> ArticulatedState:
        """At the last of a few frames, with the velocity between the last two; of one at rest."""
        last, before = observations[..., -1, :], observations[..., -2:, :][..., 0, :]
        return ArticulatedState(last, (last - before) / self.control_period)

    def velocity(self, state: ArticulatedState) -> Float[Array, "*batch links"]:
        """Of the joints, rad/s or m/s."""
        return state.velocity

    @property
    def correction_shape(self) -> tuple[int, int]:
        """(links, 1): see `models.residual.Correctable`."""
        return self.links, 1

    @property
    def correction_neighbours(self) -> Int[np.ndarray, "links 1 1"]:
        """Each joint sees itself alone: how links act on each other is left to the physics."""
        return np.arange(self.links)[:, None, None]

    def residual_features(
        self, state: ArticulatedState, action: Float[Array, "*batch links 7"]
    ) -> Float[Array, "*batch links 3"]:
        """Position and velocity of each joint, and what the action does there: N m or N."""
        given = self.joint_forces(state.position, action)
        return jnp.stack([state.position, state.velocity, given], axis=-1)

    def corrected(
        self, state: ArticulatedState, correction: Float[Array, "*batch links 1"]
    ) -> ArticulatedState:
        """The state with velocities (rad/s or m/s) added to what a joint moves."""
        moves = self.revolute + self.prismatic
        return ArticulatedState(state.position, state.velocity + moves * correction[..., 0])

    def correction_between(
        self, state: ArticulatedState, following: ArticulatedState
    ) -> Float[Array, "*batch links 1"]:
        """Change of the joints' velocities."""
        moves = self.revolute + self.prismatic
        return (moves * (following.velocity - state.velocity))[..., None]

    def joint_forces(
        self, position: Float[Array, "*batch links"], action: Float[Array, "*batch links 7"]
    ) -> Float[Array, "*batch links"]:
        """What an action comes to at each joint, N m or N: by the principle of virtual power."""
        rotation, origin = self.link_poses(position)
        push = action[..., 1:4]
        point = origin + jnp.einsum("...ij,...j->...i", rotation, action[..., 4:])
        wrench = jnp.concatenate([jnp.cross(point, push), push], axis=-1)
        carried = carriers(self.parent, wrench.dtype)
        on_joint = jnp.einsum("lj,...lk->...jk", carried, wrench)
        return action[..., 0] + jnp.sum(self.screws(position) * on_joint, axis=-1)


def _forces(action: Array) -> tuple[Array, tuple[Array, Array]]:
    """Of the joints, and on the links: force and point."""
    laned = lanes_last(action, 2)
    return laned[:, 0], (laned[:, 1:4], laned[:, 4:])
