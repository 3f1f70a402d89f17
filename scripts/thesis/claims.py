#!/usr/bin/env python
"""Hold the claims (claims.yaml) against the stored results; rewrite the tables of the pages.

    scripts/thesis/claims.py

A page marks a generated block with `<!-- claims: NAME -->`; the block ends at the next blank line.

Texts and statements name values of agents as study/arm/evaluation; within a row the study may be left out.
`a+b` in place of an arm pools the agents of two arms, `a|b` those of two names. In place of an evaluation,
`a:b` is the ratio of two evaluations of each agent, `ratio` that of the second to the first, `a&b` the
lower and `a,b` the mean of several; names with @ are numbers of an agent's curves (CURVES), `a#key` is a
number of metrics.json or identification.json that `report.py --data` stores (reading.BEHAVIOUR), of the
agents that have it. In a text `{iqm arm/evaluation}` is replaced by that number, `{iqm arm/evaluation []}`
by it with its 95 % interval, `{claim}` by the statistics of the row's statements with theirs. `{seeds
NAME}` is replaced by the number of seeds, a cell's border, and their minimum, median and maximum. The
benches' files in docs/results/data give further names: see `bench_values`.

A statement is a statistic (STATISTICS) with its values, an operator and a number, as
`difference position/emulated constant/emulated > 0`.
"""

import json
import math
import re
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from enum import StrEnum
from pathlib import Path
from textwrap import fill
from typing import Any, NamedTuple

import numpy as np
import yaml
from charts import rank_agreements
from page import CRITERIA, robustness
from reading import read_studies
from results import SMALLEST, StudyResults
from scipy.stats import binomtest

from cartpole_rl.checking import validated
from cartpole_rl.errors import CartPoleError, ConfigError
from cartpole_rl.files import write_text
from cartpole_rl.reporting.results import Agent, Curve
from cartpole_rl.reporting.statistics import (
    Array,
    Estimate,
    bootstrap,
    difference,
    estimate,
    interquartile_mean,
    paired_difference,
)
from cartpole_rl.settings import Settings

CHECKOUT = Path(__file__).resolve().parents[2]
DATA = CHECKOUT / "docs/results/thesis"
BENCHES = CHECKOUT / "docs/results/data"
CLAIMS = Path(__file__).with_name("claims.yaml")
PAGES = (
    "README.md",
    "docs/thesis.md",
    "docs/thesis-results.md",
    "docs/results/learning.md",
    "docs/results/learned-model.md",
)
BLOCK = re.compile(r"(<!-- claims: (\w+) -->\n)((?:.+\n)*)")
FORMULA = re.compile(r"\{([^{}]+)\}")
WIDTH = 120  # characters of a line of text
NEAR = 0.05  # an interval within this of a number agrees with "= number"
LIKE, DROPPED = 50, 250  # of 500: agents that differ by less are alike, the pole is dropped below
NEVER = {"seconds_to_reached": math.inf, "transitions_to_reached": math.inf, "kept": 0.0}  # of such a seed
LATE, MIDDLE = 0.75, 0.5  # shares of a training: its last quarter begins, its second one ends


class Word(StrEnum):
    """The verdict of a row, in the order in which several statements of one row count."""

    CONTRADICTS = "contradicts"
    DIFFERS = "differs"
    NOT_SHOWN = "not shown"
    AGREES = "agrees"
    NEW = "new"
    NOT_ASKED = "not asked yet"


class Row(Settings):
    """A claim of the thesis, what was found here, and what was done otherwise."""

    place: str  # in the thesis
    thesis: str
    here: str = ""
    otherwise: str = ""  # what was done otherwise than in the thesis
    study: str = ""  # or a bench's script; empty: not asked yet, `otherwise` says why and what it would cost
    claim: str = ""  # statements, separated by ";"; empty: the thesis has no result
    because: bool = False  # what was done otherwise could turn the result round


class Table(Settings):
    """Interquartile means of a study: a row for each evaluation, a column for each arm."""

    study: str
    columns: Mapping[str, str]  # heading: arm
    rows: Mapping[str, str]  # text: evaluation


