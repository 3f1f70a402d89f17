"""The page of studies and that of a person's own runs, each one HTML file with everything in it."""

import re
from collections import Counter
from collections.abc import Mapping, Sequence

from cartpole_rl.reporting.page import Html, document, escaped, table
from cartpole_rl.reporting.studies.answers import (
    GOOD,
    THESIS_ROWS,
    Status,
    answer,
    opening,
    reason,
    status,
)
from cartpole_rl.reporting.studies.comparison import Comparison
from cartpole_rl.reporting.studies.numbers import counted_text, estimate_text, percent
from cartpole_rl.reporting.studies.ranks import rank_agreements
from cartpole_rl.reporting.studies.results import StudyResults
from cartpole_rl.reporting.studies.robustness import Robustness, robustness
from cartpole_rl.reporting.studies.sections import (
    MOST_EXCLUSIONS,
    Picture,
    commands,
    doubts,
    drawn,
    figure_parts,
    folded,
    run_list,
    wide,
)
from cartpole_rl.reporting.studies.texts import (
    EMULATED,
    EMULATED_CART,
    ENOUGH,
    INTRODUCTION,
    METHOD,
    STYLE,
    TITLE,
)

REAL = "plant=serial"  # the override of a run on a real cart
NOT_IN_THESIS = "not in the thesis"
NO_STUDY = ': <span class="alarm">no study</span>'  # of a row of the thesis's list


