"""cartpole-preflight as a user runs it: on the emulated cart, and on a port whose cart is wired wrongly."""

from pathlib import Path

import hydra
import pytest
from command_line import in_process
from hydra_configs import shipped_choices
from serial_peer import Between

from cartpole_rl.checking import validated
from cartpole_rl.composition import compose
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.plants.emulated import EmulatedCart
from cartpole_rl.workflows.config import PreflightConfig
from cartpole_rl.workflows.preflight import next_command


def test_the_emulated_cart_is_ready(tmp_path: Path) -> None:
    words = ("plant=emulated", "plant.rehome=always", "emulator=large", "emulator.physics_step=0.001")
    done = in_process("preflight", *words, folder=tmp_path)
    assert (done.code, done.err) == (0, ""), done
    *checks, last, following = done.out.splitlines()
    assert len(checks) == 8
    assert all(line.startswith("OK   ") for line in checks)
    assert (
        last
        == "The cart is ready. Next, hold the pole up when asked (pretrained/large is for one of 0.66 m):"
    )
    assert following == f"cartpole-evaluate run=pretrained/large task=balance {' '.join(words)} episodes=1"
    with shipped_choices():
        hydra.compose("evaluate", following.split()[1:])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("given", "following"),
    [
        (("plant.port=COM3",), "medium task=balance plant=serial plant.port=COM3"),
        (
            ("plant.port=auto", "plant.baud=115200", "plant.pole_length=0.65"),
            "large task=balance plant=serial plant.port=auto plant.baud=115200 plant.pole_length=0.65",
        ),
        (
            ("plant.port=x", "plant.pole_length=1.0"),
            "medium task=balance plant=serial plant.port=x plant.pole_length=1.0",
        ),
    ],
)
def test_the_next_command_is_for_the_same_cart(given: tuple[str, ...], following: str) -> None:
    settings = dict(word.split("=") for word in given)
    config = validated(PreflightConfig, compose("preflight", settings))
    assert next_command(config) == f"cartpole-evaluate run=pretrained/{following} episodes=1"


def test_a_motor_the_wrong_way_round_is_refused(tmp_path: Path) -> None:
    with (
        EmulatedCart(EmulatorSettings(physics_step=1e-3)) as emulated,
        Between(emulated.port, motor=-1) as cable,
    ):
        done = in_process("preflight", "plant=serial", f"plant.port={cable.port}", folder=tmp_path)
    assert done.code == 1
    assert done.complaint.endswith("the cart is not ready: cart encoder failed")
    *before, last = done.out.splitlines()
    assert [line.split()[0] for line in before] == ["OK", "OK", "OK"]
    assert last.startswith("BAD  cart encoder: ")
    assert "swap the motor's two" in last


def test_a_port_without_a_cart_is_reported(tmp_path: Path) -> None:
    done = in_process("preflight", "plant.port=/dev/nosuch0", folder=tmp_path)
    assert done.code == 1
    assert done.out.startswith("BAD  link: /dev/nosuch0 does not exist: plug the cart in")
