"""Bring a swinging rope to rest by moving its end (SPiD, Long et al., arXiv 2602.03623)."""

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from palpate.errors import PalpateError
from palpate.models.model import rollout
from palpate.models.rope import Rope, RopeState
from palpate.networks import Channel
from palpate.tasks.task import Start, Task

STABILISED = 0.01  # of the start's energy: the seed's bar
STAY = 1.0  # s that the energy has to stay below it
AT_REST = 0.05  # m/s, the gripper's mean speed in the last second of a success
LEAST_ENERGY = 0.02  # of mass x gravity x length: a start that is all but at rest counts as this

FIRST_ROOT = 1.2024  # of J0(2 x): a hanging chain's first frequency is 1.2024 sqrt(g / L)

MOTION = 3.0  # s of random gripper motion, of which the last part is free swing
STATES_PER_MOTION = 16

_HANGING = np.array([0.0, 0.0, -1.0], np.float32)


class HangingRopeTask(Task):
    """A task for a rope that hangs from a gripper: what is seen of it, and its symmetries.

    The model is driven by `velocity` at its first node.
    """

    goal_features: ClassVar[int] = 0  # of `features`: what is seen of the goal
    action_name: ClassVar[str] = "gripper velocity"
    action_unit: ClassVar[str] = "m/s"
    action_limit: float = eqx.field(static=True, default=1.5)  # m/s
    action_rate_limit: float = eqx.field(static=True, default=10.0)  # m/s^2

    def check_driven(self, model: Rope) -> None:
        """Raise `PalpateError` when the rope is not driven by velocity at its first node."""
        if model.driven != (0,) or model.drive != "velocity":
            raise PalpateError(
                f"{self.name} needs a rope driven by velocity at node 0, "
                f"got one driven by {model.drive} at {model.driven}"
            )

    def augment(self, start: Start, key: PRNGKeyArray) -> Start:
        """Turned about the vertical through any angle, and mirrored or not in a vertical plane.

        With translations these are all symmetries that gravity leaves. Translations need not be
        drawn: the features do not say where the gripper is, so all of them look the same.
        """
        count = start.command.shape[0]
        for_angle, for_mirror = jax.random.split(key)
        angle = jax.random.uniform(for_angle, (count,), maxval=2 * jnp.pi)
        mirror = jax.random.rademacher(for_mirror, (count,), angle.dtype)
        move = vertical_symmetry(angle, mirror)

        def moved(vectors: Array) -> Array:
            return jnp.einsum("bij,bnj->bni", move, vectors)

        return jax.tree.map(moved, start)

    def adapt(self, start: Start, models: Rope) -> Start:
        """The same directions and turning rates with each rope's own segment lengths."""
        position, velocity = start.state.position, start.state.velocity
        edge = jnp.diff(position, axis=-2)
        length = jnp.linalg.norm(edge, axis=-1)
        ratio = (models.rest_length / length)[..., None]
        own = RopeState(
            _along(edge, ratio[..., 0]) + position[..., :1, :],
            _along(jnp.diff(velocity, axis=-2), ratio[..., 0]) + velocity[..., :1, :],
        )
        return eqx.tree_at(lambda s: s.state, start, own)

    def features(self, state: RopeState, goal: Any = None) -> Float[Array, "*batch features"]:
        """Positions relative to the gripper (m) and velocities (m/s) of all nodes but the gripper.

        The same wherever the rope is. The gripper's velocity is the command, which policies carry.
        """
        relative = state.position[..., 1:, :] - state.position[..., :1, :]
        seen = jnp.concatenate([relative, state.velocity[..., 1:, :]], axis=-2)
        return seen.reshape(*seen.shape[:-2], -1)

    def feature_channels(self, model: Rope) -> tuple[Channel, ...]:
        shape = (model.nodes - 1, 3)
        return (
            Channel("node position relative to the gripper", shape, "m"),
            Channel("node velocity", shape, "m/s"),
        )


