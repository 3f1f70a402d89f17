#!/usr/bin/env python
"""Does fine-tuning help on emulated carts that an agent never saw?

    scripts/bench/fine_tuning.py runs/train/a runs/train/b runs/train/c --jobs 2 --json tuned.json

Fine-tunes the last checkpoint of each agent on each of `--truths` drawn carts, as `cartpole-finetune` does:
`--starts` episodes without exploration, `--episodes` to learn from, then `--starts` without exploration. The
carts are drawn as in zero_shot.py, with a seed of their own. Fractions are scores divided by the reference of
the same cart (reference.py --truths). An episode with a score below 500 is lost. `after` is the policy after
fine-tuning, even where `cartpole-finetune` keeps the one from before. Further words are overrides of
cartpole-finetune.

The runs are in runs/bench/fine_tuning, each in a folder whose name depends on all of its settings. One that
was interrupted is resumed, and one that has ended is not made again. `seconds` are those of the last call, so
they are too few for a run that was resumed.
"""

import argparse
import hashlib
import json
import time
from collections.abc import Sequence
from concurrent.futures import as_completed
from pathlib import Path
from typing import Any

import numpy as np
from common import (
    LOST_SCORE,
    RUNS,
    add_wider_option,
    check_agent,
    option_parser,
    overrides_of,
    positive_int,
    print_table,
    processes,
    read_json,
    write_json,
)
from truth_references import Draw, known_references, note_missing
from truths import TUNED, Truth

from cartpole_rl.errors import CartPoleError
from cartpole_rl.reporting.texts import Cell
from cartpole_rl.run_folder import CHECKPOINTS, RESUME
from cartpole_rl.tasks.episode import Ending, Episode
from cartpole_rl.workflows.config import FinetuneConfig, load_settings
from cartpole_rl.workflows.finetune import finetune
from cartpole_rl.workflows.finetuning_cart import FinetuningFiles, Stage

PARENT = RUNS / "fine_tuning"
FIGURES = "bench.json"  # in a run folder, written at the end


def tuned(folder: Path, overrides: dict[str, Any]) -> dict[str, Any]:
    """Fine-tune in `folder` unless it has been done, and return the figures; `error` if the cart fails."""
    check_agent(folder, str(overrides["run"]))
    if (folder / FIGURES).exists():
        figures: dict[str, Any] = read_json(folder / FIGURES)
        return figures
    interrupted = (folder / CHECKPOINTS / RESUME).exists()
    config = load_settings(FinetuneConfig, {"resume": str(folder)} if interrupted else overrides)
    started = time.perf_counter()
    try:
        finetune(config, folder)
    except CartPoleError as error:  # high friction can prevent homing
        return {"error": str(error)}
    seconds = time.perf_counter() - started
    episodes = {stage: FinetuningFiles(folder, config).episodes(stage) for stage in Stage}
    found = {**stage_figures(episodes), "seconds": round(seconds, 1)}
    write_json(folder / FIGURES, found)
    return found


def stage_figures(episodes: dict[Stage, list[Episode]]) -> dict[str, Any]:
    """Return the scores of each stage, and how many tuning episodes left the track."""
    left = [episode.ended_by == Ending.TRACK for episode in episodes[Stage.TUNE]]
    scores = {str(stage): [float(each.score.sum()) for each in found] for stage, found in episodes.items()}
    return {"scores": scores, "left_track": sum(left), "left_track_first": bool(left[0])}


def cart_figures(
    agent: str, number: int, truth: Truth, reference: float | None, found: dict[str, Any]
) -> dict[str, Any]:
    """Return the figures of one fine-tuning; the fractions are None without a reference."""
    figures = {"agent": agent, "cart": number, "truth": truth, "reference": reference, **found}
    if "error" in found:
        return figures
    before, after = (float(np.mean(found["scores"][stage])) for stage in (Stage.BEFORE, Stage.AFTER))
    fractions = {"before": before, "after": after}
    return figures | {
        "before": before,
        "after": after,
        "fraction": {name: score / reference if reference else None for name, score in fractions.items()},
        "lost": {
            stage: sum(score < LOST_SCORE for score in scores) for stage, scores in found["scores"].items()
        },
    }


def cart_row(figures: dict[str, Any]) -> dict[str, Cell]:
    """Return the table row of one fine-tuning."""
    row: dict[str, Cell] = {"agent": figures["agent"], "cart": figures["cart"]}
    if "error" in figures:
        return {**row, "before": figures["error"]}
    tuning = " ".join(f"{score:.0f}" for score in figures["scores"][Stage.TUNE])
    return {
        **row,
        "before": f"{figures['before']:.0f}",
        "tuning": tuning,
        "after": f"{figures['after']:.0f}",
        "fraction before": figures["fraction"]["before"],
        "after, fraction": figures["fraction"]["after"],
        "left track": figures["left_track"],
        "seconds": f"{figures['seconds']:.0f}",
    }


