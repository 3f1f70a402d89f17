"""cartpole-preflight as a user runs it: on the emulated cart, and on a port without a cart."""

import shlex
from pathlib import Path

import hydra
import pytest
from command_line import COARSE, in_process

from cartpole_rl.checking import validated
from cartpole_rl.composition import compose, reading_conf
from cartpole_rl.terminal import noting
from cartpole_rl.workflows.config import PreflightConfig
from cartpole_rl.workflows.preflight import next_command

CHECKS = ["link", "limits", "homing", "cart encoder", "pole encoder", "dead-band", "latency", "soft limit"]


def test_the_emulated_cart_is_ready(tmp_path: Path) -> None:
    words = (
        "plant=emulated",
        "plant.rehome=always",
        "emulator=large",
        "emulator.journal=journal",
        "emulator.physics_step=0.001",
    )
    done = in_process("preflight", *words, folder=tmp_path)
    assert (done.code, done.err) == (0, ""), done
    *checks, last, following = done.out.splitlines()
    assert [line.partition(":")[0] for line in checks] == [f"OK   {check}" for check in CHECKS]
    assert (
        last
        == "The cart is ready. Next, hold the pole up when asked (pretrained/large is for one of 0.66 m):"
    )
    again = " ".join(word for word in words if "journal" not in word)
    assert following == f"cartpole-evaluate run=pretrained/large task=balance {again} episodes=1"
    with reading_conf():
        hydra.compose("evaluate", following.split()[1:])
    journal = tmp_path / "journal"
    taken = [line for line in journal.read_text().splitlines() if '"took"' in line]
    assert '"STOP"' in taken[-1]  # it is left disarmed
    assert list(tmp_path.iterdir()) == [journal]


def test_a_stepper_whose_pole_still_swings_is_ready(tmp_path: Path) -> None:
    """It does not feel its pole, which goes on swinging, and it glides after a push."""
    done = in_process("preflight", "cart=stepper", "plant=emulated", COARSE, folder=tmp_path)
    assert (done.code, done.err) == (0, ""), done
    assert len(done.out.splitlines()) == len(CHECKS) + 2


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


def test_the_file_of_another_cart_is_quoted_in_the_next_command() -> None:
    config = validated(PreflightConfig, compose("preflight", {"cart": "stepper", "plant.port": "x"}))
    with noting(["cart=my cart.yaml", "plant.port=x"]):
        following = next_command(config)
    words = ["cart=my cart.yaml", "plant=serial", "plant.port=x", "pole=<yours>.yaml"]
    assert shlex.split(following) == ["cartpole-identify", *words]


def test_a_port_without_a_cart_is_reported(tmp_path: Path) -> None:
    done = in_process("preflight", "plant.port=/dev/nosuch0", folder=tmp_path)
    assert done.code == 1
    assert done.complaint.endswith("the cart is not ready: link failed")
    assert done.out.startswith("BAD  link: /dev/nosuch0 does not exist: plug the cart in")
