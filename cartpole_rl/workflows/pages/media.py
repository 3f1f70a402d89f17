"""Pictures for a page from run folders: animations of agents, made smaller, and figures."""

import io
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from PIL import Image

from cartpole_rl.reporting.animation import smaller
from cartpole_rl.reporting.results import Agent, Results, low_is_good, measure_label
from cartpole_rl.reporting.runs_page import Picture
from cartpole_rl.reporting.texts import number_text
from cartpole_rl.run_folder import ANIMATION, FIGURES
from cartpole_rl.workflows.pages.runs import short

BUDGET = 12_000_000  # bytes of all pictures; a page takes a third more
SIZES = ((320, 3), (240, 4), (200, 6))  # width in pixels, frames per kept one: the first that fits is taken
TYPICAL = (110_000, 65_000, 40_000)  # bytes of an animation of 10 s in these sizes
FIGURE_WIDTH, FIGURE_QUALITY = 900, 70
MOST_FIGURES = 6  # of a run


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
            text = f"{name}: {labels[agent.group]}, seed {agent.seed}, {label} {number_text(value)}"
            alt = f"Animation of one episode of the {name} agent ({labels[agent.group]}, seed {agent.seed})"
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
            yield file, f"An episode of the {name} agent over time (seed {agent.seed})"


def _figure(path: Path) -> bytes:
    """Return a figure as WebP. A damaged one raises one of many errors."""
    with Image.open(path) as source:
        picture = source.convert("RGB")
        picture.thumbnail((FIGURE_WIDTH, FIGURE_WIDTH))
    buffer = io.BytesIO()
    picture.save(buffer, "WEBP", quality=FIGURE_QUALITY)
    return buffer.getvalue()
