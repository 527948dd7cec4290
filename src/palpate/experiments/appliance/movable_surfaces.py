"""`palpate reproduce movable-surfaces`: what a still look tells of which surfaces move.

The network of `palpate.learning.movable_guess` is trained on first looks at generated appliances
and judged on others, beside the same number for every surface and beside a logistic regression of
the same features. The run holds the network; a copy of it comes with palpate, and
`palpate interact --guess` takes one of yours.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize
from scipy.stats import rankdata

from palpate.experiments.experiment import Experiment
from palpate.learning.movable_guess import fit_guess
from palpate.perception.surface_features import FEATURES
from palpate.runs import Figure, Result
from palpate.trials.appliance.surface_examples import examples_of
from palpate.worlds.appliance.categories import CATEGORIES

NAME = "movable-surfaces"
GUESS = "guess.safetensors"
TRAINED, JUDGED = 720_000, 740_000  # seeds of the first appliances of each category
CHUNK = 10  # seeds of a stage
MINUTES = {"looks": 16, "training": 1}

Probabilities = Float[np.ndarray, " surfaces"]


@dataclass(frozen=True)
class Size:
    """Seeds of each category, to train on and to judge by."""

    trained: int
    judged: int


FULL, QUICK = Size(200, 40), Size(10, 10)


def reproduce(out: Path, *, quick: bool = False, seed: int = 0) -> Result:
    """Look, train and judge below `out`; `quick` is a twentieth of it.

    Raises `PalpateError` when `out` holds other runs.
    """
    experiment, size = Experiment(NAME, out, quick, seed), QUICK if quick else FULL
    experiment.announce({"looks": 1} if quick else MINUTES)
    firsts = {
        "trained": experiment.uses(TRAINED, size.trained),
        "judged": experiment.uses(JUDGED, size.judged),
    }
    grid = [
        (split, first + start)
        for split, first in firsts.items()
        for start in range(0, getattr(size, split), CHUNK)
    ]
    experiment.on_every_core(looks_from, grid, "looks")
    examples = {
        split: together([looks_from(experiment, *one) for one in grid if one[0] == split])
        for split in firsts
    }
    features, moves = examples["trained"]
    with experiment.counted():
        guess = fit_guess(features, moves, seed)
        guess.save(out / GUESS, {"appliances": size.trained * len(CATEGORIES), "first": TRAINED})
    seen, real = examples["judged"]
    rivals = {
        "logistic": logistic(features, moves)(seen),
        "constant": np.full(len(real), moves.mean()),
    }
    return experiment.result(
        figures(guess(seen), rivals, seen, real),
        {"size": dataclasses.asdict(size), "features": list(FEATURES)},
        "judged by appliances that it is not trained on",
    )


def looks_from(experiment: Experiment, split: str, first: int) -> dict[str, Any]:
    """Examples of some seeds of each category, in a stage of its own."""

    def work() -> dict[str, Any]:
        found = [
            examples_of(category, seed)
            for category in CATEGORIES
            for seed in range(first, first + CHUNK)
        ]
        features, moves = (np.concatenate(each) for each in zip(*found, strict=True))
        return {"features": features.round(4).tolist(), "moves": moves.tolist()}

    return experiment.found(f"{split}-{first}", {"split": split, "first": first}, work)


def together(parts: Sequence[dict[str, Any]]) -> tuple[np.ndarray, np.ndarray]:
    """Features (surfaces, features) and whether each moves (surfaces,)."""
    features = np.concatenate([np.array(one["features"], float) for one in parts])
    return features, np.concatenate([np.array(one["moves"], float) for one in parts])


def logistic(features: np.ndarray, moves: np.ndarray):
    """A logistic regression of the standardised features, as a function of others."""
    mean, deviation = features.mean(axis=0), features.std(axis=0) + 1e-6

    def rows(of: np.ndarray) -> np.ndarray:
        return np.column_stack([np.ones(len(of)), (of - mean) / deviation])

    def loss(weights: np.ndarray) -> float:
        odds = rows(features) @ weights
        return float(np.mean(np.logaddexp(0.0, odds) - moves * odds))

    weights = minimize(loss, np.zeros(features.shape[1] + 1), method="L-BFGS-B").x
    return lambda of: 1.0 / (1.0 + np.exp(-rows(of) @ weights))


def figures(
    guess: Probabilities,
    rivals: dict[str, Probabilities],
    features: np.ndarray,
    real: np.ndarray,
) -> list[Figure]:
    """How well probabilities tell what moves from what stands still, and how true they are."""
    on_part = features[:, FEATURES.index("on a part")] > 0.5
    listed = []
    for prefix, chosen in (("", ~on_part), ("on_part.", on_part)):
        own = {"": guess, **{f"{name}.": each for name, each in rivals.items()}}
        for name, each in own.items():
            listed += [
                Figure(f"{prefix}{name}area_under_curve",
                       area_under_curve(each[chosen], real[chosen]), "", better="higher"),
                Figure(f"{prefix}{name}log_loss", log_loss(each[chosen], real[chosen]), "nats"),
            ]  # fmt: skip
        listed.append(Figure(f"{prefix}surfaces", float(chosen.sum()), "", better="higher"))
    return listed


def area_under_curve(chance: Probabilities, real: np.ndarray) -> float | None:
    """The probability that a surface that moves has a greater number than one that does not."""
    positive = real > 0.5
    count, others = int(positive.sum()), int((~positive).sum())
    if not count or not others:
        return None
    ranks = rankdata(chance)[positive].sum() - 0.5 * count * (count + 1)
    return float(ranks / (count * others))


def log_loss(chance: Probabilities, real: np.ndarray) -> float | None:
    """The mean negative logarithm of what was said of what happened, nats."""
    if not len(real):
        return None
    said = np.clip(np.where(real > 0.5, chance, 1.0 - chance), 1e-9, 1.0)
    return float(-np.mean(np.log(said)))
