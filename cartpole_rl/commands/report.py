"""Writes what episodes were worth: metrics.json, and figures of them."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cartpole_rl.commands.run_folder import METRICS, write_json
from cartpole_rl.evaluation.metrics import episode_metrics, summarize
from cartpole_rl.randomization.poles import PoleSettings
from cartpole_rl.reporting.animation import write_gif
from cartpole_rl.reporting.figures import behaviour, learning_curve, save
from cartpole_rl.tasks.episode import Episode, Origin


def report(
    folder: Path,
    episodes: Sequence[Episode],
    plant: str,
    pole: PoleSettings,
    x_max: float,
    link: Mapping[str, int] | None = None,
    history: Sequence[Mapping[str, float]] = (),
) -> dict[str, Any]:
    """Write metrics.json and figures/ into `folder`; returns what `summarize` makes of the episodes.

    The behaviour and the animation show the first episode; `history` adds the learning curve.
    """
    figures = [episode_metrics(episode, x_max) for episode in episodes]
    summary = summarize(figures)
    head = {"plant": plant, "pole": pole.name, **(link or {})}
    cart, origins = stored_origins(episodes)
    told = [{**figure, **origin} for figure, origin in zip(figures, origins, strict=True)]
    write_json(folder / METRICS, {**head, **summary, **cart, "episodes": told})
    pictures = folder / "figures"
    save(behaviour(episodes[0], f"First episode, plant={plant}", x_max), pictures / "behaviour.png")
    write_gif(episodes[0], pictures / "episode.gif", 2 * pole.nominal.pole_com, x_max, f"plant={plant}")
    if history:
        save(learning_curve([("score", list(history))]), pictures / "learning_curve.png")
    return summary


def stored_origins(episodes: Sequence[Episode]) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """What metrics.json holds of the simulated carts: what all have in common, and what each has of its own.

    Nothing where a cart was not simulated. `read_origin` puts both together again.
    """
    stored = [stored_origin(episode.origin) for episode in episodes if episode.origin is not None]
    if len(stored) < len(episodes):
        return {}, [{} for _ in episodes]
    carts = [each["cart"] for each in stored]
    shared = {name: value for name, value in carts[0].items() if all(cart[name] == value for cart in carts)}
    own = [{name: value for name, value in cart.items() if name not in shared} for cart in carts]
    return {"cart": shared}, [{**each, "cart": cart} for each, cart in zip(stored, own, strict=True)]


def stored_origin(origin: Origin) -> dict[str, dict[str, float]]:
    """A cart and its start as they are written down, each number as short as it can be."""
    return {
        "cart": {name: as_stored(value) for name, value in origin.parameters.items()},
        "start": {name: as_stored(value) for name, value in origin.state.items()},
    }


def read_origin(metrics: Mapping[str, Any], number: int) -> Origin:
    """The cart and the start of an episode in metrics.json. Raises LookupError where they are not there."""
    episode = metrics["episodes"][number]
    return Origin({**metrics["cart"], **episode["cart"]}, episode["start"])


def as_stored(value: float) -> float:
    """The shortest number that is `value` as a float32 again: 0.7 instead of 0.699999988079071."""
    short = float(str(np.float32(value)))
    return short if np.float32(short) == np.float32(value) else value