class Claims(Settings):
    """The contents of claims.yaml."""

    rows: tuple[Row, ...]
    tables: Mapping[str, tuple[Table, ...]]  # block: parts with the same headings
    texts: Mapping[str, str]  # block: text


class Statement(NamedTuple):
    """A statistic of the data, what the thesis says of it, and the word that follows."""

    text: str
    word: Word


def _mean_between(curve: Curve, first: float, last: float) -> float:
    """Return the mean of a curve between two shares of its length."""
    at, values = np.array(curve).T
    return float(values[(at > first * at[-1]) & (at <= last * at[-1])].mean())


CURVES: Mapping[str, tuple[str, Callable[[Curve], float]]] = {  # name: curve, number
    "@loss": ("loss", lambda curve: _mean_between(curve, LATE, 1.0)),
    "@growth": ("loss", lambda curve: _mean_between(curve, LATE, 1.0) - _mean_between(curve, 0.25, MIDDLE)),
    "@jumps": ("score_upright", lambda curve: float(np.abs(np.diff([y for _, y in curve])).mean())),
    "@start": ("score_upright", lambda curve: _mean_between(curve, 0.0, 0.3)),
    "@fifth": ("score", lambda curve: _mean_between(curve, 0.1, 0.2)),
    "@first": ("score_upright", lambda curve: next((x for x, y in curve if y > 400), curve[-1][0])),
}


def _exact(value: float, agents: int) -> Estimate:
    return Estimate(float(value), None, None, agents)


def _share(threshold: Array, values: Array) -> Estimate:
    """Return the share of `values` above a threshold, with its exact interval."""
    count = int((values > threshold).sum())
    low, high = binomtest(count, values.size).proportion_ci()
    return Estimate(count / values.size, float(low), float(high), values.size)


def _mean(values: Array) -> Estimate:
    return bootstrap(lambda sample: sample.mean(axis=-1), values)


def _nearer(values: Array, others: Array) -> Estimate:
    """Return how much farther from 1 the ratios of `values` are than those of `others`."""
    return difference(np.abs(values - 1), np.abs(others - 1))


def _percent_less(values: Array, others: Array) -> Array:
    return 100 * (1 - interquartile_mean(values) / interquartile_mean(others))


def _beside(simulated: Array, driven: Array) -> Estimate:
    """Return the best score on the cart of an agent that is LIKE one in simulation which drops the pole."""
    like = np.abs(simulated[:, None] - simulated) <= LIKE
    return _exact(driven[(like & (driven < DROPPED)).any(axis=1)].max(initial=0), driven.size)


def _contrast(*groups: Array) -> Estimate:
    """Return by how much the first difference, of the first two groups, is larger than the second one."""
    iqm = interquartile_mean
    return bootstrap(lambda a, b, c, d: iqm(a) - iqm(b) - iqm(c) + iqm(d), *groups)


def _wider(values: Array, others: Array) -> Estimate:
    return bootstrap(lambda a, b: a.std(axis=-1) - b.std(axis=-1), values, others)


STATISTICS: Mapping[str, tuple[str, Callable[..., Estimate]]] = {  # name: in words, function
    "iqm": ("", estimate),
    "mean": ("mean", _mean),
    "median": ("median", lambda values: _exact(np.median(values), values.size)),
    "most": ("best agent", lambda values: _exact(values.max(), values.size)),
    "least": ("worst agent", lambda values: _exact(values.min(), values.size)),
    "apart": (
        "largest difference",
        lambda values, others: _exact(np.abs(values - others).max(), values.size),
    ),
    "over": ("", _share),
    "gain": ("difference", paired_difference),
    "percent": ("", lambda whole, values: estimate(100 * values / whole)),
    "less": ("percent less", lambda values, others: bootstrap(_percent_less, values, others)),
    "difference": ("difference", difference),
    "contrast": ("difference of the differences", _contrast),
    "beside": ("the better has at most", _beside),
    "distance": ("difference", _nearer),
    "spread": ("difference", _wider),
}


