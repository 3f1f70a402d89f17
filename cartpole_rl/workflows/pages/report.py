"""Make a report: one HTML page from run folders, of the studies of the thesis or of any runs."""

from collections.abc import Sequence
from pathlib import Path

from cartpole_rl.files import write_text
from cartpole_rl.reporting.figures import save
from cartpole_rl.reporting.studies.answers import Status, status
from cartpole_rl.reporting.studies.comparison import compare
from cartpole_rl.reporting.studies.figures import Drawing, drawings
from cartpole_rl.reporting.studies.numbers import counted_text
from cartpole_rl.reporting.studies.page import runs_page, studies_page
from cartpole_rl.reporting.studies.ranks import rank_agreements
from cartpole_rl.reporting.studies.results import StudyResults
from cartpole_rl.reporting.studies.sections import Picture
from cartpole_rl.run_files import FIGURES, PAGE
from cartpole_rl.workflows.config import ReportConfig
from cartpole_rl.workflows.pages.media import Gallery
from cartpole_rl.workflows.pages.studies import emulators, read_studies, write_data
from cartpole_rl.workflows.pages.sweeps import Sweep, grouped, read_sweeps, results_of, table
from cartpole_rl.workflows.person import print_message
from cartpole_rl.workflows.run_folder import write_config

TABLE = "runs.csv"


def make_report(config: ReportConfig, folder: Path) -> None:
    """Write the page of the studies in `config.studies`, or of the runs in `config.runs`.

    Writes into `folder` config.yaml, provenance.json and page.html, of a report on runs also runs.csv, with
    `config.figures` also figures/; into `config.data` a small JSON file for each study. Prints how many runs
    count, and where the page is.
    Raises ConfigError for folders without runs and for damaged studies.
    """
    if config.studies is not None:
        _report_studies(config, config.studies, folder)
    else:
        _report_runs(config, folder)


def _report_studies(config: ReportConfig, source: Path, folder: Path) -> None:
    results = read_studies(source)
    write_config(folder, "report", {**config.model_dump(mode="json"), "seed": None})
    if config.data is not None:
        write_data(results, config.data)
        print(f"{config.data}/ holds the numbers of {sum(bool(each.agents) for each in results)} studies")
    pictures = _pictures(config, results)
    write_text(folder / PAGE, studies_page(results, pictures, emulators(results)))
    if config.figures:
        _write_figures(results, folder, rank_agreements(results))
    for each in results:
        if each.lost_finding:
            print(f'{each.name}: {" ".join(each.remarks)} That of these has digest: "{each.digest}"')
    for kind in (Status.FAILS, Status.CONTRADICTS, Status.EMPTY, Status.INCOMPLETE):
        if names := [each.name for each in results if status(each) is kind]:
            print(f"{kind}: {', '.join(names)}")
    _print_end(results, folder)


def _report_runs(config: ReportConfig, folder: Path) -> None:
    sets = {"runs": config.runs, "compare": config.compare}
    given = {name: sources for name, sources in sets.items() if sources}
    sweeps, between = grouped(read_sweeps(given, config.measure))
    results = [results_of(sweep, config.measure) for sweep in sweeps]
    write_config(folder, "report", {**config.model_dump(mode="json"), "seed": None})
    write_text(folder / TABLE, table(sweeps))
    comparison = compare(results[0], results[1], between) if len(results) > 1 else None
    title = " and ".join(_title(sweep) for sweep in sweeps)
    write_text(folder / PAGE, runs_page(title, results, _pictures(config, results), comparison))
    print(f"{folder}/{TABLE} holds all runs")
    if config.figures:
        _write_figures(results, folder)
    _print_end(results, folder)


def _write_figures(results: list[StudyResults], folder: Path, ranks: Sequence[Drawing] = ()) -> None:
    """Write the figures of studies or runs as SVG files, and print where they are."""
    figures = {f"{each.name}_{drawing.name}": drawing for each in results for drawing in drawings(each)}
    figures |= {each.name: each for each in ranks}
    for name, drawing in figures.items():
        save(drawing.figure, folder / FIGURES / f"{name}.svg")
    print(f"{folder}/{FIGURES}/ holds {len(figures)} figures" if figures else "there is no figure to write")


def _pictures(config: ReportConfig, results: list[StudyResults]) -> dict[str, list[Picture]]:
    """Return the pictures of each study by its name."""
    if not config.animations:
        return {}
    gallery = Gallery(results)
    pictures = {each.name: gallery.pictures(each) for each in results}
    if gallery.left_out:
        print_message("report", f"note: {gallery.left_out} pictures were left out to keep the page small")
    for problem in gallery.problems:
        print_message("report", f"note: {problem}")
    return pictures


def _title(sweep: Sweep) -> str:
    return f"{sweep.name}: {', '.join(sweep.sources)}"


def _print_end(results: list[StudyResults], folder: Path) -> None:
    counting = sum(len(each.agents) for each in results)
    others = sum(len(each.exclusions) for each in results)
    where = "; the page says why" if others else ""
    count = f"{counted_text(counting, 'run')} {'counts' if counting == 1 else 'count'}"
    print(f"{count}, {others} {'does' if others == 1 else 'do'} not{where}")
    print(f"{folder}/{PAGE} is written")
