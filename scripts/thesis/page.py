"""The page of studies: one HTML file with everything in it. What fails or contradicts comes first."""

import re
import shlex
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from charts import drawings, rank_agreements
from results import Status, StudyResults
from study import RUN

from cartpole_rl.reporting.results import (
    GOOD,
    Named,
    estimate_text,
    measure_label,
    ranked_text,
    sentence_start,
)
from cartpole_rl.reporting.runs_page import (
    STYLE,
    Picture,
    anchor,
    doubts,
    drawn,
    figure_parts,
    method,
    run_list,
    wide,
)
from cartpole_rl.reporting.statistics import Array, Estimate, bootstrap
from cartpole_rl.reporting.style import Html, document, escaped, table
from cartpole_rl.reporting.texts import count_text

TITLE = "The thesis, carried out"
THESIS_ROWS = {  # of the thesis's list: what must work
    1: "Physics, both integrators, substeps",
    2: "Balance with reward (5.1), three actions",
    3: "Balance with a reward for angle and position",
    4: "Swing-up in the stock simulation",
    5: "Nine actions, linear and measured spacing",
    6: "AdamW and Adam, reward (5.3), growth of the loss",
    7: "Measuring pole friction, cart friction and the force curve",
    8: "Friction models, six set-ups",
    9: "Realistic swing-up, recovery after a knock",
    10: "Large pole",
    11: "One agent for both poles",
    12: "One agent for lengths of 0.2 to 1.0 m",
    13: "Perturbed friction coefficients",
    14: "Parameters estimated from transitions",
    15: "Fine-tuning on the cart",
    16: "Recurrent Q-network",
    17: "Outlook: static friction, the pole's vertical force, a learned model",
    18: "Baselines: LQR, PID, energy swing-up",
}
BEYOND = 200  # order from which a study lies beyond the thesis
NOT_IN_THESIS = "not in the thesis"
NO_STUDY = ': <span class="alarm">no study</span>'  # of a row of the thesis's list
REAL = "plant=serial"  # the override of a run on a real cart
CARTS = ("simulated cart", "emulated cart")  # starts of labels of evaluations
CRITERIA = "robustness_"  # prefix of the names of studies
ENOUGH = 10  # agents per set-up
SENTENCES = re.compile(r"(?<=[a-z0-9)][.?!]) (?=[A-Z])")
OPENING, SHORT = 200, 30  # characters of a text's first sentences: at most; fewer take another sentence
EMULATED = (
    "The emulated cart is an emulator, not a real cart: a separate program with the physics of MuJoCo that "
    "speaks the cart's serial protocol and shares no equation with the simulator; many of its parameters lie "
    "inside the training ranges, see the comments below. The settings below say how it differs from the "
    "nominal cart. It lacks wear, backlash, a bending track and more. With a real cart, plant=serial takes "
    "the place of plant=emulated in the same commands."
)
EMULATED_CART = (
    'The emulated cart is a separate MuJoCo simulation that stands in for one (<a href="#emulated">more</a>).'
)
TERMS = {  # what they mean; the carts come before
    "Score (6.1)": "Balance: at most 500.",
    "Score (6.2)": "Swing-up: at most 5500; over 2000 is good.",
    "Values": (
        "Interquartile means over agents with 95 % intervals, as 4104 (4062 to 4177); the last checkpoint of "
        "every seed counts."
    ),
    "Settings": "Thesis's settings: those of the thesis. Today's settings: this package's defaults.",
    "Verdicts": (
        "Agrees, contradicts: the 95 % interval lies on the thesis's side, or on the other. Differs: on the "
        "other side, but a method, plant or budget that is not the thesis's may be why. Not shown: the "
        "interval excludes neither. New: the thesis has no result. Fails: it does not work. Of several "
        "claims the worst counts."
    ),
    "No difference is shown": "The interval of the difference includes 0.",
    "Ratio": "Score on the emulated cart divided by that in simulation.",
}


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
        method(),
    ]
    return document(TITLE, "\n".join(filter(None, parts)), STYLE)


