"""The page of studies and that of a person's own runs, each one HTML file with everything in it."""

import base64
import html
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from cartpole_rl.reporting.page import Html, document, escaped, table
from cartpole_rl.reporting.studies.answers import (
    BEYOND,
    GOOD,
    THESIS_ROWS,
    Status,
    agents_text,
    answer,
    estimate_text,
    measure_label,
    ratios,
    reason,
    status,
)
from cartpole_rl.reporting.studies.comparison import Comparison
from cartpole_rl.reporting.studies.figures import Drawing, drawings, rank_agreement
from cartpole_rl.reporting.studies.results import Exclusion, StudyResults
from cartpole_rl.reporting.studies.settings import Variant
from cartpole_rl.reporting.studies.statistics import estimate
from cartpole_rl.reporting.table import number_text

MOST_ROWS = 24  # of a table that is shown unfolded
MOST_EXCLUSIONS = 40  # runs named one by one
TITLE = "The thesis, carried out"
METHOD = (
    "Each number of an agent is the mean over its evaluation episodes; the last checkpoint of every seed "
    "counts and no agent is picked. Values are interquartile means over agents (the mean without the lowest "
    "and the highest quarter) with the 95 % interval of a stratified bootstrap over agents, after Agarwal et "
    "al. (2021). Runs that are unfinished, damaged, or of other versions or settings than the rest are named "
    "and do not count."
)
STYLE = """
svg * { stroke-linejoin: round; stroke-linecap: butt; }
svg { width: 100%; height: auto; font-family: inherit; }
nav ol { padding-left: 1.8rem; } nav ul { padding-left: 1rem; list-style: none; margin: 0; }
section { margin-top: 2.5rem; border-top: 1px solid var(--faint); }
dt { color: var(--muted); } dd { margin: 0 0 .6rem 0; }
.figures { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 24rem), 1fr));
  gap: 1.2rem; }
.animations { display: grid; grid-template-columns: repeat(3, 1fr); gap: .6rem; }
figure { margin: 0; } figcaption { color: var(--muted); font-size: .85rem; }
.box { border: 1px solid var(--alarm); border-left-width: 6px; border-radius: 4px;
  padding: .2rem .9rem; margin: 1rem 0; }
.box ul { padding-left: 1.2rem; margin: .3rem 0; }
.alarm { color: var(--alarm); font-weight: 600; }
pre { white-space: pre-wrap; background: var(--faint); padding: .5rem .7rem; border-radius: 4px; }
pre code { padding: 0; }
summary { cursor: pointer; color: var(--link); }
table { margin: 1rem 0; } h3 { font-size: 1rem; margin: 1.6rem 0 .5rem; } details { margin: .8rem 0; }
@media print { details:not([open])::details-content { content-visibility: visible; display: block; } }
"""


@dataclass(frozen=True)
class Picture:
    """A picture or an animation for the page."""

    data: bytes
    kind: str  # "gif", "png" or "webp"
    alt: str
    caption: str


def studies_page(results: Sequence[StudyResults], pictures: Mapping[str, Sequence[Picture]]) -> str:
    """Return the page of studies, in their order; `pictures` maps the name of a study to its pictures."""
    agents = sum(len(each.agents) for each in results)
    sizes = sorted({each.label for each in results if each.agents and each.label})
    size = f", size {', '.join(sizes)}" if sizes else ""
    parts = [
        f"<h1>{TITLE}</h1>",
        f"<p>{len(results)} {'study' if len(results) == 1 else 'studies'}{size}, {agents_text(agents)}.</p>",
        _summary(results),
        _contents(results),
        *(_study_section(each, pictures.get(each.name, ())) for each in results),
        _ranks(results),
        _method(),
    ]
    return document(TITLE, "\n".join(part for part in parts if part), STYLE)


