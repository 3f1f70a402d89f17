"""The page of a report: tables, figures, pictures, doubts and runs of each set, and the comparison of two."""

import base64
import html
import io
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from PIL import Image

from cartpole_rl.reporting.animation import smaller
from cartpole_rl.reporting.groups import Drawing, drawings
from cartpole_rl.reporting.results import (
    Agent,
    Results,
    estimate_text,
    low_is_good,
    measure_label,
    ranked_text,
    sentence_start,
    value_text,
)
from cartpole_rl.reporting.runs import short
from cartpole_rl.reporting.statistics import (
    difference,
    estimate,
    paired_difference,
    paired_improvement,
    probability_of_improvement,
)
from cartpole_rl.reporting.style import document, escaped, svg, table
from cartpole_rl.reporting.texts import count_text
from cartpole_rl.run_folder import ANIMATION, FIGURES, TABLE

BUDGET = 12_000_000  # bytes of all pictures; a page takes a third more
SIZES = ((320, 3), (240, 4), (200, 6))  # width in pixels, frames per kept one: the first that fits is taken
TYPICAL = (110_000, 65_000, 40_000)  # bytes of an animation of 10 s in these sizes
FIGURE_WIDTH, FIGURE_QUALITY = 900, 70
MOST_FIGURES = 6  # of a run
MOST_LISTED = 1000  # runs in the list of a set
MOST_TABLED = 200  # groups in a table
MOST_ROWS = 24  # of a table that is shown unfolded
MOST_EXCLUSIONS = 40  # runs named one by one
OF_RUNS = ("The runs are of ", ": each agent has its own ")  # in notes that stand with the list of runs
METHOD = (
    "Each number of an agent is the mean over its evaluation episodes; the last checkpoint of every seed "
    "counts and no agent is picked. A controller without training counts once per seed of its evaluation, "
    "a pretrained agent once. "
    "Values are interquartile means over agents (the mean without the lowest and the highest quarter) with "
    "the 95 % interval of a stratified bootstrap over agents, after Agarwal et al. (2021). With ten agents "
    "about 94 of 100 such intervals cover the true value, with three only 73. Runs that are unfinished, "
    "damaged, or of other versions or settings than the rest are named and do not count."
)
Item = TypeVar("Item")
STYLE = Path(__file__).with_name("runs_page.css").read_text(encoding="utf-8")


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
    between: Mapping[str, Sequence[str]] | None = None,
) -> str:
    """Return the page of one set of runs, with a section for each command, or of two and their comparison.

    `pictures` maps the name of a set to its pictures, `between` the settings that differ between two sets to
    their values.
    """
    links = "".join(f'<li><a href="#{anchor(each.name)}">{escaped(each.title)}</a></li>' for each in sweeps)
    parts = [
        f"<h1>{escaped(title)}</h1>",
        *([f"<nav><ul>{links}</ul></nav>"] if len(sweeps) > 1 else []),
        *([comparison(sweeps[0], sweeps[1], between)] if between is not None else []),
        *(_section(each, pictures.get(each.name, ())) for each in sweeps),
        method(),
    ]
    return document(title, "\n".join(parts), STYLE)


def _section(results: Results, pictures: Sequence[Picture]) -> str:
    groups = f"{len(results.groups)} groups" if len(results.groups) > 1 else "one group"
    parts = [
        f'<section id="{anchor(results.name)}">',
        f"<h2>{escaped(results.title)}</h2>",
        f"<p>{count_text(len(results.agents), 'agent')} in {groups}. {escaped(_answer(results))}</p>",
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
    last = f", {results.judged[0].label}" if len(results.evaluations) > 1 else ""
    what = f"{sentence_start(measure_label(results.measure))}{last}"
    return f"{what}{ranked_text(found, measure=results.measure)}."


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
        {group.label: found for group in each.groups if (found := _judged_values(each, group.name))}
        for each in (first, second)
    ]
    several = [each.judged[0].label for each in (first, second) if len(each.evaluations) > 1]
    rows = [
        {"group": label, **_compared(names, values[0][label], values[1][label])}
        for label in ends([label for label in values[0] if label in values[1]])
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
        f'<section id="comparison"><h2>{escaped(", ".join(["Comparison", *dict.fromkeys(several)]))}</h2>',
        f"<p>Settings that differ:</p>{folded(differs, 'settings')}"
        if differs
        else "<p>No setting differs.</p>",
        folded(rows, "groups") if rows else "<p>The two sets have no group in common.</p>",
        "".join(f"<p>{escaped(line)}</p>" for line in lone[:MOST_EXCLUSIONS]),
        "</section>",
    ]
    return "\n".join(parts)


