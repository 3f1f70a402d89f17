#!/usr/bin/env python
"""Make the page of the studies of the thesis: one HTML file, from runs or from the small files of --data.

    scripts/thesis/report.py runs/reproduce/full
    scripts/thesis/report.py runs/reproduce/full/friction_models       one of them
    scripts/thesis/report.py runs/reproduce/full --data docs/results/thesis
    scripts/thesis/report.py docs/results/thesis

Writes page.html into a new folder of runs/report, or into --output.
"""

import argparse
import sys
import time
from pathlib import Path

from charts import drawings, rank_agreements
from page import studies_page
from reading import emulators, read_studies
from results import Status, write_data

from cartpole_rl.errors import CartPoleError
from cartpole_rl.files import write_text
from cartpole_rl.run_folder import PAGE, write_config
from cartpole_rl.workflows.report import pictures_of, print_end, write_figures


def parse_options() -> argparse.Namespace:
    """Return the command-line options."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="of studies, of one study, or of the files of --data")
    parser.add_argument("--output", type=Path, help="folder of the page (runs/report/<date_time>)")
    parser.add_argument(
        "--data", type=Path, help="also write the numbers of each study to a small file in DATA"
    )
    parser.add_argument("--figures", action="store_true", help="also write each figure as an SVG file")
    parser.add_argument("--no-animations", action="store_true", help="leave animations and pictures out")
    return parser.parse_args()


def make_page(options: argparse.Namespace) -> None:
    """Write the page and what the options ask for. Raises CartPoleError."""
    results = read_studies(options.folder)
    folder = options.output or Path("runs/report", time.strftime("%Y-%m-%d_%H-%M-%S"))
    write_config(folder, "report", {"studies": str(options.folder), "seed": None})
    if options.data is not None:
        write_data(results, options.data)
        print(f"{options.data}/ holds the numbers of {sum(bool(each.agents) for each in results)} studies")
    pictures = {} if options.no_animations else pictures_of(results)
    write_text(folder / PAGE, studies_page(results, pictures, emulators(results)))
    if options.figures:
        figures = {f"{each.name}_{one.name}": one for each in results for one in drawings(each)}
        write_figures(figures | {each.name: each for each in rank_agreements(results)}, folder)
    for each in results:
        if each.lost_finding:
            print(f'{each.name}: {" ".join(each.remarks)} That of these has digest: "{each.digest}"')
    for kind in (Status.FAILS, Status.CONTRADICTS, Status.DIFFERS, Status.EMPTY, Status.INCOMPLETE):
        if names := [each.name for each in results if each.status() is kind]:
            print(f"{kind}: {', '.join(names)}")
    print_end(results, folder)


def main() -> int:
    """Make the page; return the exit code."""
    try:
        make_page(parse_options())
    except (CartPoleError, OSError) as error:
        print(f"scripts/thesis/report.py: {' '.join(str(error).split())}", file=sys.stderr)
        return getattr(error, "exit_code", CartPoleError.exit_code)
    return 0


if __name__ == "__main__":
    sys.exit(main())
