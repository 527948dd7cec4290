"""Draws of any model with declared priors, given recordings of it, and how far to trust them.

    posterior = sample(posterior_of(model, recording.align(model.control_period)), "nuts")
    posterior.table                    # medians, intervals, R-hat, what the data left undecided
    posterior.predict(cut(held_out, model, 2.0, at_rest=True))

The likelihood is that of `likelihood`, of pieces of two seconds or so (`comparison.posterior_of`);
what samples it is one of `SAMPLERS`.
"""

import contextlib
import dataclasses
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import cached_property

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from palpate.errors import PalpateError
from palpate.family import check_name
from palpate.identification.data.segments import Segments
from palpate.identification.posterior import predictive
from palpate.identification.posterior.diagnostics import FEWEST, bulk_size, rhat, tail_size
from palpate.identification.posterior.likelihood import MotionPosterior
from palpate.identification.posterior.predictive import Predicted, Score
from palpate.identification.posterior.settled import Settled, factors_of, join_draws, settle_each
from palpate.identification.samplers.draws import Draws
from palpate.identification.samplers.hamiltonian import no_u_turn
from palpate.identification.samplers.local_global import CHAINS, compile_beside, local_global
from palpate.identification.samplers.metropolis import metropolis
from palpate.identification.samplers.tempered import populations
from palpate.identification.verdicts import undecided
from palpate.models.model import Model
from palpate.parameters import value_of
from palpate.runs.progress import Watch, without_progress

MIXED, EFFECTIVE = 1.01, 400.0  # R-hat and effective sizes to reach (Vehtari et al.)
WIDEST = 40  # coordinates among which a mixture that proposes can be learnt
PRIOR_DRAWS = 1000  # that the posterior's spread is held against
PREDICTING = 400  # draws that a prediction is made of
LOCAL_GLOBAL = "local-global"


@dataclasses.dataclass(frozen=True)
class Sampler:
    """What draws from a posterior whose modes are known, and how many chains and draws it wants.

    `run(target, modes, key, chains, draws, watch)` gives `Draws`.
    """

    run: Callable[..., Draws]
    chains: int
    draws: int


SAMPLERS = {
    # Chains of the no-U-turn sampler run one after another on each core.
    "nuts": Sampler(no_u_turn, 8, 200),
    "metropolis": Sampler(metropolis, 16, 100),
    LOCAL_GLOBAL: Sampler(local_global, CHAINS, 100),
    "smc": Sampler(populations, 4, 500),
}


@dataclasses.dataclass(frozen=True)
class Row:
    """One coordinate of a posterior, in the parameter's own unit.

    `lower` to `upper` holds 90 % of the draws; `share` is the posterior's standard deviation over
    the prior's, and `shift` the distance of its mean from the prior's in such deviations, both in
    whitened coordinates: a share of 1 and no shift say that the data told nothing.
    """

    name: str
    unit: str
    about: str
    median: float
    lower: float
    upper: float
    share: float
    shift: float
    rhat: float
    bulk: float
    tail: float

    @property
    def undecided(self) -> bool:
        """Whether the data left this where the prior had it."""
        return bool(undecided(self.share, self.shift))


