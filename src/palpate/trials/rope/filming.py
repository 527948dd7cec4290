"""One trial of the MuJoCo rope through a camera: followed, and by a policy controlled."""

import contextlib
import time
from collections.abc import Mapping

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from palpate.models.rope import Rope, RopeState
from palpate.networks import CommandPolicy
from palpate.numerics.pinhole import Frame
from palpate.perception.rope.centre_line import FEWEST, centre_lines, line_points
from palpate.perception.rope.segmentation import Appearance, segment
from palpate.perception.rope.tracking import REACH, RopeTracker
from palpate.tasks.rope import RopeStabilization
from palpate.trials.rope.stabilization import StabilizationTrial
from palpate.worlds.camera import Sensor
from palpate.worlds.excitation import excitation
from palpate.worlds.rope.filmed import ROPE_COLOUR, Background, FilmedObservation, FilmedRope
from palpate.worlds.rope.rope import RopeConfiguration
from palpate.worlds.world import DivergedError

COMPILED = 20  # control periods, by which everything has been called once
TIMED = 100  # control periods of which the computing time of frames is taken


def empty_films(trials: int, steps: int, nodes: int) -> dict[str, np.ndarray]:
    """What happens in that many trials, once per control period from the start on; all NaN.

    `squared_error` (trials, 4, times) in m^2, mean over the nodes but the gripper's: of the tracker
    now; of the picture's centre line at its own time, NaN between frames; of the model alone since
    the first frame; and of a rope that hangs straight down. `true` and `tracked` (trials, times,
    nodes, 3) in m; `energy` in J, `gripper_speed` in m/s, and `hidden`, the share of the rope's
    nodes that the last frame did not show, (trials, times).
    """
    shapes = {
        "squared_error": (4, steps + 1),
        "true": (steps + 1, nodes, 3),
        "tracked": (steps + 1, nodes, 3),
        **dict.fromkeys(("energy", "gripper_speed", "hidden"), (steps + 1,)),
    }
    return {name: np.full((trials, *shape), np.nan, np.float32) for name, shape in shapes.items()}


def film(
    trial: StabilizationTrial,
    kept: Mapping[str, np.ndarray],
    *,
    model: Rope,
    policy: CommandPolicy | None,
    background: Background,
    sensor: Sensor,
    shaken: bool,
) -> None:
    """Run the trial: controlled by `policy` through the camera, else shaken, else held still.

    What happens is written into `kept`, one row of `empty_films`; from where a simulation diverges
    it stays NaN, and so does what the tracker is compared with under control.
    """
    configuration, steps = trial.configuration, trial.steps or 0
    world = FilmedRope(configuration, sensor, background=background)
    tracker = RopeTracker(model, world.pinhole, Appearance(ROPE_COLOUR, configuration.radius))
    alone = RopeTracker(model, world.pinhole, Appearance(ROPE_COLOUR, configuration.radius))
    every = configuration.bodies // (model.nodes - 1)
    commands = np.zeros((steps, 3))
    if shaken:
        commands = excitation(
            trial.seed, steps * world.control_period, world.control_period,
            configuration.speed_limit, configuration.acceleration_limit,
        )  # fmt: skip
    with contextlib.suppress(DivergedError):  # a failure to settle
        observation = world.reset(trial.seed, start=trial.start)
        state = _start(tracker, observation)
        predicted = _start(alone, observation)
        decide = None if policy is None else _Decisions(policy)
        for step in range(steps + 1):
            if step:
                command = commands[step - 1] if decide is None else decide(state)
                observation = world.step(command)
                state = tracker.step(observation.gripper_position, observation.frame)
                if policy is None:
                    predicted = alone.step(observation.gripper_position)
            truth = world.truth()
            nodes = truth.positions[::every]
            kept["true"][step], kept["tracked"][step] = nodes, state.position
            kept["energy"][step] = truth.energy
            kept["gripper_speed"][step] = np.linalg.norm(truth.gripper_velocity)
            kept["squared_error"][0, step] = _mean_square(state.position - nodes)
            if policy is None:
                down = np.linspace(0, configuration.length, model.nodes)[:, None] * [0, 0, -1]
                hanging = truth.gripper_position + down
                kept["squared_error"][2, step] = _mean_square(predicted.position - nodes)
                kept["squared_error"][3, step] = _mean_square(hanging - nodes)
            if policy is None and observation.frame is not None:
                _keep_picture(kept, step, observation, world, model, configuration.radius)