class RopeStabilization(HangingRopeTask):
    """A hanging rope of one driven end comes to rest, wherever the gripper then is.

    The loss of an episode, with the energy e(t) = E_rope(X^t) / E_rope(X^0) above hanging rest and
    the gripper's speed v, is

        final_weight e(T) + settling_weight mean_t log(1 + e(t) / 0.01) + rest_weight v(T)

    The first term is the seed's, L = E_rope(X^T), as a share of the start's energy. It says nothing
    about when the rope comes to rest; the second does: it counts the time above 1 % and goes on
    pulling where e is already small. The third (s/m) stops the gripper.
    """

    name: ClassVar[str] = "rope-stabilization"
    outcome_units: ClassVar[Mapping[str, str]] = {
        "settling_time": "s",
        "settling_periods": "periods",
        "final_speed": "m/s",
    }
    duration: float = eqx.field(static=True, default=2.0)
    final_weight: float = eqx.field(static=True, default=1.0)
    settling_weight: float = eqx.field(static=True, default=1.0)
    rest_weight: float = eqx.field(static=True, default=1.0)

    def starts(self, model: Rope, key: PRNGKeyArray, count: int) -> Start:
        """Half from random motions of the rope, half held still in random curves.

        Motions are smooth (five sinusoids per axis, 0.3 to 2.5 Hz), as vigorous as the limits of
        speed and acceleration allow or down to a third of that, and stop for the last quarter.
        Curves are straight, circular or helical, their mean direction 10 to 120 degrees from
        hanging. Raises `PalpateError` when the rope is not driven by velocity at its first node.
        """
        self.check_driven(model)
        for_motion, for_curve = jax.random.split(key)
        moving = self._from_motions(model, for_motion, count // 2)
        still = self._curves(model, for_curve, count - count // 2)
        return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), moving, still)

    def _from_motions(self, model: Rope, key: PRNGKeyArray, count: int) -> Start:
        motions = max(1, -(-count // STATES_PER_MOTION))  # none is no batch
        for_motion, for_time = jax.random.split(key)
        steps = round(MOTION / model.control_period)
        commands = self._random_commands(for_motion, motions, steps, model.control_period)
        position = _along(jnp.broadcast_to(_HANGING, (model.nodes - 1, 3)), model.rest_length)
        hanging = RopeState(position, jnp.zeros_like(position))
        hanging = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (motions, *leaf.shape)), hanging)
        states = rollout(model, hanging, commands[:, :, None, :])
        times = jax.random.randint(for_time, (motions, STATES_PER_MOTION), steps // 6, steps)
        state, command = at_times((states, commands), times, count)
        return Start(state, command[:, None, :])

    def _random_commands(  # gripper velocities, m/s
        self, key: PRNGKeyArray, count: int, steps: int, period: float
    ) -> Float[Array, "count steps 3"]:
        keys = jax.random.split(key, 3)
        logarithm = jax.random.uniform(
            keys[0], (count, 1, 5, 3), minval=math.log(0.3), maxval=math.log(2.5)
        )
        frequency = jnp.exp(logarithm)
        phase = jax.random.uniform(keys[1], (count, 1, 5, 3), maxval=2 * jnp.pi)
        time = jnp.arange(steps)[:, None, None] * period
        velocity = jnp.sum(
            jnp.sin(2 * jnp.pi * frequency * time + phase) / jnp.sqrt(frequency), axis=2
        )
        share = jnp.arange(steps) / steps
        rise, fall = jnp.clip(share / 0.1, 0, 1), jnp.clip((0.75 - share) / 0.1, 0, 1)
        velocity = velocity * (_smooth(rise) * _smooth(fall))[:, None]
        acceleration = jnp.diff(velocity, axis=1) / period
        speed = jnp.max(jnp.linalg.norm(velocity, axis=-1), axis=1)
        room = jnp.minimum(
            self.action_limit / speed,
            self.action_rate_limit / jnp.max(jnp.linalg.norm(acceleration, axis=-1), axis=1),
        )
        room = room * jax.random.uniform(keys[2], room.shape, minval=1 / 3, maxval=1.0)
        return velocity * room[:, None, None]

    def _curves(self, model: Rope, key: PRNGKeyArray, count: int) -> Start:
        """Ropes held still along curves of constant curvature and torsion.

        With a mean direction m and directions n, b square to it, the tangent at the share s of the
        length is cos(t) m + sin(t) n for t = turn (s - 1/2), which is an arc, straight without a
        turn; or cos(slope) m + sin(slope) (cos(t) n + sin(t) b), a helix.
        """
        keys = jax.random.split(key, 7)
        kind = jax.random.randint(keys[0], (count, 1, 1), 0, 3)

        def uniform(key, low, high):
            return jax.random.uniform(key, (count, 1, 1), minval=low, maxval=high)

        polar = uniform(keys[1], jnp.pi / 18, jnp.pi * 2 / 3)
        azimuth, roll = uniform(keys[2], 0, 2 * jnp.pi), uniform(keys[3], 0, 2 * jnp.pi)
        zero = jnp.zeros_like(azimuth)
        outwards = jnp.concatenate([jnp.cos(azimuth), jnp.sin(azimuth), zero], axis=-1)
        sideways = jnp.concatenate([-jnp.sin(azimuth), jnp.cos(azimuth), zero], axis=-1)
        mean = jnp.cos(polar) * _HANGING + jnp.sin(polar) * outwards
        upwards = jnp.sin(polar) * -_HANGING + jnp.cos(polar) * outwards
        normal = jnp.cos(roll) * upwards + jnp.sin(roll) * sideways
        binormal = jnp.cross(mean, normal)
        middle = ((jnp.arange(model.nodes - 1) + 0.5) / (model.nodes - 1) - 0.5)[:, None]
        turn = jnp.where(kind == 1, uniform(keys[4], 0.0, 1.5 * jnp.pi), 0.0) * middle
        arc = jnp.cos(turn) * mean + jnp.sin(turn) * normal
        turns = uniform(keys[5], jnp.pi, 5 * jnp.pi) * middle
        slope = uniform(keys[6], 0.3, 1.2)
        helix = jnp.cos(slope) * mean + jnp.sin(slope) * (
            jnp.cos(turns) * normal + jnp.sin(turns) * binormal
        )
        position = _along(jnp.where(kind == 2, helix, arc), model.rest_length)
        return Start(RopeState(position, jnp.zeros_like(position)), jnp.zeros((count, 1, 3)))

    @staticmethod
    def measure(observation: Any, truth: Any) -> dict[str, float]:
        """What a `RopeTruth` is judged by: "energy" (J) and "gripper_speed" (m/s)."""
        speed = float(np.linalg.norm(truth.gripper_velocity))
        return {"energy": truth.energy, "gripper_speed": speed}

    def loss(
        self, models: Rope, start: Start, states: RopeState, actions: Array
    ) -> Float[Array, " b"]:
        """See the class; dimensionless."""
        share = self.energy_share(models, start, states)
        settling = jnp.mean(jnp.log1p(share / STABILISED), axis=1)
        velocity = states.velocity[:, -1, 0]
        speed = jnp.sqrt(jnp.sum(velocity**2, axis=-1) + 1e-8)  # differentiable at rest
        return (
            self.final_weight * share[:, -1]
            + self.settling_weight * settling
            + self.rest_weight * speed
        )

    def energy_share(
        self, models: Rope, start: Start, states: RopeState
    ) -> Float[Array, "batch time"]:
        """Energy over time as a share of the start's."""
        # One time after the other: over all times at once XLA's CPU back end (JAX 0.10) miscompiles
        # sums of reductions that broadcast a parameter over the time axis.
        in_time = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 1, 0), states)
        energy = jnp.moveaxis(jax.lax.map(models.energy, in_time), 0, 1)
        weight = jnp.sum(models.node_mass, axis=-1) * models.gravity
        least = LEAST_ENERGY * weight * jnp.sum(models.rest_length, axis=-1)
        initial = jnp.maximum(models.energy(start.state), least)
        return energy / initial[:, None]

    def outcome(
        self, models: Rope, start: Start, states: RopeState, actions: Array
    ) -> dict[str, Float[Array, " b"]]:
        """Gives "success", "settling_time" (s), "settling_periods" and "final_speed" (m/s).

        Success: the energy falls below 1 % of the start's and stays there for one second, and the
        gripper is at rest in the end: its "final_speed", the mean over the last second, is below
        0.05 m/s, because 0.5 mm of noise in what a policy sees makes it tremble by 0.02 m/s. The
        time is that of the first sample from which the energy stays below, NaN without success.
        Periods are the rope's first, 2 pi / (1.2024 sqrt(g / L)).
        """
        share = self.energy_share(models, start, states)
        period, stay = models.control_period, round(STAY / models.control_period)
        below = jnp.cumsum(jnp.pad(share < STABILISED, ((0, 0), (1, 0))), axis=1, dtype=int)
        stays = below[:, stay:] - below[:, :-stay] == stay
        stays = jnp.pad(stays, ((0, 0), (0, 1)))  # an episode may be shorter than that second
        speed = jnp.mean(jnp.linalg.norm(states.velocity[:, -stay:, 0], axis=-1), axis=1)
        success = jnp.any(stays, axis=1) & (speed < AT_REST)
        time = jnp.where(success, (jnp.argmax(stays, axis=1) + 1) * period, jnp.nan)
        length = jnp.sum(models.rest_length, axis=-1)
        swing = 2 * jnp.pi / (FIRST_ROOT * jnp.sqrt(models.gravity / length))
        return {
            "success": success.astype(share.dtype),
            "settling_time": time,
            "settling_periods": time / swing,
            "final_speed": speed,
        }


