"""A compliant tip in a plane, and walls that yield: what touching them shows."""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from palpate.errors import PalpateError
from palpate.models.contact.integration import Impedance, PlateState, Surfaces, advance
from palpate.models.model import Model
from palpate.parameters import LogNormal, Normal, Parameter, as_floating, parameter, parameters_of

Number = Float[Array, "*batch"]
Walls = Float[Array, "*batch walls"]
Point = Float[Array, "*batch 2"]

SUBSTEP = 1.25e-3  # s, of the integration, at most: of twice that stiffnesses were .2 % further off
OF_WALLS = "position", "tilt", "stiffness", "damping", "friction", "wall_mass"
SLIP = 1e-5  # m/s, the sliding velocity at which three quarters of a wall's friction are there


def _data() -> Any:
    return eqx.field(converter=as_floating)


class TipState(NamedTuple):
    """Position in m, velocity in m/s, the force on the tip as sensed, N, each (2,); the plates."""

    position: Point
    velocity: Point
    force: Point
    plates: PlateState


class Tip(Model):
    """The tip of a robot under Cartesian impedance control, in a plane with straight walls.

    The controller pulls the tip to a set-point x_d: m a = K (x_d - x) - D v + f, with the diagonal
    stiffness K that it commands and the damping D = 2 zeta sqrt(K m) by design (Albu-Schaeffer et
    al., ICRA 2003, of one mass), and the arm rubs: it creeps before it slides. x and v are those of
    `control_delay` s ago: half a period of a controller that holds its force, and what it takes to
    measure. An action is, for one control period, the mean x_d, K, and how fast x_d moves in it.

    Each wall is a plate on a spring: where the tip is pressed in by u, it pushes with
    f_n = max(0, k u + d u' + m_w u''), along its outward normal, and rubs with Coulomb's friction
    mu f_n against the sliding velocity (regularised: three quarters at `slip` m/s, and all at twice
    that). Its mass m_w is met at rest, and left behind without bouncing: it comes back as slowly as
    k and d have it.

    How many walls there are, and the nominal `direction` (rad) of each outward normal, is data; a
    wall may be tilted about it. `position` is where the wall is along that direction, from the
    frame's origin, measured abreast of the point `centre`: so that a tilt does not move what is
    near it. What is observed is the tip's position and the force on it as a sensor at the wrist
    shows it: less what the tool beyond the sensor takes to be accelerated, late, by a low-pass of
    first order, and with a bias. Batch axes lead everywhere.

    Raises `PalpateError` for no wall, and where direction and parameters are of different numbers
    of walls.
    """

    mass: Number = parameter(
        "kg", prior=LogNormal(1.0, 0.7), spread=0.3, about="effective mass at the tip"
    )
    damping_ratio: Number = parameter(
        "", prior=LogNormal(1.0, 0.3), spread=0.2, about="of the impedance, one is critical"
    )
    control_delay: Number = parameter(
        "s", prior=LogNormal(1e-3, 0.7), about="from what the controller measures to its force"
    )
    arm_friction: Number = parameter(
        "N", prior=LogNormal(0.2, 1.0), spread=0.5, about="dry friction of the arm, at the tip"
    )
    arm_creep: Number = parameter(
        "m/s",
        prior=LogNormal(1e-3, 1.0),
        about="at which three quarters of the arm's friction are there",
    )
    tool_mass: Number = parameter(
        "kg", prior=LogNormal(0.1, 1.0), about="beyond the force sensor, which feels its inertia"
    )
    position: Walls = parameter(
        "m", prior=Normal(None, 0.02), about="of each wall along its direction"
    )
    tilt: Walls = parameter(
        "rad", prior=Normal(0.0, 0.1), about="of each wall's normal from its direction"
    )
    stiffness: Walls = parameter("N/m", prior=LogNormal(1e3, 1.5), spread=0.3, about="of each wall")
    damping: Walls = parameter("N s/m", prior=LogNormal(10.0, 1.5), spread=0.5, about="of each")
    friction: Walls = parameter(
        "", prior=LogNormal(0.3, 0.7), spread=0.3, about="Coulomb's coefficient on each wall"
    )
    wall_mass: Walls = parameter(
        "kg", prior=LogNormal(0.02, 1.0), about="of each wall's plate, which moves with the tip"
    )
    impact_time: Number = parameter(
        "s", prior=LogNormal(3e-4, 0.7), about="in which a plate takes on the tip's velocity"
    )
    force_bias: Point = parameter(
        "N", prior=Normal(0.0, 0.5), about="what the sensor shows without contact"
    )
    sensor_lag: Number = parameter(
        "s", prior=LogNormal(2e-3, 0.7), about="time constant of the force sensor's low-pass"
    )
    direction: Walls = _data()
    centre: Point = _data()
    control_period: float = eqx.field(static=True, default=5e-3)
    slip: float = eqx.field(static=True, default=SLIP)
    overrides: tuple[tuple[str, Parameter], ...] = eqx.field(static=True, default=())

    def __check_init__(self) -> None:
        shape = getattr(self.direction, "shape", None)  # of a tree of something else None
        if shape is None:
            return
        if not shape or shape[-1] < 1:
            raise PalpateError(f"expected the direction of at least one wall, got {shape}")
        for name in OF_WALLS:
            own = getattr(getattr(self, name), "shape", shape)
            if own[-1:] != shape[-1:]:
                raise PalpateError(
                    f"'{name}' has the shape {own}: expected as many walls as there are "
                    f"directions, {shape[-1]}"
                )

    @property
    def action_shape(self) -> tuple[int]:
        """(6,): set-point x and y (m), stiffness along x and y (N/m), the set-point's m/s."""
        return (6,)

    @property
    def observation_shape(self) -> tuple[int]:
        """(4,): position x and y, force x and y."""
        return (4,)

    @property
    def observation_units(self) -> tuple[str, ...]:
        """Of x, y and the force along them."""
        return "m", "m", "N", "N"

    @property
    def walls(self) -> int:
        """How many there are."""
        return self.direction.shape[-1]

    @property
    def surfaces(self) -> Surfaces:
        """The walls as the integration needs them."""
        nominal, normal = _unit(self.direction), _unit(self.direction + self.tilt)
        across = jnp.stack([-nominal[..., 1], nominal[..., 0]], axis=-1)
        abreast = jnp.sum(across * self.centre[..., None, :], axis=-1)
        point = nominal * self.position[..., None] + across * abreast[..., None]
        place = jnp.sum(normal * point, axis=-1)
        stiffness, damping, mass = self.stiffness, self.damping, self.wall_mass
        # The slower root of m s^2 + d s + k; where it swings, as fast as it does at most.
        beyond = jnp.maximum(jnp.square(damping) - 4.0 * stiffness * mass, 0.0)
        recovery = 2.0 * stiffness / (damping + jnp.sqrt(beyond + 1e-12))
        impact = self.impact_time[..., None]
        return Surfaces(normal, place, stiffness, damping, self.friction, mass, recovery, impact)

    def step(self, state: TipState, action: Float[Array, "*batch 6"]) -> TipState:
        """One control period later; x and y of the mean x_d (m), of K (N/m), and of x_d' (m/s)."""
        return self.stepper()(state, action)

    def stepper(self) -> Callable[[TipState, Array], TipState]:
        surfaces, mass, delay = self.surfaces, self.mass[..., None], self.control_delay[..., None]
        count = max(1, math.ceil(self.control_period / SUBSTEP - 1e-9))
        time = self.control_period / count
        late = jnp.exp(-time / self.sensor_lag)[..., None]
        tool = self.tool_mass[..., None] / time
        reaching = (1.0 - self.tool_mass / self.mass)[..., None] / self.sensor_lag[..., None]
        moments = time * (np.arange(count) + 0.5) - 0.5 * self.control_period

        def step(state: TipState, action: Array) -> TipState:
            setpoint, stiffness, moves = action[..., :2], action[..., 2:4], action[..., 4:]
            # A floor below any stiffness that matters: the slope of a root is infinite at zero.
            root = jnp.sqrt(jnp.maximum(stiffness, 1e-6) * mass)
            damping = 2.0 * self.damping_ratio[..., None] * root
            impedance = Impedance(
                mass, delay, self.arm_friction, self.arm_creep, setpoint, stiffness, damping
            )

            def advanced(state: TipState, moment: Array) -> tuple[TipState, None]:
                here = impedance._replace(setpoint=setpoint + moment * moves)
                plates, position, velocity, force, later = advance(
                    surfaces, here, state.plates, state.position, state.velocity, time, self.slip
                )
                force -= tool * (velocity - state.velocity)
                # What the walls do late in a step has had less time to reach the sensor.
                force += reaching * later
                sensed = force + late * (state.force - force)
                return TipState(position, velocity, sensed, plates), None

            return jax.lax.scan(advanced, state, as_floating(moments))[0]

        return step

    def observe(self, state: TipState) -> Float[Array, "*batch 4"]:
        """Position (m) and the force of the walls on the tip with the sensor's bias (N)."""
        bias = self.force_bias.reshape(
            *self.force_bias.shape[:-1], *(1,) * (state.force.ndim - self.force_bias.ndim), 2
        )
        return jnp.concatenate([state.position, state.force + bias], axis=-1)

    def initial_state(self, observations: Float[Array, "*batch frames 4"]) -> TipState:
        """At the last of a few frames, with the velocity between the last two; of one at rest."""
        last, before = observations[..., -1, :], observations[..., -2:, :][..., 0, :]
        velocity = (last[..., :2] - before[..., :2]) / self.control_period
        return self.state(last[..., :2], velocity, last[..., 2:] - self.force_bias)

    def state(self, position: Point, velocity: Point, force: Point | None = None) -> TipState:
        """The tip there (m), moving (m/s), and plates pressed in by it or relaxed.

        What the sensor shows is zero unless `force` (N) is given.
        """
        normal, place = self.surfaces[:2]
        pressed = jnp.maximum(place - jnp.sum(normal * position[..., None, :], axis=-1), 0.0)
        plates = PlateState(pressed, (pressed > 0.0).astype(pressed.dtype))
        sensed = jnp.zeros_like(velocity) if force is None else force
        return TipState(position, velocity, sensed, plates)

    def velocity(self, state: TipState) -> Point:
        """Of the tip, m/s."""
        return state.velocity


def tip_with_walls(directions: Sequence[float], **values: Any) -> Tip:
    """A tip between walls whose outward normals point to `directions` (rad).

    `values` are fields of `Tip`: parameters that are not given are at their prior's centre, and a
    single number serves all walls; walls without a position are at the frame's origin.
    """
    count = len(directions)
    fields: dict[str, Any] = {
        name: 0.0 if declared.prior.centre is None else declared.prior.centre
        for name, declared in parameters_of(Tip).items()
    }
    fields = {"centre": 0.0} | fields | values
    for name in OF_WALLS:
        fields[name] = np.broadcast_to(fields[name], count)
    for name in ("force_bias", "centre"):
        fields[name] = np.broadcast_to(fields[name], 2)
    return Tip(direction=as_floating(np.asarray(directions, float)), **fields)


def _unit(angle: Array) -> Array:
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