def agent_figures(agent: str, results: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the figures that summarize the fine-tunings of one agent."""
    done = [each for each in results if "error" not in each]
    found: dict[str, Any] = {"run": agent, "not_tuned": len(results) - len(done)}
    for stage in (Stage.BEFORE, Stage.AFTER) if done else ():
        scores = [each[stage] for each in done]
        fractions = [each["fraction"][stage] for each in done if each["fraction"][stage] is not None]
        found[str(stage)] = {
            "mean_score": float(np.mean(scores)),
            "worst_score": min(scores),
            "mean_fraction": float(np.mean(fractions)) if fractions else None,
            "worst_fraction": min(fractions, default=None),
        }
    return found | {
        "ended_below": sum(each["after"] < each["before"] for each in done),
        "lost": {str(stage): sum(each["lost"][stage] for each in done) for stage in Stage},
        "left_track": sum(each["left_track"] for each in done),
        "left_track_first": sum(each["left_track_first"] for each in done),
        "seconds": float(np.mean([each["seconds"] for each in done])) if done else None,
        "carts": [{name: value for name, value in each.items() if name != "agent"} for each in results],
    }


def agent_row(figures: dict[str, Any]) -> dict[str, Cell]:
    """Return the table row of one agent."""
    row: dict[str, Cell] = {
        "agent": figures["run"],
        "carts": len(figures["carts"]) - figures["not_tuned"],
        "not tuned": figures["not_tuned"],
    }
    for stage in (Stage.BEFORE, Stage.AFTER):
        of_stage = figures.get(stage, {})
        row |= {f"{name.replace('_', ' ')} {stage}": value for name, value in of_stage.items()}
    return row | {
        "ended below": figures["ended_below"],
        "lost before, tuning, after": ", ".join(map(str, figures["lost"].values())),
        "left track": figures["left_track"],
        "in first episode": figures["left_track_first"],
        "seconds a cart": figures["seconds"],
    }


def parse_options() -> tuple[argparse.Namespace, dict[str, Any]]:
    """Return the command-line options, and the overrides for cartpole-finetune."""
    parser = option_parser(__doc__)
    parser.add_argument("agents", nargs="+", help="run folders; NAME=VALUE is an override")
    parser.add_argument("--truths", type=positive_int, default=20, help="number of carts (20)")
    parser.add_argument("--seed", type=int, default=TUNED, help=f"decides which carts are drawn ({TUNED})")
    add_wider_option(parser)
    parser.add_argument("--episodes", type=positive_int, default=5, help="to learn from on each cart (5)")
    parser.add_argument("--starts", type=positive_int, default=5, help="episodes before and after (5)")
    parser.add_argument("--jobs", type=positive_int, default=1, help="fine-tunings at the same time (1)")
    options, words = parser.parse_known_args()
    words += [word for word in options.agents if "=" in word]
    options.agents = [word for word in options.agents if word not in words]
    return options, overrides_of(words)


def fine_tunings(
    options: argparse.Namespace, overrides: dict[str, Any]
) -> dict[tuple[str, int], tuple[Path, dict[str, Any]]]:
    """Return the folder and the overrides of each fine-tuning, by agent and number of the cart.

    Other settings have other folders, so that none is taken for that of other settings.
    """
    work = {}
    for number, truth in enumerate(Draw(options.seed, options.wider).truths(options.truths)):
        for agent in options.agents:
            path = Path(agent)
            words = {
                "run": agent,
                "plant": "emulated",
                "episodes": options.episodes,
                "evaluation_episodes": options.starts,
                **{f"emulator.{name}": value for name, value in truth.items()},
                **overrides,
            }
            asked = hashlib.sha256(json.dumps(words, sort_keys=True).encode()).hexdigest()[:8]
            folder = PARENT / f"{path.parent.name}_{path.name}"
            name = f"{options.seed}_{options.wider:g}_{number:02d}_{asked}"
            work[agent, number] = folder / name, words
    return work


def main() -> None:
    """Fine-tune every agent on every cart, print the tables and write the figures."""
    options, overrides = parse_options()
    draw = Draw(options.seed, options.wider)
    truths = draw.truths(options.truths)
    references = known_references(draw, truths)
    note_missing(draw, references)
    results: dict[tuple[str, int], dict[str, Any]] = {}
    with processes(options.jobs) as pool:
        jobs = fine_tunings(options, overrides)
        tunings = {pool.submit(tuned, *arguments): key for key, arguments in jobs.items()}
        for done in as_completed(tunings):
            agent, number = tunings[done]
            results[agent, number] = cart_figures(
                agent, number, truths[number], references[number], done.result()
            )
            of_draw = {"seed": options.seed, "wider": options.wider}
            agents = [
                agent_figures(each, [results[key] for key in jobs if key[0] == each and key in results])
                for each in options.agents
            ]
            write_json(options.json, {**of_draw, "agents": agents})
    print_table([cart_row(results[key]) for key in jobs])
    print()
    print_table([agent_row(each) for each in agents])


if __name__ == "__main__":
    main()