def _judged_values(results: Results, group: str) -> dict[tuple[Any, ...], float]:
    """Return the value of each agent of a group in the evaluation that counts, by its source and seeds."""
    name = results.judged[0].name
    return {
        (each.source, each.seeds): each.values[name] for each in results.members(group) if name in each.values
    }


def _compared(
    names: tuple[str, str], first: Mapping[Any, float], second: Mapping[Any, float]
) -> dict[str, str]:
    """Return the cells that compare two sets of agents: in pairs if both have the same ones."""
    paired = first.keys() == second.keys()
    ours, others = [*first.values()], [second[key] for key in (first if paired else second)]
    apart, higher = (
        (paired_difference, paired_improvement) if paired else (difference, probability_of_improvement)
    )
    return {
        names[0]: estimate_text(estimate(ours)),
        names[1]: estimate_text(estimate(others)),
        "difference, 95 % interval": estimate_text(apart(others, ours)),
        f"chance that {names[1]} is higher": estimate_text(higher(others, ours)),
        "agents": f"{len(ours)}, paired" if paired else f"{len(ours)} and {len(others)}, unpaired",
    }


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
    if (left_out := len(results.groups) - MOST_TABLED) > 0:
        yield f"<p>{left_out} groups between them are left out; {TABLE} has every run.</p>"
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
    for group in ends(results.groups):
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
            if good := results.good:
                row[f"above {good:g}"] = f"{(values > good).sum()} of {values.size}"
            rows.append({**row, f"{results.unit}s": values.size})
    return rows


