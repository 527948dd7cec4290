"""`palpate reproduce velocity-yardstick`: environments nobody here wrote, beside OmniSafe.

HalfCheetah and Ant under a speed limit (`palpate.worlds.velocity`) are learnt by `palpate train
gymnasium --method lagrangian` and tried by `palpate evaluate gymnasium`, with the steps and the
limit on cost of OmniSafe's SAC-Lag, and fewer updates. Trainings in folders halfcheetah-SEED and
ant-SEED below `out` are taken as they are.
"""

from pathlib import Path
from typing import Any

from palpate.commands import evaluate, train
from palpate.experiments.experiment import Experiment, mean_of
from palpate.families.gymnasium.options import EvaluateGymnasium, TrainGymnasium
from palpate.runs import Figure, Result
from palpate.runs.result import read_result
from palpate.runs.run import RESULT

NAME = "velocity-yardstick"
ROBOTS = {"halfcheetah": "palpate/VelocityHalfCheetah-v0", "ant": "palpate/VelocityAnt-v0"}
COST_LIMIT = 25.0  # of an episode
FIRST, TRAININGS, QUICK_TRAININGS = 1, 3, 1  # seeds of the trainings
TRIED = 500_000  # added to a training's seed: that of the episodes its policy is tried in
STEPS, QUICK_STEPS = 1_000_000, 400
EPISODES, QUICK_EPISODES = 20, 1  # of a policy; OmniSafe's are 10
MINUTES = {"halfcheetah": 30, "ant": 35}  # of a seed
BARS = {"halfcheetah": {"reward": 2700.0, "cost": COST_LIMIT}}
# SACLag of OmniSafe's benchmarks/off-policy/README.md: five seeds, as many steps.
RIVALS = {
    "halfcheetah": {"reward": "OmniSafe 2833.7 ± 3.6", "cost": "OmniSafe 0 ± 0"},
    "ant": {"reward": "OmniSafe 1897 ± 1214", "cost": "OmniSafe 5.7 ± 7.8"},
}

Values = dict[str, Any]


def reproduce(out: Path, *, quick: bool = False, seed: int = 0) -> Result:
    """Train and try below `out`; what is finished there is taken as it is.

    `quick` is one seed, few steps and one episode. Raises `PalpateError` when `out` holds other
    runs, and without the extra `gymnasium`.
    """
    experiment, count = Experiment(NAME, out, quick, seed), QUICK_TRAININGS if quick else TRAININGS
    experiment.announce({robot: 1 if quick else each * count for robot, each in MINUTES.items()})
    first = experiment.uses(FIRST, count)
    listed = []
    for robot in ROBOTS:
        listed += figures_of(
            robot, [train_and_evaluate(experiment, robot, first + n) for n in range(count)]
        )
    episodes = QUICK_EPISODES if quick else EPISODES
    settings = {"environments": ROBOTS, "cost_limit": COST_LIMIT, "episodes": episodes}
    return experiment.result(listed, settings, f"episodes of seeds from {TRIED} on, used once")


def train_and_evaluate(experiment: Experiment, robot: str, seed: int) -> Values:
    """What a training cost, and what its policy's episodes gave."""
    steps, episodes = (QUICK_STEPS, QUICK_EPISODES) if experiment.quick else (STEPS, EPISODES)
    policy, values = experiment.out / f"{robot}-{seed}", {}
    training = TrainGymnasium(
        environment=ROBOTS[robot], cost_limit=COST_LIMIT, steps=steps, seed=seed, out=policy
    )
    tried = policy.with_name(f"{policy.name}-tried")
    trial = EvaluateGymnasium(policy=policy, episodes=episodes, seed=TRIED + seed, out=tried)
    for folder in (train.run(training), evaluate.run(trial)):
        result = read_result(folder / RESULT)
        experiment.seconds += result.wall_time_s
        values |= {figure.name: figure.value for figure in result.figures}
    return values


def figures_of(robot: str, runs: list[Values]) -> list[Figure]:
    """A robot's reward and cost, means over the seeds with their bars; then what they are of."""
    listed, details = [], []
    for name, better in (("reward", "higher"), ("cost", "lower")):
        held: dict[str, Any] = {"bar": BARS.get(robot, {}).get(name), "rival": RIVALS[robot][name]}
        values = [run[name] for run in runs]
        listed.append(mean_of(f"{robot}.{name}", values, better=better, **held))
        for number, value in enumerate(values, 1):
            details.append(Figure(f"detail.{robot}.{name}_{number}", value, "", better=better))
    costs = [run["training.violations"] for run in runs]
    return [*listed, *details, mean_of(f"detail.{robot}.training_cost", costs)]
