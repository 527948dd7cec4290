"""Speed of the rope model against MuJoCo: `python -m benchmarks.rope [--out FILE] [--quick]`.

Both simulate a 1 m rope of 21 nodes at 1 ms with symplectic Euler: ours with every term on
(stretch, bend, twist, dampings, linear and quadratic drag), MuJoCo one thread of its cable with
bending and twisting stiffness, joint damping and fluid drag. First both have to agree with closed
forms, the period of a small swing and the hanging shape; then the two are timed in turn, and the
median of the ratios is kept.

What is timed: `mj_step` in a loop within one call (`mujoco.rollout` would add threads and copies);
our rollouts as a user calls them, over all cores, compiled beforehand. A step is one rope, 1 ms.
"""

import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from benchmarks import run
from palpate.errors import PalpateError
from palpate.models.model import rollout
from palpate.models.rope import Rope, RopeState
from palpate.networks import CommandPolicy
from palpate.numerics import devices
from palpate.runs import Figure, Result
from palpate.tasks.rope import RopeStabilization
from palpate.worlds.rope.rope import RopeConfiguration, RopeWorld

LENGTH, MASS, NODES = 1.0, 0.1, 21
GRAVITY = 9.81
FIRST_ROOT = 1.2024  # first zero of J0 over two: omega_1 = 1.2024 sqrt(g / L)
TIME_STEP, SUBSTEPS = 1e-3, 10
BATCH, STEPS, SINGLE_STEPS = 4096, 20, 500  # ropes, and control periods timed
AGREE = 0.03  # relative, with the closed forms


def our_rope(**fields) -> Rope:
    """The rope of the benchmark, every term on."""
    return Rope.uniform(LENGTH, MASS, NODES, substeps=SUBSTEPS, **fields)


def their_rope(**fields) -> RopeWorld:
    """The same rope as a MuJoCo cable of as many nodes, Euler at 1 ms."""
    return RopeWorld(
        RopeConfiguration(
            length=LENGTH,
            mass=MASS,
            bodies=NODES - 1,
            markers=NODES,
            time_step=TIME_STEP,
            observation_noise=0.0,
            **fields,
        )
    )


def hanging(angle: float = 0.0, nodes: int = NODES) -> np.ndarray:
    """Node positions (nodes, 3) of a straight rope at an angle from hanging."""
    along = np.linspace(0.0, LENGTH, nodes)[:, None]
    return along * np.array([np.sin(angle), 0.0, -np.cos(angle)])


def first_mode(nodes: int = NODES) -> np.ndarray:
    """A small deflection of the shape of the hanging chain's slowest swing."""
    from scipy.special import j0

    below = np.linspace(1.0, 0.0, nodes)
    shape = 0.02 * (j0(2 * FIRST_ROOT * np.sqrt(below)) - j0(2 * FIRST_ROOT))
    position = hanging(nodes=nodes)
    position[:, 0] = shape
    return position


def period_of(offsets: np.ndarray, interval: float) -> float:
    """Period (s) of a decaying swing, from the zero crossings of the tip's offset."""
    rising = np.flatnonzero((offsets[:-1] < 0) & (offsets[1:] >= 0))
    falling = np.flatnonzero((offsets[:-1] >= 0) & (offsets[1:] < 0))
    crossings = np.sort(np.concatenate([rising, falling])).astype(float)
    before, after = offsets[crossings.astype(int)], offsets[crossings.astype(int) + 1]
    times = (crossings + before / (before - after)) * interval
    return float(2 * np.mean(np.diff(times)))


def check_closed_forms() -> dict[str, float]:
    """Small swing period and hanging shape of both simulations; raises if either disagrees."""
    expected = 2 * np.pi / (FIRST_ROOT * np.sqrt(GRAVITY / LENGTH))
    # Limp, but damped enough that a small swing does not feed other modes through the stretch.
    rope = our_rope(bend_stiffness=1e-5, twist_stiffness=1e-8, grip_stiffness=1e-8)
    seconds = 5.0
    still = jnp.zeros((round(seconds / rope.control_period), 1, 3))
    swing = rollout(rope, _at(first_mode()), still)
    ours = period_of(np.asarray(swing.position[:, -1, 0]), rope.control_period)
    rest = rollout(rope, _at(hanging()), still).position[-1]

    world = their_rope(bending_stiffness=1e-6, twisting_stiffness=1e-6, joint_damping=1e-4)
    world.reset(0, start=first_mode(), azimuth=0.0)
    offsets = []
    for _ in range(round(seconds / world.control_period)):
        world.step(np.zeros(3))
        truth = world.truth()
        offsets.append(truth.positions[-1, 0] - truth.gripper_position[0])
    theirs = period_of(np.asarray(offsets), world.control_period)
    world.reset(0, start="hanging")
    for _ in range(100):
        world.step(np.zeros(3))
    truth = world.truth()
    their_rest = truth.positions - truth.gripper_position

    checks = {
        "period_ours_over_closed_form": ours / expected,
        "period_mujoco_over_closed_form": theirs / expected,
        "hanging_error_ours_m": float(np.abs(np.asarray(rest) - hanging()).max()),
        "hanging_error_mujoco_m": float(np.abs(their_rest - hanging()).max()),
    }
    for name, value in checks.items():
        off = abs(value - 1.0) if name.startswith("period") else value / LENGTH
        if not off < AGREE:
            raise PalpateError(f"{name} is {value:.4g}: the simulations do not agree, no timing")
    return checks


def _at(position: np.ndarray) -> RopeState:
    position = jnp.asarray(position, jnp.float32)
    return RopeState(position, jnp.zeros_like(position))


