"""A rival in `one-shot`: mujoco.sysid, given the true structure of a piece of furniture.

mujoco.sysid (github.com/google-deepmind/mujoco, python/mujoco/sysid) fits constants of a MuJoCo
scene to recordings by nonlinear least squares within bounds. Here it is told what our method has
to find out or do without: the very scene that the recording comes from, its wheels, casters and
feet, which caster is locked and at what angle, where a hinge holds. It fits what remains: the mass,
where the load stands, friction and rolling resistance, and is told the ranges they were drawn from,
as a prior and a place to begin. It yields one point and no posterior.

Both begin at starts that are smoothed alike (`segments.cut`): here of pieces of a second, ours of
pieces of two. What a start does not show is where free casters point: that follows from the way
they were dragged before (`caster_angles`), and pieces that begin before it is known are left out.
"""

import contextlib
import dataclasses
import functools
import io
import math
import os
import time
from collections.abc import Callable
from typing import Any

import jax
import mujoco
import mujoco.rollout
import numpy as np
import scipy.signal
from jaxtyping import Float

from palpate.errors import PalpateError
from palpate.identification.segments import Segments, cut, noise_scale
from palpate.models.planar_shapes import furniture
from palpate.recording import Aligned, Recording
from palpate.worlds.furniture import CONTROL_PERIOD, SETTLING, STEPS_PER_PERIOD
from palpate.worlds.furniture_pieces import (
    LOAD_REACH,
    MASS_SPREAD,
    PieceKind,
    PieceParameters,
    draw_parameters,
    placed,
)
from palpate.worlds.furniture_scene import TIME_STEP, furniture_scene

PIECE = 1.0  # s
SMOOTHING = 21  # frames of the cubic by which the way of casters is smoothed
STARTS = 16  # angles that a caster of unknown angle is dragged from
KNOWN = 0.98  # length of their mean unit vector from which on it counts as known
# Of a constant's range. Where a push comes close to what dry friction can hold, the residual is
# all steps: with differences of 1e-3 a couch's fit ended at 4.7 times the noise, so at the noise.
DIFFERENCES = (0.03, 0.01)
TOLERANCE = 1e-3  # relative change of the cost, or of the constants, at which a fit is done
MOST_STEPS = 50  # of the optimizer, for each difference
GUESSES = 16  # of the constants, of which the best is where a fit begins
# Bounds: the mass as a share of the kind's nominal one, the load as shares of its half extent.
MASS, LOAD, FRICTION, ROLLING = (1 / 3, 3.0), (-1.0, 1.0), (0.02, 1.5), (0.0, 0.1)
BODY = "body"  # what the piece is called in its scene
MEASURED = "pose and deviation"
THREADS = os.cpu_count() or 1


class CastersUnknownError(PalpateError):
    """A recording in which no free caster rolls far enough to show where it points."""


