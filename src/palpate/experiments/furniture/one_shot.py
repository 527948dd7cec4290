"""`palpate reproduce one-shot`: ten seconds of handling, then pushes that nobody has seen.

Each kind of furniture of the MuJoCo world is wiggled for ten seconds. From poses and wrenches alone
palpate finds out what a piece most probably is (on a wheel, on feet, hinged, bolted down), samples
the posterior of its parameters, and predicts pushes of two seconds open loop. Beside it regressions
after 1 to 100 samples, mujoco.sysid which is told the structure, other samplers of the same
posterior, and five pieces in one scene fitted jointly.
"""

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from palpate.experiments.experiment import Experiment
from palpate.experiments.furniture.one_shot_figure import shares_figure
from palpate.experiments.furniture.one_shot_pieces import (
    BOLTED,
    HANDLED,
    MOVABLE,
    PERIOD,
    SCENE,
    error_share,
    fit,
    fit_jointly,
    judge,
    pushes_of,
    recordings,
    scene,
)
from palpate.experiments.furniture.one_shot_regression import OURS, RIVALS, SIZES, shares
from palpate.experiments.furniture.one_shot_sampling import OURS as SAMPLER
from palpate.experiments.furniture.one_shot_sampling import Pace, race
from palpate.experiments.rivals import mujoco_sysid as one_shot_sysid
from palpate.families.furniture.recording import POSE, WRENCH, starting_furniture
from palpate.identification.posterior.comparison import posterior_of
from palpate.identification.posterior.posterior import Posterior, sample
from palpate.recordings import Recording
from palpate.runs import Figure, Result
from palpate.runs.progress import progress
from palpate.runs.result import two_standard_errors
from palpate.worlds.furniture.furniture import FurnitureWorld
from palpate.worlds.furniture.pieces import KINDS, Piece

NAME = "one-shot"
FIGURE = "shares.png"
SEEDS = 923_000  # of hidden constants, handling and pushes, used by nothing else
RACED = "couch"  # whose posterior the samplers race on


@dataclasses.dataclass(frozen=True)
class Size:
    """How much of everything: pieces of each kind, pushes of each, draws of each chain."""

    pieces: int
    pushes: int
    draws: int
    compared_draws: int
    scene_draws: int
    scene_pushes: int  # of each piece
    raced_draws: int
    budget: float  # s, of each rival sampler
    minutes: dict[str, int] = dataclasses.field(default_factory=dict)


FULL = Size(
    2, 10, 100, 50, 150, 6, 140, 60.0, {"pieces": 20, "samples": 35, "samplers": 4, "scene": 6}
)
QUICK = Size(1, 4, 25, 25, 50, 2, 25, 5.0, {"pieces": 4, "samples": 2, "samplers": 1})


def reproduce(out: Path, *, quick: bool = False, seed: int = 0) -> Result:
    """Handle, identify and push every kind below `out`; `quick` is the same, smaller.

    Raises `PalpateError` when `out` holds another run's stages.
    """
    experiment, size = Experiment(NAME, out, quick, seed), QUICK if quick else FULL
    experiment.announce(size.minutes)
    one_shot_sysid.mujoco_sysid()  # an hour later would be late to say that it is missing
    movable = ("cart", "couch") if quick else MOVABLE
    first = SEEDS + 1000 * seed

    def found(folder: str, stage: str, work: Callable[..., dict[str, Any]], **about: Any):
        return experiment.found(folder, {"stage": stage, **about}, lambda: work(**about))

    given = {"pushes": size.pushes, "draws": size.draws}
    pieces = {
        kind: [
            found(f"{kind}-{piece}", "piece", _piece, kind=kind, seed=piece, **given)
            for piece in range(first, first + size.pieces)
        ]
        for kind in progress((*movable, BOLTED), "handling, identifying and pushing")
    }
    given = {"seed": first, "pushes": size.pushes, "draws": size.compared_draws}
    compared = {
        kind: found(f"samples-{kind}", "samples", _compare, kind=kind, **given)
        for kind in progress(movable, "sample sizes")
    }
    given = {"seed": first, "pushes": size.pushes, "pieces": size.pieces}
    sysid = {
        kind: found(f"sysid-{kind}", "sysid", _sysid, kind=kind, **given)
        for kind in progress(movable, "mujoco.sysid")
    }
    given = {"seed": first, "draws": size.raced_draws, "budget_s": size.budget}
    raced = found("samplers", "samplers", _race, kind=RACED, **given)
    given = {"seed": first, "pushes": size.scene_pushes, "draws": size.scene_draws}
    joint = None if quick else found("scene", "scene", _joint, kinds=SCENE, **given)
    shares_figure(out / FIGURE, compared)
    return experiment.result(
        _figures(pieces, compared, sysid, raced, joint, first),
        {
            "handled_s": HANDLED,
            "sizes": SIZES,
            "raced": f"the {RACED} of seed {first}; chains and leaps were tuned on that of {SEEDS}",
            **{name: value for name, value in vars(size).items() if name != "minutes"},
        },
        {
            "fitted": f"{HANDLED:g} s of handling of each piece, seeds from {first}",
            "evaluated": f"{size.pushes} pushes of 2 s of the same pieces from rest",
        },
        [seed, *range(first, first + size.pieces)],
    )


