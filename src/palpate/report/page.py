"""One HTML page from one or several runs, whole in itself: no file beside it, no network.

Everything a run says about itself (names, labels, settings) is somebody's text: it is escaped in
HTML, cannot end a script element, and the page's own policy forbids every load.
"""

import base64
import dataclasses
import html
import json
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from importlib.resources import files
from itertools import chain
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
    Piece,
    pieces,
    read_evidence,
)
from palpate.report.parameter_chart import parameters
from palpate.report.parameter_words import elements, interval, number
from palpate.report.player import scene
from palpate.report.style import STYLES, style_indices
from palpate.runs.figure_names import name_in_words, number_in_words, value_in_words
from palpate.runs.storage import write_text

Section = tuple[str, str]  # title, HTML
Part = Callable[[Evidence, dict[str, int]], str]
NAMED = 5  # stages that a page names; more are counted
_OPEN_NOTES = 3
_VERDICTS = {
    True: '<span class="met">✓ met</span>',
    False: '<span class="not-met">✗ not met</span>',
    None: "–",
}
_OBSERVED = "observed"  # the label that predictions are held against


def build_report(runs: Sequence[str | Path], out: str | Path, title: str) -> Path:
    """Write one page about `runs` (their folders, in the order to be told) to the file `out`.

    It opens with what the first run says of itself, the sentences in "summary" of its settings, and
    a picture: pictures (of the first run, which the page is about), motion, or a prediction beside
    what was observed, whichever there is first. Below them are warnings, then results, and what
    else some run left evidence for: tip path, error against horizon, parameters, learning, what
    families add, and what was run. The same files give the same page.

    Raises `PalpateError` for a folder without a run, a damaged file, or an `out` that is refused.
    """
    if not runs:
        raise PalpateError("a report needs at least one run: give the folder of one")
    found = [read_evidence(run) for run in runs]
    opening, sections = _sections(found)
    body = "".join(_header(found, title)) + opening + _notes(found)
    for index, (heading, content) in enumerate(sections):
        body += f'<section id="section-{index}"><h2>{_text(heading)}</h2>{content}</section>\n'
    out = Path(out)
    write_text(out, _page(title, body))
    return out


def _sections(found: Sequence[Evidence]) -> tuple[str, list[Section]]:
    """The view that the page opens with, and every other section that has evidence, in order."""
    looks = []
    for evidence in found:
        curves = [
            curves
            for curves in (evidence.horizon, evidence.prediction, *evidence.pieces.values())
            if curves
        ]
        labelled = (*(motion.chains for motion in evidence.motions), *(c.values for c in curves))
        looks.append(style_indices(chain.from_iterable(labelled)))

    def contents(part: Part) -> list[str]:
        """Of each run that has evidence for it, under its name where there are several."""
        each = [(e.name, part(e, look)) for e, look in zip(found, looks, strict=True)]
        named = len(found) > 1
        return [f"<h3>{_text(name)}</h3>" * named + content for name, content in each if content]

    views: tuple[tuple[str, Part], ...] = (
        ("Pictures", lambda e, looks: _pictures(e) if e is found[0] else ""),
        ("Motion", _motion),
        ("Observed and predicted", _prediction),
    )
    rest: tuple[tuple[str, Part], ...] = (
        ("Results", _results),
        *((piece.heading, partial(_piece, name, piece)) for name, piece in pieces().items()),
        ("Path of the tip", _tips),
        ("Error against horizon", _horizon),
        ("Parameters", _parameters),
        ("Learning", _learning),
    )
    shown, others = ([(of, contents(part)) for of, part in parts] for parts in (views, rest))
    opening = next((of.pop(0) for _, of in shown if of), "")  # one picture, and the rest below
    if opening:
        opening = f'<section class="opening">{opening}</section>\n'
    ordered = [
        (of, "".join(content)) for of, content in (others[0], *shown, *others[1:]) if content
    ]
    return opening, [*ordered, ("What was run", "".join(map(_provenance, found)))]


# --- sections ---------------------------------------------------------------------------------


