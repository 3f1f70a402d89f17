"""repeat=: one episode of an earlier evaluation, with the same simulated cart from the same start."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from cartpole_rl.checking import checked
from cartpole_rl.errors import ConfigError
from cartpole_rl.evaluation.recordings import read_origin
from cartpole_rl.randomization.poles import Pole
from cartpole_rl.run_folder import CONFIG, METRICS, check_program
from cartpole_rl.tasks.episode import Origin
from cartpole_rl.workflows.checks import simulated_carts
from cartpole_rl.workflows.config import EvaluateConfig


@dataclass(frozen=True)
class Repetition:
    """An episode to repeat."""

    config: EvaluateConfig  # of that evaluation, with this cart only
    origin: Origin
    row: int  # in the batch; another batch or row would be rounded differently
    score: float  # in that evaluation


def repetition(config: EvaluateConfig) -> Repetition | None:
    """Return the episode that `config` repeats; None if it repeats none. Raises ConfigError."""
    run, number = config.repeat.run, config.repeat.episode
    if run is None and number is None:
        return None
    if run is None:
        raise ConfigError("repeat.run is missing; give repeat.run=..., the run folder of an evaluation")
    recorded, metrics = read_evaluation(run)
    count = len(metrics["episodes"])
    if number is None:
        raise ConfigError(f"repeat.episode is missing; give repeat.episode=0 to {count - 1}")
    if number >= count:
        raise ConfigError(f"repeat.episode={number}: repeat.run={run} has episodes 0 to {count - 1}")
    try:
        origin = read_origin(metrics, number)
    except LookupError:
        raise ConfigError(
            f"repeat.run={run}: its {METRICS} has no cart for each episode; evaluate again"
        ) from None
    batch_number = (recorded.get("repeat") or {}).get("episode")
    evaluation = same_evaluation(config, recorded, origin)
    row = (number if batch_number is None else batch_number) % simulated_carts(evaluation)
    return Repetition(evaluation, origin, row, metrics["episodes"][number]["score"])


def read_evaluation(run: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the config and the metrics of an evaluation in simulation. Raises ConfigError."""
    check_program("repeat.run", run, "evaluate")
    try:
        recorded = yaml.safe_load((run / CONFIG).read_text(encoding="utf-8"))
        metrics = json.loads((run / METRICS).read_text(encoding="utf-8"))
        plant, _ = metrics["plant"], recorded["evaluated"]
    except (OSError, ValueError, LookupError, TypeError, yaml.YAMLError):
        raise ConfigError(
            f"repeat.run={run}: it is not a finished run of cartpole-evaluate; give the run folder of one"
        ) from None
    if plant != "simulated":
        raise ConfigError(
            f"repeat.run={run}: it drove plant={plant}, whose episodes cannot be repeated; give a run "
            "with plant=simulated"
        )
    return recorded, metrics


def same_evaluation(config: EvaluateConfig, recorded: Mapping[str, Any], origin: Origin) -> EvaluateConfig:
    """Return the recorded evaluation with the agent of `config`, on that cart only. Raises ConfigError.

    The guard is the one of then if it was chosen, or if the agent is the same; else it is the agent's own.
    """
    former = {name: recorded[name] for name in EvaluateConfig.model_fields if name in recorded}
    own = {name: getattr(config, name) for name in ("run", "label", "repeat", "animation")}
    pole = {name: origin.parameters[name] for name in Pole.model_fields}
    of_cart = {name: value for name, value in origin.parameters.items() if name not in pole}
    one_cart: dict[str, Any] = {
        "parameters": of_cart,
        "pole": {"choices": {f"{2 * pole['pole_com']:.2f} m": pole}},
        "randomization": {},
    }
    same_agent = Path(former["run"]).resolve() == config.run.resolve()
    if former.get("guard") or same_agent:  # its numbers may be of all the poles then
        one_cart["guard"] = recorded["evaluated"]["guard"]
    return checked(EvaluateConfig, {**former, **own, **one_cart})