def _word(found: Estimate, operator: str, number: float) -> Word:
    """Return how "found operator number" stands by the interval; without one, whether an example exists."""
    value, low, high, _ = found
    if low is None or high is None:
        return Word.AGREES if (value > number if operator == ">" else value < number) else Word.NOT_SHOWN
    if operator == "~":  # the thesis sees no difference
        return Word.AGREES if low <= number <= high else Word.CONTRADICTS
    if operator == "=":
        near = max(abs(low - number), abs(high - number)) <= NEAR * abs(number)
        return Word.AGREES if near else Word.NOT_SHOWN if low <= number <= high else Word.CONTRADICTS
    above, below = low > number, high < number
    if not above and not below:
        return Word.NOT_SHOWN
    return Word.AGREES if above == (operator == ">") else Word.CONTRADICTS


class Evidence:
    """The stored results, as values of agents by name."""

    def __init__(
        self, results: Mapping[str, StudyResults], benches: Mapping[str, Array] | None = None
    ) -> None:
        self.results = results
        self.benches = benches or {}

    def values(self, name: str, study: str = "") -> Array:
        """Return the values of "study/arm/evaluation" or "arm/evaluation" [agents]. Raises ConfigError."""
        if name in self.benches:
            return self.benches[name]
        if "|" in name:
            return np.concatenate([self.values(each, study) for each in name.split("|")])
        *above, arms, evaluation = name.split("/")
        study = above[0] if above else study
        try:
            results = self.results[study]
            pools = [_of_agents(results, arm, evaluation) for arm in arms.split("+")]
            found = np.concatenate(pools)
        except KeyError as error:
            raise ConfigError(f"{study}/{arms}/{evaluation}: there is no {error.args[0]}") from None
        if not found.size:
            raise ConfigError(f"{study}/{arms}/{evaluation}: there is no such value")
        return found

    def statistic(self, words: list[str], study: str) -> Estimate:
        """Return a statistic: its name, and the numbers and values that it takes. Raises ConfigError."""
        if words[0] not in STATISTICS:
            raise ConfigError(f"{words[0]}: there is no such statistic; give one of {', '.join(STATISTICS)}")
        function = STATISTICS[words[0]][1]
        return function(*(float(w) if _is_number(w) else self.values(w, study) for w in words[1:]))

    def statements(self, row: Row) -> Iterator[Statement]:
        """Yield the statements of a row."""
        for claim in filter(None, map(str.strip, row.claim.split(";"))):
            *words, operator, number = claim.split()
            found = self.statistic(words, row.study)
            word = _word(found, operator, float(number))
            if word is Word.CONTRADICTS and row.because:
                word = Word.DIFFERS
            text = f"{STATISTICS[words[0]][0]} {_with_interval(words[0], found)}"
            yield Statement(text.strip(), word)

    def word(self, row: Row) -> Word:
        """Return the verdict of a row."""
        if not row.study:
            return Word.NOT_ASKED
        order = [*Word]
        return min((each.word for each in self.statements(row)), key=order.index, default=Word.NEW)

    def study_words(self, rows: Iterable[Row]) -> dict[str, Word]:
        """Return the verdict of each study: the first of those of its rows, in the order of Word."""
        words: dict[str, list[Word]] = {}
        for row in rows:
            if row.study and not row.study.endswith(".py"):
                words.setdefault(row.study, []).append(self.word(row))
        return {study: min(found, key=[*Word].index) for study, found in words.items()}

    def filled(self, text: str, row: Row | None = None) -> str:
        """Return a text with its numbers."""

        def number(match: re.Match[str]) -> str:
            if row and match[1] == "claim":
                return ", ".join(each.text for each in self.statements(row))
            words = match[1].removesuffix(" []").split()
            if words[0] == "seeds":
                return _of_seeds(self.values(words[1]))
            found = self.statistic(words, row.study if row else "")
            if match[1].endswith(" []"):
                return _with_interval(words[0], found)
            return _count(found) if words[0] == "over" else number_text(found.value)

        return FORMULA.sub(number, text)


