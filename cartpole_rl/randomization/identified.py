"""Draws carts from a table of carts: the posterior of an identification, correlations included."""

import csv
import zlib
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cartpole_rl.errors import ConfigError
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.randomization.poles import HEAVIER, Pole, PoleSettings
from cartpole_rl.randomization.randomizer import Draws, Randomizer
from cartpole_rl.randomization.ranges import IdentifiedSettings
from cartpole_rl.rig.parameters import PARAMETERS, Bound, check_names

Array = NDArray[np.float64]
# what NumPy raises for a file that is missing, cut off, changed or another one
UNREADABLE = (OSError, ValueError, LookupError, TypeError, EOFError, RuntimeError, BadZipFile, zlib.error)


class IdentifiedCarts(Draws):
    """Draws with replacement from `table` [P, M], and a `prior_share` of all draws from `prior` instead.

    The prior keeps an agent from relying too much on an identification. Parameters not `identified` are
    always the prior's; with None all are identified. Raises ConfigError for a number that is not finite.
    """

    def __init__(
        self,
        table: Tensor,
        prior: Draws,
        prior_share: float,
        longest_latency: float,
        identified: Collection[str] | None = None,
    ) -> None:
        if not table.isfinite().all():
            row = int((~table.isfinite()).any(1).nonzero()[0])
            raise ConfigError(f"carts to draw from: {CartParameters.names()[row]} is not finite")
        self.table, self.prior, self.prior_share = table.to(prior.nominal), prior, prior_share
        flags = [identified is None or name in identified for name in CartParameters.names()]
        self._identified = torch.tensor(flags, device=self.table.device).unsqueeze(1)
        self._longest_latency = longest_latency  # s, of this table and of any that may replace it
        self.nominal = self.table.median(1).values

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """Return parameters of `count` carts, [P, count]."""
        table, keeps = self._draw_table(count, generator, self.prior_share)
        return torch.where(keeps, table, self.prior.draw(count, generator))

    def ends(self, name: str, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Return a draw with `name` at the low end of its range, and the same with it at the high end.

        Two tables [P, count], equal if a cart has the identified `name`. If the prior has a share, it
        has at least half of the carts here, so that a small share is not overlooked.
        """
        share = max(self.prior_share, 0.5) if self.prior_share else 0.0
        table, keeps = self._draw_table(count, generator, share)
        low, high = self.prior.ends(name, count, generator)
        return torch.where(keeps, table, low), torch.where(keeps, table, high)

    def _draw_table(
        self, count: int, generator: torch.Generator, prior_share: float
    ) -> tuple[Tensor, Tensor]:
        """Return carts of the table [P, count], and which of their numbers are kept, [P, count] bool.

        No number is kept of a `prior_share` of the carts.
        """
        device = self.nominal.device
        which = torch.randint(self.table.shape[1], (count,), generator=generator, device=device)
        from_prior = torch.rand(count, generator=generator, device=device) < prior_share
        return self.table[:, which], self._identified & ~from_prior

    def highest(self, name: str) -> float:
        """Return the highest value that a draw of `name`, a parameter of the cart, can have."""
        found = float(self.table[CartParameters.names().index(name)].max())
        if name == "latency":
            found = max(found, self._longest_latency)
        return max(self.prior.highest(name), found)

    def limits(self) -> dict[str, tuple[float, float]]:
        """Return the least and the largest value of each identified parameter."""
        flags = self._identified.squeeze(1).tolist()
        rows = zip(CartParameters.names(), flags, self.table, strict=True)
        return {name: (float(row.min()), float(row.max())) for name, identified, row in rows if identified}

    def can_differ_from_zero(self, name: str) -> bool:
        """Return whether a draw of `name` can be anything but 0."""
        row = self.table[CartParameters.names().index(name)]
        return self.prior.can_differ_from_zero(name) or bool((row != 0).any())


def identified_carts(
    settings: IdentifiedSettings,
    cart: Mapping[str, float],
    poles: PoleSettings,
    device: torch.device | str = "cpu",
) -> IdentifiedCarts:
    """Return the draws that `settings` describe. Raises ConfigError if the file is missing or damaged.

    With `poles` other than the identified one, the identified cart carries these.
    """
    prior = Randomizer(cart, poles, settings.ranges, device)
    try:
        posterior, identified = read_posterior(settings.posterior)
    except UNREADABLE as error:
        remedy = "copy it again, or run cartpole-identify from=<its run>"
        if settings.posterior.suffix.lower() == ".csv":
            remedy = "write names of parameters in its first line, and a number of each in every other one"
        if isinstance(error, FileNotFoundError):
            error, remedy = (
                FileNotFoundError("there is no such file"),
                "put it back, or start in the folder that its path counts from",
            )
        raise ConfigError(
            f"randomization.posterior={settings.posterior} cannot be read: {error}; {remedy}"
        ) from None
    if not poles.is_single or not is_about(poles.nominal, posterior):
        if settings.posterior.suffix.lower() == ".csv" and (
            given := posterior.keys() & Pole.model_fields.keys()
        ):
            raise ConfigError(
                f"randomization.posterior={settings.posterior} has {', '.join(sorted(given))} of another "
                "pole than pole=: leave these columns out, or choose that pole"
            )
        posterior = {name: values for name, values in posterior.items() if name not in Pole.model_fields}
        identified = [name for name in identified if name in posterior]
    rows = []
    for name, nominal in zip(CartParameters.names(), prior.nominal.tolist(), strict=True):
        values = posterior.get(name, np.array([nominal]))
        rows.append(widened(values, settings.widen, PARAMETERS[name].bound))
    table = torch.from_numpy(np.stack(np.broadcast_arrays(*rows))).float()
    return IdentifiedCarts(table, prior, settings.prior_share, 0.0, identified)


def widened(values: Array, factor: float, bound: Bound) -> Array:
    """Return values [M] `factor` times as far from their median, within the bound.

    Distances are those of logarithms where the parameter must be above 0.
    """
    median = np.median(values)
    if bound.low == 0 and not bound.low_allowed:
        return np.minimum(median * (values / median) ** factor, bound.high)
    return np.clip(median + factor * (values - median), bound.low, bound.high)


def read_posterior(path: Path) -> tuple[dict[str, Array], list[str]]:
    """Return carts, [M] of each parameter by name, and the names that are identified.

    A .csv file has a row for each cart, and all of its columns are identified. Raises UNREADABLE.
    """
    if path.suffix.lower() == ".csv":
        return read_samples(path)
    with path.open("rb") as file, np.load(file) as stored:
        names, table, identified = (stored[name] for name in ("names", "carts", "identified"))
    if names.ndim != 1 or table.shape[0] != len(names) or table[0].ndim != 1 or not table[0].size:
        raise ValueError("it holds no table of carts")
    carts = dict(zip(names.tolist(), table.astype(np.float64, casting="same_kind"), strict=True))
    return carts, [str(name) for name in identified]


def read_samples(path: Path) -> tuple[dict[str, Array], list[str]]:
    """Return `read_posterior` of a .csv file. Raises ConfigError for an impossible value, UNREADABLE."""
    with path.open(newline="", encoding="utf-8-sig") as file:
        reader = csv.DictReader(file, skipinitialspace=True)
        rows, names = [*reader], reader.fieldnames or []
    if not rows:
        raise ValueError("it holds no cart")
    if twice := [name for name in names if names.count(name) > 1]:
        raise ValueError(f"it has two columns {twice[0]}")
    for place, row in enumerate(rows, 1):
        if None in row or None in row.values():
            raise ValueError(f"cart {place} has more or fewer numbers than the first line has names")
    carts = {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}
    check_names(carts)
    for name, values in carts.items():
        for value in (values.min(), values.max()):
            if not (bound := PARAMETERS[name].bound).holds(value):
                raise ConfigError(f"randomization.posterior={path}: {name} is {value:g}; it must be {bound}")
    return carts, list(carts)


def is_about(pole: Pole, posterior: Mapping[str, Any]) -> bool:
    """Return True where `pole` may be the pole of a posterior: by its length and its mass, if it has them."""
    mass, com = (
        float(np.median(posterior.get(name, getattr(pole, name)))) for name in ("pole_mass", "pole_com")
    )
    return pole.is_about(2 * com) and 1 / HEAVIER < mass / pole.pole_mass < HEAVIER
