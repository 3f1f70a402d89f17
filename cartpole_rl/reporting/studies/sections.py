"""Parts of a study's section on a page: doubts, tables, figures, commands and runs."""

import base64
import html
import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from cartpole_rl.reporting.page import escaped, table
from cartpole_rl.reporting.studies.answers import GOOD, estimate_text, measure_label, ratios
from cartpole_rl.reporting.studies.figures import Drawing, drawings
from cartpole_rl.reporting.studies.results import Exclusion, StudyResults
from cartpole_rl.reporting.studies.settings import RUN, Variant
from cartpole_rl.reporting.studies.statistics import estimate
from cartpole_rl.reporting.table import number_text

MOST_LISTED = 1000  # runs in the list of a study
MOST_ROWS = 24  # of a table that is shown unfolded
MOST_EXCLUSIONS = 40  # runs named one by one


@dataclass(frozen=True)
class Picture:
    """A picture or an animation for the page."""

    data: bytes
    kind: str  # "gif" for an animation, else "webp"
    alt: str
    caption: str


def figure_parts(results: StudyResults, pictures: Sequence[Picture]) -> Iterator[str]:
    """Yield the table of values, the figures, and the animations and other pictures."""
    if not results.agents:
        return
    yield folded(_value_rows(results), "values")
    if shares := ratios(results):
        first, second = results.evaluations[:2]
        name = f"{second.label} / {first.label}"
        yield folded(
            [
                {"set-up": label, name: estimate_text(each), "agents": each.agents}
                for label, each in shares.items()
            ],
            "ratios",
        )
    yield f'<div class="figures">{"".join(map(drawn, drawings(results)))}</div>'
    animations = [each for each in pictures if each.kind == "gif"]
    others = [each for each in pictures if each.kind != "gif"]
    for heading, grid, chosen in (
        ("The best, the median and the worst agent", "animations", animations),
        ("Figures of a run", "figures", others),
    ):
        if shown := "".join(map(_picture, chosen)):
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
            row: dict[str, Any] = {"set-up": arm.label}
            if several:
                row["evaluation"] = evaluation.label
            row |= {
                f"{measure_label(measure)}, 95 % interval": estimate_text(estimate(values)),
                "lowest": number_text(float(values.min())),
                "highest": number_text(float(values.max())),
            }
            if good := GOOD.get(measure):
                row[f"above {good:g}"] = f"{(values > good).sum()} of {values.size}"
            row[f"{results.study.unit}s"] = values.size
            rows.append(row)
    return rows


def folded(rows: Sequence[Mapping[str, Any]], name: str) -> str:
    """Return a table, folded if it is long."""
    if not rows:
        return ""
    whole = table(rows)
    if len(rows) <= MOST_ROWS:
        return whole
    return f"<details><summary>{len(rows)} rows of {name}</summary>{whole}</details>"


def doubts(results: StudyResults, missing: Sequence[str]) -> str:
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


def commands(results: StudyResults) -> str:
    """Return the command that repeats the study, and those of its runs by hand."""
    size = f" --size {results.label}" if results.label else ""
    whole = f"scripts/reproduce {results.name}{size}"
    by_hand = "\n".join(_by_hand(results))
    return (
        f"<h3>Command</h3><pre><code>{escaped(whole)}</code></pre>"
        f"<details><summary>Each run by hand</summary><pre><code>{escaped(by_hand)}</code></pre></details>"
    )


def _by_hand(results: StudyResults) -> Iterator[str]:
    """Yield the command of each arm, and of each evaluation of its agents."""
    study, size = results.study, results.size
    overrides = size.overrides if size else ()
    experiment = [f"experiment={study.experiment}"] if study.experiment else []
    for arm in study.arms:
        if study.agents_of:
            yield f"# {arm.label}: agents of {study.agents_of}"
        elif named := study.agent_of(arm):
            more = " ".join(study.evaluated_with(arm))
            yield f"# {arm.label}: {RUN}{named}" + (f", each evaluation also with {more}" if more else "")
        else:
            yield _command(study.command, [*experiment, *arm.overrides, *overrides, "seed={seed}"], results)
    for evaluation in study.evaluations:
        common = size.evaluation_overrides if size else ()
        for name in ("", *evaluation.of_arms):
            if name:
                yield f"# agents of {name}:"
            yield _command("evaluate", ["run={run}", *evaluation.words(name, common), "seed={seed}"], results)


def _command(name: str, words: Sequence[str], results: StudyResults) -> str:
    """Return a command line; {runs} is filled in, {run} and {seed} are the reader's."""
    runs = results.folder.rpartition("/")[0] or "."
    filled = (word.replace("{runs}", runs) for word in words)
    return " ".join((f"cartpole-{name}", *(_quoted(word) for word in filled)))


def _quoted(word: str) -> str:
    return word if re.fullmatch(r"[\w.=/{}+-]+", word) else shlex.quote(word)


def run_list(results: StudyResults) -> str:
    """Return the folded list of the runs that count."""
    if not results.agents:
        return ""
    measure = results.study.measure
    rows = [
        {"run": agent.run, "seed": agent.seed, **_named_values(results, agent.values, measure)}
        for agent in results.agents[:MOST_LISTED]
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


def drawn(drawing: Drawing) -> str:
    """Return a figure with its caption."""
    return f"<figure>{drawing.svg}<figcaption>{escaped(drawing.caption)}</figcaption></figure>"


def _picture(picture: Picture) -> str:
    data = base64.b64encode(picture.data).decode()
    source = f"data:image/{picture.kind};base64,{data}"
    image = f'<img src="{source}" alt="{html.escape(picture.alt)}">'
    return f"<figure>{image}<figcaption>{escaped(picture.caption)}</figcaption></figure>"
