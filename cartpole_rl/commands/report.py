"""cartpole-report: make one HTML page from run folders.

cartpole-report runs=runs/train/2026-11-21_12-00-00_multirun
cartpole-report 'runs=runs/train/2026-11-21_12-00-00_multirun' 'compare="runs/train/2026-11-22*"'

The page groups the runs by the settings that differ.
"""

from pathlib import Path

from cartpole_rl.commands.hydra_application.application import application
from cartpole_rl.workflows.config import ReportConfig


@application("report", ReportConfig)
def main(config: ReportConfig, folder: Path) -> None:
    """Make the page."""
    from cartpole_rl.workflows.pages.report import make_report

    make_report(config, folder)


if __name__ == "__main__":
    main()
