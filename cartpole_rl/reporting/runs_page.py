"""The page of a report: tables, figures, doubts and the runs of each set, and the comparison of two."""

import base64
import html
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from cartpole_rl.reporting.groups import Drawing, drawings
from cartpole_rl.reporting.page import document, escaped, table
from cartpole_rl.reporting.results import (
    GOOD,
    Agent,
    Exclusion,
    Results,
    counted_text,
    estimate_text,
    measure_label,
    ranked_text,
    sentence_start,
    value_text,
)
from cartpole_rl.reporting.statistics import difference, estimate, probability_of_improvement
from cartpole_rl.reporting.style import svg

MOST_LISTED = 1000  # runs in the list of a set
MOST_ROWS = 24  # of a table that is shown unfolded
MOST_EXCLUSIONS = 40  # runs named one by one
OF_RUNS = ("The runs are of ", ": each agent has its own ")  # in notes that stand with the list of runs
METHOD = (
    "Each number of an agent is the mean over its evaluation episodes; the last checkpoint of every seed "
    "counts and no agent is picked. A controller without training counts once per seed of its evaluation. "
    "Values are interquartile means over agents (the mean without the lowest and the highest quarter) with "
    "the 95 % interval of a stratified bootstrap over agents, after Agarwal et al. (2021). With ten agents "
    "about 94 of 100 such intervals cover the true value, with three only 73. Runs that are unfinished, "
    "damaged, or of other versions or settings than the rest are named and do not count."
)
STYLE = """
svg * { stroke-linejoin: round; stroke-linecap: butt; }
svg { width: 100%; height: auto; font-family: inherit; }
nav ol { padding-left: 1.8rem; } nav ul { padding-left: 1rem; list-style: none; margin: 0; }
section { margin-top: 2.5rem; border-top: 1px solid var(--faint); }
dt { color: var(--muted); } dd { margin: 0 0 .6rem 0; }
.terms { display: grid; grid-template-columns: max-content 1fr; gap: .15rem 1.2rem; font-size: .92rem; }
.terms dd { margin: 0; }
.figures { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 24rem), 1fr));
  gap: 1.2rem; }
.animations { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 14rem), 1fr));
  gap: .6rem; }
figure { margin: 0; } figcaption { color: var(--muted); font-size: .85rem; }
.box { border: 1px solid var(--alarm); border-left-width: 6px; border-radius: 4px;
  padding: .2rem .9rem; margin: 1rem 0; }
.box ul { padding-left: 1.2rem; margin: .3rem 0; }
.alarm { color: var(--alarm); font-weight: 600; }
pre { white-space: pre-wrap; background: var(--faint); padding: .5rem .7rem; border-radius: 4px; }
pre code { padding: 0; }
summary { cursor: pointer; color: var(--link); }
table { margin: 1rem 0; } h3 { font-size: 1rem; margin: 1.6rem 0 .5rem; } details { margin: .8rem 0; }
@media (min-width: 40.01rem) {
  #summary td:nth-child(1) { width: 21%; } #summary td:nth-child(2) { width: 13%; }
  #summary td:nth-child(3) { width: 28%; }
}
@media (max-width: 40rem) {
  .terms { grid-template-columns: 1fr; gap: 0; } .terms dd { margin-bottom: .4rem; }
  .wide table { display: table; } .wide th { white-space: nowrap; } .wide td:not(.number) { min-width: 8rem; }
  .wide { overflow-x: auto; background:
    linear-gradient(to right, var(--paper) 30%, transparent) left / 3rem 100% no-repeat local,
    linear-gradient(to left, var(--paper) 30%, transparent) right / 3rem 100% no-repeat local,
    linear-gradient(to right, var(--muted), transparent) left / 1rem 100% no-repeat scroll,
    linear-gradient(to left, var(--muted), transparent) right / 1rem 100% no-repeat scroll; }
}
@media print {
  details.values:not([open])::details-content { content-visibility: visible; display: block; }
  .figures { grid-template-columns: 1fr 1fr; }
}
"""


@dataclass(frozen=True)
class Picture:
    """A picture or an animation for the page."""

    data: bytes
    kind: str  # "gif" for an animation, else "webp"
    alt: str
    caption: str