def runs_page(
    title: str,
    sweeps: Sequence[StudyResults],
    pictures: Mapping[str, Sequence[Picture]],
    comparison: Comparison | None = None,
) -> str:
    """Return the page of sets of runs, and of their comparison."""
    links = "".join(
        f'<li><a href="#{_anchor(each.name)}">{escaped(each.study.title)}</a></li>' for each in sweeps
    )
    parts = [
        f"<h1>{escaped(title)}</h1>",
        f"<nav><ul>{links}</ul></nav>" if len(sweeps) > 1 else "",
        _comparison(comparison) if comparison else "",
        *(_sweep_section(each, pictures.get(each.name, ())) for each in sweeps),
        _method(),
    ]
    return document(title, "\n".join(part for part in parts if part), STYLE)


def _summary(results: Sequence[StudyResults]) -> str:
    """Return the table of all studies, what fails or contradicts first."""
    order = [*Status]
    ranked = sorted(results, key=lambda each: order.index(status(each)))
    rows = [
        {
            "study": _link(each),
            "the thesis": each.study.thesis or "–",
            "here": answer(each),
            "verdict": _status(each),
        }
        for each in ranked
    ]
    return (
        f'<section id="summary"><h2>Summary: what fails comes first</h2>{table(rows, cards=True)}</section>'
    )