@dataclasses.dataclass(frozen=True)
class ToldScene:
    """A piece whose structure is known, standing at `pose` (3,) m, m, rad where it is hinged.

    Its constants are counted in shares of their bounds, from 0 to 1, in the order of `bounds`, so
    that one step and one tolerance suit them all.
    """

    kind: PieceKind
    locked: tuple[float | None, ...]
    anchor: tuple[float, float] | None
    pose: tuple[float, float, float]

    @property
    def bounds(self) -> dict[str, tuple[float, float]]:
        """What is fitted, and from where to where; rolling resistance only where wheels roll."""
        x, y = self.kind.half_extent.tolist()
        bounds = {
            "mass": (MASS[0] * self.kind.mass, MASS[1] * self.kind.mass),
            "load x": (LOAD[0] * x, LOAD[1] * x),
            "load y": (LOAD[0] * y, LOAD[1] * y),
            "friction": FRICTION,
        }
        if any(mount.type != "foot" for mount in self.kind.mounts):
            bounds["rolling resistance"] = ROLLING
        return bounds

    def shares(self, parameters: PieceParameters) -> list[float]:
        """Where constants stand within their bounds."""
        values = {
            "mass": parameters.mass,
            "load x": parameters.load_place[0],
            "load y": parameters.load_place[1],
            "friction": parameters.friction,
            "rolling resistance": parameters.rolling_resistance,
        }
        return [(values[name] - low) / (high - low) for name, (low, high) in self.bounds.items()]

    @property
    def prior(self) -> tuple[np.ndarray, np.ndarray]:
        """Middle and half width of the kind's own ranges, in shares of the bounds."""
        kind = self.kind
        ends = []
        for end, side in enumerate((-1, 1)):
            x, y = (side * LOAD_REACH * kind.half_extent).tolist()
            mass = kind.mass * (1 + side * MASS_SPREAD)
            friction, rolling = kind.friction[end], kind.rolling_resistance[end]
            parameters = PieceParameters(mass, (x, y), friction, rolling, self.locked, self.anchor)
            ends.append(self.shares(parameters))
        low, high = np.array(ends)
        return (low + high) / 2, (high - low) / 2

    @property
    def free(self) -> list[int]:
        """The mounts that swivel."""
        pairs = zip(self.kind.mounts, self.locked, strict=True)
        return [i for i, (m, angle) in enumerate(pairs) if m.type == "caster" and angle is None]

    def parameters(self, *shares: float) -> PieceParameters:
        """The constants at these shares."""
        pairs = zip(self.bounds.items(), shares, strict=True)
        values = {name: low + share * (high - low) for (name, (low, high)), share in pairs}
        return PieceParameters(
            mass=values["mass"],
            load_place=(values["load x"], values["load y"]),
            friction=values["friction"],
            rolling_resistance=values.get("rolling resistance", 0.0),
            locked=self.locked,
            anchor=self.anchor,
        )

    def spec(self, parameters: PieceParameters) -> mujoco.MjSpec:
        """The scene, free casters at 0, with room for what is measured as sensor data."""
        swivels = [0.0 if angle is None else angle for angle in self.locked]
        spec = furniture_scene(
            [BODY], [self.kind], [parameters], [swivels], np.array([self.pose]), []
        )
        spec.add_sensor(name=MEASURED, type=mujoco.mjtSensor.mjSENS_USER, dim=6)
        return spec

    def model(self, *shares: float) -> mujoco.MjModel:
        """The compiled scene at these shares."""
        return self.spec(self.parameters(*shares)).compile()


@dataclasses.dataclass(frozen=True)
class SysidFit:
    """What mujoco.sysid found.

    `scene` is what it was told and `parameters` the constants with it. `error` is the root mean
    square of residuals over their standard deviations, `pieces` how many were fitted.
    `evaluations` counts how often all of them were simulated, for derivatives too. `converged`
    says that it ended by its tolerances, and not because it had tried often enough.
    """

    scene: ToldScene
    parameters: PieceParameters
    error: float
    pieces: int
    converged: bool
    evaluations: int
    wall_time_s: float


def fit_scene(
    recording: Recording,
    kind: PieceKind,
    locked: tuple[float | None, ...],
    anchor: tuple[float, float] | None = None,
    seed: int = 0,
) -> SysidFit:
    """Fit the constants of one piece to a recording of its handling, in trials that begin at rest.

    Args:
        recording: channels "pose" (frames, 1, 3) in m, m, rad and "wrench" of that shape in N, N,
            N m, as measured.
        kind: the piece. The fit begins at the best of constants drawn from the kind's ranges,
            and may leave these.
        locked: rad, per mount, the swivel angle that it is locked at, or None.
        anchor: m, body frame, the point hinged to the world where it is in the first frame.
        seed: draws these constants.

    Raises `PalpateError` when the extra is missing, the piece is bolted down, the recording has
    gaps or another number of bodies; `CastersUnknownError` when it does not tell where casters
    point.
    """
    sysid = mujoco_sysid()
    if kind.bolted:
        raise PalpateError(
            f"a '{kind.name}' is bolted down, so that nothing of it can be fitted: leave it out"
        )
    began = time.perf_counter()
    aligned = recording.align(CONTROL_PERIOD)
    _check(recording, aligned)
    scene = ToldScene(kind, locked, anchor, tuple(aligned.observation[0, 0, 0].tolist()))
    sequences, pieces = _sequences(sysid, scene, aligned)
    model = functools.lru_cache(maxsize=GUESSES)(scene.model)  # it asks anew for every piece
    whole = sysid.build_residual_fn(
        models_sequences=[sequences],
        build_model=lambda current, _: model(*current.as_vector().tolist()),
        modify_residual=_residual,
        resample_true=False,
        n_threads=THREADS,
    )
    middle, width = scene.prior
    evaluations = 0

    def residual(vector: np.ndarray, current: Any) -> Any:
        """What mujoco.sysid compares, and how far the constants are from what is usual.

        Without the latter what the recording does not determine, such as the friction of wheels
        that never slip, ends anywhere.
        """
        nonlocal evaluations
        evaluations += vector.shape[1] if vector.ndim == 2 else 1
        errors, *compared = whole(vector, current)
        return [*errors, ((vector.T - middle) / width).T], *compared

    random = np.random.default_rng(seed)
    guesses = np.array([scene.shares(draw_parameters(kind, random)) for _ in range(GUESSES)])
    errors, *_ = residual(guesses.T, _counted(sysid, scene, guesses[0]))
    shares = guesses[np.argmin(np.square(np.concatenate(errors)).sum(0))]
    for difference in DIFFERENCES:
        found = _optimized(residual, _counted(sysid, scene, shares), difference)
        shares = found.x
    return SysidFit(
        scene=scene,
        parameters=scene.parameters(*shares.tolist()),
        error=float(np.sqrt(np.mean(np.square(found.fun)))),
        pieces=pieces,
        converged=found.status > 0,
        evaluations=evaluations,
        wall_time_s=time.perf_counter() - began,
    )


