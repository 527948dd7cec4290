"""`palpate reproduce rope-bound`: how near the controller comes to what is possible at all.

For each of the four start poses of the nominal rope, sequences of gripper velocities are searched
for by CMA-ES through the identified model, knowing the start exactly and a future without noise:
four times from nothing, once from what the shipped policy did. The fastest of each search are
replayed in MuJoCo, and the one that is first at rest there is the bound. What the policy itself
did is a sequence too: where no search finds a faster one, it is the bound.
"""

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from palpate.experiments.experiment import Experiment, ratio
from palpate.experiments.rope import nominal
from palpate.models.model import rollout
from palpate.models.rope import Rope, RopeState
from palpate.networks import CommandPolicy
from palpate.planning.open_loop import POPULATION, CommandSequence, Found, cma_package, search
from palpate.report.evidence import write_evidence
from palpate.runs import Figure, Result, Run
from palpate.tasks.rope import RopeStabilization
from palpate.tasks.rope.stabilization import STABILISED, STAY
from palpate.tasks.task import Start
from palpate.trials.controller import Noted, OpenLoop
from palpate.trials.rope.learned import LearnedController
from palpate.trials.rope.stabilization import StabilizationTrial, lasting, settling_time
from palpate.trials.trial import resumable, run_trials
from palpate.worlds.rope.rope import START_POSES, RopeWorld

NAME = "rope-bound"
RATIO_BAR = 1.15
SEEDS = 980_000  # of azimuths and sensor noise, used by nothing else
ROLLOUTS = 20_000  # of each restart
KNOTS, SHAPED = 20, 1.2  # s that they are spread over; ropes are at rest sooner, or nearly so
SEARCHED = 2.0  # s within which a rope has to come to rest


@dataclasses.dataclass(frozen=True)
class Restart:
    """One search: how it begins, from nothing or (`warm`) from what the controller did.

    `aim`: how much of the 1 % is allowed; what is reached in the model has to hold in another
    world. `deadline` (s) and step size `deviation`, a share of the limit of speed, are the first:
    see `search`.
    """

    name: str
    aim: float
    deadline: float
    deviation: float
    warm: bool = False


RESTARTS = (
    Restart("cold 1", 0.3, 1.0, 0.2),
    Restart("cold 2", 0.3, 1.2, 0.2),
    Restart("cold 3", 0.5, 0.9, 0.2),
    Restart("cold 4", 0.7, 1.1, 0.2),
    Restart("warm", 0.5, 1.5, 0.05, warm=True),
)
OWN = "the controller's own"
_ALLOWED = STABILISED * np.array([restart.aim for restart in RESTARTS])
# Which of a search's sequences are replayed: the fastest, and ever fewer of those before it.
REPLAYED = (0, 1, 3, 7)


def reproduce(out: Path, *, quick: bool = False, seed: int = 0) -> Result:
    """Identify, search and replay below `out`; `quick` is the same work at a smaller size.

    Raises `PalpateError` when `out` holds the stages of another run, without the package `cma`, or
    when this installation has no shipped weights.
    """
    experiment, size = Experiment(NAME, out, quick, seed), nominal.QUICK if quick else nominal.FULL
    minutes = size.part("recording", "identification")
    experiment.announce(minutes | {"search": 2 if quick else 4})
    cma_package()  # before minutes of work that would be in vain
    policy, about = nominal.shipped_policy()
    model = nominal.identified_rope(experiment, size)
    first = experiment.uses(SEEDS)
    trials = lasting([StabilizationTrial(nominal.BASE, start, first) for start in START_POSES])
    rollouts = ROLLOUTS // 20 if quick else ROLLOUTS
    with experiment.stage("search", {"policy": about, "rollouts": rollouts}) as stage:
        done = find_bound(model, policy, trials, rollouts, seed, stage.run)
        if not stage.finished:
            write_evidence(stage.path, _evidence(done))
    outcome = Outcome.of(done)
    print("\n".join(_table(outcome)))
    return experiment.result(
        _figures(outcome, trials[0].period),
        {
            "weights": "shipped",
            "policy": about,
            "restarts": [dataclasses.asdict(restart) for restart in RESTARTS],
            "rollouts_of_each_restart": rollouts,
            "population": POPULATION,
            "knots": KNOTS,
            "knots_spread_over_s": SHAPED,
            "at_rest_within_s": SEARCHED,
        },
        {
            "identified": nominal.identified_split(size, seed),
            "policy trained": nominal.SHIPPED_SPLIT,
            "start states": f"nominal rope, four poses, seed {first}: used by nothing else",
        },
    )


