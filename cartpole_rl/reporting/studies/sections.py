"""Parts of a study's section on a page: doubts, tables, figures, commands and runs."""

import base64
import html
import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from cartpole_rl.reporting.figures import svg
from cartpole_rl.reporting.page import escaped, table
from cartpole_rl.reporting.studies.answers import GOOD, ratios
from cartpole_rl.reporting.studies.figures import Drawing, drawings
from cartpole_rl.reporting.studies.numbers import estimate_text, measure_label, value_text
from cartpole_rl.reporting.studies.results import Exclusion, StudyResults
from cartpole_rl.reporting.studies.settings import RUN, Variant
from cartpole_rl.reporting.studies.statistics import estimate

MOST_LISTED = 1000  # runs in the list of a study
MOST_ROWS = 24  # of a table that is shown unfolded
MOST_EXCLUSIONS = 40  # runs named one by one
COMMITS, OWN_FILES = (
    "The runs are of ",
    ": each agent has its own ",
)  # of notes that stand with the list of runs


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
    figures = "".join(drawn(each, results.name) for each in drawings(results))
    yield f'<div class="figures">{figures}</div>'
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
                f"{measure_label(measure)}, 95 % interval": estimate_text(estimate(values), measure),
                "lowest": value_text(float(values.min()), measure),
                "highest": value_text(float(values.max()), measure),
            }
            if good := GOOD.get(measure):
                row[f"above {good:g}"] = f"{(values > good).sum()} of {values.size}"
            row[f"{results.study.unit}s"] = values.size
            rows.append(row)
    return rows


def folded(rows: Sequence[Mapping[str, Any]], name: str) -> str:
    """Return a table that scrolls on a phone, folded if it is long; paper shows it unfolded."""
    if not rows:
        return ""
    whole = wide(rows)
    if len(rows) <= MOST_ROWS:
        return whole
    summary = f"<summary>{len(rows)} rows of {name}</summary>"
    return f'<details class="values">{summary}{whole}</details>'


