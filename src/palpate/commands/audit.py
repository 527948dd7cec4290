"""`palpate audit`: what energy a policy could be made to draw, or what a recording drew."""

import functools
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from palpate.commands import folders
from palpate.commands.in_world.episodes import at_its_best
from palpate.commands.options import Audit
from palpate.errors import PalpateError
from palpate.families.world_options import EvaluateInWorld
from palpate.family import check_name, options_of, resolve
from palpate.networks.guarded import load_actor
from palpate.recordings.files import read_recording
from palpate.report.energy_picture import energy_picture
from palpate.runs import Figure, Run
from palpate.runs.figure_names import lines_of
from palpate.runs.result import read_result
from palpate.runs.run import RESULT
from palpate.runs.storage import write_text
from palpate.safety.filters import FILTERS
from palpate.safety.recorded_energy import recorded_energy
from palpate.trials.adversaries import MisledPolicy, RandomAdversary, SearchedAdversary
from palpate.trials.audit import Adversary, audit
from palpate.worlds.gymnasium import GymnasiumWorlds, features_of

PICTURE = "energy.png"
WORLDS, DECISIONS = 10, 30  # side by side; of an episode
HOLD = 2  # decisions, for which a random adversary asks for the same, at most
LIES = 0.5  # of what a policy sees, each number of which is about 1


def run(options: Audit) -> Path:
    """Audit a policy or a recording, and return the folder everything is in.

    Raises `PalpateError` for what is neither, for a policy whose energy nobody counts, and for
    channels that are not there.
    """
    if _is_recording(options.subject):
        return _audit_recording(options)
    return _audit_policy(options)


def _is_recording(path: Path) -> bool:
    if path.is_dir():
        return not (path / folders.POLICY).exists() and not (path / RESULT).exists()
    return path.suffix != Path(folders.POLICY).suffix


# --- of a recording ---------------------------------------------------------------------------


def _audit_recording(options: Audit) -> Path:
    with folders.begin(options, "audit", {"subject": options.subject}) as run:
        if not run.finished:
            recording = read_recording(
                options.subject, rate=options.rate, unit=options.unit, up=options.up,
                topics=options.topics or (),
                columns=[*options.force, *options.motion],
            )  # fmt: skip
            found = [
                recorded_energy(trial, options.force, options.motion, not options.by_robot)
                for trial in recording.trials
            ]
            energy_picture(run.path / PICTURE, found)
            figures = [
                Figure("energy_given", float(np.median([one.given for one in found])), "J"),
                Figure("energy_returned", float(np.median([one.returned for one in found])), "J"),
                Figure("tank_needed", max(one.needed for one in found), "J"),
                Figure("greatest_power", max(float(one.power.max()) for one in found), "W"),
            ]
            lines = [
                f"{one.trial}: {one.given:.3g} J given, {one.returned:.3g} J returned; a tank of "
                f"{one.needed:.3g} J would have paid for it"
                for one in found
            ]
            _finish(run, figures, lines)
        return _write_report(options, run, "What energy a recording drew")


# --- of a policy ------------------------------------------------------------------------------


def _audit_policy(options: Audit) -> Path:
    if options.filter is not None:
        check_name("filter", options.filter, FILTERS)
    file = folders.product_of(options.subject, folders.POLICY, "train")
    policy, manifest = load_actor(file)
    asked = {"world": options.world, "filter": options.filter, "tank": options.tank}
    given = {name: value for name, value in asked.items() if value is not None}
    place = options_of("evaluate").get(str(manifest.get("task")))
    kind = None if place is None else resolve(place)
    if not (
        kind is not None
        and issubclass(kind, EvaluateInWorld)
        and "filter" in {field.name for field in fields(kind)}
    ):
        raise PalpateError(
            f"{file} was trained for '{manifest.get('task')}', whose energy nobody counts: "
            "expected a policy of `palpate train maze`"
        )
    evaluation: Any = kind(policy=options.subject, **given)
    inputs = {"policy": file, **evaluation.inputs(manifest)}
    with folders.begin(options, "audit", inputs) as run:
        if not run.finished:
            environments = evaluation.make(WORLDS, manifest, policy)
            try:
                figures, lines = _try_adversaries(environments, at_its_best(policy), options)
            finally:
                environments.close()
            _finish(run, figures, [evaluation.about(manifest), *lines])
        return _write_report(options, run, "What energy a policy could be made to draw")


