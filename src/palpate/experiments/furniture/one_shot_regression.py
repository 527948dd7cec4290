"""After how many samples which method knows how a piece moves: ours beside regressions.

A sample is a tenth of a second of handling: pose and velocity before and after, smoothed from what
a tracker shows, and the mean wrench between. All are given the same handling up to n samples after
the piece is first seen to have moved, before which nobody could know how it does, and the tenth of
a second after it, without which nobody knows the last velocity; pushes of 2 s are then predicted
open loop. Regressions get the inputs that suit them: raw as in the deck (whole
state, whole wrench) and in the piece's own axes; of both the better on these very pushes counts.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from palpate.experiments.furniture.one_shot_pieces import PERIOD, error_share, judge, pushes_of
from palpate.families.furniture.recording import POSE, WRENCH, names_of, starting_furniture
from palpate.families.furniture.structures import structures
from palpate.identification.data.segments import Segments, cut, noise_scale
from palpate.identification.posterior.comparison import compare
from palpate.identification.posterior.likelihood import inferred_scales, motion_posterior
from palpate.identification.regression.model import RegressedModel, fit_regression
from palpate.models.model import rollout
from palpate.models.planar import Planar, PlanarState
from palpate.recordings import Aligned, Polygons, Recording
from palpate.trials.furniture.planar_features import body_features, raw_features

SAMPLE = 0.1  # s
SIZES = (1, 2, 5, 10, 20, 50, 100)
MOVED = 0.02  # m: beyond any noise
PIECE = 10  # samples: longest piece of the handling that the posterior is asked to explain
RIVALS = ("lwr", "oo-lwr", "gp")
OURS = "posterior"
CHAINS = 8  # their draws are predicted with, and not compared


def shares(
    handled: Recording, pushes: Recording, draws: int, seed: int
) -> dict[str, dict[int, float | None]]:
    """Error share on the pushes by method and number of samples; None of one that diverged."""
    aligned = handled.align(PERIOD, POSE, WRENCH)
    found: dict[str, dict[int, float | None]] = {name: {} for name in (OURS, *RIVALS)}
    for size in SIZES:
        seen = first_samples(aligned, size + 1)
        found[OURS][size] = _ours(truncate(handled, seen), seen, pushes, draws, seed)
        for rival in RIVALS:
            share = _theirs(handled, aligned, pushes, rival, size)
            found[rival][size] = share if np.isfinite(share) else None
    return found


def first_samples(aligned: Aligned, size: int) -> Aligned:
    """A recording's first trial up to `size` samples after its one body has first moved."""
    each, last = round(SAMPLE / aligned.period), int(aligned.length[0]) - 1
    way = aligned.observation[0, : last + 1, 0, :2]
    far = np.linalg.norm(way - way[0], axis=-1) > MOVED
    begun = int(np.argmax(far)) if far.any() else 0
    steps = min(each * (begun // each + size), last)
    return Aligned(
        aligned.period,
        aligned.observation[:1, : steps + 1],
        aligned.action[:1, :steps],
        np.array([steps + 1]),
    )


def truncate(recording: Recording, seen: Aligned) -> Recording:
    """A recording of no more than these frames of its first trial."""
    trial = recording.trials[0]
    channels = {}
    for name, values in ((POSE, seen.observation[0]), (WRENCH, seen.action[0])):
        time = trial[name].time[0] + seen.period * np.arange(len(values))
        channels[name] = dataclasses.replace(trial[name], time=time, values=values)
    return dataclasses.replace(recording, trials=(dataclasses.replace(trial, channels=channels),))


def _ours(handled: Recording, seen: Aligned, pushes: Recording, draws: int, seed: int) -> float:
    """Of the posterior given what was `seen` of the handling, of what the piece then probably is.

    Padded, so that all numbers of samples compile once.
    """
    models = structures(handled, PERIOD)
    model, seconds = models["wheels"], PIECE * SAMPLE
    pieces = cut(seen, model, seconds, at_rest=True, count=max(SIZES) // PIECE)
    scales = inferred_scales(model, noise_scale(seen, model))
    targets = {name: motion_posterior(of, pieces, scales) for name, of in models.items()}
    posterior = compare(targets, draws, CHAINS, seed).posterior
    asked = pushes_of(pushes, model)
    result = judge(model, posterior.predict(asked), asked)
    return error_share(result.error_m, result.displacement_m)


def _theirs(handled: Recording, aligned: Aligned, pushes: Recording, kind: str, size: int) -> float:
    """Of the better of two choices of inputs; the object-oriented kind needs the piece's own."""
    prototype = starting_furniture(handled, SAMPLE)
    fine = starting_furniture(handled, PERIOD)
    outlines = handled.fact("outlines", Polygons)
    assert outlines is not None  # the world's own recordings have them
    outline = outlines[names_of(handled)[0]]
    before, wrench, after = transitions(aligned, fine, size)
    asked = pushes_of(pushes, fine)
    choices = [body_features([outline])] + ([] if kind == "oo-lwr" else [raw_features()])
    return min(
        _share(fit_regression(prototype, features, kind, before, wrench, after), asked)
        for features in choices
    )


def transitions(
    aligned: Aligned, model: Planar, size: int
) -> tuple[PlanarState, jax.Array, PlanarState]:
    """States before the samples, mean wrenches, and states after; each leads with the samples."""
    starts = cut(first_samples(aligned, size + 1), model, SAMPLE, at_rest=True)
    states = PlanarState(starts.pose, starts.rate)
    wrench = jnp.mean(starts.action, axis=1)
    before = jax.tree.map(lambda leaf: leaf[:-1], states)
    after = jax.tree.map(lambda leaf: leaf[1:], states)
    return before, wrench[:-1], after


def _share(model: RegressedModel, pushes: Segments) -> float:
    """Error share of open-loop predictions, a sample's time a step; infinite where it diverges."""
    every = round(SAMPLE / PERIOD)
    action = pushes.action.reshape(pushes.count, -1, every, *pushes.action.shape[2:]).mean(axis=2)
    states = rollout(model, PlanarState(pushes.pose, pushes.rate), action)
    final = np.asarray(states.pose, np.float64)[:, -1, 0, :2]
    if not np.isfinite(final).all():
        return float("inf")
    target = np.asarray(pushes.target)[:, -1, 0, :2]
    displacement = target - np.asarray(pushes.pose)[:, 0, :2]
    return error_share(np.linalg.norm(final - target, axis=1), np.linalg.norm(displacement, axis=1))
