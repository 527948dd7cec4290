"""A rope as a chain of point masses, springs and dampers (SPiD, Long et al., arXiv 2602.03623)."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from palpate.errors import PalpateError
from palpate.models.rope import kernel, own_frame, stability
from palpate.models.rope.parameters import RopeParameters, RopeState
from palpate.parameters import parameters_of

# Ropes integrated side by side: as many as a vector register holds numbers. Measured: 8 costs a
# fifth more time forwards and a tenth backwards, 32 a tenth more of each. Other processors have no
# cache to stay in, and take the batch as a whole.
LANES = 16


class Rope(RopeParameters):
    """Mass-spring-damper rope of N segments and N + 1 nodes, some of them driven.

    Six elements per segment (rest length; stretch stiffness and damping; bend stiffness and
    damping; twist stiffness), mass, air drag and gravity: the parameters of the seed's talk.
    Bending acts at the N - 1 joints between segments and twisting over the N - 2 pairs of joints.
    A model without damping is that of Lv et al. 2017 (J. Manuf. Syst. 43:385-399).

    An action gives, for each driven node and axis, what `drive` says: the `position` (m) it has at
    the end of the control period (moved there at constant velocity), the `velocity` (m/s) it has
    then (reached at constant acceleration), or its `acceleration` (m/s^2) over the period.
    """

    @classmethod
    def uniform(cls, length: float = 1.0, mass: float = 0.1, nodes: int = 21, **fields) -> "Rope":
        """A rope of equal segments: length in m, mass in kg, `fields` as in `from_rest_lengths`."""
        if nodes < 4:
            raise PalpateError(f"a rope needs at least 4 nodes, got {nodes}")
        return cls.from_rest_lengths(np.full(nodes - 1, length / (nodes - 1)), mass, **fields)

    @classmethod
    def from_rest_lengths(cls, rest_length: np.ndarray, mass: float, **fields) -> "Rope":
        """A rope with given segments (m) and `mass` (kg) spread evenly along it, made legal.

        Each node carries half of its neighbouring segments, so that the inertia of a swing is that
        of the rope to second order: equal nodes would weigh down the free end.
        Others are given in `fields`, a number standing for all elements, or their priors' centres.
        """
        rest_length = np.asarray(rest_length)
        if not np.all(np.isfinite(rest_length)) or np.any(rest_length <= 0):
            raise PalpateError(f"rest lengths must be positive, got {rest_length}")
        if not mass > 0:
            raise PalpateError(f"the mass of a rope must be positive, got {mass}")
        nodes = len(rest_length) + 1
        for name, count in cls._elements(nodes).items():
            prior = parameters_of(cls)[name].prior
            value = fields.get(name, prior.centre)
            fields[name] = np.full(count, value) if np.ndim(value) == 0 and count else value
        share = rest_length / np.sum(rest_length)
        node_mass = 0.5 * mass * (np.append(share, 0.0) + np.append(0.0, share))
        fields |= {"node_mass": node_mass, "rest_length": rest_length}
        fields.setdefault("rest_bend", np.zeros((nodes - 2, 3)))
        return cls(**fields).constrain()

    @property
    def action_shape(self) -> tuple[int, int]:
        """(driven nodes, 3)."""
        return len(self.driven), 3

    @property
    def observation_shape(self) -> tuple[int, int]:
        """(nodes, 3): a marker at every node."""
        return self.nodes, 3

    def observe(self, state: RopeState) -> Float[Array, "*batch nodes 3"]:
        """Marker positions, m."""
        return state.position

    def drawing(self, observation: Float[Array, "*batch nodes 3"]) -> dict[str, Array]:
        return {"": observation}

    def initial_state(self, observations: Float[Array, "*batch frames nodes 3"]) -> RopeState:
        """The state at the last frame; velocity from the last two, zero with one frame."""
        position = observations[..., -1, :, :]
        if observations.shape[-3] < 2:
            return RopeState(position, jnp.zeros_like(position))
        return RopeState(position, (position - observations[..., -2, :, :]) / self.control_period)

    def step(self, state: RopeState, action: Float[Array, "*batch driven 3"]) -> RopeState:
        """The state one control period later. On CPUs a batch goes in blocks of `LANES` ropes."""
        state, increment = self._drive(state, action)
        motion = state, increment, self._rest_bend(state.position)
        coefficients = self._coefficients()
        batch = state.position.shape[:-2]
        if not batch:
            batch = jnp.broadcast_shapes(
                *(leaf.shape[:-1] for leaf in jax.tree.leaves(coefficients)),
                *(leaf.shape[:-2] for leaf in jax.tree.leaves(motion[2])),
            )
            if not batch:
                return self._integrate(motion, coefficients, 1)
            motion = jax.tree.map(
                lambda leaf: jnp.broadcast_to(leaf, batch + leaf.shape[-2:]), motion
            )
        return self._integrate_blocks(motion, coefficients, motion[0].position.shape[0])

    def _rest_bend(self, position: Array) -> Array | None:
        """Bend at rest in the world frame, (*batch, joints, 3); None for a straight rope.

        The frame is the chord's: along it in the horizontal plane, across it, and up.
        """
        if not self.held_at_both_ends:
            return None
        chord = position[..., -1, :2] - position[..., 0, :2]
        along = chord / jnp.sqrt(jnp.sum(jnp.square(chord), axis=-1, keepdims=True) + 1e-6)
        return own_frame.from_rope_frame(self.rest_bend, along)

    def _drive(self, state: RopeState, action: Array) -> tuple[RopeState, Array]:
        """Start velocity of the driven nodes, and what each integration step adds to it."""
        nodes = jnp.asarray(self.driven)
        start = state.velocity[..., nodes, :]
        increment = jnp.zeros(action.shape, state.velocity.dtype)
        if self.drive == "position":
            start = (action - state.position[..., nodes, :]) / self.control_period
        elif self.drive == "velocity":
            increment = (action - start) / self.substeps
        else:
            increment = action * self.time_step
        velocity = state.velocity.at[..., nodes, :].set(start)
        increment = jnp.zeros_like(velocity).at[..., nodes, :].set(increment)
        return RopeState(state.position, velocity), increment

    def _coefficients(self) -> kernel.Coefficients:
        """The parameters as the integration uses them, each (*batch, elements)."""
        free = self.free_nodes()

        def per_node(value: Array) -> Array:
            return jnp.broadcast_to(value[..., None], (*value.shape, self.nodes))

        def at_the_grip(value: Array) -> Array:
            held = float(0 in self.driven)
            return stability.spread(held * value[..., None], self.nodes - 1, 0)

        return kernel.Coefficients(
            **{name: getattr(self, name) for name in kernel.PER_ELEMENT},
            grip_stiffness=at_the_grip(self.grip_stiffness),
            grip_damping=at_the_grip(self.grip_damping),
            linear_drag=per_node(self.air_drag),
            quadratic_drag=per_node(self.quadratic_drag),
            step_per_mass=self.time_step * free / self.node_mass,
            step_gravity=self.time_step * free * per_node(self.gravity),
        )

    def _integrate(self, motion, coefficients, lanes: int) -> RopeState:
        """Integrate a block: leaves lead with (lanes,), or have no batch axis for one lane.

        `motion` is the state, the driven nodes' increment, and the rest bend.
        """
        state, increment, rest_bend = motion

        def flat(values: Array) -> Array:
            """(lanes, elements) or (elements,) to (elements x lanes,)."""
            if values.ndim == 1:
                values = jnp.broadcast_to(values, (lanes, *values.shape))
            return jnp.moveaxis(values, 0, -1).reshape(-1)

        def axes(values: Array) -> tuple[Array, Array, Array]:
            x, y, z = (flat(values[..., axis]) for axis in range(3))
            return x, y, z

        def unflat(values) -> Array:
            stacked = jnp.stack([v.reshape(self.nodes, lanes) for v in values], axis=-1)
            return jnp.moveaxis(stacked, 1, 0).reshape(state.position.shape)

        position, velocity = kernel.integrate(
            axes(state.position),
            axes(state.velocity),
            axes(increment),
            None if rest_bend is None else axes(rest_bend),
            jax.tree.map(flat, coefficients),
            lanes=lanes,
            steps=self.substeps,
            time_step=self.time_step,
        )
        return RopeState(unflat(position), unflat(velocity))

    def _integrate_blocks(self, motion, coefficients, count: int) -> RopeState:
        """Integrate `count` ropes (leading axis) in blocks; parameters batched or shared."""
        lanes = min(LANES, count) if jax.default_backend() == "cpu" else count
        blocks = -(-count // lanes)
        missing = blocks * lanes - count

        def block(leaf: Array) -> Array:
            if missing:  # the last rope again: lanes must be full, and legal
                leaf = jnp.concatenate([leaf, jnp.repeat(leaf[-1:], missing, axis=0)])
            return leaf.reshape(blocks, lanes, *leaf.shape[1:])

        batched = jax.tree.map(lambda leaf: leaf.ndim > 1, coefficients)
        own, shared = eqx.partition(coefficients, batched)
        result = jax.lax.map(
            lambda x: self._integrate(x[0], eqx.combine(x[1], shared), lanes),
            jax.tree.map(block, (motion, own)),
        )
        return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[:count], result)

    @property
    def correction_shape(self) -> tuple[int, int]:
        """(nodes, 3): see `models.residual.Correctable`."""
        return self.nodes, 3

    @property
    def correction_neighbours(self) -> Int[np.ndarray, "nodes 3 1"]:
        """A chain: the node before, the node itself, the node after."""
        node = np.arange(self.nodes)
        after = np.append(node[1:], -1)
        return np.stack([node - 1, node, after], axis=-1)[..., None]

    def residual_features(
        self, state: RopeState, action: Float[Array, "*batch driven 3"]
    ) -> Float[Array, "*batch nodes features"]:
        """What a correction of each node may depend on: see `own_frame.features`."""
        state, increment = self._drive(state, action)
        return own_frame.features(self, state, state.velocity + self.substeps * increment)

    def corrected(self, state: RopeState, correction: Float[Array, "*batch nodes 3"]) -> RopeState:
        """The state with velocities (m/s, in the rope's own frame) added to its free nodes."""
        frame = own_frame.axes(self, state.position)
        added = self.free_nodes()[:, None] * own_frame.from_rope_frame(correction, frame)
        return RopeState(state.position, state.velocity + added)

    def correction_between(
        self, state: RopeState, following: RopeState
    ) -> Float[Array, "*batch nodes 3"]:
        """Change of the free nodes' velocities (m/s), in the rope's own frame at `state`."""
        frame = own_frame.axes(self, state.position)
        change = self.free_nodes()[:, None] * (following.velocity - state.velocity)
        return own_frame.to_rope_frame(change, frame)

    def constrain(self) -> "Rope":
        """The rope softened where the integration would be unstable: see `stability`."""
        return stability.soften(self)

    def energy(self, state: RopeState) -> Float[Array, "*batch"]:
        """Mechanical energy (J) above hanging at rest under the first driven node's position.

        Gravity, motion, stretch, bend and twist (seed 1: E_rope), minus the same of the rope
        hanging still, stretched by its own weight, from where the gripper is now: lowering the
        gripper earns nothing. Raises `PalpateError` for a rope that is not held at its first end
        alone: it has no such rest.
        """
        if self.driven != (0,):
            raise PalpateError(
                "the energy above hanging rest is that of a rope driven at node 0 alone, "
                f"this one is driven at {self.driven}"
            )
        head = state.position[..., 0, :]
        mass_below = jnp.cumsum(self.node_mass[..., ::-1], axis=-1)[..., ::-1][..., 1:]
        tension = mass_below * self.gravity[..., None]
        hanging_length = self.rest_length + tension / self.stretch_stiffness
        hanging_height = -jnp.cumsum(hanging_length, axis=-1)
        height = state.position[..., 1:, 2] - head[..., None, 2] - hanging_height
        weight = self.node_mass[..., 1:] * self.gravity[..., None]
        gravity = jnp.sum(weight * height, axis=-1)
        squared_speed = jnp.sum(jnp.square(state.velocity), axis=-1)
        kinetic = 0.5 * jnp.sum(self.node_mass * squared_speed, axis=-1)
        elastic_at_rest = 0.5 * jnp.sum(jnp.square(tension) / self.stretch_stiffness, axis=-1)
        return gravity + kinetic + self.elastic_energy(state.position) - elastic_at_rest

    def elastic_energy(self, position: Float[Array, "*batch nodes 3"]) -> Float[Array, "*batch"]:
        """Energy of stretch, bend, twist and grip, J."""
        edge = jnp.diff(position, axis=-2)
        length = jnp.sqrt(jnp.sum(jnp.square(edge), axis=-1) + kernel.COINCIDENT)
        direction = edge / self.rest_length[..., None]
        bend = jnp.diff(direction, axis=-2)
        binormal = jnp.cross(direction[..., 1:, :], bend)
        rest_bend = self._rest_bend(position)
        if rest_bend is not None:
            bend = bend - rest_bend
        sine_squared = jnp.sum(jnp.square(binormal), axis=-1) + kernel.TWIST_FADE
        triple = jnp.sum(direction[..., :-2, :] * binormal[..., 1:, :], axis=-1)
        stretch = self.stretch_stiffness * jnp.square(length - self.rest_length)
        bending = self.bend_stiffness * jnp.sum(jnp.square(bend), axis=-1)
        fade = sine_squared[..., :-1] * sine_squared[..., 1:]
        twist = self.twist_stiffness * jnp.square(triple) / fade
        down = jnp.array([0.0, 0.0, -1.0], position.dtype)
        from_down = jnp.sum(jnp.square(direction[..., 0, :] - down), axis=-1)
        elastic = sum(jnp.sum(each, axis=-1) for each in (stretch, bending, twist))
        return 0.5 * (elastic + float(0 in self.driven) * self.grip_stiffness * from_down)
