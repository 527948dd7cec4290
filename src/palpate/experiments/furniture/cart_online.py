"""`palpate reproduce cart-online`: furniture brought to its places by who learns how it rolls.

The Shopping-Cart and Apartment tasks (`palpate.tasks.furniture.cart`) in MuJoCo, learnt online from
the first decision on. PBRL climbs the posterior of a planar model of each piece as data arrive and
plans through its mode; OO-LWR and LWR plan through regressions of the same decisions in the pieces'
own axes, with and without the deck's oriented contact predicates; random takes any action. TRUE is
told the planar model that explains best how the same pieces moved when they were wiggled apart,
pushed anyhow, and then brought to their places from other starts, searched for from the hidden
constants on: MuJoCo itself as the planner's model would take hours.
All plan by the same MPPI with the same samples, on the same seeds: the same hidden parameters and
starts.

The hand's force on the cart task's table was raised from 50 to 120 N after the first fits: see
`palpate.tasks.furniture.cart`.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from palpate.experiments.experiment import Experiment, mean_of, suffix
from palpate.report.picture import band, canvas_of, curve, legend_of, save_picture
from palpate.report.style import STYLES
from palpate.runs import Figure, Result
from palpate.runs.progress import progress
from palpate.runs.result import two_standard_errors
from palpate.tasks.furniture.cart import DECISION, CartTask, apartment, shopping_cart
from palpate.trials.furniture.cart_controllers import (
    CartController,
    PhysicsController,
    Planning,
    RegressionController,
)
from palpate.trials.furniture.cart_trials import (
    HANDLED,
    PRACTISED,
    TOSSED,
    best_scene,
    rewards_by_episode,
)
from palpate.trials.trial import resumable

NAME = "cart-online"
BAR = 0.05
FROM = 50  # the decision from which on regret counts
EVALUATION_SEEDS = 990_000  # of hidden parameters, starts and noise, used by nothing else
TRUE, PBRL, OO_LWR, LWR, RANDOM, NOTHING = (
    "TRUE",
    "PBRL",
    "OO-LWR",
    "LWR",
    "random",
    "doing nothing",
)
AGENTS = (TRUE, PBRL, OO_LWR, LWR, RANDOM, NOTHING)
TASKS: dict[str, Callable[[], CartTask]] = {"cart": shopping_cart, "apartment": apartment}
WORLDS, DECISIONS = {"full": 5, "quick": 1}, {"full": 1000, "quick": 100}
PLANNING = {
    "cart": Planning(samples=256, knots=7, spacing=3),
    # A second look closer by: what is to stop short of a wall needs a smaller push than it came by.
    "apartment": Planning(samples=64, knots=5, spacing=3, deviation=0.5, iterations=2),
}
SMOOTHED = 50  # decisions that a loss in the run's log is the mean of

Rewards = dict[str, np.ndarray]  # (worlds, decisions) by agent


def reproduce(out: Path, *, quick: bool = False, seed: int = 0) -> Result:
    """Let every agent learn both tasks below `out`; `quick` is the same, shorter.

    Raises `PalpateError` when `out` holds another run's stages.
    """
    experiment, size = Experiment(NAME, out, quick, seed), "quick" if quick else "full"
    experiment.announce({"cart": 4, "apartment": 8} if quick else {"cart": 25, "apartment": 40})
    seeds = [EVALUATION_SEEDS + 10 * seed + world for world in range(WORLDS[size])]
    earned = {}
    for name in TASKS:
        earned[name] = _rewards_of(experiment, name, seeds, DECISIONS[size])
        print("\n".join(_lines(name, earned[name])), flush=True)
    draw(out / "curves.png", earned)
    return experiment.result(
        [figure for name, rewards in earned.items() for figure in figures(name, rewards)],
        {
            "decisions": DECISIONS[size],
            "decision_s": DECISION,
            "planning": {name: vars(options) for name, options in PLANNING.items()},
            "regret": f"(TRUE - PBRL) / (TRUE - random), of mean rewards from decision {FROM} on, "
            "mean over the worlds",
            "TRUE": "told planar models fitted, from the hidden constants on, to three times "
            f"{HANDLED:g} s of handling of the same pieces, to {TOSSED} episodes of the task by "
            f"random actions and to {PRACTISED} of its own from other starts, apart and not to be "
            "seen by the others",
            "LWR and OO-LWR": "velocity and wrench in each piece's own axes, one regression for "
            "each piece; bandwidth and ridge by leave-one-out",
        },
        {
            "chosen on": "worlds of seeds 1 to 14; the cart in 985000, 986000, 986001 and 987000 "
            "to 987004, the apartment in 988004 and 989001, where TRUE or PBRL fell short, before "
            "fits and planner were put right",
            "evaluated": f"worlds of seeds {seeds[0]} to {seeds[-1]}: all agents begin in each "
            "without data, TRUE with its models",
        },
        seeds,
    )


def _rewards_of(experiment: Experiment, name: str, seeds: list[int], decisions: int) -> Rewards:
    """What every agent earned in every world, in a stage."""
    configuration = {
        "stage": name,
        "seeds": seeds,
        "decisions": decisions,
        "planning": vars(PLANNING[name]),
    }
    shape = len(seeds), len(AGENTS), decisions
    rewards = np.zeros(shape, np.float32)
    grid = [(world, agent) for world in range(len(seeds)) for agent in range(len(AGENTS))]
    with experiment.stage(name, configuration) as stage:
        for (world, agent), _ in resumable(stage.run, grid, {"rewards": rewards}, name):
            rewards[world, agent] = _work(name, AGENTS[agent], seeds[world], decisions)
        earned = {agent: rewards[:, index] for index, agent in enumerate(AGENTS)}
        if not stage.finished:
            for step in range(SMOOTHED, decisions + 1, SMOOTHED):
                block = slice(step - SMOOTHED, step)
                means = {a: -float(rows[:, block].mean()) for a, rows in earned.items()}
                stage.run.log(step, **{f"{agent} loss": loss for agent, loss in means.items()})
    return earned


def _work(name: str, who: str, seed: int, decisions: int) -> np.ndarray:
    """What one agent earns in one world, beginning with nothing, decision by decision."""
    task = TASKS[name]()
    episodes = rewards_by_episode(task, _controller(task, who, seed, decisions), seed, decisions)
    watch = progress(range(0, decisions, task.episode), f"{name}, {who}, world {seed}")
    rewards = []
    for _ in watch:
        rewards.append(next(episodes))
        watch.show(reward=rewards[-1].mean())
    return np.concatenate(rewards)


def _controller(task: CartTask, who: str, seed: int, decisions: int) -> CartController:
    planning = PLANNING[task.name]
    if who == PBRL:
        return PhysicsController(task, planning, seed)
    if who in (OO_LWR, LWR):
        return RegressionController(task, planning, seed, who.lower(), decisions)
    scene = best_scene(task, planning, seed) if who == TRUE else None
    return CartController(task, planning, seed, scene=scene, idle=who == NOTHING)


def regret(rewards: Rewards, agent: str, window: slice) -> np.ndarray:
    """(TRUE - agent) / (TRUE - random) in each world, of mean rewards in a window of decisions."""
    mean = {name: rows[:, window].mean(axis=1) for name, rows in rewards.items()}
    # Over all worlds, or one in which TRUE happens to be no better would decide.
    return (mean[TRUE] - mean[agent]) / (mean[TRUE] - mean[RANDOM]).mean()


def figures(name: str, rewards: Rewards) -> list[Figure]:
    """The task's regret against its bar, that of the others, and what everybody earned."""
    later = slice(FROM, None)
    own, rival = regret(rewards, PBRL, later), regret(rewards, OO_LWR, later)
    first = float(regret(rewards, PBRL, slice(FROM)).mean())
    theirs = float(regret(rewards, OO_LWR, slice(FROM)).mean())
    rows = [
        mean_of(
            f"{name}.regret", own, bar=BAR, rival=float(rival.mean()),
            seed_document="PBRL close to TRUE after few steps",
        ),
        # TRUE may fall short too, and a mean would hide where PBRL does
        Figure(f"{name}.regret_worst_world", float(own.max()), "", rival=float(rival.max())),
        Figure(f"{name}.regret_first_{FROM}", first, "", rival=theirs),
    ]  # fmt: skip
    for agent in (OO_LWR, LWR, NOTHING):
        value = float(regret(rewards, agent, later).mean())
        rows.append(Figure(f"{name}.regret.{suffix(agent)}", value, ""))
    for agent in AGENTS:
        value = float(rewards[agent][:, later].mean())
        rows.append(Figure(f"{name}.reward.{suffix(agent)}", value, "m", better="higher"))
    return rows


