"""cartpole-preflight as a user runs it: on the emulated cart, and on a port whose cart is wired wrongly."""

from pathlib import Path

from command_line import in_process
from serial_peer import Between

from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.plants.emulated_cart import EmulatedCart


def test_the_emulated_cart_is_ready(tmp_path: Path) -> None:
    words = ("plant=emulated", "emulator=large", "emulator.cart_coulomb_right=0.8")
    done = in_process("preflight", *words, folder=tmp_path)
    assert (done.code, done.err) == (0, ""), done
    *checks, last, following = done.out.splitlines()
    assert len(checks) == 8
    assert all(line.startswith("OK   ") for line in checks)
    assert last == "The cart is ready. Next:"
    assert following == "cartpole-identify plant=emulated"
    assert not list(tmp_path.iterdir())


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


def test_a_port_has_to_be_given(tmp_path: Path) -> None:
    done = in_process("preflight", folder=tmp_path)
    assert done.code == 2
    assert "plant.port is missing; give plant.port=/dev/ttyUSB0" in done.complaint


def test_a_simulated_cart_has_nothing_to_check(tmp_path: Path) -> None:
    done = in_process("preflight", "plant=simulated", folder=tmp_path)
    assert done.code == 2
    assert "plant" in done.complaint


def test_help_has_examples(tmp_path: Path) -> None:
    assert "cartpole-preflight plant.port=auto" in in_process("preflight", "--help", folder=tmp_path).out