def at_times(motions: Any, times: Array, count: int) -> Any:
    """The first `count` of all that (motions, time, ...) are at `times` (motions, picks, ...)."""
    pick = jax.vmap(lambda leaf, index: leaf[index])
    own = jax.tree.map(lambda leaf: pick(leaf, times), motions)
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[:count], own)


def vertical_symmetry(
    angle: Float[Array, "*batch"], mirror: Float[Array, "*batch"]
) -> Float[Array, "*batch 3 3"]:
    """Mirror y (where `mirror` is -1), then turn by `angle` (rad) about the vertical."""
    cosine, sine = jnp.cos(angle), jnp.sin(angle)
    zero, one = jnp.zeros_like(angle), jnp.ones_like(angle)
    rows = [
        [cosine, -sine * mirror, zero],
        [sine, cosine * mirror, zero],
        [zero, zero, one],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def _along(
    direction: Float[Array, "*batch segments 3"], length: Float[Array, "*#batch segments"]
) -> Float[Array, "*batch nodes 3"]:
    """Positions of the nodes from the origin along scaled segments."""
    steps = direction * length[..., None]
    return jnp.concatenate([jnp.zeros_like(steps[..., :1, :]), jnp.cumsum(steps, axis=-2)], axis=-2)


def _smooth(share: Array) -> Array:
    return 0.5 - 0.5 * jnp.cos(jnp.pi * share)
