"""A rival in `one-shot`: mujoco.sysid, given the true structure of a piece of furniture.

mujoco.sysid (github.com/google-deepmind/mujoco, python/mujoco/sysid) fits constants of a MuJoCo
scene to recordings by nonlinear least squares within bounds. Here it is told what our method has
to find out or do without: the very scene that the recording comes from, its wheels, casters and
feet, which caster is locked and at what angle, where a hinge holds. It fits what remains: the mass,
where the load stands, friction and rolling resistance, and is told the ranges they were drawn from,
as a prior and a place to begin. It yields one point and no posterior.

Both begin at starts that are smoothed alike (`segments.cut`): here of pieces of a second, ours of
pieces of two. What a start does not show is where free casters point: that follows from the way
they were dragged before (`told_scene`), and pieces that begin before it is known are left out.
"""

import contextlib
import dataclasses
import functools
import io
import math
import os
from collections.abc import Callable
from typing import Any

import jax
import mujoco
import mujoco.rollout
import numpy as np
from jaxtyping import Float

from palpate.errors import PalpateError
from palpate.experiments.rivals.furniture_scene import (
    MEASURED,
    SMOOTHING,
    ToldScene,
    caster_tracks,
    poses_of,
    rolling_state,
    settled_positions,
)
from palpate.identification.data.segments import Segments, cut, noise_scale
from palpate.models.planar import furniture
from palpate.recordings import Aligned, Recording
from palpate.worlds.furniture.furniture import CONTROL_PERIOD, STEPS_PER_PERIOD
from palpate.worlds.furniture.pieces import PieceKind, PieceParameters, draw_parameters
from palpate.worlds.furniture.scene import TIME_STEP

PIECE = 1.0  # s
KNOWN = 0.98  # length of their mean unit vector from which on it counts as known
# Of a constant's range. Where a push comes close to what dry friction can hold, the residual is
# all steps: with differences of 1e-3 a couch's fit ended at 4.7 times the noise, so at the noise.
DIFFERENCES = (0.03, 0.01)
TOLERANCE = 1e-3  # relative change of the cost, or of the constants, at which a fit is done
MOST_STEPS = 50  # of the optimizer, for each difference
GUESSES = 16  # of the constants, of which the best is where a fit begins
THREADS = os.cpu_count() or 1


class CastersUnknownError(PalpateError):
    """A recording in which no free caster rolls far enough to show where it points."""


