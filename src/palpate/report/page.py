"""One HTML page from one or several runs, whole in itself: no file beside it, no network.

Everything a run says about itself (names, labels, settings) is somebody's text: it is escaped in
HTML, cannot end a script element, and the page's own policy forbids every load.
"""

import base64
import html
import json
import math
import re
from collections.abc import Iterator, Sequence
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from palpate.errors import PalpateError
from palpate.report import charts
from palpate.report.evidence import (
    RENDERINGS,
    Curves,
    Evidence,
    Motion,
    Parameter,
    Piece,
    pieces,
    read_evidence,
)
from palpate.report.parameter_chart import number, parameters
from palpate.report.player import scene
from palpate.report.style import STYLES, numbered
from palpate.runs import Figure
from palpate.runs.storage import write_text

Section = tuple[str, str]  # title, HTML
NAMED = 5  # stages that a page names; more are counted
_FEW = 4  # elements of a parameter that are told one by one
_OBSERVED = "observed"  # the label that predictions are held against


def build_report(
    runs: Sequence[str | Path], out: str | Path, title: str, notes: Sequence[str] = ()
) -> Path:
    """Write one page about `runs` (their folders, in the order to be told) to the file `out`.

    A section appears where some run left evidence for it: results, pictures (of the first run,
    which the page is about), motion, tip path, error against horizon, parameters, learning,
    what families add, and what was run. `notes` are sentences shown on top.
    The same files give the same page.

    Raises `PalpateError` when a folder holds no run, when a file in it is damaged, or when `out`
    cannot be written.
    """
    if not runs:
        raise PalpateError("a report needs at least one run: give the folder of one")
    found = [read_evidence(run) for run in runs]
    body = "".join(_header(found, title, notes))
    for index, (heading, content) in enumerate(_sections(found)):
        body += f'<section id="section-{index}"><h2>{_text(heading)}</h2>{content}</section>\n'
    out = Path(out)
    write_text(out, _page(title, body))
    return out


def _sections(found: Sequence[Evidence]) -> Iterator[Section]:
    """Every section that has evidence, in the order a reader asks."""
    parts = (
        ("Results", lambda e, looks: _results(e.figures)),
        ("Pictures", lambda e, looks: _pictures(e) if e is found[0] else ""),
        ("Motion", _motion),
        ("Path of the tip", _tips),
        ("Error against horizon", lambda e, looks: _horizon(e.horizon, looks, e.unit)),
        ("Parameters", lambda e, looks: _parameters(e.parameters)),
        ("Learning", lambda e, looks: _learning(e.metrics)),
        *((piece.heading, partial(_piece, name, piece)) for name, piece in pieces().items()),
    )
    looks = [numbered(_labels(evidence)) for evidence in found]
    for heading, part in parts:
        contents = [(e.name, part(e, look)) for e, look in zip(found, looks, strict=True)]
        contents = [(name, content) for name, content in contents if content]
        if len(contents) > 1:
            contents = [(name, f"<h3>{_text(name)}</h3>{content}") for name, content in contents]
        if contents:
            yield heading, "".join(content for _, content in contents)
    yield "What was run", "".join(map(_provenance, found))


def _labels(evidence: Evidence) -> Iterator[str]:
    for motion in evidence.motions:
        yield from motion.chains
    for curves in (evidence.horizon, *evidence.pieces.values()):
        yield from curves.values if curves else ()


# --- sections ---------------------------------------------------------------------------------


def _header(found: Sequence[Evidence], title: str, notes: Sequence[str]) -> Iterator[str]:
    names = " → ".join(_text(evidence.name) for evidence in found[:NAMED])
    names += f" and {len(found) - NAMED} more" if len(found) > NAMED else ""
    dates = sorted(str(e.environment["date"])[:10] for e in found if "date" in e.environment)
    when = f", {_text(dates[-1])}" if dates else ""
    yield f"<header><h1>{_text(title)}</h1><p>{names}{when}</p>"
    figures = [figure for evidence in found for figure in evidence.figures]
    verdicts = [figure.met for figure in figures if figure.met is not None]
    if verdicts:
        spread = any(figure.spread is not None for figure in figures)
        yield f"<p><strong>{sum(verdicts)} of {len(verdicts)} bars met.</strong>"
        yield " ± is what other seeds are expected to change.</p>" if spread else "</p>"
    yield "".join(f'<p class="note">{_text(note)}</p>' for note in notes) + "</header>\n"