def _count(results: Sequence[StudyResults]) -> str:
    """Return "38 studies, size full: 1122 agents and 10 models.", or "2 of 38 ..." for some with results."""
    made = sum(bool(each.agents) for each in results)
    part = f"{made} of " if made < len(results) else ""
    sizes = sorted({each.label for each in results if each.agents and each.label})
    size = f", size {', '.join(sizes)}" if sizes else ""
    units: Counter[str] = Counter()
    for each in results:
        units[each.unit] += len(each.agents)
    *others, last = [count_text(count, unit) for unit, count in units.items() if count] or ["no result"]
    runs = f"{', '.join(others)} and {last}" if others else last
    several = " An agent that several studies evaluate counts in each." if made > 1 else ""
    return f"{part}{len(results)} {'study' if len(results) == 1 else 'studies'}{size}: {runs}.{several}"


def _introduction(results: Sequence[StudyResults], emulated: bool) -> str:
    """Return what a newcomer must know to read the summary."""
    variants = [part for each in results for part in (*each.study.arms, *each.study.evaluations)]
    real = any(REAL in variant.overrides for variant in variants)
    carts = " ".join(("" if real else "No real cart was driven.", EMULATED_CART if emulated else "")).strip()
    terms = ({"Carts": Html(carts)} if carts else {}) | TERMS
    listed = "".join(f"<dt>{term}</dt><dd>{escaped(text)}</dd>" for term, text in terms.items())
    return f'<dl class="terms">{listed}</dl>'


def _tendency(results: Sequence[StudyResults]) -> str:
    """Return a warning if no study has ENOUGH agents per set-up; empty otherwise."""
    most = max((each.size.seeds for each in results if each.agents and each.size), default=ENOUGH)
    if most >= ENOUGH:
        return ""
    agents = count_text(most, "agent")
    return f'<p class="alarm">At most {agents} per set-up: these results show tendencies only.</p>'


def _emulators(emulators: Mapping[str, str]) -> str:
    """Return what stands for the real cart, and in what it differs from the simulated one."""
    files = "".join(
        f"<h3>emulator={escaped(name)}</h3><pre><code>{escaped(text)}</code></pre>"
        for name, text in emulators.items()
    )
    heading = "<h2>The cart that stands for the real one</h2>"
    return f'<section id="emulated">{heading}<p>{EMULATED}</p>{files}</section>' if files else ""


def _summary(results: Sequence[StudyResults]) -> str:
    """Return the table of the studies with results, what fails or contradicts first, and name the others."""
    order = [*Status]
    carried_out = [each for each in results if each.agents]
    rows = [
        {
            "study": _link(each),
            "verdict": _status(each),
            "the thesis": _prose(opening(each.study.thesis or NOT_IN_THESIS)),
            "here": _prose(
                opening(each.finding.comment) if each.finding else " ".join(answer(each)[: len(each.judged)])
            ),
        }
        for each in sorted(carried_out, key=lambda each: order.index(each.status()))
    ]
    found = table(rows, cards=True) if rows else ""
    others = ", ".join(_link(each) for each in results if not each.agents)
    lacking = f"<p>No result yet: {others}.</p>" if others else ""
    return f'<section id="summary"><h2>Summary: what fails comes first</h2>{found}{lacking}</section>'


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


def _link(results: StudyResults) -> Html:
    figure = f" ({escaped(results.study.place)})" if results.study.figure else ""
    return Html(f'<a href="#{anchor(results.name)}">{escaped(results.title)}</a>{figure}')


def _status(results: StudyResults) -> Html:
    found = results.status()
    if found in (Status.AGREES, Status.NOT_SHOWN, Status.NEW, Status.OPEN, Status.EMPTY):
        return Html(found)
    return Html(f'<span class="alarm">{found}</span>{escaped(results.reason())}')


def _prose(text: str) -> Html:
    """Return a text as HTML in which a number and its percent sign stay together."""
    return Html(escaped(text).replace(" %", "&nbsp;%"))


