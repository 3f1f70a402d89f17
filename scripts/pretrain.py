#!/usr/bin/env python3
"""Put the agent of a training into the package, as run=pretrained/<name>.

    cartpole-train experiment=medium seed=12 hydra.run.dir=runs/pretrain/medium
    scripts/pretrain.py medium runs/pretrain/medium

copies its last checkpoint to cartpole_rl/pretrained/medium/, with the provenance of the training.
"""

import argparse
import json
from pathlib import Path

from cartpole_rl.files import write_text
from cartpole_rl.learning.checkpoints import load_agent, save_agent
from cartpole_rl.run_folder import PRETRAINED, PRETRAINED_AGENT, PROVENANCE, find_agent
from cartpole_rl.workflows.build import provenance

PACKAGE = Path(__file__).parents[1] / "cartpole_rl"
LARGEST = 300_000  # bytes


def main() -> None:
    """Copy the agent."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("name", help="of the pretrained agent, such as medium")
    parser.add_argument("run", type=Path, help="run folder of the training, or a checkpoint in it")
    options = parser.parse_args()
    folder = PACKAGE / PRETRAINED / options.name
    agent = load_agent(options.run)
    origin = provenance(options.run, agent)
    if find_agent(options.run).stat().st_size > LARGEST:
        parser.error(f"{options.run}: its checkpoint is larger than {LARGEST} bytes")
    origin["command"] = [word for word in origin["command"] if not word.startswith("hydra.run.dir=")]
    save_agent(folder / PRETRAINED_AGENT, agent)
    write_text(folder / PROVENANCE, json.dumps(origin, indent=2) + "\n")
    size = (folder / PRETRAINED_AGENT).stat().st_size / 1000
    print(f"run={PRETRAINED}/{options.name}: {size:.0f} kB, score {agent.score:.0f} in training")


if __name__ == "__main__":
    main()
