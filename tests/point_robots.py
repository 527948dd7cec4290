"""Robots side by side between springs, whose energy is exact: what filters are held to."""

import numpy as np

from palpate.safety.port import Impedance, Port

WALL = 0.1  # m from the middle, on either side of either axis
ITERATIONS = 4  # each leaves k h^2 / 2 m of the error, which is 1e-5 at the robots' step
WALL_STIFFNESS = 200.0  # N/m: they store what they take, and give all of it back


class Robots:
    """Point masses in the plane under held forces, by a discrete gradient (Gonzalez 1996).

    Over a step from x to x' the springs act with -(V(x') - V(x)) / (x' - x) on each axis, so that
    energy rises by the work done from outside and by nothing else, whatever the step.
    """

    def __init__(self, count: int, mass: float, step: float = 2e-4):
        self.mass, self.step, self.wall_stiffness = mass, step, WALL_STIFFNESS
        self.position, self.velocity = np.zeros((2, count, 2))
        self.work = np.zeros(count)  # J, from outside
        self.pushed = np.zeros((count, 2))  # N, from outside

    def over(self, position: np.ndarray) -> np.ndarray:
        """How deep in a wall, signed, m."""
        within = np.minimum(np.maximum(position, -WALL), WALL)  # np.clip takes thrice as long
        return position - within

    def wall_force(self, after: np.ndarray) -> np.ndarray:
        first, then = self.over(self.position), self.over(after)
        rise, moved = then - first, after - self.position
        # All of a motion within one wall is deeper in it: there the quotient is 1, and not 0 / 0.
        crossed = first * then <= 0.0
        share = np.divide(rise, moved, out=np.ones_like(rise), where=crossed & (moved != 0.0))
        return -0.5 * self.wall_stiffness * (first + then) * share

    def energy(self) -> np.ndarray:
        stored = 0.5 * self.wall_stiffness * (self.over(self.position) ** 2).sum(axis=1)
        return 0.5 * self.mass * (self.velocity**2).sum(axis=1) + stored

    def hold(self, force: np.ndarray, time: float) -> None:
        before = self.position.copy()
        for _ in range(max(1, round(time / self.step))):
            both, after = force + self.pushed, self.position + self.step * self.velocity
            for _ in range(ITERATIONS):
                faster = self.step / self.mass * (both + self.wall_force(after))
                after = self.position + self.step * (self.velocity + 0.5 * faster)
            self.position, self.velocity = after, self.velocity + faster
        self.work += (self.pushed * (self.position - before)).sum(axis=1)

    def port(self, force, before, elapsed, period, spring=None) -> Port:
        count = len(self.position)
        mass = np.broadcast_to(self.mass * np.eye(2), (count, 2, 2))
        return Port(force, self.position - before, self.velocity.copy(), mass,
                    np.broadcast_to(elapsed, (count,)), period, spring)  # fmt: skip


def hostile(random: np.random.Generator, robots: Robots, count: int) -> Impedance:
    """Set-points and stiffnesses anywhere, anew: damped as by design."""
    stiffness = np.exp(random.uniform(np.log(50.0), np.log(1000.0), (count, 1, 1))) * np.eye(2)
    target = random.uniform(-0.2, 0.2, (count, 2))
    damping = 2.0 * np.sqrt(stiffness * robots.mass) * random.uniform(0.0, 1.0, (count, 1, 1))
    return Impedance(target - robots.position, stiffness, damping)


def force_of(spring: Impedance, velocity: np.ndarray) -> np.ndarray:
    pull = (spring.stiffness @ spring.error[:, :, None])[:, :, 0]
    return pull - (spring.damping @ velocity[:, :, None])[:, :, 0]


def driven(one, period, samples, count=32, seed=0, mass=1.3, pushes=0.0, late=0.0):
    """Under a hostile impedance and a filter: the greatest rise of energy and tank, the tank's
    least level, J, and how far robots went, m.

    `pushes` N come from outside, and a share of samples is `late` by three periods.
    """
    random = np.random.default_rng(seed)
    robots, state = Robots(count, mass), one.begin(count)
    force, before, elapsed = np.zeros((count, 2)), np.zeros((count, 2)), period
    start = robots.energy() + (0.0 if one.level(state) is None else one.level(state))
    rise, least, far = -np.inf, np.inf, 0.0
    for _ in range(samples):
        spring = hostile(random, robots, count)
        port = robots.port(force, before, elapsed, period, spring)
        state, force = one(state, port, force_of(spring, robots.velocity))
        before = robots.position.copy()
        robots.pushed = pushes * random.uniform(-1.0, 1.0, (count, 2))
        elapsed = period * (4.0 if random.uniform() < late else 1.0)
        robots.hold(force, elapsed)
        booked = one.level(state)
        # What the held force has drawn meanwhile is booked at the next sample.
        drawn = (force * (robots.position - before)).sum(axis=1)
        level = 0.0 if booked is None else booked - drawn
        rise = max(rise, float((robots.energy() + level - robots.work - start).max()))
        least = min(least, float(np.min(level)))
        far = max(far, float(np.abs(robots.position).max()))
    return rise, least, far
