"""cartpole-replay: drive the simulated cart with recorded motor values, and compare.

cartpole-replay from=runs/record/2026-11-21_12-00-00
cartpole-replay from=recordings/episode_000.csv pole=large 'parameters={cart_coulomb:0.8,latency:0.01}'

The simulated cart restarts from the recorded state every second, since any two carts diverge in an episode.
"""

from pathlib import Path

from cartpole_rl.commands.hydra_application.application import application
from cartpole_rl.workflows.checks import check_replay
from cartpole_rl.workflows.config import ReplayConfig


@application("replay", ReplayConfig)
def main(config: ReplayConfig, folder: Path) -> None:
    """Check, then replay."""
    check_replay(config)
    from cartpole_rl.workflows.replay import replay_recordings

    replay_recordings(config, folder)


if __name__ == "__main__":
    main()
