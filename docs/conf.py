"""Sphinx configuration: Markdown through MyST."""

import json
import sys
from importlib.metadata import version as installed_version
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
from docstrings import without_hints_for_the_command_line
from reference_pages import STAGES, write_pages

project = "palpate"
author = "The palpate developers"
version = release = installed_version("palpate")

extensions = ["myst_nb", "sphinx.ext.autodoc", "docstrings"]
myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
nb_execution_raise_on_error = True
exclude_patterns = ["_build", "_generated/results.md", "_generated/reference/calls.md"]

suppress_warnings = ["ref.python"]  # an axis of a shape, "trials", is no name
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
python_maximum_signature_line_length = 88

html_theme = "furo"
html_title = f"palpate {release}"


# What a reader has to know beside a table; the result's file does not say it.
NOTES = {
    "own-model": (
        "Finite differences and linear least squares, which need no library, are off by 2.8 % on "
        "the median door: within the bar too. They say nothing of how far to trust them. MuJoCo "
        "takes steps of 0.1 ms, because with 1 ms its own error is above the noise; the example "
        "was made to integrate as exactly on doors of other seeds. 59 of 60 intervals "
        "of smc hold, one more than the bar allows. mujoco.sysid is not beside it yet."
    ),
    "rope-residual": (
        "The ratio is one of mean errors, of which one trial carries a large part; this run did "
        "not keep its trials one by one. In a quick run (ratio 0.83) the median of the 14 trials' "
        "own ratios is 0.80, from 0.49 to 1.14; two trials lose, and the one with the largest "
        "error (3.8 to 3.0 cm) has 39 % of the whole gain."
    ),
    "rope-tracking": (
        "MPPI and CEM plan as if the gripper followed at once. It lags by 10 ms in MuJoCo, and the "
        "policy was trained with lags of 0 to 30 ms: part of the ratio may be the lag that they "
        "were not given. Who had more time was tried on one rope of ten."
    ),
    "rope-stabilization": (
        "The rival is the tuned swing damper. Gradient MPC through the same model, with 10 ms for "
        "a decision, is as fast as the policy and is not in this run: 0.70 periods where the "
        "policy takes 0.75, in the same 8 trials of `rope-rivals`."
    ),
    "rope-dagger": (
        "The swing damper, which nobody trains, brings all 40 ropes to rest too, in 1.12 periods; "
        "the policy after DAgger takes 0.98."
    ),
    "calibration": (
        "The likelihood knows the scale of the noise, which a user's fit infers, and the priors "
        "are narrower than the declared ones of a user's fit, from which half of the bodies would "
        "not move when pushed. What is calibrated is the sampler, not a user's whole fit."
    ),
    "cart-online": (
        "The hand's force on the table was raised from 50 to 120 N after the first fits: a locked "
        "caster holds with 20 to 90 N, so that with 50 N the table could only be turned about it, "
        "and who knows how it rolls could do no better than who does not."
    ),
    "namo-online": (
        "The hundred rooms are small: 98 of them have two doors and two have three; 74 hold two "
        "objects, 24 three and two four."
    ),
    "one-shot": (
        "The samplers race on the couch of seed 923000. The number of chains and leaps was changed "
        "after a run on this couch had missed its bar for R-hat, so that it is no unseen one. Of "
        "four couches that nothing was tuned on one mixes badly (R-hat 1.03 and 1.11), and so do "
        "the two hinged tables (1.05 and 1.04)."
    ),
}


def results_page() -> str:
    """Tables of every kept result in results/, one section each."""
    sections = []
    for path in sorted((Path(__file__).parents[1] / "results").glob("*.json")):
        result = json.loads(path.read_text())
        machine = result["machine"]
        sections.append(
            f"## {result['name']}\n\n"
            f"Commit `{result['commit']}`, {result['wall_time_s'] / 60:.1f} minutes on "
            f"{machine.get('cores')} cores of {machine.get('cpu')}, seeds {spans(result['seeds'])}."
            f"\n\n{NOTES.get(result['name'], '')}\n\n"
            "| figure | value | unit | bar | met | seed document | rival | spread |\n"
            "|---|---|---|---|---|---|---|---|\n" + "\n".join(map(_row, result["figures"]))
        )
    return "\n\n".join(sections) or "None are kept yet."


def spans(seeds: list[int]) -> str:
    """Seeds as a person reads them: 0 to 7, 910000."""
    parts: list[list[int]] = []
    for seed in sorted(seeds):
        if parts and seed == parts[-1][-1] + 1:
            parts[-1].append(seed)
        else:
            parts.append([seed])
    return ", ".join(
        f"{part[0]} to {part[-1]}" if len(part) > 2 else ", ".join(map(str, part)) for part in parts
    )


def _row(figure: dict) -> str:
    met = {True: "yes", False: "**no**", None: ""}[figure["met"]]
    keys = ("value", "bar", "seed_document", "rival", "spread")
    numbers = {key: _cell(figure[key]) for key in keys}
    bound = "≥ " if figure["better"] == "higher" else "≤ "
    bar = bound + numbers["bar"] if numbers["bar"] else ""
    cells = (
        f"`{figure['name']}`",
        numbers["value"],
        figure["unit"],
        bar,
        met,
        *(numbers[key] for key in ("seed_document", "rival", "spread")),
    )
    return f"| {' | '.join(cells)} |"


def _cell(entry: float | str | None) -> str:
    """A number, or what a rival is said to reach in words."""
    if entry is None or isinstance(entry, str):
        return entry or ""
    return f"{entry:.4g}"


_generated = Path(__file__).parent / "_generated"
_generated.mkdir(exist_ok=True)
(_generated / "results.md").write_text(results_page())
write_pages(_generated / "reference")
without_hints_for_the_command_line(
    f"palpate.{name}" for name in STAGES["commands"] if name.endswith(("options", "demo"))
)