def find_bound(
    model: Rope,
    policy: CommandPolicy,
    trials: list[StabilizationTrial],
    rollouts: int,
    seed: int,
    run: Run,
) -> dict[str, np.ndarray]:
    """What the controller and the sequences found do in MuJoCo, and the latter in the model.

    "energy" and "speed" (trials, times) of the controller, and its "commands" (trials, steps, 3);
    "replayed_energy" and "replayed_speed" (trials, restarts, replays, steps + 1), NaN where less
    was found than is replayed; "in_model" (trials, restarts): the least time found in s, for the
    restart's own aim, NaN where none was. A run that was cut off repeats one trial at most.
    """
    task, period = RopeStabilization(), model.control_period
    sequence = CommandSequence(
        KNOTS,
        active=round(SHAPED / period),
        steps=round((SEARCHED + STAY) / period),
        period=period,
        limit=task.action_limit,
        rate_limit=task.action_rate_limit,
    )
    count, length = len(trials), trials[0].steps or 0
    replays = count, len(RESTARTS), len(REPLAYED), sequence.steps + 1
    done = {
        "commands": np.zeros((count, length, 3), np.float32),
        "energy": np.zeros((count, length + 1), np.float32),
        "speed": np.zeros((count, length + 1), np.float32),
        "in_model": np.full((count, len(RESTARTS)), np.nan, np.float32),
        "replayed_energy": np.full(replays, np.nan, np.float32),
        "replayed_speed": np.full(replays, np.nan, np.float32),
    }
    shares = _energy_shares(model, sequence)
    for place, note in resumable(run, range(count), done, "searching"):
        if place == 0:
            noted = Noted(LearnedController(policy, task))
            own = run_trials(trials, noted)
            done["commands"][:] = np.stack(noted.actions, axis=1)
            done["energy"][:], done["speed"][:] = own.energy, own.gripper_speed
        trial = trials[place]
        reference = np.zeros((len(RESTARTS), length, 3), np.float32)
        reference[[restart.warm for restart in RESTARTS]] = done["commands"][place]
        start = start_state(trial, model.nodes)
        found = search(
            lambda knots, start=start, reference=reference: (
                shares(start, reference, knots) / _ALLOWED[:, None, None]
            ),
            (KNOTS, 3),
            deadlines=[round(restart.deadline / period) for restart in RESTARTS],
            deviations=[restart.deviation for restart in RESTARTS],
            rollouts=rollouts,
            seed=1000 * seed + 10 * place,
        )
        for restart, each in enumerate(found):
            if len(each.times):
                done["in_model"][place, restart] = period * each.times[-1]
        _replay(found, reference, sequence, trial, done, place)
        fastest = _least(done["in_model"][place]).item()
        note(start=trial.start, in_model=fastest if math.isfinite(fastest) else None)
    return done


def start_state(trial: StabilizationTrial, nodes: int) -> RopeState:
    """Where the true rope's nodes are, and how fast, when the trial begins."""
    world = RopeWorld(trial.configuration)
    world.reset(trial.seed, start=trial.start)
    truth = world.truth()
    every = (len(truth.positions) - 1) // (nodes - 1)
    position, velocity = truth.positions[::every], truth.velocities[::every]
    return RopeState(jnp.asarray(position, jnp.float32), jnp.asarray(velocity, jnp.float32))


def _energy_shares(model: Rope, sequence: CommandSequence) -> Callable:
    """A function of the start, references (restarts, time, 3) and knots (restarts, population,
    knots, 3) that gives the model's energy over time as a share of the start's.

    The rollouts of a generation are divided among all devices.
    """
    task = RopeStabilization()

    @jax.jit
    def part(start: RopeState, reference: jax.Array, knots: jax.Array) -> jax.Array:
        commands = sequence.commands(knots, reference)[:, :, None]
        batch = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (len(knots), *leaf.shape)), start)
        begin = Start(batch, commands[:, 0])
        return task.energy_share(model, begin, rollout(model, batch, commands))

    def shares(start: RopeState, reference: np.ndarray, knots: np.ndarray) -> np.ndarray:
        restarts, population = knots.shape[:2]
        devices = jax.devices()
        work = zip(
            devices,
            np.array_split(np.repeat(reference, population, axis=0), len(devices)),
            np.array_split(knots.reshape(-1, *knots.shape[2:]), len(devices)),
            strict=True,
        )
        parts = [part(*jax.device_put((start, *arrays), device)) for device, *arrays in work]
        return np.concatenate([np.asarray(p) for p in parts]).reshape(restarts, population, -1)

    return shares


def _replay(
    found: list[Found],
    reference: np.ndarray,
    sequence: CommandSequence,
    trial: StabilizationTrial,
    done: dict[str, np.ndarray],
    place: int,
) -> None:
    """Replay some of what each search found, and put down what becomes of the rope."""
    chosen = [
        (restart, replay, each.knots[-1 - back])
        for restart, each in enumerate(found)
        for replay, back in enumerate(REPLAYED)
        if back < len(each.times)
    ]
    if not chosen:
        return
    restarts, replays, knots = (np.stack(column) for column in zip(*chosen, strict=True))
    commands = jax.jit(sequence.commands)(knots, reference[restarts])
    replay = OpenLoop(np.asarray(commands), sequence.period)
    episodes = run_trials([trial] * len(chosen), replay, sequence.steps)
    done["replayed_energy"][place, restarts, replays] = episodes.energy
    done["replayed_speed"][place, restarts, replays] = episodes.gripper_speed