def runs_page(
    title: str,
    sweeps: Sequence[Results],
    pictures: Mapping[str, Sequence[Picture]],
    between: Mapping[str, Sequence[str]],
) -> str:
    """Return the page of one set of runs, or of two and their comparison.

    `pictures` maps the name of a set to its pictures, `between` the settings that differ between sets to
    their values.
    """
    links = "".join(f'<li><a href="#{anchor(each.name)}">{escaped(each.title)}</a></li>' for each in sweeps)
    parts = [
        f"<h1>{escaped(title)}</h1>",
        *(
            [f"<nav><ul>{links}</ul></nav>", comparison(sweeps[0], sweeps[1], between)]
            if len(sweeps) > 1
            else []
        ),
        *(_section(each, pictures.get(each.name, ())) for each in sweeps),
        method(),
    ]
    return document(title, "\n".join(parts), STYLE)


def _section(results: Results, pictures: Sequence[Picture]) -> str:
    groups = f"{len(results.groups)} groups" if len(results.groups) > 1 else "one group"
    parts = [
        f'<section id="{anchor(results.name)}">',
        f"<h2>{escaped(results.title)}</h2>",
        f"<p>{counted_text(len(results.agents))} in {groups}. {escaped(_answer(results))}</p>",
        doubts(results),
        *figure_parts(results, pictures, drawings(results)),
        run_list(results),
        "</section>",
    ]
    return "\n".join(part for part in parts if part)


def _answer(results: Results) -> str:
    """Return the estimate of each group in a sentence."""
    if not results.agents:
        return "No result yet."
    found = results.estimates(results.judged[0].name)
    return f"{sentence_start(measure_label(results.measure))}{ranked_text(found, measure=results.measure)}."


def anchor(name: str) -> str:
    """Return the id of a section; no character of a name ends the attribute."""
    return f"study-{re.sub('[^A-Za-z0-9_.+-]', '-', name)}"


def method() -> str:
    """Return the section on how numbers are made."""
    return f'<section id="method"><h2>How numbers are made</h2><p>{METHOD}</p></section>'


def comparison(first: Results, second: Results, between: Mapping[str, Sequence[str]]) -> str:
    """Return the section that compares two sets group by group, by the labels of their groups."""
    names = first.title, second.title
    values = [
        {
            group.label: found
            for group in each.groups
            if (found := each.values(group.name, each.evaluations[0].name)).size
        }
        for each in (first, second)
    ]
    rows = [
        {
            "group": label,
            names[0]: estimate_text(estimate(ours)),
            names[1]: estimate_text(estimate(others)),
            "difference, 95 % interval": estimate_text(difference(others, ours)),
            f"chance that {names[1]} is higher": estimate_text(probability_of_improvement(others, ours)),
            "agents": f"{ours.size} and {others.size}",
        }
        for label, ours in values[0].items()
        if (others := values[1].get(label)) is not None
    ]
    lone = [
        f"{label} is only in {name}."
        for name, own, others in zip(names, values, values[::-1], strict=True)
        for label in own
        if label not in others
    ]
    differs = [
        {"setting": name, names[0]: settings[0], names[1]: settings[1]} for name, settings in between.items()
    ]
    parts = [
        '<section id="comparison"><h2>Comparison</h2>',
        f"<p>Settings that differ:</p>{folded(differs, 'settings')}"
        if differs
        else "<p>No setting differs.</p>",
        folded(rows, "groups") if rows else "<p>The two sets have no group in common.</p>",
        "".join(f"<p>{escaped(line)}</p>" for line in lone[:MOST_EXCLUSIONS]),
        "</section>",
    ]
    return "\n".join(parts)


def figure_parts(
    results: Results,
    pictures: Sequence[Picture],
    figures: Iterable[Drawing],
    more: Mapping[str, Sequence[Mapping[str, Any]]] | None = None,
) -> Iterator[str]:
    """Yield the table of values, `more` tables by their names, the figures, animations and other pictures."""
    if not results.agents:
        return
    for name, rows in {"values": _value_rows(results), **(more or {})}.items():
        yield folded(rows, name)
    yield f'<div class="figures">{"".join(drawn(each, results.name) for each in figures)}</div>'
    animations = [each for each in pictures if each.kind == "gif"]
    others = [each for each in pictures if each.kind != "gif"]
    for heading, grid, chosen in (
        ("The best, the median and the worst agent", "animations", animations),
        ("Figures of a run", "figures", others),
    ):
        if shown := "".join(map(_picture, chosen)):
            yield f'<h3>{heading}</h3><div class="{grid}">{shown}</div>'