def _header(found: Sequence[Evidence], title: str) -> Iterator[str]:
    names = " → ".join(_text(evidence.name) for evidence in found[:NAMED])
    names += f" and {len(found) - NAMED} more" if len(found) > NAMED else ""
    dates = sorted(str(e.environment["date"])[:10] for e in found if "date" in e.environment)
    when = f", {_text(dates[-1])}" if dates else ""
    yield f"<header><h1>{_text(title)}</h1><p>{names}{when}</p>"
    lines = _listed(found[0].settings, "summary")
    summary = " ".join(_text(each if each.endswith(".") else f"{each}.") for each in lines)
    yield f'<p class="lead">{summary}</p>' if summary else ""
    figures = [figure for evidence in found for figure in evidence.figures]
    verdicts = [figure.met for figure in figures if figure.met is not None]
    if verdicts:
        spread = any(figure.spread is not None for figure in figures)
        yield f"<p><strong>{sum(verdicts)} of {len(verdicts)} bars met.</strong>"
        yield " ± is what other seeds are expected to change.</p>" if spread else "</p>"
    yield "</header>\n"


def _notes(found: Sequence[Evidence]) -> str:
    """Warnings, one line each until it is opened; those beyond the first few are folded, too."""
    notes = dict.fromkeys(chain.from_iterable(_listed(e.result, "warnings") for e in found))
    lines = [f'<details class="note"><summary>{_text(note)}</summary></details>' for note in notes]
    content = "".join(lines[:_OPEN_NOTES])
    if rest := lines[_OPEN_NOTES:]:
        content += f'<details class="note"><summary>{len(rest)} more</summary>'
        content += "".join(rest) + "</details>"
    return content and f'<section class="notes">{content}</section>\n'


def _listed(document: Mapping[str, Any], key: str) -> list[str]:
    found = document.get(key) or []
    return [str(item) for item in found] if isinstance(found, list) else []


def _results(evidence: Evidence, looks: dict[str, int]) -> str:
    rows = []
    for figure in evidence.figures:
        sign = "≤" if figure.better == "lower" else "≥"
        number, _, unit = _text(value_in_words(figure)).partition(" ")
        value = f"<b>{number}</b> {unit}"
        if figure.spread is not None:
            value += f" <small>± {number_in_words(figure, float(f'{figure.spread:.2g}'))}</small>"
        met = _VERDICTS[figure.met]
        bar = "–" if figure.bar is None else f"{sign} {number_in_words(figure, figure.bar)}"
        others = (_text(number_in_words(figure, of)) for of in (figure.seed_document, figure.rival))
        rows.append((_text(name_in_words(figure)), value, bar, met, *others))
    rows = list(dict.fromkeys(rows))  # what never came is said once, not in each unit
    columns = "", "value", "bar", "verdict", "seed document", "compared with"
    return _table("results", columns, rows)


def _pictures(evidence: Evidence) -> str:
    return "".join(_image(path, path.stem) for path in evidence.pictures)


def _image(path: Path, shows: str) -> str:
    data = base64.b64encode(path.read_bytes()).decode()
    kind = RENDERINGS[path.suffix]
    return f'<img alt="{_readable(shows)}" src="data:{kind};base64,{data}">'


def _motion(evidence: Evidence, looks: dict[str, int]) -> str:
    content = ""
    if evidence.motions:
        labels = list(dict.fromkeys(label for m in evidence.motions for label in m.chains))
        caption = f"The motion: {', '.join(labels)}"
        if _OBSERVED in labels and len(labels) > 1:
            caption += "; where the lines part, the prediction is wrong"
        caption += "; the trail is the path of its tip" * any(map(_tips_of, evidence.motions))
        caption += ". Drag to look from another side."
        content = _caption(caption)
        content += f'<div class="player">{_data(scene(evidence.motions, looks))}</div>'
    if evidence.rendering is not None:
        rendered = "The same scene as its simulator renders it." if content else "In motion."
        content += _caption(rendered) + _image(evidence.rendering, "The scene in motion")
    return content


def _tips_of(motion: Motion) -> Motion | None:
    """The chains of a motion whose last point is their tip; lines that a gap ends have none."""
    chains = {of: p for of, p in motion.chains.items() if np.isfinite(p[:, -1]).any()}
    return dataclasses.replace(motion, chains=chains) if chains else None