def mujoco_steps_per_second(steps: int) -> float:
    """One thread of `mj_step` on the cable, moving."""
    world = their_rope()
    world.reset(0, start="straight")
    model, data = world._model, world._data
    began = time.perf_counter()
    mujoco.mj_step(model, data, nstep=steps)
    return steps / (time.perf_counter() - began)


def seconds(call: Callable[[], object]) -> float:
    """Wall time of one call, finished."""
    began = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - began


def batch_calls(batch: int, steps: int) -> tuple[Callable, Callable]:
    """A batched rollout over all cores, and its gradient to all parameters and actions."""
    rope = our_rope()
    keys = jax.random.split(jax.random.key(0), 2)
    angles = jax.random.uniform(keys[0], (batch,), minval=0.2, maxval=1.4)
    along = jnp.linspace(0.0, LENGTH, NODES)[None, :, None]
    direction = jnp.stack([jnp.sin(angles), 0 * angles, -jnp.cos(angles)], axis=-1)
    position = along * direction[:, None]
    state = RopeState(position, jnp.zeros_like(position))
    actions = 0.3 * jax.random.normal(keys[1], (batch, steps, 1, 3))

    def mean_height(rope: Rope, data: tuple[RopeState, jax.Array]) -> jax.Array:
        return jnp.mean(rollout(rope, *data).position[..., 2])

    def gradient(rope: Rope, data: tuple[RopeState, jax.Array]):
        to_rope, to_data = jax.grad(mean_height, argnums=(0, 1))(rope, data)
        return to_rope, jnp.mean(jnp.square(to_data[1]))

    forward = jax.jit(devices.data_parallel(mean_height))
    backward = jax.jit(devices.data_parallel(gradient))
    data = jax.device_put((state, actions))
    return lambda: forward(rope, data), lambda: backward(rope, data)


def single_call(steps: int) -> Callable:
    """One rope, open loop."""
    rope = our_rope()
    state = _at(hanging(1.0))
    actions = jnp.zeros((steps, 1, 3))
    forward = jax.jit(lambda rope: rollout(rope, state, actions).position[-1])
    return lambda: forward(rope)


def policy_times(calls: int) -> np.ndarray:
    """Wall times (s) of single decisions of the stabilising policy, as in a control loop."""
    rope = our_rope()
    task = RopeStabilization()
    start = task.starts(rope, jax.random.key(0), 32)
    policy = CommandPolicy.create(
        jax.random.key(1),
        task.features(start.state, start.goal),
        task.action_channels(rope),
        period=rope.control_period,
    )

    @jax.jit
    def decide(carry, state):
        return policy(carry, task.features(state, None), None, None)

    state = _at(hanging(0.5))
    carry = policy.initial_carry(jnp.zeros(rope.action_shape))
    times = np.empty(calls)
    for index in range(calls):
        began = time.perf_counter()
        carry, action = jax.block_until_ready(decide(carry, state))
        np.asarray(action)
        times[index] = time.perf_counter() - began
    return times[calls // 10 :]  # the first are still warming up


def benchmark(quick: bool = False) -> Result:
    """Check, then time in turn."""
    began = time.monotonic()
    checks = check_closed_forms()
    for name, value in checks.items():
        print(f"  {name}: {value:.4g}")
    rounds = 3 if quick else 9
    forward, backward = batch_calls(BATCH, STEPS)
    small, _ = batch_calls(64, STEPS)
    single = single_call(SINGLE_STEPS)
    for call in (forward, backward, small, single):
        jax.block_until_ready(call())
    rows = []
    for _ in range(rounds):
        theirs = mujoco_steps_per_second(5_000)
        batched = seconds(forward)
        rows.append(
            (
                theirs,
                BATCH * STEPS * SUBSTEPS / batched,
                SINGLE_STEPS * SUBSTEPS / seconds(single),
                seconds(backward) / batched,
                64 * STEPS * SUBSTEPS / seconds(small),
            )
        )
    theirs, batched, alone, ratio, cached = np.array(rows).T
    policy = policy_times(1_000 if quick else 5_000)
    settings = {
        "nodes": NODES,
        "time_step_s": TIME_STEP,
        "batch": BATCH,
        "rounds": rounds,
        "cores": devices.cores(),
        "mujoco_steps_per_s": float(np.median(theirs)),
        "batched_steps_per_s": float(np.median(batched)),
        "batched_64_steps_per_s": float(np.median(cached)),
        "single_steps_per_s": float(np.median(alone)),
        "checks": checks,
    }
    for name in ("mujoco", "batched", "batched_64", "single"):
        print(f"  {name}: {settings[f'{name}_steps_per_s']:.3g} steps/s")
    return Result(
        "bench-rope",
        [
            _figure("batched_speedup", batched / theirs, "", 200.0, "higher"),
            _figure("single_speedup", alone / theirs, "", 40.0, "higher"),
            _figure("gradient_cost_ratio", ratio, "", 8.0, "lower"),
            _figure("policy_p99_ms", [1e3 * np.quantile(policy, 0.99)], "ms", 1.0, "lower"),
            _figure("batched_4096_over_64", batched / cached, "", None, "higher"),
        ],
        settings,
        [0],
        {},
        time.monotonic() - began,
    )


def _figure(name: str, values, unit: str, bar: float | None, better: str) -> Figure:
    values = np.asarray(values, float)
    half = float((values.max() - values.min()) / 2) if values.size > 1 else None
    return Figure(name, float(np.median(values)), unit, bar=bar, better=better, spread=half)


if __name__ == "__main__":
    run(benchmark, __doc__ or "")