def _contents(results: Sequence[StudyResults]) -> str:
    """Return the thesis's own list with the studies of each row, then those beyond it."""
    beyond = "".join(f"<li>{_link(each)}</li>" for each in results if each.study.order >= BEYOND)
    further = f"<ul>{beyond}</ul>" if beyond else ""
    if all(each.study.order >= BEYOND for each in results):
        return f'<nav id="contents"><h2>Contents</h2>{further}</nav>'
    rows = []
    for number, what in THESIS_ROWS.items():
        own = [each for each in results if each.study.order // 10 == number]
        links = "".join(f"<li>{_link(each)}</li>" for each in own)
        missing = "" if own else ': <span class="alarm">no study</span>'
        rows.append(f"<li>{escaped(what)}{missing}<ul>{links}</ul></li>")
    further = f"<h3>Beyond the thesis</h3>{further}" if beyond else ""
    return f'<nav id="contents"><h2>The list of the thesis</h2><ol>{"".join(rows)}</ol>{further}</nav>'


def _study_section(results: StudyResults, pictures: Sequence[Picture]) -> str:
    study = results.study
    figure = f" <small>({escaped(_figure_name(study.figure))})</small>" if study.figure else ""
    facts = {
        "Question": study.question,
        "The thesis": study.thesis or "not in the thesis",
        "Here": answer(results),
        "Why": study.comment,
    }
    listed = "".join(f"<dt>{name}</dt><dd>{escaped(text)}</dd>" for name, text in facts.items() if text)
    parts = [
        f'<section id="{_anchor(results.name)}">',
        f"<h2>{escaped(study.title)}{figure}</h2>",
        f"<p>{_status(results)}</p><dl>{listed}</dl>",
        _doubts(results, [f"Missing: {each}." for each in results.missing()]),
        *_figures(results, pictures),
        _commands(results),
        _runs(results),
        "</section>",
    ]
    return "\n".join(part for part in parts if part)


def _sweep_section(results: StudyResults, pictures: Sequence[Picture]) -> str:
    groups = f"{len(results.study.arms)} groups" if len(results.study.arms) > 1 else "one group"
    parts = [
        f'<section id="{_anchor(results.name)}">',
        f"<h2>{escaped(results.study.title)}</h2>",
        f"<p>{agents_text(len(results.agents))} in {groups}. {escaped(answer(results))}</p>",
        _doubts(results, []),
        *_figures(results, pictures),
        _runs(results),
        "</section>",
    ]
    return "\n".join(part for part in parts if part)


def _figures(results: StudyResults, pictures: Sequence[Picture]) -> Iterator[str]:
    """Yield the table of values, the figures, and the animations and other pictures."""
    if not results.agents:
        return
    yield _folded(_value_rows(results), "values")
    if shares := ratios(results):
        first, second = results.evaluations[:2]
        name = f"{second.label} / {first.label}"
        yield _folded(
            [
                {"arm": label, name: estimate_text(each), "agents": each.agents}
                for label, each in shares.items()
            ],
            "ratios",
        )
    yield f'<div class="figures">{"".join(map(_drawing, drawings(results)))}</div>'
    for kind, heading in (("gif", "The best, the median and the worst agent"), ("png", "Figures of a run")):
        if shown := "".join(_picture(each) for each in pictures if (each.kind == "gif") == (kind == "gif")):
            grid = "animations" if kind == "gif" else "figures"
            yield f'<h3>{heading}</h3><div class="{grid}">{shown}</div>'


def _value_rows(results: StudyResults) -> list[dict[str, Any]]:
    """Return a row for each arm and evaluation that has agents."""
    measure = results.study.measure
    several = len(results.evaluations) > 1
    rows = []
    for arm in results.study.arms:
        for evaluation in results.evaluations:
            values = results.values(arm.name, evaluation.name)
            if not values.size:
                continue
            row: dict[str, Any] = {"arm": arm.label}
            if several:
                row["evaluation"] = evaluation.label
            row |= {
                f"{measure_label(measure)}, 95 % interval": estimate_text(estimate(values)),
                "lowest": number_text(float(values.min())),
                "highest": number_text(float(values.max())),
            }
            if good := GOOD.get(measure):
                row[f"above {good:g}"] = f"{(values > good).sum()} of {values.size}"
            row["agents"] = values.size
            rows.append(row)
    return rows


def _folded(rows: Sequence[Mapping[str, Any]], name: str) -> str:
    """Return a table, folded if it is long."""
    if not rows:
        return ""
    whole = table(rows)
    if len(rows) <= MOST_ROWS:
        return whole
    return f"<details><summary>{len(rows)} rows of {name}</summary>{whole}</details>"


def _doubts(results: StudyResults, missing: Sequence[str]) -> str:
    """Return the box that names what is missing, what does not count and what is mixed; empty without any."""
    shown = [f"{each.run} does not count: {each.reason}." for each in results.exclusions[:MOST_EXCLUSIONS]]
    if (more := len(results.exclusions) - len(shown)) > 0:
        shown.append(f"{more} more runs do not count, as: {_reasons(results.exclusions[MOST_EXCLUSIONS:])}.")
    lines = [*missing, *shown, *results.notes]
    if not lines:
        return ""
    listed = "".join(f"<li>{escaped(line)}</li>" for line in lines)
    return f'<aside class="box" role="note" aria-label="Missing or mixed runs"><ul>{listed}</ul></aside>'


def _reasons(exclusions: Sequence[Exclusion]) -> str:
    return "; ".join(dict.fromkeys(each.reason for each in exclusions[:5]))


def _commands(results: StudyResults) -> str:
    """Return the command that repeats the study, and those of its first arm by hand."""
    size = f" --size {results.label}" if results.label else ""
    whole = f"scripts/reproduce {results.name}{size}"
    by_hand = "\n".join(_by_hand(results))
    return (
        f"<h3>Command</h3><pre><code>{escaped(whole)}</code></pre>"
        f"<details><summary>Arm by arm</summary><pre><code>{escaped(by_hand)}</code></pre></details>"
    )


def _by_hand(results: StudyResults) -> Iterator[str]:
    """Yield a command for each arm, and one for each evaluation."""
    study, size = results.study, results.size
    overrides = size.overrides if size else ()
    seeds = f"seed=range({size.seeds})" if size else "seed=0"
    for arm in study.arms:
        if not study.agents_of:
            experiment = [f"experiment={study.experiment}"] if study.experiment else []
            yield _command(study.command, ["-m", *experiment, *overrides, *arm.overrides, seeds])
    for evaluation in study.evaluations:
        if study.command != "evaluate":
            more = size.evaluation_overrides if size else ()
            yield _command("evaluate", ["run=<run>", *more, *evaluation.overrides])
    if study.agents_of:
        yield f"# agents: scripts/reproduce {study.agents_of}"


def _command(name: str, words: Sequence[str]) -> str:
    quoted = (word if word == "run=<run>" else shlex.quote(word) for word in words)
    return f"cartpole-{name} {' '.join(quoted)}"


def _runs(results: StudyResults) -> str:
    """Return the folded list of the runs that count."""
    if not results.agents:
        return ""
    measure = results.study.measure
    rows = [
        {"run": agent.run, "seed": agent.seed, **_named_values(results, agent.values, measure)}
        for agent in results.agents[:1000]
    ]
    versions = f"<p>{escaped(results.versions)}</p>" if results.versions else ""
    heading = f"The {len(results.agents)} runs behind it"
    return f"<details><summary>{heading}</summary>{versions}{table(rows)}</details>"


def _named_values(results: StudyResults, values: Mapping[str, float], measure: str) -> dict[str, str]:
    evaluations: Sequence[Variant] = results.evaluations
    if len(evaluations) == 1:
        return {measure_label(measure): number_text(values[evaluations[0].name])}
    return {
        each.label: number_text(values[each.name]) if each.name in values else "–" for each in evaluations
    }


def _ranks(results: Sequence[StudyResults]) -> str:
    drawing = rank_agreement(results)
    if drawing is None:
        return ""
    return (
        '<section id="ranks"><h2>Does the order in simulation predict that on the cart?</h2>'
        f'<div class="figures">{_drawing(drawing)}</div></section>'
    )


def _comparison(comparison: Comparison) -> str:
    first, second = comparison.names
    differs = [
        {"setting": name, first: values[0], second: values[1]} for name, values in comparison.between.items()
    ]
    rows = [
        {
            "group": each.label,
            first: estimate_text(each.first),
            second: estimate_text(each.second),
            "difference, 95 % interval": estimate_text(each.difference),
            f"chance that {second} is higher": estimate_text(each.improvement),
            "agents": f"{each.first.agents} and {each.second.agents}",
        }
        for each in comparison.pairs
    ]
    lone = [f"{label} is only in {name}." for name, label in comparison.lone]
    parts = [
        '<section id="comparison"><h2>Comparison</h2>',
        f"<p>Settings that differ:</p>{_folded(differs, 'settings')}"
        if differs
        else "<p>No setting differs.</p>",
        _folded(rows, "groups") if rows else "<p>The two sets have no group in common.</p>",
        "".join(f"<p>{escaped(line)}</p>" for line in lone[:MOST_EXCLUSIONS]),
        "</section>",
    ]
    return "\n".join(parts)


def _method() -> str:
    return f'<section id="method"><h2>How numbers are made</h2><p>{METHOD}</p></section>'


def _drawing(drawing: Drawing) -> str:
    return f"<figure>{drawing.svg}<figcaption>{escaped(drawing.caption)}</figcaption></figure>"


def _picture(picture: Picture) -> str:
    data = base64.b64encode(picture.data).decode()
    source = f"data:image/{picture.kind};base64,{data}"
    image = f'<img src="{source}" alt="{html.escape(picture.alt)}">'
    return f"<figure>{image}<figcaption>{escaped(picture.caption)}</figcaption></figure>"


def _link(results: StudyResults) -> Html:
    figure = f" ({escaped(_figure_name(results.study.figure))})" if results.study.figure else ""
    return Html(f'<a href="#{_anchor(results.name)}">{escaped(results.study.title)}</a>{figure}')


def _figure_name(figure: str) -> str:
    """Return "Fig. 6.8" for "6.8", and any other text as it is written."""
    return f"Fig. {figure}" if figure[:1].isdigit() else figure


def _status(results: StudyResults) -> Html:
    found = status(results)
    calm = found in (Status.AGREES, Status.OPEN)
    return Html(found if calm else f'<span class="alarm">{found}</span>{escaped(reason(results))}')


def _anchor(name: str) -> str:
    return f"study-{name}"
