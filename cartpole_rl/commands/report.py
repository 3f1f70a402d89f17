"""cartpole-report: make one HTML page from run folders.

cartpole-report studies=runs/reproduce/full
cartpole-report studies=runs/reproduce/full data=docs/results/thesis
cartpole-report 'runs=runs/train/2026-11-21_12-00-00_multirun' 'compare="runs/train/2026-11-22*"'

The page of studies follows the list of the thesis. That of other runs groups them by settings that differ.
"""

from pathlib import Path

from cartpole_rl.commands.hydra_application.application import application
from cartpole_rl.workflows.checks import check_report
from cartpole_rl.workflows.config import ReportConfig


@application("report", ReportConfig)
def main(config: ReportConfig, folder: Path) -> None:
    """Check, then make the page."""
    check_report(config)
    from cartpole_rl.workflows.pages.report import make_report

    make_report(config, folder)


if __name__ == "__main__":
    main()
