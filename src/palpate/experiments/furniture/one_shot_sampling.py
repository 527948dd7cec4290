"""Three samplers on one posterior: how many effective draws of predictions each gives in a second.

The posterior is that of a couch, of which the model knows neither feet nor wheels: 14 physical
parameters of one body, and the noise scales. Metropolis proposes with the prior's widths (the
sampler of physics-based RL) or with the covariance that it has seen (Haario, Saksman and Tamminen
2001). All begin at the modes.
"""

import dataclasses
from collections.abc import Callable

import jax
import numpy as np

from palpate.identification.posterior import predictive
from palpate.identification.posterior.diagnostics import bulk_size, rhat, tail_size
from palpate.identification.posterior.posterior import Posterior
from palpate.identification.samplers.draws import Draws
from palpate.identification.samplers.metropolis import covariance_adapted, prior_scaled

OURS = "local-global"


@dataclasses.dataclass(frozen=True)
class Pace:
    """Of one sampler: R-hat and effective size of what the draws predict, and seconds it took."""

    rhat: float
    size: float
    seconds: float
    evaluations: int

    @property
    def rate(self) -> float:
        """Effective draws per second."""
        return self.size / self.seconds


DRAWS = 1000  # kept of each chain of Metropolis
TRIED = 2000  # steps from which a sampler's pace is found


def race(posterior: Posterior, seed: int, budget: float) -> dict[str, Pace]:
    """Our draws, and both kinds of Metropolis given about `budget` seconds each.

    How many steps fit in is found from a short run of the same sampler. Neither compiling counts
    for any of them nor the search for the modes that all begin at: the rate is of a sampler that
    runs on. All divide their chains over the cores.
    """
    paces = {OURS: _pace(posterior, posterior.draws)}
    target, chains = posterior.target, posterior.draws.position.shape[0]
    samplers: dict[str, Callable[..., Draws]] = {
        "metropolis": prior_scaled,
        "adapted": covariance_adapted,
    }
    start, *keys = jax.random.split(jax.random.key(seed), 1 + 2 * len(samplers))
    begin = posterior.settled.parts[0].modes.draw(start, chains)
    for number, (name, sampler) in enumerate(samplers.items()):
        tried = sampler(target, begin, keys[2 * number], 50, TRIED // 2, thin=TRIED // 100)
        step = (tried.seconds - tried.compiling) / TRIED
        steps = max(TRIED, int(budget / step))
        thin = max(1, steps // 2 // DRAWS)
        draws = sampler(target, begin, keys[2 * number + 1], DRAWS, steps // 2, thin=thin)
        paces[name] = _pace(posterior, draws)
    return paces


def _pace(posterior: Posterior, draws: Draws) -> Pace:
    """Judged by what is predicted at the ends of the posterior's probes."""
    found = predictive.final_poses(posterior.target, draws.position, posterior.probes)
    return Pace(
        rhat=float(np.max(rhat(found))),
        size=float(min(np.min(bulk_size(found)), np.min(tail_size(found)))),
        seconds=draws.seconds - draws.compiling,
        evaluations=draws.evaluations,
    )