def _study_section(results: StudyResults, pictures: Sequence[Picture]) -> str:
    study = results.study
    figure = f" <small>({escaped(study.place)})</small>" if study.figure else ""
    facts = {
        "Question": study.question,
        "The thesis": study.thesis or NOT_IN_THESIS,
        "Answer": results.finding.comment if results.finding else "",
        "Numbers": " ".join(answer(results)),
    }
    listed = "".join(f"<dt>{name}</dt><dd>{_prose(text)}</dd>" for name, text in facts.items() if text)
    missing = [f"Missing: {each}." for each in results.missing()] if results.agents else []
    tables: dict[str, list[dict[str, Any]]] = {}
    if shares := results.mean_ratios():
        ratio = f"{results.evaluations[1].label} / {results.evaluations[0].label}"
        tables["ratios"] = [
            {"set-up": label, ratio: estimate_text(each), "agents": each.agents}
            for label, each in shares.items()
        ]
    parts = [
        f'<section id="{anchor(results.name)}">',
        f"<h2>{escaped(study.title)}{figure}</h2>",
        f"<p>{_status(results)}</p><dl>{listed}</dl>",
        doubts(results, missing, results.remarks),
        *figure_parts(results, pictures, drawings(results), tables),
        commands(results),
        run_list(results),
        "</section>",
    ]
    return "\n".join(filter(None, parts))


def answer(results: StudyResults) -> list[str]:
    """Return our numbers in a few sentences, the main one first, with intervals and numbers of agents."""
    if not results.agents:
        return ["No result yet."]
    shown: Sequence[Named] = results.judged
    if results.varied and {each.name for each in results.varied} <= {
        each.name for each in results.evaluations
    }:
        shown = [results.varied[0], results.varied[-1]]
    name, measure = sentence_start(measure_label(results.measure)), results.measure
    sentences = [
        f"{name}{_place(results, each)}{ranked_text(found, results.unit, measure)}."
        for each in shown
        if (found := results.estimates(each.name))
    ]
    if shares := results.mean_ratios():
        first, second = results.evaluations[:2]
        sentences.append(f"Ratio of {second.label} to {first.label}{ranked_text(shares)}.")
    return sentences


def _place(results: StudyResults, evaluation: Named) -> str:
    """Return where a number was measured: " on the emulated cart", ", latency 60 ms"; empty for one place."""
    if len(results.evaluations) == 1:
        return ""
    if results.study.axis and evaluation in results.varied:
        return f", {results.study.axis.label} {evaluation.label}"
    if evaluation.label.startswith(CARTS):
        return f" on the {evaluation.label}"
    return f", {evaluation.label}"


def opening(text: str) -> str:
    """Return the first sentence of a text, and the next ones up to OPENING characters."""
    first, *others = SENTENCES.split(text)
    for sentence in others:
        if len(first) >= SHORT and len(first) + len(sentence) > OPENING:
            break
        first += f" {sentence}"
    return first


def commands(results: StudyResults) -> str:
    """Return the command that repeats the study, and those of its runs by hand."""
    size, where = f" --size {results.label}" if results.label else "", ""
    if not results.shipped:  # the reader knows the folder of its file
        parts = results.folder.split("/")[:-1]
        root = "/".join(parts[:-1] if parts[-1:] == [results.label] else parts) or "."
        where = f" --studies FOLDER --folder {_quoted(root)}"
    seeds = sorted({agent.seed for agent in results.agents})
    used = f" ({seeds[0]} to {seeds[-1]} here)" if len(seeds) > 1 else ""
    by_hand = "\n".join(_by_hand(results))
    return (
        f"<h3>Command</h3><pre><code>scripts/reproduce {escaped(f'{results.name}{where}{size}')}</code></pre>"
        f"<details><summary>Each run by hand</summary><p>{{seed}}: one run for each seed{used}. "
        "{run}: the run folder of an agent. {runs}: the folder of all studies.</p>"
        f"<pre><code>{escaped(by_hand)}</code></pre></details>"
    )