@dataclasses.dataclass(frozen=True)
class Posterior:
    """Draws of a model's parameters given recordings, and how far to trust them.

    `probes` are the pieces at whose ends the chains' predictions are compared: labels of wheels
    may swap between draws that predict the same. `sampler` is the name of what drew.
    """

    settled: Settled
    draws: Draws
    probes: Segments
    sampler: str = LOCAL_GLOBAL

    @property
    def target(self) -> MotionPosterior:
        """What was sampled."""
        return self.settled.target

    @property
    def flat(self) -> Float[np.ndarray, "draws free"]:
        """Draws of all chains in whitened coordinates, chain after chain."""
        return self.draws.position.reshape(-1, self.draws.position.shape[-1])

    def thinned(self, count: int) -> Float[np.ndarray, "count free"]:
        """About evenly spaced draws over all chains."""
        return self.flat[spread_out(len(self.flat), count)]

    def models(self, count: int | None = None) -> Model:
        """Legal models as one, all draws or about `count` evenly spaced; free parameters lead.

        What is fixed has no batch axis.
        """
        return self.target.models(jnp.asarray(self.flat if count is None else self.thinned(count)))

    @cached_property
    def prior(self) -> Model:
        """Models as one, as `models`, of draws from the prior."""
        return self.target.models(self._prior_draws)

    @cached_property
    def _prior_draws(self) -> Float[Array, "draws free"]:
        return jax.random.normal(jax.random.key(0), (PRIOR_DRAWS, self.target.dimension))

    @cached_property
    def values(self) -> dict[str, Float[np.ndarray, "chains draws ..."]]:
        """Legal values of the free parameters by path, in their units."""
        models = self.models()
        lead = self.draws.position.shape[:2]
        found = {}
        for path in self.target.coordinates.declarations:
            value = np.asarray(value_of(models, path))
            found[path] = value.reshape(*lead, *value.shape[1:])
        return found

    @cached_property
    def predictions(self) -> Float[np.ndarray, "chains draws segments ..."]:
        """What each draw says is observed at the end of each probe, without noise."""
        return predictive.final_poses(self.target, self.draws.position, self.probes)

    @cached_property
    def rhat_of_predictions(self) -> float:
        """Greatest R-hat over everything observed at the ends of the probes."""
        return float(np.max(rhat(self.predictions)))

    @cached_property
    def size_of_predictions(self) -> float:
        """Least effective sample size, bulk and tail, over the ends of the probes."""
        return float(min(np.min(bulk_size(self.predictions)), np.min(tail_size(self.predictions))))

    @cached_property
    def table(self) -> tuple[Row, ...]:
        """A row for each coordinate: the parameters by element, then the noise scales."""
        position = self.draws.position
        after = np.asarray(_legal(self.target, jnp.asarray(self.flat)))
        before = np.asarray(_legal(self.target, self._prior_draws))
        share = after.std(axis=0) / before.std(axis=0)
        shift = (after.mean(axis=0) - before.mean(axis=0)) / before.std(axis=0)
        judged = rhat(position), bulk_size(position), tail_size(position)
        values = self._by_name()
        rows = []
        for index, (name, (unit, about, draws)) in enumerate(values.items()):
            lower, median, upper = np.quantile(draws, (0.05, 0.5, 0.95))
            rows.append(
                Row(
                    name, unit, about, float(median), float(lower), float(upper),
                    float(share[index]), float(shift[index]),
                    *(float(column[index]) for column in judged),
                )
            )  # fmt: skip
        return tuple(rows)

    @property
    def rows_of(self) -> dict[str, list[Row]]:
        """The rows of `table` by parameter; noise scales are left out."""
        paths = self.target.coordinates.declarations
        return {
            path: [row for row in self.table if row.name.partition("[")[0] == path]
            for path in paths
        }

    @property
    def undecided(self) -> tuple[str, ...]:
        """Names of the coordinates that the data left where the prior had them."""
        return tuple(row.name for row in self.table if row.undecided)

    @property
    def warnings(self) -> tuple[str, ...]:
        """How far not to trust this posterior, a sentence each; none when there is no reason."""
        said = []
        if self.rhat_of_predictions >= MIXED:
            said.append(
                f"the chains do not agree on what will happen: R-hat of predictions is "
                f"{self.rhat_of_predictions:.5g}, expected below {MIXED}; draw more, or compare "
                "hypotheses if there are several modes"
            )
        if self.size_of_predictions < EFFECTIVE:
            said.append(
                f"predictions rest on {self.size_of_predictions:.0f} effective draws, expected at "
                f"least {EFFECTIVE:.0f}: draw more"
            )
        unmixed = [row.name for row in self.table if row.rhat >= MIXED]
        if unmixed:
            said.append(
                f"the chains differ on {', '.join(unmixed)}: if predictions agree, labels that "
                "mean the same motion were swapped, and only the predictions should be read"
            )
        if self.draws.divergences:
            said.append(
                f"{self.draws.divergences} of {self.draws.density.size} trajectories diverged: "
                "the posterior has corners that were not explored, and intervals may be too narrow"
            )
        if self.undecided:
            said.append(
                f"the data say next to nothing of {', '.join(self.undecided)}: what is printed "
                "for them is the prior"
            )
        return tuple(said)

    def predict(self, segments: Segments, count: int = PREDICTING, seed: int = 0) -> Predicted:
        """Predict pieces with about `count` draws; see `predictive.predict`."""
        return predictive.predict(self.target, self.thinned(count), segments, seed)

    def score(self, segments: Segments, count: int = PREDICTING, seed: int = 0) -> Score:
        """Coverage, log score and errors on pieces it was not fitted to."""
        return predictive.score(self.target, self.predict(segments, count, seed), segments)

    def _by_name(self) -> dict[str, tuple[str, str, np.ndarray]]:
        """Unit, meaning and values (chains x draws) of each coordinate, in order."""
        found = {}
        for path, declaration in sorted(self.target.coordinates.declarations.items()):
            values = self.values[path]
            first = values.reshape(*values.shape[:2], -1)
            if declaration.shared or values.ndim == 2:
                found[path] = declaration.unit, declaration.about, first[..., 0]
                continue
            for index in np.ndindex(values.shape[2:]):
                several = first.shape[-1] > 1
                name = f"{path}[{', '.join(map(str, index))}]" if several else path
                element = values[(..., *index)]
                found[name] = declaration.unit, declaration.about, element
        noise, growth = (np.asarray(x) for x in _scales(self.target, jnp.asarray(self.flat)))
        scales = self.target.scales
        for kind, of, values in (
            ("noise", scales.of_channel, noise),
            ("discrepancy", scales.of_channel, growth),
        ):
            labels = [label for label in scales.labels if label.startswith(kind)]
            for group, label in enumerate(labels):
                unit = label.partition("(")[2].removesuffix(")")
                about = "sensor noise" if kind == "noise" else "what the model does not explain"
                found[label] = unit, about, values[:, of.index(group)]
        return found


