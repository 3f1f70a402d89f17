"""Carts drawn from a table of carts keep the parameters of a cart together; some come from the prior."""

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from cartpole_rl.choices import group_choices
from cartpole_rl.errors import ConfigError
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.plants.simulated import SimulatedPlant
from cartpole_rl.randomization.identified import IdentifiedCarts, identified_carts
from cartpole_rl.randomization.poles import PoleSettings
from cartpole_rl.randomization.randomizer import Randomizer
from cartpole_rl.randomization.ranges import IdentifiedSettings, Range

MASS, VISCOUS = (CartParameters.names().index(name) for name in ("cart_mass", "cart_viscous"))


@pytest.fixture
def heavy_carts(ip02: dict[str, float], medium: PoleSettings) -> Callable[..., IdentifiedCarts]:
    """Carts with twice as much friction as mass; those of the prior have 5 to 6 kg."""

    def build(prior_share: float, spoilt: float = 1.0) -> IdentifiedCarts:
        prior = Randomizer(ip02, medium, {"cart_mass": Range(absolute=(5.0, 6.0))})
        table = prior.nominal.unsqueeze(1).repeat(1, 100)
        table[MASS] = torch.linspace(0.5, 1.0, 100)
        table[VISCOUS] = 2 * table[MASS]
        table[VISCOUS, 7] *= spoilt
        return IdentifiedCarts(table, prior, prior_share, longest_latency=0.03)

    return build


def test_rows_stay_together(heavy_carts: Callable) -> None:
    drawn = heavy_carts(0.0).draw(500, torch.Generator().manual_seed(0))
    assert torch.equal(drawn[VISCOUS], 2 * drawn[MASS])
    assert len(drawn[MASS].unique()) > 50


def test_a_number_that_is_not_finite_is_refused(heavy_carts: Callable) -> None:
    with pytest.raises(ConfigError, match="cart_viscous is not finite"):
        heavy_carts(0.0, spoilt=float("nan"))


def test_the_share_of_the_prior(heavy_carts: Callable) -> None:
    drawn = heavy_carts(0.2).draw(5000, torch.Generator().manual_seed(0))
    assert 0.17 < (drawn[MASS] >= 5).float().mean() < 0.23


def test_a_plant_goes_on_with_other_carts(
    heavy_carts: Callable, make_plant: Callable[..., SimulatedPlant]
) -> None:
    plant = make_plant(8)
    plant.replace_randomizer(heavy_carts(0.0))
    plant.reset()
    assert torch.equal(plant.parameters.cart_viscous, 2 * plant.parameters.cart_mass)
    assert heavy_carts(0.0).longest_delay() == 0.03


def identified(folder: Path, **columns: list[float]) -> IdentifiedSettings:
    """The posterior of an identification, as a file."""
    names, posterior = list(columns), folder / "posterior.npz"
    np.savez(posterior, names=names, carts=np.array([*columns.values()]), identified=names)
    return IdentifiedSettings(posterior=posterior, widen=1.0, prior_share=0.0, ranges={})


@pytest.mark.parametrize(
    ("pole", "masses"), [("medium", {0.12, 0.13}), ("large", {0.23}), ("both", {0.127, 0.23})]
)
def test_the_identified_cart_carries_the_given_pole(
    pole: str, masses: set[float], ip02: dict[str, float], tmp_path: Path
) -> None:
    """The identified pole, if the given one is about the same, and else the given one."""
    settings = identified(tmp_path, cart_mass=[0.9, 1.0], pole_mass=[0.12, 0.13], pole_com=[0.18] * 2)
    poles = PoleSettings(**group_choices("pole")[pole])
    drawn = identified_carts(settings, ip02, poles).draw(100, torch.Generator().manual_seed(0))
    pole_mass = drawn[CartParameters.names().index("pole_mass")]
    assert {round(mass, 3) for mass in pole_mass.tolist()} == masses
    assert {round(mass, 3) for mass in drawn[MASS].tolist()} == {0.9, 1.0}


@pytest.fixture(params=["carts.csv", "CARTS.CSV"])
def sampled(
    request: pytest.FixtureRequest, ip02: dict[str, float], medium: PoleSettings, tmp_path: Path
) -> Callable[..., IdentifiedCarts]:
    """The carts of a .csv file; a mass without a column is 2 to 3 kg."""
    path, ranges = tmp_path / request.param, {"cart_mass": Range(absolute=(2.0, 3.0))}

    def build(text: str, **settings: Any) -> IdentifiedCarts:
        path.write_text(text)
        return identified_carts(
            IdentifiedSettings(posterior=path, **{"ranges": ranges, **settings}), ip02, medium
        )

    return build