def _lines(name: str, rewards: Rewards) -> list[str]:
    """What is printed of a task: each agent's mean reward, before and after `FROM`."""
    return [
        f"{name} {agent}: mean reward {rows[:, :FROM].mean():.3f} to decision {FROM}, "
        f"{rows[:, FROM:].mean():.3f} after"
        for agent, rows in rewards.items()
    ]


def draw(path: Path, earned: dict[str, Rewards]) -> None:
    """A PNG of reward against decisions, one panel for each task.

    A point is the mean over an episode and the worlds, at the episode's end; bands are two standard
    errors of the mean over the worlds either way.
    """
    canvas = canvas_of(10, 4.2)
    axes = np.atleast_1d(canvas.subplots(1, len(earned)))
    for axis, (name, rewards) in zip(axes, earned.items(), strict=True):
        task = TASKS[name]()
        for style, (agent, rows) in zip(STYLES, rewards.items(), strict=True):
            worlds, decisions = rows.shape
            # Within an episode the reward rises whether or not anything is learnt.
            episodes = rows.reshape(worlds, -1, min(task.episode, decisions)).mean(axis=2)
            ends = decisions / episodes.shape[1] * np.arange(1, episodes.shape[1] + 1)
            middle = episodes.mean(axis=0)
            error = np.array([two_standard_errors(of) or 0.0 for of in episodes.T])
            band(axis, ends, middle - error, middle + error, style)
            curve(axis, ends, middle, style, agent)
        axis.set(title=f"{name}, {task.episode} decisions an episode", xlabel="decisions")
        axis.set_xlim(left=0)
    axes[0].set_ylabel("mean reward of an episode's decisions (m)")
    legend_of(canvas, "lower center")
    save_picture(path, canvas)