def _value_rows(results: Results) -> list[dict[str, Any]]:
    """Return a row for each group and evaluation that has agents."""
    measure, several, rows = results.measure, len(results.evaluations) > 1, []
    for group in results.groups:
        for evaluation in results.evaluations:
            values = results.values(group.name, evaluation.name)
            if not values.size:
                continue
            row: dict[str, Any] = {"set-up": group.label}
            row |= {"evaluation": evaluation.label} if several else {}
            row |= {
                f"{measure_label(measure)}, 95 % interval": estimate_text(estimate(values), measure),
                "lowest": value_text(float(values.min()), measure),
                "highest": value_text(float(values.max()), measure),
            }
            if good := GOOD.get(measure):
                row[f"above {good:g}"] = f"{(values > good).sum()} of {values.size}"
            rows.append({**row, f"{results.unit}s": values.size})
    return rows


def folded(rows: Sequence[Mapping[str, Any]], name: str) -> str:
    """Return a table that scrolls on a phone, folded if it is long; paper shows it unfolded."""
    if len(rows) <= MOST_ROWS:
        return wide(rows) if rows else ""
    return f'<details class="values"><summary>{len(rows)} rows of {name}</summary>{wide(rows)}</details>'


def wide(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return a table that scrolls by itself where it is wider than the page."""
    return f'<div class="wide" tabindex="0" role="group" aria-label="table">{table(rows)}</div>'


def doubts(results: Results, missing: Sequence[str] = (), remarks: Sequence[str] = ()) -> str:
    """Return the box that names what is missing and what does not count; empty without any."""
    shown = [f"{each.run} does not count: {each.reason}." for each in results.exclusions[:MOST_EXCLUSIONS]]
    if more := results.exclusions[MOST_EXCLUSIONS:]:
        shown.append(f"{len(more)} more runs do not count, as: {_reasons(more)}.")
    notes = (note for note in results.notes if not _is_of_runs(note))
    lines = [*missing, *shown, *notes, *remarks]
    listed = "".join(f"<li>{escaped(line)}</li>" for line in lines)
    box = '<aside class="box" role="note" aria-label="Missing or excluded runs">'
    return f"{box}<ul>{listed}</ul></aside>" if lines else ""


def _is_of_runs(note: str) -> bool:
    """Return True for a note on how the runs were made, which is no reason to doubt them."""
    return any(part in note for part in OF_RUNS)


def _reasons(exclusions: Sequence[Exclusion]) -> str:
    return "; ".join(dict.fromkeys(each.reason for each in exclusions[:5]))


def run_list(results: Results) -> str:
    """Return the folded list of the runs that count, with the versions and commits that made them."""
    if not results.agents:
        return ""
    rows = [
        {"run": agent.run, "seed": agent.seed, **_named_values(results, agent)}
        for agent in results.agents[:MOST_LISTED]
    ]
    notes = filter(_is_of_runs, results.notes)
    made = "".join(f"<p>{escaped(line)}</p>" for line in (results.versions, *notes) if line)
    count = len(results.agents)
    heading = f"The {count} runs behind it" if count > 1 else "The run behind it"
    heading += f": the first {MOST_LISTED}" if count > MOST_LISTED else ""
    return f"<details><summary>{heading}</summary>{made}{wide(rows)}</details>"


def _named_values(results: Results, agent: Agent) -> dict[str, str]:
    single, measure = len(results.evaluations) == 1, results.measure
    return {
        measure_label(measure) if single else each.label: value_text(agent.values[each.name], measure)
        if each.name in agent.values
        else "–"
        for each in results.evaluations
    }


def drawn(drawing: Drawing, study: str = "") -> str:
    """Return a figure with its caption; `study` makes its ids unique on the page."""
    figure = svg(drawing.figure, drawing.alt, f"{study}/{drawing.name}")
    return f"<figure>{figure}<figcaption>{escaped(drawing.caption)}</figcaption></figure>"


def _picture(picture: Picture) -> str:
    source = f"data:image/{picture.kind};base64,{base64.b64encode(picture.data).decode()}"
    image = f'<img src="{source}" alt="{html.escape(picture.alt)}">'
    return f"<figure>{image}<figcaption>{escaped(picture.caption)}</figcaption></figure>"