def spread_out(size: int, count: int | None = None) -> Int[np.ndarray, " count"]:
    """Indices of about `count` of `size` draws, evenly spaced; of all where no count is given."""
    count = size if count is None else min(count, size)
    return np.linspace(0, size - 1, count).round().astype(int)


def sample(
    target: MotionPosterior | Settled,
    method: str = LOCAL_GLOBAL,
    *,
    chains: int | None = None,
    draws: int | None = None,
    seed: int = 0,
    probes: Segments | None = None,
    watch: Watch = without_progress,
) -> Posterior:
    """Draws of a posterior by one of the `SAMPLERS`, as many as it wants where no number is given.

    Its modes are searched for unless it is `Settled`. Chains are compared by what they predict at
    the ends of `probes`, by default the pieces that were fitted. `watch` goes through the rounds of
    the search and of the sampling. The same seed gives the same draws.

    A factor of too many coordinates for a mixture to be learnt in is for the no-U-turn sampler even
    where "local-global" is asked for; `Posterior.sampler` then says so. Raises `PalpateError` when
    the likelihood is not finite anywhere, or so few chains or draws are asked for that they cannot
    be judged.
    """
    check_numbers(chains, draws)
    check_name("sampler", method, SAMPLERS)
    climbing, sampling = jax.random.split(jax.random.key(seed))
    if isinstance(target, MotionPosterior):
        with prepare_sampler(target, chains, method):
            target = settle_each(target, climbing, watch)
    chosen = [
        "nuts" if method == LOCAL_GLOBAL and part.target.dimension > WIDEST else method
        for part in target.parts
    ]
    fewest = min((SAMPLERS[name] for name in chosen), key=lambda sampler: sampler.chains)
    numbers, found = (chains or fewest.chains, draws or fewest.draws), []
    for number, (name, part) in enumerate(zip(chosen, target.parts, strict=True)):
        key = jax.random.fold_in(sampling, number) if number else sampling
        found.append(SAMPLERS[name].run(part.target, part.modes, key, *numbers, watch))
    every = join_draws(target, found, jax.random.fold_in(sampling, len(found)))
    probes = target.target.segments if probes is None else probes
    return Posterior(target, every, probes, " and ".join(dict.fromkeys(chosen)))


def prepare_sampler(
    target: MotionPosterior, chains: int | None, method: str = LOCAL_GLOBAL
) -> AbstractContextManager[None]:
    """Within it modes may be searched for, while the sampler of such a target is compiled."""
    first, _ = factors_of(target)[0]
    if method != LOCAL_GLOBAL or first.dimension > WIDEST:
        return contextlib.nullcontext()
    return compile_beside(first, chains or CHAINS)


def check_numbers(chains: int | None, draws: int | None) -> None:
    """Raise `PalpateError` for so few chains or draws that nothing says how far to trust them."""
    if (chains is not None and chains < 1) or (draws is not None and draws < FEWEST):
        raise PalpateError(
            f"expected at least 1 chain of {FEWEST} draws, by which it can be judged, got "
            f"{'the usual' if chains is None else chains} of "
            f"{'the usual' if draws is None else draws}"
        )


@eqx.filter_jit
def _legal(target: MotionPosterior, position: Array) -> Array:
    """Whitened coordinates of the legal models, noise scales as they are."""
    flat, unravel = ravel_pytree(target.coordinates.initial)

    def one(position: Array) -> Array:
        projected = target.coordinates.project(unravel(position[: flat.size]))
        return jnp.concatenate([ravel_pytree(projected)[0], position[flat.size :]])

    return jax.vmap(one)(position)


@eqx.filter_jit
def _scales(target: MotionPosterior, position: Array) -> tuple[Array, Array]:
    return jax.vmap(target.noise)(position), jax.vmap(target.growth)(position)
