"""Make a report: one HTML page from any runs."""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

from cartpole_rl.files import write_text
from cartpole_rl.reporting.groups import Drawing, drawings
from cartpole_rl.reporting.results import Results
from cartpole_rl.reporting.runs_page import Gallery, Picture, runs_page
from cartpole_rl.reporting.style import save
from cartpole_rl.reporting.sweeps import read_groups, results_of
from cartpole_rl.reporting.tables import episode_rows, run_rows, write_table
from cartpole_rl.reporting.texts import count_text
from cartpole_rl.run_folder import EPISODES, FIGURES, PAGE, TABLE, write_config
from cartpole_rl.terminal import print_message, shown
from cartpole_rl.workflows.checks import check_installed
from cartpole_rl.workflows.config import ReportConfig


def make_report(config: ReportConfig, folder: Path) -> None:
    """Write the page of the runs in `config.runs`, and of their comparison with those in `config.compare`.

    Writes config.yaml, provenance.json, page.html and runs.csv into `folder`, a table of all episodes in each
    of `config.format`, and with `config.figures` figures/. Prints how many runs count, and where the page is.
    Raises ConfigError for folders without runs, and if Parquet is asked for and PyArrow is missing.
    """
    if "parquet" in config.format:
        check_installed("format=parquet", "parquet")
    sets = {"runs": config.runs, "compare": config.compare}
    given = {name: sources for name, sources in sets.items() if sources}
    sweeps, between = read_groups(given, config.measure)
    results = [results_of(sweep, config.measure) for sweep in sweeps]
    write_config(folder, "report", {**config.model_dump(mode="json"), "seed": None})
    write_table(partial(run_rows, sweeps), folder / TABLE)
    tables = [f"{EPISODES}.{suffix}" for suffix in config.format]
    for name in tables:
        write_table(partial(episode_rows, sweeps), folder / name)
    title = " and ".join(f"{name}: {', '.join(sources)}" for name, sources in given.items())
    pictures = pictures_of(results) if config.animations else {}
    write_text(folder / PAGE, runs_page(title, results, pictures, between))
    print(f"{shown(folder)}/{TABLE} holds all runs" + "".join(f", {name} all episodes" for name in tables))
    if config.figures:
        write_figures({f"{each.name}_{one.name}": one for each in results for one in drawings(each)}, folder)
    print_end(results, folder)


def pictures_of(results: Sequence[Results]) -> dict[str, list[Picture]]:
    """Return the pictures of each set of runs by its name; print which are left out or damaged."""
    gallery = Gallery(results)
    pictures = {each.name: gallery.pictures(each) for each in results}
    if gallery.left_out:
        print_message("report", f"note: {gallery.left_out} pictures were left out to keep the page small")
    for problem in gallery.problems:
        print_message("report", f"note: {problem}")
    return pictures


def write_figures(figures: Mapping[str, Drawing], folder: Path) -> None:
    """Write figures as SVG files by their names, and print where they are."""
    for name, drawing in figures.items():
        save(drawing.figure, folder / FIGURES / f"{name}.svg")
    print(
        f"{shown(folder)}/{FIGURES}/ holds {len(figures)} figures"
        if figures
        else "there is no figure to write"
    )


def print_end(results: Sequence[Results], folder: Path) -> None:
    """Print how many runs count, and where the page is."""
    counting = sum(len(each.agents) for each in results)
    others = sum(len(each.exclusions) for each in results)
    where = "; the page says why" if others else ""
    count = f"{count_text(counting, 'run')} {'counts' if counting == 1 else 'count'}"
    print(f"{count}, {others} {'does' if others == 1 else 'do'} not{where}")
    print(f"{shown(folder)}/{PAGE} is written")