def _try_adversaries(
    environments: GymnasiumWorlds, act: Callable[[np.ndarray], np.ndarray], options: Audit
) -> tuple[list[Figure], list[str]]:
    """Every adversary in turn: figures, and a line for each."""
    inside: Any = environments.lockstep
    law, every, actions = inside.law, inside.every, inside.task.actions
    sees, numbers = functools.partial(_features, inside), inside.observation_space.shape[0]
    tank = getattr(law.filter, "tank", None)
    episodes = max(1, round(options.steps / (WORLDS * DECISIONS * every)))
    asked: dict[str, Any] = {
        "periods": DECISIONS * every,
        "touches": lambda truth: truth.peak_force > 0.0,
        "reserve": 0.0 if tank is None else tank.reserve,
    }
    hold = HOLD * every
    who: dict[str, tuple[str, Adversary]] = {
        "policy": ("the policy as it is", MisledPolicy(act, sees, every)),
        "misled": ("the policy, misled by its sensors", MisledPolicy(act, sees, every, LIES)),
        "random": ("decisions at random, at any time", RandomAdversary(actions, hold, 0.5)),
        "searched": (
            "decisions that were searched for the worst",
            SearchedAdversary(actions, sees, numbers, WORLDS, options.seed),
        ),
    }
    figures, lines = [], []
    for name, (words, adversary) in who.items():
        found = []
        for episode in range(episodes):
            seed = options.seed + WORLDS * episode
            one = audit(inside.worlds, law, adversary, episodes=1, seed=seed, **asked)
            if isinstance(adversary, SearchedAdversary):
                adversary.improve(one.drawn)
            found.append(one)
        drawn = max(float(one.drawn.max()) for one in found)
        figures.append(Figure(f"energy_drawn.{name}", drawn, "J"))
        line = f"{words}: {drawn:.3g} J drawn in an episode at most"
        margin = min(float(one.margin.min()) for one in found)
        if np.isfinite(margin):
            figures.append(Figure(f"tank_margin.{name}", margin, "J", better="higher"))
            side = "above" if margin >= 0.0 else "below"
            line += f"; the tank {abs(margin):.3g} J {side} its reserve"
        rise = max(float(one.rise.max()) for one in found)
        if np.isfinite(rise):
            figures.append(Figure(f"energy_gain.{name}", rise, "J"))
            line += f"; robot and tank {rise:.2g} J above what came from outside"
        lines.append(line)
    return figures, lines


def _features(inside: Any, observation: Any) -> np.ndarray:
    """What the policy sees of observations side by side, and of the tank."""
    seen, energy = features_of(inside.task, observation), inside.energy
    if energy is None:
        return seen
    begun = np.asarray(observation.time) > 0.0
    level = np.where(begun, inside.law.level if begun.any() else energy.full, energy.full)
    return np.concatenate([seen, (level / energy.full)[:, None]], axis=1)


# --- of both ----------------------------------------------------------------------------------


def _finish(run: Run, figures: list[Figure], lines: list[str]) -> None:
    write_text(run.path / folders.TABLE, "\n".join(lines) + "\n")
    summary = [f"{line[0].upper()}{line[1:]}." for line in lines]
    folders.finish(run, figures, {folders.SUMMARY: summary})


def _write_report(options: Audit, run: Run, title: str) -> Path:
    print((run.path / folders.TABLE).read_text(encoding="utf-8"), end="")
    print("\n".join(lines_of(read_result(run.path / RESULT).figures)))
    return folders.hand_over(options, run, title)