def frame_times(model: Rope) -> np.ndarray:
    """Computing time (frames,) in s from a picture to the state, of a rope that swings freely.

    Of all cores together: what one core alone would need. Nothing else may run in this process.
    """
    configuration = RopeConfiguration()
    world = FilmedRope(configuration)
    tracker = RopeTracker(model, world.pinhole, Appearance(ROPE_COLOUR, configuration.radius))
    _start(tracker, world.reset(0, start="half_circle"))
    times = []
    for step in range(COMPILED + TIMED):
        observation = world.step(np.zeros(3))
        began = time.process_time()
        tracker.step(observation.gripper_position, observation.frame).position.block_until_ready()
        if observation.frame is not None and step >= COMPILED:
            times.append(time.process_time() - began)
    return np.array(times)


def _start(tracker: RopeTracker, observation: FilmedObservation) -> RopeState:
    assert observation.frame is not None  # there is one at every reset
    return tracker.start(observation.frame, observation.gripper_position)


def _mean_square(miss) -> float:
    """Over the nodes of the squared distance, m^2; the gripper's, which is known, left out."""
    return float((np.asarray(miss)[1:] ** 2).sum(-1).mean())


def _keep_picture(
    kept: Mapping[str, np.ndarray],
    step: int,
    observation: FilmedObservation,
    world: FilmedRope,
    model: Rope,
    radius: float,
) -> None:
    """What the frame alone says, beside the truth at its time; and how much it does not show."""
    frame = observation.frame
    assert isinstance(frame, Frame)
    instant = min(frame.time / world.control_period, step)
    before = int(instant)
    after = min(before + 1, step)
    nodes = kept["true"][before] + (instant - before) * (kept["true"][after] - kept["true"][before])
    rest_length = np.asarray(model.rest_length)
    gripper, length = np.asarray(nodes[0], float), float(rest_length.sum())
    seen = segment(frame, Appearance(ROPE_COLOUR, radius), world.pinhole, gripper, REACH * length)
    points = line_points(seen)
    pixels, _ = world.pinhole.project(nodes[1:])
    distance = np.linalg.norm(pixels[:, None] - points.pixels[None], axis=-1)
    kept["hidden"][step] = np.mean(distance.min(axis=1, initial=np.inf) > 3.0)
    if len(points.pixels) >= FEWEST:
        line = centre_lines(seen, world.pinhole, gripper, length)[0]
        kept["squared_error"][1, step] = _mean_square(line.nodes(rest_length) - nodes)


class _Decisions:
    """A policy that is asked about one rope, state by state."""

    def __init__(self, policy: CommandPolicy):
        self._policy = policy
        self._carry = policy.initial_carry(jnp.zeros((1, 3)))

    def __call__(self, state: RopeState) -> np.ndarray:
        """The command (3,) in m/s; none where the rope's state is not known, as on a robot."""
        if not (np.isfinite(state.position).all() and np.isfinite(state.velocity).all()):
            self._carry = self._policy.initial_carry(jnp.zeros((1, 3)))
            return np.zeros(3)
        self._carry, action = _decide(self._policy, RopeStabilization(), self._carry, state)
        return np.asarray(action)[0]


@eqx.filter_jit
def _decide(policy, task, carry, state):
    return policy(carry, task.features(state, None), None, None)
