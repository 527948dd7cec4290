"""`palpate evaluate` of what learnt in a world: episodes of the policy, and of doing nothing."""

import functools
from pathlib import Path

import numpy as np

from palpate.commands import folders
from palpate.commands.in_world.episodes import at_its_best, play_episodes
from palpate.errors import PalpateError
from palpate.families.world_options import EvaluateInWorld
from palpate.networks.guarded import load_actor
from palpate.runs import Figure
from palpate.runs.figure_names import name_in_words, value_in_words
from palpate.runs.storage import write_text

STILL = "held still"
STILL_EPISODES = 20  # of holding still, which goes on to the horizon and hardly varies


def evaluate_in_world(options: EvaluateInWorld) -> Path:
    """Evaluate, print a line for each controller, and return the folder everything is in.

    Raises `PalpateError` for a file that is no policy, or one for another task.
    """
    file = folders.product_of(options.policy, folders.POLICY, "train")
    policy, manifest = load_actor(file)
    if manifest.get("task") != options.task:
        raise PalpateError(
            f"{file} was trained for '{manifest.get('task')}', not for {options.task}"
        )
    words = f"evaluate {options.task}"
    with folders.begin(options, words, {"policy": file, **options.inputs(manifest)}) as run:
        if not run.finished:
            who = {
                "policy": (at_its_best(policy), options.episodes),
                STILL: (
                    lambda seen: np.zeros((len(seen), sum(c.count for c in policy.actions))),
                    min(options.episodes, STILL_EPISODES),
                ),
            }
            rows: dict[str, list[Figure]] = {}
            for name, (act, episodes) in who.items():
                suffix = "" if name == "policy" else f".{name.replace(' ', '_')}"
                watching = policy if name == "policy" else None
                make = functools.partial(options.make, manifest=manifest, policy=watching)
                found = play_episodes(make, act, episodes, options.seed)
                rows[name] = options.figures(found, suffix)
            rows["policy"] += options.probed(policy, manifest)
            options.show(run, policy, manifest)
            about = options.about(manifest)
            lines = [about, *(line_of(name, figures) for name, figures in rows.items())]
            write_text(run.path / folders.TABLE, "\n".join(lines) + "\n")
            settings = {
                "episodes": options.episodes,
                folders.SUMMARY: [f"{line[0].upper()}{line[1:]}." for line in lines],
            }
            split = {"evaluated": f"{options.episodes} episodes, seed {options.seed}"}
            every = [figure for figures in rows.values() for figure in figures]
            folders.finish(run, every, settings, split)
        print((run.path / folders.TABLE).read_text(encoding="utf-8"), end="")
        return folders.hand_over(options, run, f"What a controller does: {options.task}")


def line_of(name: str, figures: list[Figure]) -> str:
    """How a controller did, as a row of a table."""
    parts = (f"{name_in_words(of).split(',')[0]} {value_in_words(of)}" for of in figures)
    return f"{name:12s} {', '.join(parts)}"
