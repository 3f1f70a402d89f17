"""The page of studies and that of a person's own runs, each one HTML file with everything in it."""

import re
from collections.abc import Mapping, Sequence

from cartpole_rl.reporting.page import Html, document, escaped, table
from cartpole_rl.reporting.studies.answers import (
    BEYOND,
    GOOD,
    THESIS_ROWS,
    Status,
    answer,
    counted_text,
    estimate_text,
    reason,
    status,
)
from cartpole_rl.reporting.studies.comparison import Comparison
from cartpole_rl.reporting.studies.figures import rank_agreements
from cartpole_rl.reporting.studies.results import StudyResults
from cartpole_rl.reporting.studies.robustness import robustness
from cartpole_rl.reporting.studies.sections import (
    MOST_EXCLUSIONS,
    Picture,
    commands,
    doubts,
    drawn,
    figure_parts,
    folded,
    run_list,
)
from cartpole_rl.reporting.studies.texts import EMULATED, ENOUGH, METHOD, STYLE, TITLE


def studies_page(
    results: Sequence[StudyResults],
    pictures: Mapping[str, Sequence[Picture]],
    emulators: Mapping[str, str] | None = None,
) -> str:
    """Return the page of studies, in their order.

    `pictures` maps the name of a study to its pictures, `emulators` the name of each emulated cart to its
    settings with their comments.
    """
    agents = sum(len(each.agents) for each in results)
    sizes = sorted({each.label for each in results if each.agents and each.label})
    size = f", size {', '.join(sizes)}" if sizes else ""
    parts = [
        f"<h1>{TITLE}</h1>",
        f"<p>{_count(results)}{size}, {counted_text(agents, 'run')}.</p>",
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
    """Return "1 study", "38 studies", or "2 of 38 studies" where the others have no results."""
    made = sum(bool(each.agents) for each in results)
    part = f"{made} of " if made < len(results) else ""
    return f"{part}{len(results)} {'study' if len(results) == 1 else 'studies'}"


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
            "the thesis": each.study.thesis or "–",
            "here": " ".join([*answer(each)[: len(each.judged)], *_comment(each)]),
            "verdict": _status(each),
        }
        for each in ranked
    ]
    found = table(rows, cards=True) if rows else ""
    others = ", ".join(_link(each) for each in results if not each.agents)
    lacking = f"<p>No result yet: {others}.</p>" if others else ""
    return f'<section id="summary"><h2>Summary: what fails comes first</h2>{found}{lacking}</section>'


def _contents(results: Sequence[StudyResults]) -> str:
    """Return the thesis's list with the studies of each row, then those beyond it; empty for one study."""
    if len(results) == 1:
        return ""
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
        "Here": " ".join(answer(results)),
        "Why": " ".join(_comment(results)),
    }
    listed = "".join(f"<dt>{name}</dt><dd>{escaped(text)}</dd>" for name, text in facts.items() if text)
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
    figures = "".join(map(drawn, rank_agreements(results)))
    if not figures:
        return ""
    return (
        '<section id="ranks"><h2>Does the order in simulation predict that on the cart?</h2>'
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
            "overall": _percent(each.overall),
            "agents": each.agents,
        }
        for each in found
    ]
    text = (
        f"Share of cases, one agent at one value of a quantity, with a score (6.2) above {GOOD['score']:g}. "
        f"Each quantity is a criterion of weight 1/{len(found[0].criteria)}, after the leaderboard of DFKI's "
        "double pendulum (Wiebe et al., 2023). A set-up that lacks agents has no score."
    )
    return f'<section id="robustness"><h2>Robustness score</h2><p>{text}</p>{table(rows)}</section>'


def _percent(share: float | None) -> str:
    return "–" if share is None else f"{share:.0%}"


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
    figure = f" ({escaped(_figure_name(results.study.figure))})" if results.study.figure else ""
    return Html(f'<a href="#{_anchor(results.name)}">{escaped(results.study.title)}</a>{figure}')


def _figure_name(figure: str) -> str:
    """Return "Fig. 6.8" for "6.8", "Section 3.1.3" for other numbers, and any other text as it is written."""
    if re.match(r"\d+\.\d+[a-z]?(,|$)", figure):
        return f"Fig. {figure}"
    return f"Section {figure}" if figure[:1].isdigit() else figure


def _status(results: StudyResults) -> Html:
    found = status(results)
    if not _is_alarming(results):
        return Html(found)
    return Html(f'<span class="alarm">{found}</span>{escaped(reason(results))}')


def _comment(results: StudyResults) -> list[str]:
    """Return what a person wrote about these results."""
    return [results.finding.comment] if results.finding else []


def _is_alarming(results: StudyResults) -> bool:
    return status(results) not in (Status.AGREES, Status.ANSWERED, Status.OPEN, Status.EMPTY)


def _anchor(name: str) -> str:
    return f"study-{name}"
