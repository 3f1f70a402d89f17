"""The simulated cart and the initial state of each episode, in metrics.json and recordings."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from cartpole_rl.tasks.episode import Episode, Origin


def stored_origins(episodes: Sequence[Episode]) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Return the parameters that all simulated carts share, and the rest for each, for metrics.json.

    Both are empty if a cart was not simulated. `read_origin` is the inverse.
    """
    stored = [stored_origin(episode.origin) for episode in episodes if episode.origin is not None]
    if len(stored) < len(episodes):
        return {}, [{} for _ in episodes]
    carts = [each["cart"] for each in stored]
    shared = {name: value for name, value in carts[0].items() if all(cart[name] == value for cart in carts)}
    own = [{name: value for name, value in cart.items() if name not in shared} for cart in carts]
    return {"cart": shared}, [{**each, "cart": cart} for each, cart in zip(stored, own, strict=True)]


def stored_origin(origin: Origin) -> dict[str, dict[str, float]]:
    """Return a cart and its initial state with numbers as short as possible."""
    return {
        "cart": {name: as_stored(value) for name, value in origin.parameters.items()},
        "start": {name: as_stored(value) for name, value in origin.state.items()},
    }


def read_origin(metrics: Mapping[str, Any], number: int) -> Origin:
    """Return the cart and the initial state of an episode in metrics.json. Raises LookupError."""
    episode = metrics["episodes"][number]
    return Origin({**metrics["cart"], **episode["cart"]}, episode["start"])


def as_stored(value: float) -> float:
    """Return the shortest number that is `value` as float32: 0.7 instead of 0.699999988079071."""
    short = float(str(np.float32(value)))
    return short if np.float32(short) == np.float32(value) else value