def _piece(kind: str, seed: int, pushes: int, draws: int) -> dict[str, Any]:
    """One piece: its structure and posterior, and what they say of pushes."""
    handled, pushed = recordings(kind, seed, pushes)
    found, seconds = fit(handled, draws, seed)
    return {
        **_judge(found.posterior, pushed),
        "structure": found.structure,
        "probability": found.probability,
        "divergences": found.posterior.draws.divergences,
        "fit_s": seconds,
    }


def _compare(kind: str, seed: int, pushes: int, draws: int) -> dict[str, Any]:
    """One piece after growing numbers of samples, beside regressions."""
    found = shares(*recordings(kind, seed, pushes), draws, seed)
    return {"shares": {name: {str(n): v for n, v in of.items()} for name, of in found.items()}}


def _sysid(kind: str, seed: int, pushes: int, pieces: int) -> dict[str, Any]:
    """mujoco.sysid, given all but constants, on the first piece of a kind it can be fitted to.

    It needs to know where free casters point, which some handling does not show.
    """
    refused = {}
    for piece in range(seed, seed + pieces):
        try:
            return {**_fit_by_sysid(kind, piece, pushes), "refused": refused}
        except one_shot_sysid.CastersUnknownError as error:
            refused[str(piece)] = str(error)
    return {"error_m": [], "displacement_m": [], "refused": refused}


def _race(kind: str, seed: int, draws: int, budget_s: float) -> dict[str, Any]:
    """The samplers on the posterior of a piece.

    Ours is timed as a user waits for it: search for modes, compiling, warm-up and draws.
    """
    handled, _ = recordings(kind, seed, 1)
    model = starting_furniture(handled, PERIOD)
    target = posterior_of(model, handled.align(PERIOD, POSE, WRENCH))
    jax.clear_caches()  # what the pieces have compiled would not be there for a user
    began = time.monotonic()
    posterior = sample(target, draws=draws, seed=seed)
    spent = time.monotonic() - began
    paces = race(posterior, seed, budget_s)
    return {
        "free_parameters": posterior.target.parameters,
        "posterior_s": spent,
        "compiling_s": posterior.draws.compiling,
        "paces": {name: dataclasses.asdict(pace) for name, pace in paces.items()},
    }


def _joint(kinds: tuple[str, ...], seed: int, pushes: int, draws: int) -> dict[str, Any]:
    """Pieces in one scene, fitted together from ten seconds in which all are handled."""
    handled, pushed = scene(kinds, seed, pushes)
    return _judge(fit_jointly(handled, draws, seed), pushed)


def _judge(posterior: Posterior, pushes: Recording) -> dict[str, Any]:
    """What a posterior says of pushes, and how far its draws are to be trusted."""
    model = posterior.target.coordinates.reference
    asked = pushes_of(pushes, model)
    return {
        **vars(judge(model, posterior.predict(asked), asked)),
        "rhat": posterior.rhat_of_predictions,
        "ess": posterior.size_of_predictions,
        "sampling_s": posterior.draws.seconds,
    }


def _fit_by_sysid(kind: str, seed: int, pushes: int) -> dict[str, Any]:
    """What mujoco.sysid says of the pushes of one piece, whose structure it is given."""
    handled, pushed = recordings(kind, seed, pushes)
    world = FurnitureWorld([Piece(kind)])
    world.reset(seed)
    truth = world.truth().parameters[0]
    fitted = one_shot_sysid.fit_scene(handled, KINDS[kind], truth.locked, truth.anchor, seed)
    asked = pushes_of(pushed, starting_furniture(handled, PERIOD))
    motion = one_shot_sysid.predict_pieces(fitted, asked)
    target, start = np.asarray(asked.target), np.asarray(asked.pose)
    return {
        "error_m": np.linalg.norm((motion - target)[:, -1, 0, :2], axis=-1).tolist(),
        "displacement_m": np.linalg.norm((target[:, -1] - start)[:, 0, :2], axis=-1).tolist(),
        "converged": fitted.converged,
        "piece": seed,
    }