@dataclasses.dataclass(frozen=True)
class Outcome:
    """Times to 1 % in s, NaN where there is none.

    `ours` (poses,) of the controller, `replayed` (poses, restarts, replays) in MuJoCo, and
    `in_model` (poses, restarts) of each restart's fastest, for its own aim.
    """

    ours: np.ndarray
    replayed: np.ndarray
    in_model: np.ndarray

    @classmethod
    def of(cls, done: dict[str, np.ndarray]) -> "Outcome":
        """What came of a search that is done: see `find_bound`."""
        period, shape = nominal.BASE.control_period, done["replayed_energy"].shape
        energy, speed = (
            done[name].reshape(-1, shape[-1]) for name in ("replayed_energy", "replayed_speed")
        )
        return cls(
            settling_time(done["energy"], done["speed"], period),
            settling_time(energy, speed, period).reshape(shape[:-1]),
            done["in_model"],
        )

    @property
    def searched(self) -> np.ndarray:
        """The fastest replay of each restart, (poses, restarts); NaN where it found none."""
        return _least(self.replayed)

    @property
    def found(self) -> np.ndarray:
        """The fastest replay of each pose, (poses,)."""
        return _least(self.searched)

    @property
    def bound(self) -> np.ndarray:
        """The fastest there is: `found` or the controller's own, (poses,)."""
        return np.fmin(self.found, self.ours)

    @property
    def winners(self) -> list[str]:
        """Whose the bound of each pose is."""
        times = np.nan_to_num(np.column_stack([self.ours, self.searched]), nan=np.inf)
        names = [OWN, *(restart.name for restart in RESTARTS)]
        return [names[place] for place in np.argmin(times, axis=1)]


def _least(times: np.ndarray) -> np.ndarray:
    """The least along the last axis, NaN where all are."""
    least = np.min(np.nan_to_num(times, nan=np.inf), axis=-1)
    return np.where(np.isfinite(least), least, np.nan)


def _spell(times: np.ndarray) -> str:
    return " ".join("none" if math.isnan(time) else f"{time:.2f}" for time in times)


def _table(outcome: Outcome) -> list[str]:
    names = " ".join(restart.name.replace(" ", "") for restart in RESTARTS)
    lines = [f"times to 1 % in s; restarts: {names}"]
    for place, pose in enumerate(START_POSES):
        lines.append(
            f"{pose:12s} controller {_spell(outcome.ours[[place]])}, bound "
            f"{_spell(outcome.bound[[place]])} ({outcome.winners[place]}); restarts in MuJoCo "
            f"{_spell(outcome.searched[place])}, in the model {_spell(outcome.in_model[place])}"
        )
    return lines


def _figures(outcome: Outcome, period: float) -> list[Figure]:
    ours, bound, found = outcome.ours, outcome.bound, outcome.found
    in_model = _least(outcome.in_model)
    rows = [
        Figure("time_ratio_to_bound", ratio(_mean(ours), _mean(bound)), "", bar=RATIO_BAR),
        # Below one where the searches alone, without the controller's own motion, are slower.
        Figure("time_ratio_to_search", ratio(_mean(ours), _mean(found)), ""),
        Figure("poses_where_search_is_faster", int(np.sum(found < ours)), "", better="higher"),
        Figure("time_to_1pct_s", _mean(ours), "s"),
        Figure("bound_s", _mean(bound), "s"),
        Figure("bound_periods", _mean(bound / period), "periods"),
        Figure("bound_in_model_s", _mean(in_model), "s"),
    ]
    every = {"time_to_1pct_s": ours, "bound_s": bound, "found_s": found}
    every["bound_in_model_s"] = in_model
    for place, pose in enumerate(START_POSES):
        rows += [
            Figure(f"{name}.{pose}", _mean(times[[place]]), "s") for name, times in every.items()
        ]
    return rows


def _mean(times: np.ndarray) -> float | None:
    return float(np.mean(times)) if np.all(np.isfinite(times)) else None


def _evidence(done: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Energies of the controller and of the fastest replay of each pose, NaN where none was."""
    energy = done["replayed_energy"]
    count, _, _, length = energy.shape
    times = np.nan_to_num(Outcome.of(done).replayed, nan=np.inf).reshape(count, -1)
    fastest = energy.reshape(count, -1, length)[np.arange(count), times.argmin(axis=1)]
    own = done["energy"][:, :length]
    return {
        "energy.time": np.arange(length) * nominal.BASE.control_period,
        "energy.controlled": own / own[:, :1],
        "energy.best open loop": fastest / fastest[:, :1],
    }
