"""The constants of a rope world, and ropes drawn around them."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from palpate.errors import PalpateError

SHORTEST_STEP = 2e-5  # s, of a simulation that anybody waits for


@dataclass(frozen=True)
class Disturbance:
    """A push: a constant force on one node of the rope for a while."""

    time: float  # s after reset
    duration: float  # s
    force: tuple[float, float, float]  # N, world frame
    node_fraction: float = 1.0  # which node: 0 at the gripper, 1 at the tip

    def __post_init__(self):
        force = np.asarray(self.force, float)
        if force.shape != (3,) or not np.isfinite(force).all():
            raise PalpateError(f"a disturbance's force is three finite newtons, not {self.force}")
        if not (0 <= self.time < math.inf and 0 < self.duration < math.inf):
            raise PalpateError(
                "a disturbance has a time >= 0 and a duration > 0 in seconds, "
                f"not {self.time} and {self.duration}"
            )
        if not 0 <= self.node_fraction <= 1:
            raise PalpateError(
                "a disturbance's node_fraction lies between 0 (gripper) and 1 (tip), "
                f"not {self.node_fraction}"
            )


@dataclass(frozen=True)
class RopeConfiguration:
    """All constants of a rope world, in SI units; the defaults are a 1 m rope of 100 g.

    **Damping.** Every ball joint, the pivot in the gripper too, resists with `joint_damping`
    times its angular velocity. MuJoCo applies its inertia-box fluid law to each body: with the
    half sides r of the box that has the body's inertia, the force along axis i is
    -6 pi viscosity mean(r) v_i (linear) and -2 density r_j r_k |v_i| v_i (quadratic); torques
    likewise. The viscosity is an effective one, for fuzz and sliding fibres too (still air has
    1.8e-5 Pa s): with the defaults a small free swing halves its amplitude in about 3.6 periods.

    **Time step.** The simulation is explicit but for the joint damping, of first order, and gains
    energy where a limp rope spins about its own axis: at 0.5 ms some 4 % of the start's within
    the collapse of a helix, at 1 ms three times that, and without damping it diverges.

    `mass_distribution` is "uniform", one weight per body, or a function from the fraction of
    the length (0 at the gripper, 1 at the tip) to a weight; weights are relative and `mass` is
    their sum.

    `marker_places` says how far along the rope each marker is, from 0 at the gripper to 1 at the
    tip; one that lies between two nodes is a point of the rigid body between them.

    Raises `PalpateError` for values that are not physical, that do not divide evenly, or that
    the explicit time step cannot integrate.
    """

    length: float = 1.0  # m
    bodies: int = 40  # rigid capsules in the chain
    radius: float = 5e-3  # m
    mass: float = 0.1  # kg, without tip_mass
    mass_distribution: str | Sequence[float] | np.ndarray | Callable[[float], float] = "uniform"
    tip_mass: float = 0.0  # kg, a point at the tip
    bending_stiffness: float = 1e-4  # EI, N m^2
    twisting_stiffness: float = 7e-5  # GJ, N m^2
    joint_damping: float = 3e-3  # N m s/rad per joint
    grip_damping: float | None = None  # N m s/rad of the pivot in the gripper; None: as a joint
    air_density: float = 1.2  # kg/m^3
    air_viscosity: float = 3e-3  # Pa s, effective: see above
    gravity: float = 9.81  # m/s^2
    time_step: float = 5e-4  # s, of the simulation
    control_period: float = 0.01  # s
    grip: Literal["pivot", "clamped"] = "pivot"  # clamped: the first body always points down
    speed_limit: float = 1.5  # m/s, Euclidean norm of the gripper's velocity
    acceleration_limit: float = 10.0  # m/s^2, Euclidean norm
    markers: int = 21
    marker_places: Sequence[float] | None = None  # shares of the length; None: evenly, 0 to 1
    observation_noise: float = 5e-4  # m, standard deviation per marker coordinate
    observation_delay: float = 0.0  # s, whole control periods
    observation_rate: float | None = None  # Hz; None: the control rate
    disturbances: tuple[Disturbance, ...] = ()

    def __post_init__(self):
        positive = ("length", "radius", "mass", "bending_stiffness", "twisting_stiffness",
                    "time_step", "control_period", "speed_limit", "acceleration_limit")  # fmt: skip
        for name in positive:
            if not 0 < getattr(self, name) < math.inf:
                raise PalpateError(f"a rope's {name} is greater than 0, not {getattr(self, name)}")
        if self.grip_damping is not None and not 0 <= self.grip_damping < math.inf:
            raise PalpateError(f"a rope's grip_damping is 0 or greater, not {self.grip_damping}")
        zero_or_more = ("tip_mass", "joint_damping", "air_density", "air_viscosity", "gravity",
                        "observation_noise", "observation_delay")  # fmt: skip
        for name in zero_or_more:
            if not 0 <= getattr(self, name) < math.inf:
                raise PalpateError(f"a rope's {name} is 0 or greater, not {getattr(self, name)}")
        if self.grip not in ("pivot", "clamped"):
            raise PalpateError(f"a rope's grip is 'pivot' or 'clamped', not {self.grip!r}")
        if not isinstance(self.bodies, int | np.integer) or self.bodies < 3:
            raise PalpateError(f"a rope has a whole number of bodies, 3 or more, not {self.bodies}")
        if not isinstance(self.markers, int | np.integer) or self.markers < 2:
            raise PalpateError(f"a rope has a whole number of markers, 2 or more: {self.markers}")
        self._check_places()
        self._whole("control_period", self.control_period / self.time_step, "time steps")
        delay = self.observation_delay / self.control_period
        self._whole("observation_delay", delay, "control periods")
        if self.observation_rate is not None:
            if not 0 < self.observation_rate < math.inf:
                raise PalpateError(
                    f"a rope's observation_rate is greater than 0, not {self.observation_rate}"
                )
            every = 1 / (self.observation_rate * self.control_period)
            self._whole("observation_rate", every, "control periods between observations", least=1)
        object.__setattr__(self, "mass_distribution", self._weights())
        object.__setattr__(self, "disturbances", tuple(self.disturbances))
        self._check_time_step()

    def _whole(self, name: str, count: float, of: str, least: int = 0) -> None:
        if round(count) < least or abs(count - round(count)) > 1e-6:
            raise PalpateError(
                f"a rope's {name} of {getattr(self, name)} makes {count:.6g} {of}; "
                "it has to be a whole number of them"
            )

    def _check_places(self) -> None:
        if self.marker_places is None:
            return
        places = np.asarray(self.marker_places, float)
        in_order = places.ndim == 1 and bool((np.diff(places) > 0).all())
        if len(places) != self.markers or not in_order or places[0] < 0 or places[-1] > 1:
            raise PalpateError(
                f"a rope's marker_places are {self.markers} growing shares of its length, from 0 "
                f"at the gripper to 1 at the tip, not {self.marker_places}"
            )
        object.__setattr__(self, "marker_places", tuple(places.tolist()))

    def _weights(self) -> str | tuple[float, ...]:
        weights = self.mass_distribution
        if isinstance(weights, str):
            if weights != "uniform":
                raise PalpateError(
                    "a rope's mass_distribution is 'uniform', a weight per body or a function, "
                    f"not {weights!r}"
                )
            return weights
        if callable(weights):
            weights = [weights((body + 0.5) / self.bodies) for body in range(self.bodies)]
        weights = np.asarray(weights, float)
        if weights.shape != (self.bodies,) or not (np.isfinite(weights) & (weights > 0)).all():
            raise PalpateError(
                f"a rope's mass_distribution has {self.bodies} positive weights, one per body, "
                f"not shape {weights.shape} with least value {weights.min(initial=math.inf):.3g}"
            )
        return tuple(weights.tolist())

    def _check_time_step(self) -> None:
        """Refuse what symplectic Euler cannot integrate: angular frequency x time step < 2."""
        for name, omega in self.fastest().items():
            if omega * self.time_step >= 2:
                raise PalpateError(
                    f"a {name} of {getattr(self, name):g} N m^2 needs a time_step below "
                    f"{2 / omega:.3g} s with bodies of {self.body_masses().min():.3g} kg and "
                    f"{self.length / self.bodies:.3g} m, not {self.time_step:g}"
                )

    def fastest(self) -> dict[str, float]:
        """Greatest angular frequency in rad/s that each stiffness makes.

        The fastest bending of a chain of rods of mass m and length h is its zigzag, whose
        kinetic energy is the rods' rotation: omega^2 = 48 EI / (h^3 m). The fastest twisting
        has omega^2 = 4 GJ / (h I), where I = m r^2 / 2 is a rod's inertia about its axis.
        """
        mass, spacing = self.body_masses().min(), self.length / self.bodies
        bending = math.sqrt(48 * self.bending_stiffness / (spacing**3 * mass))
        twisting = math.sqrt(8 * self.twisting_stiffness / (spacing * mass * self.radius**2))
        return {"bending_stiffness": bending, "twisting_stiffness": twisting}

    def sideways_drag(self) -> tuple[float, float]:
        """Linear (N s/m) and quadratic (N s^2/m^2) drag of a body that moves across its axis.

        By the class's law, with the inertia of a capsule of uniform density as MuJoCo has it.
        """
        radius, length = self.radius, self.length / self.bodies
        ends = 4 * radius / (3 * length + 4 * radius)  # share of the mass in the two half spheres
        axial = (1 - ends) * radius**2 / 2 + ends * 2 * radius**2 / 5
        across = (1 - ends) * (length**2 / 12 + radius**2 / 4) + ends * (
            2 * radius**2 / 5 + length**2 / 4 + 3 * length * radius / 8
        )
        long, thin = math.sqrt(1.5 * (2 * across - axial)), math.sqrt(1.5 * axial)
        linear = 6 * math.pi * self.air_viscosity * (long + 2 * thin) / 3
        return linear, 2 * self.air_density * long * thin

    def body_masses(self) -> np.ndarray:
        """Mass of each body from gripper to tip in kg, shape (bodies,), without `tip_mass`."""
        if self.mass_distribution == "uniform":
            return np.full(self.bodies, self.mass / self.bodies)
        weights = np.asarray(self.mass_distribution)
        return self.mass * weights / weights.sum()


def in_step(
    period: float, longest: float = RopeConfiguration.time_step, **constants: Any
) -> RopeConfiguration:
    """A rope of these constants, controlled every `period` s, whose simulation keeps step with it.

    Its time step is the longest that divides the period, is no longer than `longest` (s), and is
    half of what the stiffness allows, so that ropes drawn around it can be simulated as well.

    Raises `PalpateError` where that is below 20 microseconds, and as `RopeConfiguration`.
    """
    instant = {"time_step": 1e-6, "control_period": 1e-6}
    quickest = max(RopeConfiguration(**{**constants, **instant}).fastest().values())
    longest = min(longest, 1 / quickest)
    if longest < SHORTEST_STEP:
        raise PalpateError(
            f"this rope would be simulated in steps of {longest:.2g} s, too slow to wait for: "
            f"expected one of less stiffness for its mass and length, so that {SHORTEST_STEP:g} s "
            "are enough"
        )
    steps = math.ceil(period / longest - 1e-9)
    return RopeConfiguration(**{**constants, "control_period": period, "time_step": period / steps})


def sample_configurations(
    base: RopeConfiguration, count: int, seed: int
) -> list[RopeConfiguration]:
    """Ropes drawn around `base`: each factor uniform and independent of the others.

    Length +-10 %, mass (with the tip's) +-25 %, and +-50 % on bending stiffness, on joint
    damping and on drag, where density and viscosity of the air share one factor.
    """
    factor = 1 + np.random.default_rng(seed).uniform(-1, 1, (count, 5)) * (0.1, 0.25, 0.5, 0.5, 0.5)
    return [
        dataclasses.replace(
            base,
            length=base.length * length,
            mass=base.mass * mass,
            tip_mass=base.tip_mass * mass,
            bending_stiffness=base.bending_stiffness * bending,
            joint_damping=base.joint_damping * damping,
            grip_damping=None if base.grip_damping is None else base.grip_damping * damping,
            air_density=base.air_density * drag,
            air_viscosity=base.air_viscosity * drag,
        )
        for length, mass, bending, damping, drag in factor.tolist()
    ]