def _figures(
    pieces: dict[str, list[dict[str, Any]]],
    compared: dict[str, dict[str, Any]],
    sysid: dict[str, dict[str, Any]],
    raced: dict[str, Any],
    joint: dict[str, Any] | None,
    first: int,
) -> list[Figure]:
    movable = {kind: of for kind, of in pieces.items() if kind != BOLTED}
    each = {kind: pooled_share(of) for kind, of in movable.items()}
    every = [stage for of in movable.values() for stage in of]
    inside = [stage["inside"] for stage in every]
    paces = {name: Pace(**pace) for name, pace in raced["paces"].items()}
    wins, cells = victories(compared)
    figures = [
        Figure("error_share", pooled_share(every), "", bar=0.05, seed_document="one-shot learning",
               spread=two_standard_errors([pooled_share([stage]) for stage in every])),
        Figure("error_share_worst_kind", max(each.values()), "", bar=0.2),
        Figure("bolted_drift_cm", 100.0 * max(stage["drift_m"] for stage in pieces[BOLTED]), "cm",
               bar=1.0),
        Figure("coverage_90", float(np.mean(inside)), "", bar=0.85, better="higher",
               spread=two_standard_errors(inside)),
        Figure("coverage_90_over", float(np.mean(inside)), "", bar=0.95),
        Figure("wins_against_regression", wins / cells, "", bar=0.9, better="higher"),
        Figure("rhat_max_predictions", paces[SAMPLER].rhat, "", bar=1.01),
        Figure("ess_min", paces[SAMPLER].size, "", bar=400, better="higher"),
        Figure("sampling_s", raced["posterior_s"], "s", bar=60),
        Figure("ess_per_s_over_metropolis", paces[SAMPLER].rate / paces["metropolis"].rate, "",
               bar=20, better="higher"),
        Figure("ess_per_s_over_adapted", paces[SAMPLER].rate / paces["adapted"].rate, "", bar=1,
               better="higher"),
    ]  # fmt: skip
    if joint is not None:
        share = error_share(np.array(joint["error_m"]), np.array(joint["displacement_m"]))
        figures += [
            Figure("scene.coverage_90", joint["inside"], "", bar=0.85, better="higher"),
            Figure("scene.coverage_90_over", joint["inside"], "", bar=0.95),
            Figure("scene.error_share", share, ""),
        ]
    figures += [Figure(f"error_share.{kind}", share, "") for kind, share in each.items()]
    figures += [
        Figure(f"coverage_90.{kind}", float(np.mean([stage["inside"] for stage in of])), "")
        for kind, of in pieces.items()
    ]
    figures += [
        Figure(
            f"error_share_of_sysid.{kind}", pooled_share([stage]) if stage["error_m"] else None, ""
        )
        for kind, stage in sysid.items()
    ]
    ours, theirs = of_the_same_pieces(pieces, sysid, first)
    figures += [
        Figure("error_share_of_sysid", pooled_share(theirs) if theirs else None, ""),
        Figure("error_share_of_the_same_pieces", pooled_share(ours) if ours else None, ""),
    ]
    figures.append(Figure("rhat_worst_piece", max(s["rhat"] for s in every), ""))
    figures.append(Figure("ess_worst_piece", min(s["ess"] for s in every), "", better="higher"))
    return figures


def pooled_share(stages: list[dict[str, Any]]) -> float:
    """Error share over all pushes of these pieces."""
    error = np.concatenate([stage["error_m"] for stage in stages])
    return error_share(error, np.concatenate([stage["displacement_m"] for stage in stages]))


def of_the_same_pieces(
    pieces: dict[str, list[dict[str, Any]]], sysid: dict[str, dict[str, Any]], first: int
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Our stages and those of mujoco.sysid, of exactly the pieces that it was fitted to.

    `first` is the seed of the first piece of each kind; the seeds of the others follow it.
    """
    theirs = {kind: stage for kind, stage in sysid.items() if stage["error_m"]}
    ours = [pieces[kind][stage["piece"] - first] for kind, stage in theirs.items()]
    return ours, list(theirs.values())


def victories(compared: dict[str, dict[str, Any]]) -> tuple[int, int]:
    """In how many cells of kind and number of samples no regression has a smaller error share.

    One that diverged has none.
    """
    wins = cells = 0
    for stage in compared.values():
        for size, ours in stage["shares"][OURS].items():
            theirs = (stage["shares"][rival][size] for rival in RIVALS)
            cells += 1
            wins += all(share is None or ours < share for share in theirs)
    return wins, cells