def studies_page(
    results: Sequence[StudyResults],
    pictures: Mapping[str, Sequence[Picture]],
    emulators: Mapping[str, str] | None = None,
) -> str:
    """Return the page of studies, in their order.

    `pictures` maps the name of a study to its pictures, `emulators` the name of each emulated cart to its
    settings with their comments.
    """
    parts = [
        f"<h1>{TITLE}</h1>",
        f"<p>{_count(results)}</p>",
        _introduction(results, bool(emulators)),
        _tendency(results),
        _summary(results),
        _contents(results),
        *(_study_section(each, pictures.get(each.name, ())) for each in results),
        _ranks(results),
        _robustness(results),
        _emulators(emulators or {}),
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


def _count(results: Sequence[StudyResults]) -> str:
    """Return "38 studies, size full: 1122 agents and 10 models.", or "2 of 38 ..." for some with results."""
    made = sum(bool(each.agents) for each in results)
    part = f"{made} of " if made < len(results) else ""
    sizes = sorted({each.label for each in results if each.agents and each.label})
    size = f", size {', '.join(sizes)}" if sizes else ""
    units: Counter[str] = Counter()
    for each in results:
        units[each.study.unit] += len(each.agents)
    *others, last = [counted_text(count, unit) for unit, count in units.items() if count] or ["no result"]
    runs = f"{', '.join(others)} and {last}" if others else last
    several = " An agent that several studies evaluate counts in each." if made > 1 else ""
    return f"{part}{len(results)} {'study' if len(results) == 1 else 'studies'}{size}: {runs}.{several}"


def _introduction(results: Sequence[StudyResults], emulated: bool) -> str:
    """Return what a newcomer must know to read the summary."""
    variants = [part for each in results for part in (*each.study.arms, *each.evaluations)]
    real = any(REAL in variant.overrides for variant in variants)
    carts = " ".join(("" if real else "No real cart was driven.", EMULATED_CART if emulated else "")).strip()
    terms = ({"Carts": Html(carts)} if carts else {}) | INTRODUCTION
    listed = "".join(f"<dt>{term}</dt><dd>{escaped(text)}</dd>" for term, text in terms.items())
    return f'<dl class="terms">{listed}</dl>'


def _tendency(results: Sequence[StudyResults]) -> str:
    """Return a warning if no study has ENOUGH agents per set-up; empty otherwise."""
    most = max((each.size.seeds for each in results if each.agents and each.size), default=ENOUGH)
    if most >= ENOUGH:
        return ""
    return (
        f'<p class="alarm">At most {counted_text(most)} per set-up: these results show tendencies only.</p>'
    )


def _emulators(emulators: Mapping[str, str]) -> str:
    """Return what stands for the real cart, and in what it differs from the simulated one."""
    if not emulators:
        return ""
    files = "".join(
        f"<h3>emulator={escaped(name)}</h3><pre><code>{escaped(text)}</code></pre>"
        for name, text in emulators.items()
    )
    heading = "The cart that stands for the real one"
    return f'<section id="emulated"><h2>{heading}</h2><p>{EMULATED}</p>{files}</section>'


def _summary(results: Sequence[StudyResults]) -> str:
    """Return the table of the studies with results, what fails or contradicts first, and name the others."""
    order = [*Status]
    carried_out = [each for each in results if each.agents]
    ranked = sorted(carried_out, key=lambda each: order.index(status(each)))
    rows = [
        {
            "study": _link(each),
            "verdict": _status(each),
            "the thesis": _prose(opening(each.study.thesis or NOT_IN_THESIS)),
            "here": _prose(_short_answer(each)),
        }
        for each in ranked
    ]
    found = table(rows, cards=True) if rows else ""
    others = ", ".join(_link(each) for each in results if not each.agents)
    lacking = f"<p>No result yet: {others}.</p>" if others else ""
    return f'<section id="summary"><h2>Summary: what fails comes first</h2>{found}{lacking}</section>'


def _short_answer(results: StudyResults) -> str:
    """Return the start of what a person wrote about these results, else the numbers that count."""
    if comment := _comment(results):
        return opening(*comment)
    return " ".join(answer(results)[: len(results.judged)])


def _contents(results: Sequence[StudyResults]) -> str:
    """Return the thesis's list with the studies of each row, those beyond it, and a person's own.

    It is a plain list if none is of the thesis, and empty for one study.
    """
    if len(results) == 1:
        return ""
    rows = {
        number: [each for each in results if each.shipped and each.study.order // 10 == number]
        for number in THESIS_ROWS
    }
    placed = {each.name for row in rows.values() for each in row}
    if not placed:
        return f'<nav id="contents"><h2>Contents</h2>{_links(results)}</nav>'
    listed = "".join(
        f"<li>{escaped(what)}{'' if rows[number] else NO_STUDY}{_links(rows[number])}</li>"
        for number, what in THESIS_ROWS.items()
    )
    others = {
        "Beyond the thesis": [each for each in results if each.shipped and each.name not in placed],
        "Own studies": [each for each in results if not each.shipped],
    }
    further = "".join(f"<h3>{heading}</h3>{_links(found)}" for heading, found in others.items() if found)
    return f'<nav id="contents"><h2>The list of the thesis</h2><ol>{listed}</ol>{further}</nav>'


def _links(results: Sequence[StudyResults]) -> str:
    return f"<ul>{''.join(f'<li>{_link(each)}</li>' for each in results)}</ul>"


def _study_section(results: StudyResults, pictures: Sequence[Picture]) -> str:
    study = results.study
    figure = f" <small>({escaped(study.place)})</small>" if study.figure else ""
    facts = {
        "Question": study.question,
        "The thesis": study.thesis or NOT_IN_THESIS,
        "Answer": " ".join(_comment(results)),
        "Numbers": " ".join(answer(results)),
    }
    listed = "".join(f"<dt>{name}</dt><dd>{_prose(text)}</dd>" for name, text in facts.items() if text)
    parts = [
        f'<section id="{_anchor(results.name)}">',
        f"<h2>{escaped(study.title)}{figure}</h2>",
        f"<p>{_status(results)}</p><dl>{listed}</dl>",
        doubts(results, [f"Missing: {each}." for each in results.missing()] if results.agents else []),
        *figure_parts(results, pictures),
        commands(results),
        run_list(results),
        "</section>",
    ]
    return "\n".join(part for part in parts if part)


def _sweep_section(results: StudyResults, pictures: Sequence[Picture]) -> str:
    groups = f"{len(results.study.arms)} groups" if len(results.study.arms) > 1 else "one group"
    parts = [
        f'<section id="{_anchor(results.name)}">',
        f"<h2>{escaped(results.study.title)}</h2>",
        f"<p>{counted_text(len(results.agents))} in {groups}. {escaped(' '.join(answer(results)))}</p>",
        doubts(results, []),
        *figure_parts(results, pictures),
        run_list(results),
        "</section>",
    ]
    return "\n".join(part for part in parts if part)


def _ranks(results: Sequence[StudyResults]) -> str:
    found = rank_agreements(results)
    if not found:
        return ""
    figures = "".join(f"<div><p>{escaped(each.answer)}</p>{drawn(each)}</div>" for each in found)
    return (
        '<section id="ranks"><h2>Does the order in simulation predict that on the cart?</h2>'
        f"<p>Agents of all studies together; differences between set-ups are part of it.</p>"
        f'<div class="figures">{figures}</div></section>'
    )


def _robustness(results: Sequence[StudyResults]) -> str:
    """Return the section of the robustness score; empty without its studies."""
    found = robustness(results)
    if not found:
        return ""
    rows = [
        {
            "set-up": each.label,
            **{name: _percent(score) for name, score in each.criteria.items()},
            "overall, 95 % interval": _overall(each),
            "agents": each.agents,
        }
        for each in found
    ]
    text = (
        f"Share of cases, one agent at one value of a quantity, with a score (6.2) above {GOOD['score']:g}. "
        f"Each quantity is a criterion of weight 1/{len(found[0].criteria)}, after the leaderboard of DFKI's "
        "double pendulum (Wiebe et al., 2023). A set-up that lacks agents has no score. The interval is that "
        "of the mean over agents."
    )
    return f'<section id="robustness"><h2>Robustness score</h2><p>{text}</p>{wide(rows)}</section>'


def _overall(found: Robustness) -> str:
    """Return the overall score with its interval: "62 % (58 % to 66 %)"."""
    if found.estimate is None or found.estimate.low is None or found.estimate.high is None:
        return _percent(found.overall)
    return f"{_percent(found.overall)} ({percent(found.estimate.low)} to {percent(found.estimate.high)})"


def _percent(share: float | None) -> str:
    return "–" if share is None else percent(share)


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
        f"<p>Settings that differ:</p>{folded(differs, 'settings')}"
        if differs
        else "<p>No setting differs.</p>",
        folded(rows, "groups") if rows else "<p>The two sets have no group in common.</p>",
        "".join(f"<p>{escaped(line)}</p>" for line in lone[:MOST_EXCLUSIONS]),
        "</section>",
    ]
    return "\n".join(parts)


def _method() -> str:
    return f'<section id="method"><h2>How numbers are made</h2><p>{METHOD}</p></section>'


def _link(results: StudyResults) -> Html:
    figure = f" ({escaped(results.study.place)})" if results.study.figure else ""
    return Html(f'<a href="#{_anchor(results.name)}">{escaped(results.study.title)}</a>{figure}')


def _status(results: StudyResults) -> Html:
    found = status(results)
    if not _is_alarming(results):
        return Html(found)
    return Html(f'<span class="alarm">{found}</span>{escaped(reason(results))}')


def _prose(text: str) -> Html:
    """Return a text as HTML in which a number and its percent sign stay together."""
    return Html(escaped(text).replace(" %", "&nbsp;%"))


def _comment(results: StudyResults) -> list[str]:
    """Return what a person wrote about these results."""
    return [results.finding.comment] if results.finding else []


def _is_alarming(results: StudyResults) -> bool:
    return status(results) not in (Status.AGREES, Status.ANSWERED, Status.OPEN, Status.EMPTY)


def _anchor(name: str) -> str:
    """Return the id of a section; no character of a name ends the attribute."""
    return f"study-{re.sub('[^A-Za-z0-9_.+-]', '-', name)}"