def wide(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return a table that scrolls by itself where it is wider than the page."""
    return f'<div class="wide" tabindex="0" role="group" aria-label="table">{table(rows)}</div>'


def doubts(results: StudyResults, missing: Sequence[str]) -> str:
    """Return the box that names what is missing and what does not count; empty without any."""
    shown = [f"{each.run} does not count: {each.reason}." for each in results.exclusions[:MOST_EXCLUSIONS]]
    if (more := len(results.exclusions) - len(shown)) > 0:
        shown.append(f"{more} more runs do not count, as: {_reasons(results.exclusions[MOST_EXCLUSIONS:])}.")
    notes = (note for note in results.notes if not _is_of_runs(note))
    lines = [*missing, *shown, *notes, *results.remarks]
    if not lines:
        return ""
    listed = "".join(f"<li>{escaped(line)}</li>" for line in lines)
    return f'<aside class="box" role="note" aria-label="Missing or excluded runs"><ul>{listed}</ul></aside>'


def _is_of_runs(note: str) -> bool:
    """Return True for a note on how the runs were made, which is no reason to doubt them."""
    return note.startswith(COMMITS) or OWN_FILES in note


def _reasons(exclusions: Sequence[Exclusion]) -> str:
    return "; ".join(dict.fromkeys(each.reason for each in exclusions[:5]))


def commands(results: StudyResults) -> str:
    """Return the command that repeats the study, and those of its runs by hand."""
    size = f" --size {results.label}" if results.label else ""
    whole = f"scripts/reproduce {results.name}{_places(results)}{size}"
    by_hand = "\n".join(_by_hand(results))
    return (
        f"<h3>Command</h3><pre><code>{escaped(whole)}</code></pre>"
        f"<details><summary>Each run by hand</summary><p>{_blanks(results)}</p>"
        f"<pre><code>{escaped(by_hand)}</code></pre></details>"
    )


def _blanks(results: StudyResults) -> str:
    """Return what the blanks of the commands stand for."""
    seeds = sorted({agent.seed for agent in results.agents})
    used = f" ({seeds[0]} to {seeds[-1]} here)" if len(seeds) > 1 else ""
    return (
        f"{{seed}}: one run for each seed{used}. {{run}}: the run folder of an agent. "
        "{runs}: the folder of all studies."
    )


def _places(results: StudyResults) -> str:
    """Return the options of an own study: the folder of its file, which the reader knows, and of its runs."""
    if results.shipped:
        return ""
    parts = results.folder.split("/")[:-1]
    root = "/".join(parts[:-1] if parts[-1:] == [results.label] else parts) or "."
    return f" --studies FOLDER --folder {_quoted(root)}"


def _by_hand(results: StudyResults) -> Iterator[str]:
    """Yield the command of each arm, and of each evaluation of its agents."""
    study, size = results.study, results.size
    overrides = size.overrides if size else ()
    experiment = [f"experiment={study.experiment}"] if study.experiment else []
    for arm in study.arms:
        if study.agents_of:
            yield f"# {arm.label}: agents of the study {study.agents_of}"
        elif named := study.agent_of(arm):
            more = " ".join(study.evaluated_with(arm))
            yield f"# {arm.label}: {RUN}{named}" + (f", each evaluation also with {more}" if more else "")
        else:
            yield _command(study.command, [*experiment, *arm.overrides, *overrides, "seed={seed}"], results)
    labels = {arm.name: arm.label for arm in study.arms}
    for evaluation in study.evaluations:
        common = size.evaluation_overrides if size else ()
        for name in ("", *evaluation.of_arms):
            if name:
                yield f"# agents of {labels[name]}:"
            yield _command("evaluate", ["run={run}", *evaluation.words(name, common), "seed={seed}"], results)


def _command(name: str, words: Sequence[str], results: StudyResults) -> str:
    """Return a command line; {runs} is filled in, {run} and {seed} are the reader's."""
    runs = results.folder.rpartition("/")[0] or "."
    filled = (word.replace("{runs}", runs) for word in words)
    return " ".join((f"cartpole-{name}", *(_quoted(word) for word in filled)))


def _quoted(word: str) -> str:
    return word if re.fullmatch(r"[\w.=/{}+-]+", word) else shlex.quote(word)


def run_list(results: StudyResults) -> str:
    """Return the folded list of the runs that count, with the versions and commits that made them."""
    if not results.agents:
        return ""
    measure = results.study.measure
    rows = [
        {"run": agent.run, "seed": agent.seed, **_named_values(results, agent.values, measure)}
        for agent in results.agents[:MOST_LISTED]
    ]
    notes = [note for note in results.notes if _is_of_runs(note)]
    made = "".join(f"<p>{escaped(line)}</p>" for line in (results.versions, *notes) if line)
    count = len(results.agents)
    heading = f"The {count} runs behind it" if count > 1 else "The run behind it"
    heading += f": the first {MOST_LISTED}" if count > MOST_LISTED else ""
    return f"<details><summary>{heading}</summary>{made}{wide(rows)}</details>"


def _named_values(results: StudyResults, values: Mapping[str, float], measure: str) -> dict[str, str]:
    evaluations: Sequence[Variant] = results.evaluations
    if len(evaluations) == 1:
        return {measure_label(measure): value_text(values[evaluations[0].name], measure)}
    return {
        each.label: value_text(values[each.name], measure) if each.name in values else "–"
        for each in evaluations
    }


def drawn(drawing: Drawing, study: str = "") -> str:
    """Return a figure of a study with its caption."""
    figure = svg(drawing.figure, drawing.alt, f"{study}/{drawing.name}")
    return f"<figure>{figure}<figcaption>{escaped(drawing.caption)}</figcaption></figure>"


def _picture(picture: Picture) -> str:
    data = base64.b64encode(picture.data).decode()
    source = f"data:image/{picture.kind};base64,{data}"
    image = f'<img src="{source}" alt="{html.escape(picture.alt)}">'
    return f"<figure>{image}<figcaption>{escaped(picture.caption)}</figcaption></figure>"