def drawn(carts: IdentifiedCarts) -> CartParameters:
    return CartParameters(carts.draw(500, torch.Generator().manual_seed(0)))


def numbers(values: torch.Tensor) -> list[float]:
    """The different numbers, in order."""
    return sorted({round(value, 4) for value in values.tolist()})


def test_samples_of_a_file_stay_together_by_row(sampled: Callable) -> None:
    """A parameter without a column is drawn from its range."""
    carts = drawn(sampled("\ufeffcart_viscous, cart_coulomb\n0.1,0.5\n0.2,0.6\n0.4,0.3\n"))
    pairs = {
        (round(a, 4), round(b, 4))
        for a, b in zip(carts.cart_viscous.tolist(), carts.cart_coulomb.tolist(), strict=True)
    }
    assert pairs == {(0.1, 0.5), (0.2, 0.6), (0.4, 0.3)}
    assert carts.cart_mass.min() >= 2
    assert carts.cart_mass.std() > 0.2


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "holds no cart"),
        ("cart_mass\n", "holds no cart"),
        ("cart_mass\nheavy\n", "could not convert string to float: 'heavy'; write names of parameters"),
        ("cart_mass,latency\n0.5\n", "cart 1 has more or fewer numbers"),
        ("cart_mass,cart_mass\n0.5,0.6\n", "it has two columns cart_mass; write names of"),
        ("cart_mas\n0.5\n", "did you mean 'cart_mass'"),
        ("cart_mass\n0.5\n-1\n", "cart_mass is -1; it must be above 0"),
        ("cart_mass\nnan\n", "cart_mass is nan; it must be above 0"),
        ("pole_com\n0.3\n", "has pole_com of another pole than pole=: leave these columns out"),
    ],
)
def test_samples_that_are_no_carts_are_refused(sampled: Callable, text: str, reason: str) -> None:
    with pytest.raises(ConfigError, match=reason) as raised:
        sampled(text)
    assert "\n" not in str(raised.value)


def test_a_pole_column_alone_is_drawn(sampled: Callable) -> None:
    assert numbers(drawn(sampled("pole_mass\n0.12\n0.13\n")).pole_mass) == [0.12, 0.13]


def test_a_cart_without_mass_is_not_drawn(sampled: Callable) -> None:
    """A mass is widened in its logarithm, friction until it is 0."""
    carts = drawn(sampled("cart_mass,cart_coulomb\n0.3,0\n0.7,0.2\n2,0.3\n", widen=2.0))
    assert numbers(carts.cart_mass) == [0.1286, 0.7, 5.7143]
    assert numbers(carts.cart_coulomb) == [0, 0.2, 0.4]


def test_the_longest_delay_is_that_of_a_cart_with_the_jitter_of_the_range(sampled: Callable) -> None:
    jitter = {"latency_jitter": Range(absolute=(0.0, 0.01))}
    assert sampled("latency\n0.02\n0.01\n", ranges=jitter).longest_delay() == pytest.approx(0.03)


def saved(*arrays: object, **named: object) -> bytes:
    file = io.BytesIO()
    np.savez(file, **named) if named else np.save(file, *arrays)
    return file.getvalue()


HARMS: dict[str, Callable[[bytes], bytes]] = {
    "cut": lambda content: content[: len(content) // 2],
    "other bytes": lambda content: content[:99] + bytes(each ^ 255 for each in content[99:]),
    "one array": lambda content: saved(np.arange(3)),
    "one number": lambda content: saved(names=["cart_mass"], carts=np.ones(1), identified=["cart_mass"]),
    "empty": lambda content: b"",
    "start of a zip": lambda content: b"PK",
}


@pytest.mark.parametrize("harm", HARMS)
def test_a_damaged_posterior_is_refused_in_one_line(
    harm: str, ip02: dict[str, float], medium: PoleSettings, tmp_path: Path
) -> None:
    settings, posterior = identified(tmp_path, cart_mass=[0.9, 1.0]), tmp_path / "posterior.npz"
    assert identified_carts(settings, ip02, medium)
    posterior.write_bytes(HARMS[harm](posterior.read_bytes()))
    with pytest.raises(ConfigError, match=r"cannot be read: .*; copy it again, or run cartp") as raised:
        identified_carts(settings, ip02, medium)
    assert str(raised.value).startswith(f"randomization.posterior={posterior}")
    assert "\n" not in str(raised.value)