@dataclasses.dataclass(frozen=True)
class SysidFit:
    """What mujoco.sysid found: the constants of what it was told of the `scene`.

    `converged` says that it ended by its tolerances, and not because it had tried often enough.
    """

    scene: ToldScene
    parameters: PieceParameters
    converged: bool


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
    gaps or other bodies; `CastersUnknownError` when it does not tell where casters point.
    """
    sysid = mujoco_sysid()
    if kind.bolted:
        raise PalpateError(
            f"a '{kind.name}' is bolted down, so that nothing of it can be fitted: leave it out"
        )
    aligned = recording.align(CONTROL_PERIOD)
    _check(recording, aligned)
    scene = ToldScene(kind, locked, anchor, tuple(aligned.observation[0, 0, 0].tolist()))
    sequences = _sequences(sysid, scene, aligned)
    model = functools.lru_cache(maxsize=GUESSES)(scene.model)  # it asks anew for every piece
    whole = sysid.build_residual_fn(
        models_sequences=[sequences],
        build_model=lambda current, _: model(*current.as_vector().tolist()),
        modify_residual=_residual,
        resample_true=False,
        n_threads=THREADS,
    )
    middle, width = scene.prior

    def residual(vector: np.ndarray, current: Any) -> Any:
        """What mujoco.sysid compares, and how far the constants are from what is usual.

        Without the latter what the recording does not determine, such as the friction of wheels
        that never slip, ends anywhere.
        """
        errors, *compared = whole(vector, current)
        return [*errors, ((vector.T - middle) / width).T], *compared

    random = np.random.default_rng(seed)
    guesses = np.array([scene.shares(draw_parameters(kind, random)) for _ in range(GUESSES)])
    errors, *_ = residual(guesses.T, _scale(sysid, scene, guesses[0]))
    shares = guesses[np.argmin(np.square(np.concatenate(errors)).sum(0))]
    for difference in DIFFERENCES:
        found = _optimize(residual, _scale(sysid, scene, shares), difference)
        shares = found.x
    return SysidFit(scene, scene.parameters(*shares.tolist()), found.status > 0)


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
        settled = settled_positions(model)
        states = [
            rolling_state(sysid, scene, model, settled, start[0], np.zeros(3), a) for a in angles
        ]
        control = np.tile(_hold(action), (draws, 1, 1))
        data = [mujoco.MjData(model) for _ in range(THREADS)]
        rolled, _ = mujoco.rollout.rollout(model, data, np.array(states), control)
        predicted.append(poses_of(model, rolled, pose[2]).mean(0))
    return np.array(predicted)[:, :, None]


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


def _scale(sysid: Any, scene: ToldScene, shares: np.ndarray) -> Any:
    """The constants as mujoco.sysid counts them, in shares of their bounds."""
    parameters = sysid.ParameterDict()
    for name, share in zip(scene.bounds, shares.tolist(), strict=True):
        parameters.add(sysid.Parameter(name, share, 0.0, 1.0))
    return parameters.move_off_bounds()


def _optimize(residual: Callable[..., Any], parameters: Any, difference: float) -> Any:
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


def _sequences(sysid: Any, scene: ToldScene, aligned: Aligned) -> Any:
    """The pieces of a recording as mujoco.sysid takes them.

    Measured is at each frame the pose and the standard deviation of what a perfect model's would
    differ by: the noise, and the start's deviation with that of its velocity, as it grows. Pieces
    begin where it is known of all free casters where they point, or of as many as there ever are:
    one beside a hinge may never roll, and then hardly matters.
    """
    planar = furniture([np.asarray(scene.kind.outline)], control_period=CONTROL_PERIOD)
    noise = noise_scale(aligned, planar)
    spec = scene.spec(scene.parameters(*[0.5] * len(scene.bounds)))
    model = spec.compile()
    settled = settled_positions(model)
    horizon = round(PIECE / CONTROL_PERIOD)
    after = CONTROL_PERIOD * np.arange(1, horizon + 1)[:, None]
    mapping = {MEASURED: (sysid.SignalType.CustomObs, np.arange(6))}
    names, states, controls, measured = [], [], [], []
    tracks = [
        caster_tracks(scene, poses[:length, 0])
        for poses, length in zip(aligned.observation, aligned.length, strict=True)
    ]
    known = [
        np.sum([known[: len(known) - 1 : horizon] >= KNOWN for _, known in track], axis=0)
        for track in tracks
    ]
    least = max(1, *map(np.max, known)) if scene.free else 0
    for trial, length in enumerate(aligned.length):
        one = Aligned(
            aligned.period,
            aligned.observation[trial : trial + 1, :length],
            aligned.action[trial : trial + 1, : length - 1],
            aligned.length[trial : trial + 1],
        )
        pieces = jax.tree.map(np.asarray, cut(one, planar, PIECE, at_rest=True))
        for piece in range(pieces.count):
            frame = piece * horizon
            if scene.free and known[trial][piece] < least:
                continue
            angles = np.array([angle[frame] for angle, _ in tracks[trial]])
            pose, rate = pieces.pose[piece, 0], pieces.rate[piece, 0]
            states.append(rolling_state(sysid, scene, model, settled, pose, rate, angles))
            held = _hold(pieces.action[piece])
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
    return sysid.ModelSequences("furniture", spec, names, states, controls, measured)


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
    error = poses_of(model, state[None], pose[0, 2])[0] - pose
    return error / deviation, measured, measured


def _hold(action: np.ndarray) -> np.ndarray:
    """Controls (time steps, 3) of wrenches (periods, 1, 3)."""
    return np.repeat(np.asarray(action[:, 0], float), STEPS_PER_PERIOD, axis=0)