def predict_pieces(
    fit: SysidFit, segments: Segments, draws: int = 16, seed: int = 0
) -> Float[np.ndarray, "segments time 1 3"]:
    """Poses (m, m, rad) after each action of pieces that begin at rest, open loop.

    Where free casters point at first nobody knows: the mean over `draws` of their angles. Angles
    of poses count on from those of the starts. Only starts and actions are looked at.

    Raises `PalpateError` when the extra is missing.
    """
    sysid = mujoco_sysid()
    random = np.random.default_rng(seed)
    predicted = []
    for start, action in zip(np.asarray(segments.pose), np.asarray(segments.action), strict=True):
        pose = tuple(map(float, start[0]))
        scene = dataclasses.replace(fit.scene, pose=pose)
        model = scene.spec(fit.parameters).compile()
        angles = random.uniform(-math.pi, math.pi, (draws, len(scene.free)))
        settled = _settled(model)
        states = [_state(sysid, scene, model, settled, start[0], np.zeros(3), a) for a in angles]
        control = np.tile(_held(action), (draws, 1, 1))
        data = [mujoco.MjData(model) for _ in range(THREADS)]
        rolled, _ = mujoco.rollout.rollout(model, data, np.array(states), control)
        predicted.append(_poses(model, rolled, pose[2]).mean(0))
    return np.array(predicted)[:, :, None]


def caster_angles(
    way: Float[np.ndarray, "frames 3"], place: tuple[float, float], trail: float
) -> tuple[Float[np.ndarray, " frames"], Float[np.ndarray, " frames"]]:
    """Swivel angle (rad, body frame) of a free caster along the way of its body, and how known.

    A wheel that does not slip sideways is dragged by its pivot like a point by a string of length
    `trail`. On a straight line the angle between them goes as tan(angle / 2) ~ exp(-path / trail),
    the tractrix: within a few trails it forgets where it began. Here it begins at `STARTS` angles;
    their mean is returned, with the length of their mean unit vector, 1 where all agree.
    """
    pivots = np.array([placed(np.array([place]), pose)[0] for pose in way])
    moved = np.diff(pivots, axis=0)
    path, heading = np.linalg.norm(moved, axis=1), np.arctan2(moved[:, 1], moved[:, 0])
    angles = np.empty((len(way), STARTS))  # in the world
    # None of them straight ahead on a way along an axis: a wheel pushed from behind stays there.
    angles[0] = 2 * np.pi * (np.arange(STARTS) + 0.5) / STARTS
    for frame in range(len(moved)):
        lag = (angles[frame] - heading[frame] + np.pi) % (2 * np.pi) - np.pi
        lag = 2 * np.arctan(np.tan(lag / 2) * np.exp(-path[frame] / trail))
        angles[frame + 1] = heading[frame] + lag
    mean = np.exp(1j * (angles - way[:, 2:])).mean(1)
    return np.angle(mean), np.abs(mean)


def mujoco_sysid() -> Any:
    """mujoco.sysid, which can be imported without its extra, but then is empty."""
    try:
        from mujoco import sysid

        complete = hasattr(sysid, "optimize")
    except ImportError:
        complete = False
    if not complete:
        raise PalpateError(
            "this needs mujoco.sysid, which is not installed completely: "
            "`pip install 'palpate[sysid]'` brings it"
        )
    return sysid