def _results(figures: Sequence[Figure]) -> str:
    if not figures:
        return ""
    rows = []
    for figure in figures:
        sign = "≤" if figure.better == "lower" else "≥"
        value = f"<b>{_number(figure.value)}</b> {_text(figure.unit)}"
        if figure.spread is not None:
            value += f" <small>± {figure.spread:.2g}</small>"
        met = {True: "✓ met", False: "✗ not met", None: "–"}[figure.met]
        cells = (
            ("", f'<span title="{_text(figure.name)}">{_readable(figure.name)}</span>', "th"),
            ("value", value, "td"),
            ("bar", "none" if figure.bar is None else f"{sign} {_number(figure.bar)}", "td"),
            ("verdict", f'<span class="{met[2:].replace(" ", "-")}">{met}</span>', "td"),
            ("seed document", _number(figure.seed_document, "not printed"), "td"),
            ("rival", _number(figure.rival, "none"), "td"),
        )
        rows.append(cells)
    return _table(rows, "results")


def _pictures(evidence: Evidence) -> str:
    return "".join(
        f'<img alt="{_readable(path.stem)}" src="data:image/png;base64,{_encoded(path)}">'
        for path in evidence.pictures
    )


def _encoded(path: Path) -> str:
    return base64.b64encode(path.read_bytes()).decode()


def _motion(evidence: Evidence, looks: dict[str, int]) -> str:
    content = ""
    if evidence.motions:
        labels = list(dict.fromkeys(label for m in evidence.motions for label in m.chains))
        caption = f"The object {_listed(labels)}"
        if _OBSERVED in labels and len(labels) > 1:
            caption += ": where the lines part, the prediction is wrong"
        caption += "; the trail is the path of its tip. Drag to look from another side."
        content = _caption(caption)
        content += f'<div class="player">{_data(scene(evidence.motions, looks))}</div>'
    if evidence.rendering is not None:
        kind = RENDERINGS[evidence.rendering.suffix]
        content += _caption("The same scene as its simulator renders it.")
        source = f"data:{kind};base64,{_encoded(evidence.rendering)}"
        content += f'<img alt="The scene in motion" src="{source}">'
    return content


def _tips(evidence: Evidence, looks: dict[str, int]) -> str:
    height = 400 if len(evidence.motions) == 1 else 300
    return "".join(_tip(motion, looks, height) for motion in evidence.motions)


def _tip(motion: Motion, looks: dict[str, int], height: int) -> str:
    caption = "where the object's last point is over time"
    observed = motion.chains.get(_OBSERVED)
    distances = [
        f"{number(_root_mean_square(chain[:, -1] - observed[:, -1]))} m ({label})"
        for label, chain in motion.chains.items()
        if observed is not None and label != _OBSERVED
    ]
    if distances:
        caption += f"; root-mean-square distance from what was observed: {', '.join(distances)}"
    caption = f"{motion.group}: {caption}" if motion.group else caption[0].upper() + caption[1:]
    return _caption(f"{caption}.") + _chart(charts.tip(motion, looks, height))


def _horizon(curves: Curves | None, looks: dict[str, int], unit: str) -> str:
    if curves is None:
        return ""
    ends = []
    for label, values in curves.values.items():
        known = np.flatnonzero(np.isfinite(values))
        if known.size:
            last = known[-1]
            error = f"{values[last]:.3g} {unit}".rstrip()
            ends.append(f"{error} after {curves.time[last]:.3g} s ({label})")
    caption = "How far a prediction drifts the longer it runs without looking; lower is better"
    caption += f": {', '.join(ends)}." if ends else "."
    caption += " The band spans the quantiles over trials." if curves.bands else ""
    return _caption(caption) + _chart(charts.horizon(curves, looks, unit))


def _parameters(rows: Sequence[Parameter]) -> str:
    rows = [row for row in rows if row.value.size]  # a model may have none of a kind
    if not rows:
        return ""
    own = [row for row in rows if not row.derived]
    free = sum(not row.fixed and not row.uninformed for row in own)
    caption = f"{free} of {len(own)} parameters were identified; a short whisker is one that the "
    caption += "data determine, a long or missing one is not to be trusted."
    chart = parameters(own)
    drawn = _chart(chart) if chart else ""
    cells = []
    for row in rows:
        status = "fixed" if row.fixed else "shared" if row.shared else "free"
        status = "derived" if row.derived else status
        about = f"{_readable(row.name)}<br><small>{_text(row.about)}</small>"
        verdict = _text(row.verdict or "–")
        cells.append(
            [
                ("", about, "th"),
                ("value", f"{_elements(row.value)} {_text(row.unit)}", "td"),
                ("90 % interval", "–" if row.fixed else _interval(row), "td"),
                ("kind", status, "td"),
                ("verdict", verdict, "td"),
            ]
        )
    return _caption(caption) + drawn + _table(cells, "parameters")


def _learning(metrics: Sequence[dict[str, Any]]) -> str:
    chart = charts.learning(metrics)
    if chart is None:
        return ""
    caption = "The loss as it was minimised"
    if chart["layout"].get("shapes"):
        caption += "; at each dotted line the curriculum changed the horizon, so that a rise there "
        caption += "is a harder task and no setback"
    return _caption(caption + ".") + _chart(chart)