def _of_agents(results: StudyResults, arm: str, evaluation: str) -> Array:
    """Return the values of an arm's agents. Raises KeyError."""
    agents = results.members(arm)
    if evaluation in CURVES:
        name, function = CURVES[evaluation]
        return np.array([function(agent.curves[name]) for agent in agents])
    if "#" in evaluation:
        evaluation, key = evaluation.split("#")
        found = [agent.behaviour[evaluation].get(key) for agent in agents]
        return np.array([value for value in found if value is not None])
    if evaluation == "ratio":
        return results.ratios(arm)
    if ":" in evaluation:
        names = evaluation.split(":")
        upper, lower = results.pairs(names[0], names[1], arm)
        counts = lower >= SMALLEST * lower.max()
        return np.asarray(upper[counts] / lower[counts])
    for sign, function in (("&", np.min), (",", np.mean)):
        if sign in evaluation:
            return np.array([function(_named(agent, evaluation.split(sign))) for agent in agents])
    return np.array([_named(agent, [evaluation])[0] for agent in agents])


def _named(agent: Agent, evaluations: list[str]) -> list[float]:
    return [agent.values[each] for each in evaluations]


def _is_number(word: str) -> bool:
    return bool(re.fullmatch(r"-?\d+(\.\d+)?", word))


def number_text(value: float) -> str:
    """Return a number without decimals from 10 on, with two below, and with three below 0.1."""
    decimals = 0 if abs(value) >= 9.995 else 2 if abs(value) >= 0.0995 else 3
    return f"{round(value, decimals) + 0.0:.{decimals}f}"  # + 0.0: no minus zero


def _count(found: Estimate) -> str:
    return f"{round(found.value * found.agents)} of {found.agents}"


def _with_interval(name: str, found: Estimate) -> str:
    if found.low is None or found.high is None:
        return number_text(found.value)
    if name == "over":
        return f"{_count(found)} [{100 * found.low:.0f}, {100 * found.high:.0f} %]"
    return f"{number_text(found.value)} [{number_text(found.low)}, {number_text(found.high)}]"


def _of_seeds(values: Array) -> str:
    """Return two cells of a table: how many seeds, and their minimum, median and maximum."""
    decimals = 0 if values.max() >= 2 or (values == values.round()).all() else 3
    numbers = ", ".join(f"{each:.{decimals}f}" for each in (values.min(), np.median(values), values.max()))
    return f"{values.size} | {numbers}"


def bench_values(folder: Path = BENCHES) -> dict[str, Array]:
    """Return the values of the benches' agents: learning/medium/failed, learning/range/1.0_m/fraction.

    A file of learning.py has experiments, with the figures of each seed and of each of its poles; those of
    zero_shot.py and fine_tuning.py have a list of agents. A seed that never reaches a fraction counts, too.
    """
    found: dict[str, list[float]] = {}

    def add(name: str, figures: Mapping[str, Any]) -> None:
        for key, value in figures.items():
            if isinstance(value, Mapping):
                add(f"{name}/{key.replace(' ', '_')}", value)
            elif isinstance(value, int | float | None):
                number = NEVER.get(key, math.nan) if value is None else float(value)
                found.setdefault(f"{name}/{key}", []).append(number)

    for file in sorted(folder.glob("*.json")):
        content = json.loads(file.read_text(encoding="utf-8"))
        if "agents" in content:
            for figures in content["agents"]:
                add(file.stem, figures)
        else:
            for experiment, seeds in content.items():
                for figures in seeds.values():
                    plants = figures.pop("plants")
                    own = next(iter(plants.values())) if len(plants) == 1 else plants
                    add(f"{file.stem}/{experiment}", figures | own)
    return {name: np.array(values) for name, values in found.items()}


def read_claims(file: Path = CLAIMS) -> Claims:
    """Return the claims in a YAML file. Raises ConfigError."""
    try:
        return validated(Claims, yaml.safe_load(file.read_text(encoding="utf-8")))
    except (ConfigError, yaml.YAMLError) as error:
        raise ConfigError(f"{file}: {' '.join(str(error).split())}") from None


def blocks(claims: Claims, evidence: Evidence) -> dict[str, str]:
    """Return every generated block by name."""
    found = {"rows": _rows_table(claims, evidence), "not_asked": _not_asked(claims)}
    found["counts"] = _counts(claims, evidence)
    found |= {"robustness_score": _robustness_score(evidence), "ranks": _ranks(evidence)}
    found |= {name: _tables(parts, evidence) for name, parts in claims.tables.items()}
    found |= {name: evidence.filled(text) for name, text in claims.texts.items()}
    return {name: text if text.startswith("|") else fill(text, WIDTH) for name, text in found.items()}