def _check(recording: Recording, aligned: Aligned) -> None:
    if aligned.observation.shape[2:] != (1, 3):
        raise PalpateError(
            "mujoco.sysid fits one piece of furniture: expected poses of shape (frames, 1, 3), "
            f"not (frames, {', '.join(map(str, aligned.observation.shape[2:]))})"
        )
    for trial, poses, length in zip(
        recording.trials, aligned.observation, aligned.length, strict=True
    ):
        if length < SMOOTHING or not np.isfinite(poses[:length]).all():
            raise PalpateError(
                f"trial '{trial.name}' is shorter than {SMOOTHING} frames of {CONTROL_PERIOD} s or "
                "has some without a pose: expected a longer one in which the piece is always seen"
            )


def _counted(sysid: Any, scene: ToldScene, shares: np.ndarray) -> Any:
    """The constants as mujoco.sysid counts them, in shares of their bounds."""
    parameters = sysid.ParameterDict()
    for name, share in zip(scene.bounds, shares.tolist(), strict=True):
        parameters.add(sysid.Parameter(name, share, 0.0, 1.0))
    return parameters.move_off_bounds()


def _optimized(residual: Callable[..., Any], parameters: Any, difference: float) -> Any:
    """SciPy's result of a fit with derivatives by such differences.

    Of mujoco.sysid's optimizers the one that says why it ended: SciPy's trust region with
    MuJoCo's derivatives. It prints its progress, whatever it is told.
    """
    with contextlib.redirect_stdout(io.StringIO()):
        _, found = mujoco_sysid().optimize(
            parameters,
            residual,
            optimizer="scipy_parallel_fd",
            verbose=False,
            max_iters=MOST_STEPS,
            diff_step=difference,
            ftol=TOLERANCE,
            xtol=TOLERANCE,
        )
    return found


def _sequences(sysid: Any, scene: ToldScene, aligned: Aligned) -> tuple[Any, int]:
    """The pieces of a recording as mujoco.sysid takes them, and how many they are.

    Measured is at each frame the pose and the standard deviation of what a perfect model's would
    differ by: the noise, and the start's deviation with that of its velocity, as it grows. Pieces
    begin where it is known of all free casters where they point, or of as many as there ever are:
    one beside a hinge may never roll, and then hardly matters.
    """
    planar = furniture([np.asarray(scene.kind.outline)], control_period=CONTROL_PERIOD)
    noise = noise_scale(aligned, planar)
    spec = scene.spec(scene.parameters(*[0.5] * len(scene.bounds)))
    model = spec.compile()
    settled = _settled(model)
    horizon = round(PIECE / CONTROL_PERIOD)
    after = CONTROL_PERIOD * np.arange(1, horizon + 1)[:, None]
    mapping = {MEASURED: (sysid.SignalType.CustomObs, np.arange(6))}
    names, states, controls, measured = [], [], [], []
    least = max(1, _told_at_best(scene, aligned, horizon)) if scene.free else 0
    for trial, length in enumerate(aligned.length):
        one = Aligned(
            aligned.period,
            aligned.observation[trial : trial + 1, :length],
            aligned.action[trial : trial + 1, : length - 1],
            aligned.length[trial : trial + 1],
        )
        pieces = jax.tree.map(np.asarray, cut(one, planar, PIECE, at_rest=True))
        tracks = _tracks(scene, one.observation[0, :, 0])
        for piece in range(pieces.count):
            frame = piece * horizon
            if sum(known[frame] >= KNOWN for _, known in tracks) < least:
                continue
            angles = np.array([angle[frame] for angle, _ in tracks])
            pose, rate = pieces.pose[piece, 0], pieces.rate[piece, 0]
            states.append(_state(sysid, scene, model, settled, pose, rate, angles))
            held = _held(pieces.action[piece])
            held = np.concatenate([held, held[-1:]])  # the last one is never applied
            controls.append(sysid.TimeSeries(TIME_STEP * np.arange(len(held)), held))
            deviation = np.sqrt(
                noise**2
                + pieces.pose_deviation[piece, 0] ** 2
                + (after * pieces.rate_deviation[piece, 0]) ** 2
            )
            deviation = np.where(pieces.seen[piece, :, 0], deviation, np.inf)
            values = np.concatenate([pieces.target[piece, :, 0], deviation], axis=1)
            measured.append(sysid.TimeSeries(after[:, 0], values, mapping))
            names.append(f"trial {trial} frame {frame}")
    if not names:
        raise CastersUnknownError(
            f"the {scene.kind.name} is nowhere moved far enough to tell where its casters point: "
            "expected a recording of 10 s or so in which it is"
        )
    sequences = sysid.ModelSequences("furniture", spec, names, states, controls, measured)
    return sequences, len(names)