def _by_hand(results: StudyResults) -> Iterator[str]:
    """Yield the command of each arm, and of each evaluation of its agents."""
    study, size = results.study, results.size
    runs = results.folder.rpartition("/")[0] or "."

    def command(name: str, *words: str) -> str:
        filled = (word.replace("{runs}", runs) for word in (*words, "seed={seed}"))
        return " ".join((f"cartpole-{name}", *map(_quoted, filled)))

    experiment = [f"experiment={study.experiment}"] if study.experiment else []
    for arm in study.arms:
        if study.agents_of:
            yield f"# {arm.label}: agents of the study {study.agents_of}"
        elif named := study.agent_of(arm):
            more = " ".join(study.evaluated_with(arm))
            yield f"# {arm.label}: {RUN}{named}" + (f", each evaluation also with {more}" if more else "")
        else:
            overrides = size.overrides if size else ()
            yield command(study.command, *experiment, *arm.overrides, *overrides)
    labels = {arm.name: arm.label for arm in study.arms}
    common = size.evaluation_overrides if size else ()
    for evaluation in study.evaluations:
        for name in ("", *evaluation.of_arms):
            if name:
                yield f"# agents of {labels[name]}:"
            yield command("evaluate", "run={run}", *evaluation.words(name, common))


def _quoted(word: str) -> str:
    return word if re.fullmatch(r"[\w.=/{}+-]+", word) else shlex.quote(word)


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
    criteria = [
        each
        for each in results
        if each.name.startswith(CRITERIA) and each.agents and each.varied and each.measure in GOOD
    ]
    if not criteria:
        return ""
    text = (
        f"Share of cases, one agent at one value of a quantity, with a score (6.2) above {GOOD['score']:g}. "
        f"Each quantity is a criterion of weight 1/{len(criteria)}, after the leaderboard of DFKI's "
        "double pendulum (Wiebe et al., 2023). A set-up that lacks agents has no score. The interval is that "
        "of the mean over agents."
    )
    rows = wide(robustness(criteria))
    return f'<section id="robustness"><h2>Robustness score</h2><p>{text}</p>{rows}</section>'


def robustness(criteria: Sequence[StudyResults]) -> list[dict[str, Any]]:
    """Return the rows of the robustness score, the most robust set-up first.

    It is in the manner of the leaderboard of DFKI's double pendulum (Wiebe et al., 2023). Each study is one
    criterion: a quantity of the cart is set to several values. Its score is the share of successful cases, a
    case being one agent at one value and a success a score above GOOD. All criteria have the same weight.
    """
    rows = []
    for label in dict.fromkeys(arm.label for each in criteria for arm in each.groups):
        cases = {each.study.axis.label: _successes(each, label) for each in criteria if each.study.axis}
        asked = {
            each.study.axis.label: each.size.seeds if each.size else 1 for each in criteria if each.study.axis
        }
        counts = {values.size for found in cases.values() for values in found}
        shares = {
            name: None
            if any(values.size < asked[name] for values in found)  # agents must not be picked
            else float(np.mean([values.mean() for values in found]))
            for name, found in cases.items()
        }
        known = [share for share in shares.values() if share is not None]
        overall = float(np.mean(known)) if len(known) == len(shares) else None
        estimate = None
        if overall is not None and len(counts) == 1 and 0 not in counts:
            # the agents of a set-up are the same in all criteria: whole agents are resampled
            of_agents = np.mean([np.mean(found, axis=0) for found in cases.values()], axis=0)
            estimate = bootstrap(lambda sample: np.asarray(sample.mean(axis=-1)), of_agents)
        row: dict[str, Any] = {"set-up": label, **{name: _percent(share) for name, share in shares.items()}}
        row |= {"overall, 95 % interval": _percent(overall, estimate), "agents": min(counts)}
        rows.append((-1.0 if overall is None else overall, row))
    return [row for _, row in sorted(rows, key=lambda each: each[0], reverse=True)]


def _successes(results: StudyResults, label: str) -> list[Array]:
    """Return which of a set-up's agents succeed [agents], at each value of the quantity."""
    arm = next((arm.name for arm in results.groups if arm.label == label), "")
    good = GOOD[results.measure]
    return [(results.values(arm, each.name) > good).astype(float) for each in results.varied]


def _percent(share: float | None, found: Estimate | None = None) -> str:
    """Return a share as "62 %", with its interval as "62 % (58 % to 66 %)"."""
    if share is None:
        return "–"
    interval = (
        f" ({100 * found.low:.0f} % to {100 * found.high:.0f} %)"
        if found and found.low is not None and found.high is not None
        else ""
    )
    return f"{100 * share:.0f} %{interval}"