def _rows_table(claims: Claims, evidence: Evidence) -> str:
    lines = ["| place | the thesis | here | done otherwise | verdict | study |", "|---|---|---|---|---|---|"]
    for row in filter(lambda row: row.study, claims.rows):
        ours = (evidence.filled(text, row) for text in (row.here, row.otherwise))
        cells = (row.place, row.thesis, *ours, evidence.word(row))
        lines.append(f"| {' | '.join(cells)} | `{row.study}` |")
    return "\n".join(lines)


def _not_asked(claims: Claims) -> str:
    lines = ["| place | the thesis | why not, and what it would cost |", "|---|---|---|"]
    open_rows = (row for row in claims.rows if not row.study)
    return "\n".join([*lines, *(f"| {row.place} | {row.thesis} | {row.otherwise} |" for row in open_rows)])


def _counts(claims: Claims, evidence: Evidence) -> str:
    counts = Counter(evidence.word(row) for row in claims.rows)
    asked = len(claims.rows) - counts[Word.NOT_ASKED]
    return (
        f"[The table](docs/thesis-results.md) has {asked} answers: {counts[Word.AGREES]} agree with the "
        f"thesis, {counts[Word.CONTRADICTS]} contradict it, {counts[Word.DIFFERS]} differ for a reason that "
        f"the row names, {counts[Word.NOT_SHOWN]} are not shown either way, and in {counts[Word.NEW]} "
        f"the thesis has no result. {counts[Word.NOT_ASKED]} more of its questions are not asked yet."
    )


def _robustness_score(evidence: Evidence) -> str:
    """Return the table of the robustness score."""
    rows = robustness([each for name, each in evidence.results.items() if name.startswith(CRITERIA)])
    lines = [f"| {' | '.join(rows[0])} |", "|---" * len(rows[0]) + "|"]
    return "\n".join([*lines, *(f"| {' | '.join(map(str, row.values()))} |" for row in rows)])


def _ranks(evidence: Evidence) -> str:
    """Return whether the order of agents in simulation predicts that on the cart, for each score."""
    return " ".join(each.answer for each in rank_agreements([*evidence.results.values()]))


def _tables(parts: tuple[Table, ...], evidence: Evidence) -> str:
    headings = [*parts[0].columns]
    lines = [f"| {' | '.join(['question', *headings, 'study'])} |", "|---" * (len(headings) + 2) + "|"]
    for part in parts:
        for text, evaluation in part.rows.items():
            numbers = [
                number_text(estimate(evidence.values(f"{arm}/{evaluation}", part.study)).value)
                for arm in part.columns.values()
            ]
            lines.append(f"| {' | '.join([text, *numbers])} | `{part.study}` |")
    return "\n".join(lines)


def rebuilt(page: str, contents: Mapping[str, str]) -> str:
    """Return a page with its generated blocks made again. Raises ConfigError for an unknown block."""
    if unknown := {name for _, name, _ in BLOCK.findall(page)} - contents.keys():
        raise ConfigError(f"{min(unknown)}: there is no such block; give one of {', '.join(contents)}")
    return BLOCK.sub(lambda found: f"{found[1]}{contents[found[2]]}\n", page)


def stored() -> Evidence:
    """Return the stored results."""
    return Evidence({each.name: each for each in read_studies(DATA) if each.agents}, bench_values())


def rebuild_pages() -> None:
    """Rewrite the generated blocks of all pages. Raises ConfigError."""
    contents = blocks(read_claims(), stored())
    for page in PAGES:
        text = (CHECKOUT / page).read_text(encoding="utf-8")
        if (new := rebuilt(text, contents)) != text:
            write_text(CHECKOUT / page, new)
            print(f"{page} is rewritten")


def main() -> int:
    """Rewrite the pages; return the exit code."""
    try:
        rebuild_pages()
    except (CartPoleError, OSError) as error:
        print(f"scripts/thesis/claims.py: {' '.join(str(error).split())}", file=sys.stderr)
        return getattr(error, "exit_code", CartPoleError.exit_code)
    return 0


if __name__ == "__main__":
    sys.exit(main())
