"""The constants of a rope world, and ropes drawn around them."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from palpate.errors import PalpateError


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
    air_density: float = 1.2  # kg/m^3
    air_viscosity: float = 3e-3  # Pa s, effective: see above
    gravity: float = 9.81  # m/s^2
    time_step: float = 5e-4  # s, of the simulation
    control_period: float = 0.01  # s
    grip: Literal["pivot", "clamped"] = "pivot"  # clamped: the first body always points down
    speed_limit: float = 1.5  # m/s, Euclidean norm of the gripper's velocity
    acceleration_limit: float = 10.0  # m/s^2, Euclidean norm
    markers: int = 21  # spread evenly over the nodes, gripper and tip included
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
        zero_or_more = ("tip_mass", "joint_damping", "air_density", "air_viscosity", "gravity",
                        "observation_noise", "observation_delay")  # fmt: skip
        for name in zero_or_more:
            if not 0 <= getattr(self, name) < math.inf:
                raise PalpateError(f"a rope's {name} is 0 or greater, not {getattr(self, name)}")
        if self.grip not in ("pivot", "clamped"):
            raise PalpateError(f"a rope's grip is 'pivot' or 'clamped', not {self.grip!r}")
        if not isinstance(self.bodies, int | np.integer) or self.bodies < 3:
            raise PalpateError(f"a rope has a whole number of bodies, 3 or more, not {self.bodies}")
        whole = isinstance(self.markers, int | np.integer) and self.markers >= 2
        if not whole or self.bodies % (self.markers - 1):
            fitting = [n + 1 for n in range(1, self.bodies + 1) if self.bodies % n == 0]
            raise PalpateError(
                f"{self.markers} markers do not spread evenly over {self.bodies} bodies; "
                f"{', '.join(map(str, fitting))} markers do"
            )
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
        """Refuse what symplectic Euler cannot integrate: angular frequency x time step < 2.

        The fastest bending of a chain of rods of mass m and length h is its zigzag, whose
        kinetic energy is the rods' rotation: omega^2 = 48 EI / (h^3 m). The fastest twisting
        has omega^2 = 4 GJ / (h I), where I = m r^2 / 2 is a rod's inertia about its axis.
        """
        mass, spacing = self.body_masses().min(), self.length / self.bodies
        bending = math.sqrt(48 * self.bending_stiffness / (spacing**3 * mass))
        twisting = math.sqrt(8 * self.twisting_stiffness / (spacing * mass * self.radius**2))
        for name, omega in (("bending_stiffness", bending), ("twisting_stiffness", twisting)):
            if omega * self.time_step >= 2:
                raise PalpateError(
                    f"a {name} of {getattr(self, name):g} N m^2 needs a time_step below "
                    f"{2 / omega:.3g} s with bodies of {mass:.3g} kg and {spacing:.3g} m, "
                    f"not {self.time_step:g}"
                )

    def body_masses(self) -> np.ndarray:
        """Mass of each body from gripper to tip in kg, shape (bodies,), without `tip_mass`."""
        if self.mass_distribution == "uniform":
            return np.full(self.bodies, self.mass / self.bodies)
        weights = np.asarray(self.mass_distribution)
        return self.mass * weights / weights.sum()


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
            air_density=base.air_density * drag,
            air_viscosity=base.air_viscosity * drag,
        )
        for length, mass, bending, damping, drag in factor.tolist()
    ]