def _told_at_best(scene: ToldScene, aligned: Aligned, horizon: int) -> int:
    """Of how many free casters it is known where they point, at the best start of a piece."""
    known = [
        np.array([known[: length - 1 : horizon] for _, known in _tracks(scene, poses[:length, 0])])
        for poses, length in zip(aligned.observation, aligned.length, strict=True)
    ]
    return int(max((each >= KNOWN).sum(axis=0).max() for each in known))


def _tracks(scene: ToldScene, poses: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Angles of each free caster along measured poses (frames, 3), and how known they are."""
    way = scipy.signal.savgol_filter(np.asarray(poses, float), SMOOTHING, 3, axis=0)
    mounts = [scene.kind.mounts[i] for i in scene.free]
    return [caster_angles(way, mount.place, mount.trail) for mount in mounts]


def _residual(
    parameters: Any,
    predicted: Any,
    measured: Any,
    model: mujoco.MjModel,
    return_pred_all: bool,
    state: np.ndarray,
) -> tuple[np.ndarray, Any, Any]:
    """Error of the poses over their standard deviations, (frames, 3)."""
    pose, deviation = measured.data[:, :3], measured.data[:, 3:]
    error = _poses(model, state[None], pose[0, 2])[0] - pose
    return error / deviation, measured, measured


def _settled(model: mujoco.MjModel) -> np.ndarray:
    """Positions (nq,) of everything once it has sunk into the floor."""
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, round(SETTLING / TIME_STEP))
    return data.qpos.copy()


def _state(
    sysid: Any,
    scene: ToldScene,
    model: mujoco.MjModel,
    settled: np.ndarray,
    pose: np.ndarray,
    rate: np.ndarray,
    angles: np.ndarray,
) -> np.ndarray:
    """The state of a piece that rolls without slipping, its free casters at `angles` (rad)."""
    qpos, qvel = settled.copy(), np.zeros(model.nv)
    joint = model.joint(BODY)
    first, speed = joint.qposadr[0], joint.dofadr[0]
    turn = np.zeros(4)
    mujoco.mju_axisAngle2Quat(turn, np.array([0.0, 0, 1]), float(pose[2]) - scene.pose[2])
    mujoco.mju_mulQuat(qpos[first + 3 : first + 7], turn, settled[first + 3 : first + 7])
    qpos[first : first + 2] = pose[:2]
    qvel[speed : speed + 2], qvel[speed + 5] = rate[:2], rate[2]
    cosine, sine = np.cos(pose[2]), np.sin(pose[2])
    forward, left = cosine * rate[0] + sine * rate[1], cosine * rate[1] - sine * rate[0]
    pointing = dict(zip(scene.free, angles, strict=True))
    for number, (mount, locked) in enumerate(zip(scene.kind.mounts, scene.locked, strict=True)):
        if mount.type == "foot" or locked is not None:
            continue
        along, across = forward - rate[2] * mount.place[1], left + rate[2] * mount.place[0]
        if mount.type == "caster":
            angle = pointing[number]
            cosine, sine = np.cos(angle), np.sin(angle)
            along, across = cosine * along + sine * across, cosine * across - sine * along
            swivel = model.joint(f"{BODY} wheel {number} swivel")
            qpos[swivel.qposadr[0]] = angle
            qvel[swivel.dofadr[0]] = across / mount.trail - rate[2]
        qvel[model.joint(f"{BODY} wheel {number} roll").dofadr[0]] = along / mount.radius
    return sysid.create_initial_state(model, qpos, qvel)


def _held(action: np.ndarray) -> np.ndarray:
    """Controls (time steps, 3) of wrenches (periods, 1, 3)."""
    return np.repeat(np.asarray(action[:, 0], float), STEPS_PER_PERIOD, axis=0)


def _poses(model: mujoco.MjModel, states: np.ndarray, yaw: float) -> np.ndarray:
    """Poses (..., periods, 3) at the end of each control period of states (..., steps, state).

    Angles count on from `yaw` in rad.
    """
    first = 1 + model.joint(BODY).qposadr[0]  # a state begins with the time
    ends = states[..., STEPS_PER_PERIOD - 1 :: STEPS_PER_PERIOD, first : first + 7]
    w, x, y, z = np.moveaxis(ends[..., 3:], -1, 0)
    angle = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    begun = np.concatenate([np.full((*angle.shape[:-1], 1), yaw), angle], axis=-1)
    return np.concatenate([ends[..., :2], np.unwrap(begun, axis=-1)[..., 1:, None]], axis=-1)