def _tips(evidence: Evidence, looks: dict[str, int]) -> str:
    content = ""
    for motion in filter(None, map(_tips_of, evidence.motions)):
        caption = "where the object's last point is over time"
        observed, distances = motion.chains.get(_OBSERVED), []
        for label, points in motion.chains.items():
            if observed is not None and label != _OBSERVED:
                squares = np.sum((points[:, -1] - observed[:, -1]) ** 2, axis=-1)
                known = squares[np.isfinite(squares)]
                distance = math.sqrt(known.mean()) if known.size else math.nan
                distances.append(f"{number(distance)} m ({label})")
        if distances:
            caption += f"; root-mean-square distance from what was observed: {', '.join(distances)}"
        caption = (
            f"{motion.group.replace('_', ' ')}: {caption}"
            if motion.group
            else caption[0].upper() + caption[1:]
        )
        tips = {label: points[:, -1, :, None] for label, points in motion.chains.items()}
        chart = charts.prediction(Curves(motion.time, tips), looks, ("x (m)", "y (m)", "z (m)"))
        content += _caption(f"{caption}.") + _chart(chart)
    return content


def _prediction(evidence: Evidence, looks: dict[str, int]) -> str:
    curves = evidence.prediction
    if curves is None:
        return ""
    (count,) = {values.shape[1] for values in curves.values.values()}
    names = [str(name) for name in evidence.settings.get("predicted", [])]
    names += [f"number {index + 1}" for index in range(len(names), count)]
    fans = [label for label, values in curves.values.items() if values.shape[2] > 1]
    caption = f"One motion, {' and '.join(curves.values)}"
    if _OBSERVED in curves.values:
        caption = "One motion, predicted from its first moment alone beside what was observed"
    caption += f"; each thin line is one of the {fans[0]}." if fans else "."
    return _caption(caption) + _chart(charts.prediction(curves, looks, names))


def _horizon(evidence: Evidence, looks: dict[str, int]) -> str:
    curves, unit = evidence.horizon, evidence.unit
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


def _parameters(evidence: Evidence, looks: dict[str, int]) -> str:
    rows = [row for row in evidence.parameters if row.value.size]  # a model may have none of a kind
    if not rows:
        return ""
    own = [row for row in rows if not row.derived]
    free = sum(not row.fixed and not row.uninformed for row in own)
    caption = f"{free} of {len(own)} parameters were identified; a short whisker is one that the "
    caption += "data determine, a long or missing one is not to be trusted."
    chart = parameters(own)
    cells = []
    for row in rows:
        status = "fixed" if row.fixed else "shared" if row.shared else "free"
        cells.append(
            (
                f"{_readable(row.name)}<br><small>{_text(row.about)}</small>",
                f"{elements(row)} {_text(row.unit)}",
                "–" if row.fixed else interval(row),
                "derived" if row.derived else status,
                _text(row.verdict or "–"),
            )
        )
    table = _table("parameters", ("", "value", "90 % interval", "kind", "verdict"), cells)
    return _caption(caption) + (_chart(chart) if chart else "") + table


def _learning(evidence: Evidence, looks: dict[str, int]) -> str:
    chart = charts.learning(evidence.metrics)
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
    for name in ("seeds", "split", "wall_time_s", *known):
        if name in evidence.result and name not in shown:
            shown[name] = evidence.result[name]
    # Settings hold what is in the configuration, too.
    shown["settings"] = {**evidence.configuration, **evidence.settings}
    rows = ""
    for name, value in shown.items():
        if value not in (None, {}, []):
            pretty = json.dumps(value, indent=2, ensure_ascii=False)
            text = value if isinstance(value, str) else pretty
            rows += f"<dt>{_readable(name)}</dt><dd><pre>{_text(text)}</pre></dd>"
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


def _table(kind: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Rows of HTML under those `columns` in which something stands, or nothing.

    A narrow screen shows the heading in each cell.
    """
    if not rows:
        return ""
    kept = [index for index in range(len(columns)) if any(row[index] != "–" for row in rows)]
    columns, rows = [columns[i] for i in kept], [[row[i] for i in kept] for row in rows]
    headings, tags = [_text(name) for name in columns], ["th", *["td"] * (len(columns) - 1)]
    head = "".join(f"<th>{name}</th>" for name in headings)
    body = ""
    for row in rows:
        cells = zip(tags, headings, row, strict=True)
        body += "<tr>" + "".join(f'<{t} data-name="{n}">{c}</{t}>' for t, n, c in cells) + "</tr>"
    return f'<table class="{kind}"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>'


def _caption(sentence: str) -> str:
    return f'<p class="caption">{_text(sentence)}</p>'


def _text(text: str) -> str:
    return html.escape(text)


def _readable(name: str) -> str:
    return _text(name.replace("_", " ").replace(".", " · "))
