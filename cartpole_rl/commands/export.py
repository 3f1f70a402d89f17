"""cartpole-export: write a trained agent for other programs.

cartpole-export run=runs/train/2026-11-21_12-00-00 format=weights
cartpole-export run=pretrained/medium format=web
cartpole-export -m run=pretrained/medium format=weights,onnx,c,web
"""

from pathlib import Path

from cartpole_rl.commands.hydra_application.application import application
from cartpole_rl.workflows.checks import check_export
from cartpole_rl.workflows.config import ExportConfig


@application("export", ExportConfig)
def main(config: ExportConfig, folder: Path) -> None:
    """Check, then export."""
    check_export(config)
    from cartpole_rl.workflows.export import export

    export(config, folder)


if __name__ == "__main__":
    main()
