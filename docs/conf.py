"""Sphinx configuration: Markdown through MyST."""

import json
from importlib.metadata import version as installed_version
from pathlib import Path

project = "palpate"
author = "The palpate developers"
version = release = installed_version("palpate")

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_enable_extensions = ["colon_fence", "dollarmath"]
nb_execution_raise_on_error = True
exclude_patterns = ["_build", "_generated"]

html_theme = "furo"
html_title = f"palpate {release}"


def results_page() -> str:
    """Tables of every kept result in results/, one section each."""
    sections = []
    for path in sorted((Path(__file__).parents[1] / "results").glob("*.json")):
        result = json.loads(path.read_text())
        machine = result["machine"]
        sections.append(
            f"## {result['name']}\n\n"
            f"Commit `{result['commit']}`, {result['wall_time_s'] / 60:.1f} minutes on "
            f"{machine.get('cores')} cores of {machine.get('cpu')}, seeds {result['seeds']}.\n\n"
            "| figure | value | unit | bar | met | seed document | rival | spread |\n"
            "|---|---|---|---|---|---|---|---|\n" + "\n".join(map(_row, result["figures"]))
        )
    return "\n\n".join(sections) or "None are kept yet."


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