def ends(items: Iterable[Item]) -> list[Item]:
    """Return at most MOST_TABLED of the items: the first and the last ones."""
    every = [*items]
    return every if len(every) <= MOST_TABLED else every[: MOST_TABLED // 2] + every[-MOST_TABLED // 2 :]


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
        reasons = "; ".join(dict.fromkeys(each.reason for each in more[:5]))
        shown.append(f"{len(more)} more runs do not count, as: {reasons}.")
    notes = (note for note in results.notes if not _is_of_runs(note))
    lines = [*missing, *shown, *notes, *remarks]
    listed = "".join(f"<li>{escaped(line)}</li>" for line in lines)
    box = '<aside class="box" role="note" aria-label="Missing or excluded runs">'
    return f"{box}<ul>{listed}</ul></aside>" if lines else ""


def _is_of_runs(note: str) -> bool:
    """Return True for a note on how the runs were made, which is no reason to doubt them."""
    return any(part in note for part in OF_RUNS)


def run_list(results: Results) -> str:
    """Return the folded list of the runs that count, with the versions and commits that made them."""
    if not results.agents:
        return ""
    rows = [
        {"run": agent.run, "seed": agent.seed_text, **_named_values(results, agent)}
        for agent in results.agents[:MOST_LISTED]
    ]
    notes = filter(_is_of_runs, results.notes)
    made = "".join(f"<p>{escaped(line)}</p>" for line in (results.versions, *notes) if line)
    count = len(results.agents)
    heading = f"The {count} runs behind it" if count > 1 else "The run behind it"
    heading += f": the first {MOST_LISTED}; {TABLE} has all" if count > MOST_LISTED else ""
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


class Gallery:
    """Collects pictures until BUDGET is spent.

    `left_out` counts those that had no room, `problems` names those that are damaged.
    """

    def __init__(self, sets: Sequence[Results]) -> None:
        animations = 3 * sum(bool(each.agents) for each in sets)
        fitting = (place for place, size in enumerate(TYPICAL) if animations * size <= BUDGET)
        self.width, self.every = SIZES[next(fitting, len(SIZES) - 1)]
        self.room = BUDGET
        self.left_out = 0
        self.problems: list[str] = []

    def pictures(self, results: Results) -> list[Picture]:
        """Return the pictures that the run folders hold and that there is room for."""
        found = []
        for picture in (*self._animations(results), *self._figures(results)):
            if len(picture.data) > self.room:
                self.left_out += 1
                continue
            self.room -= len(picture.data)
            found.append(picture)
        return found

    def _animations(self, results: Results) -> Iterator[Picture]:
        label = measure_label(results.measure)
        labels = {group.name: group.label for group in results.groups}
        for name, agent, value, path in chosen(results):
            which = f"{labels[agent.group]}, seed {agent.seed_text}"
            text = f"{name}: {which}, {label} {value_text(value, results.measure)}"
            alt = f"Animation of one episode of the {name} agent ({which})"
            if data := self._read(path, lambda path: smaller(path, self.width, self.every)):
                yield Picture(data, "gif", alt, text)

    def _figures(self, results: Results) -> Iterator[Picture]:
        for path, caption in _chosen_figures(results):
            if data := self._read(path, _figure):
                yield Picture(data, "webp", caption, caption)

    def _read(self, path: Path, reader: Callable[[Path], bytes]) -> bytes | None:
        """Return the bytes of a picture, smaller; None for a damaged one, which `problems` names."""
        try:
            return reader(path)
        except Exception as error:  # whatever the reader of a damaged file raises
            self.problems.append(f"{path.as_posix()} is damaged and not shown: {short(error)}")
            return None


def chosen(results: Results) -> list[tuple[str, Agent, float, Path]]:
    """Return the best, the median and the worst agent with an animation, their values and animations.

    They are those of the evaluation that counts, or of another one if it has no animation; the median of an
    even number is the worse of the two in the middle.
    """
    for evaluation in (*results.judged, *reversed(results.evaluations)):
        filmed = [
            (agent, agent.values[evaluation.name], path)
            for agent in results.agents
            if evaluation.name in agent.values
            and (path := results.folder_of(agent, evaluation.name) / FIGURES / ANIMATION).is_file()
        ]
        if filmed:
            descending = not low_is_good(results.measure)
            ranked = sorted(filmed, key=lambda each: each[1], reverse=descending)
            places = {len(ranked) // 2: "median", len(ranked) - 1: "worst", 0: "best"}
            return [(places[place], *ranked[place]) for place in sorted(places)]
    return []


def _chosen_figures(results: Results) -> Iterator[tuple[Path, str]]:
    """Yield file and caption of the median agent's behaviour, or of all figures if they are the results."""
    if results.pictured:
        for group in results.groups:
            first = next(iter(results.members(group.name)), None)
            files = sorted(Path(first.run, FIGURES).glob("*.png"))[:MOST_FIGURES] if first else []
            for file in files:
                yield file, f"{file.stem.replace('_', ' ')}, {group.label}"
        return
    for name, agent, _, path in chosen(results)[:2][-1:]:  # the median; of fewer than three, the last
        if (file := path.with_name("behaviour.png")).is_file():
            yield file, f"An episode of the {name} agent over time (seed {agent.seed_text})"


def _figure(path: Path) -> bytes:
    """Return a figure as WebP. A damaged one raises one of many errors."""
    with Image.open(path) as source:
        picture = source.convert("RGB")
        picture.thumbnail((FIGURE_WIDTH, FIGURE_WIDTH))
    buffer = io.BytesIO()
    picture.save(buffer, "WEBP", quality=FIGURE_QUALITY)
    return buffer.getvalue()
