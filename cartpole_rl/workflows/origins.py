"""The simulated cart and the start of each episode, as metrics.json and recordings hold them."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from cartpole_rl.tasks.episode import Episode, Origin


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