def _piece(name: str, piece: Piece, evidence: Evidence, looks: dict[str, int]) -> str:
    if name not in evidence.pieces:
        return ""
    caption, chart = piece.show(evidence.pieces[name], looks)
    return _caption(caption) + _chart(chart)


def _provenance(evidence: Evidence) -> str:
    known = ("command", "date", "commit", "machine", "versions")
    shown = {name: evidence.environment[name] for name in known if name in evidence.environment}
    for name in ("seeds", "split", "wall_time_s", "settings", *known):
        if name in evidence.result and name not in shown:
            shown[name] = evidence.result[name]
    shown["configuration"] = evidence.configuration
    rows = "".join(
        f"<dt>{_readable(name)}</dt><dd><pre>{_text(_pretty(value))}</pre></dd>"
        for name, value in shown.items()
        if value not in (None, {}, [])
    )
    return f"<details><summary>{_text(evidence.name)}</summary><dl>{rows}</dl></details>"


# --- parts ------------------------------------------------------------------------------------


def _page(title: str, body: str) -> str:
    from plotly.offline import get_plotlyjs

    assets = files("palpate.report") / "assets"

    def asset(name: str) -> str:
        return (assets / name).read_text(encoding="utf-8")

    parts = {
        "title": _text(title),
        "style": _palette() + asset("page.css"),
        "body": body,
        "plotly": get_plotlyjs() if 'class="chart"' in body else "",
        "script": asset("charts.js") + asset("player.js"),
    }
    # one pass over the template alone, so that nothing in a part is taken for a mark
    return re.sub(r"<!--(\w+)-->", lambda mark: parts[mark[1]], asset("page.html"))


def _palette() -> str:
    def colours(shade: str) -> str:
        return "".join(f"--series-{i}:{getattr(s, shade)};" for i, s in enumerate(STYLES))

    dark = f"@media (prefers-color-scheme:dark){{:root{{{colours('dark')}}}}}"
    return f":root{{{colours('light')}}}{dark}\n"


def _chart(chart: charts.Chart) -> str:
    height = chart["layout"]["height"]
    return f'<div class="chart" style="height:{height}px">{_data(chart)}</div>'


def _data(content: Any) -> str:
    text = json.dumps(content, allow_nan=False, separators=(",", ":"), ensure_ascii=False)
    text = text.replace("<", "\\u003c")  # or a label could close the element or open a comment
    return f'<script type="application/json">{text}</script>'


def _table(rows: Sequence[Sequence[tuple[str, str, str]]], kind: str) -> str:
    """Rows of (heading, HTML, "th" or "td"); a narrow screen shows the heading in each cell."""
    head = "".join(f"<th>{_text(name)}</th>" for name, _, _ in rows[0])
    body = "".join(
        "<tr>" + "".join(f'<{t} data-name="{_text(n)}">{c}</{t}>' for n, c, t in row) + "</tr>"
        for row in rows
    )
    return f'<table class="{kind}"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>'


def _caption(sentence: str) -> str:
    return f'<p class="caption">{_text(sentence)}</p>'


def _text(text: str) -> str:
    return html.escape(text)


def _readable(name: str) -> str:
    return _text(name.replace("_", " ").replace(".", " · "))


def _number(value: float | int | str | None, missing: str = "none") -> str:
    if value is None:
        return missing
    return _text(value) if isinstance(value, str) else f"{value:.4g}"


def _elements(values: np.ndarray) -> str:
    if 1 < values.size <= _FEW:
        return "; ".join(number(float(value)) for value in values.ravel())
    known = values[np.isfinite(values)]
    low, high = (float(known.min()), float(known.max())) if known.size else (math.nan, math.nan)
    if not known.size or math.isclose(low, high, rel_tol=5e-4):
        return number(low)
    return f"{number(low)} to {number(high)}"


def _interval(row: Parameter) -> str:
    """The interval, or what is typical of the elements' intervals relative to their values."""
    known = np.isfinite(row.lower) & np.isfinite(row.upper) & (row.value != 0)
    if not known.any():
        return "–"
    if row.value.size <= _FEW:
        edges = zip(row.lower.ravel(), row.upper.ravel(), strict=True)
        return "; ".join(f"{number(low)} to {number(high)}" for low, high in edges)
    value = row.value[known]
    sides = (np.median((edge[known] - value) / np.abs(value)) for edge in (row.lower, row.upper))
    return "typically " + " to ".join(f"{side:+.0%}" for side in sides).replace("-", "−")


def _listed(names: Sequence[str]) -> str:
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))


def _pretty(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, indent=2, ensure_ascii=False)


def _root_mean_square(difference: np.ndarray) -> float:
    squares = np.sum(difference**2, axis=-1)
    known = squares[np.isfinite(squares)]
    return math.sqrt(known.mean()) if known.size else math.nan
