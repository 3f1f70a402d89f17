"""The C firmware on a Cortex-M4 in QEMU, driven over its UART, with physics at its pins."""

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import qemu_cart

pytest.importorskip("mujoco", reason='pip install "cartpole_rl[emulator]"')
pytestmark = pytest.mark.skipif(
    bool(qemu_cart.missing_programs()),
    reason=f"needs {', '.join(qemu_cart.PROGRAMS)}: apt-get install",
)

from cartpole_rl.errors import LinkError  # noqa: E402
from cartpole_rl.plants.serial.cart import SerialCart  # noqa: E402
from cartpole_rl.plants.serial.errors import RefusedError  # noqa: E402
from cartpole_rl.plants.settings import SerialSettings  # noqa: E402
from cartpole_rl.rig.hardware import nominal_hardware  # noqa: E402
from cartpole_rl.wire.messages import Fault, Flags, State  # noqa: E402

PUSH, FAR = 110, 400  # motor value, and counts from the middle: 9 mm
SHUTTLE = Path(__file__).parents[1] / "support" / "shuttle"
SETTINGS = SerialSettings(port="later", timeout=20, answer_timeout=2, connect_timeout=20, home_timeout=600)


@contextmanager
def board(*options: str) -> Iterator[str]:
    """Run a board that has just booted; yield its port."""
    command = [sys.executable, str(qemu_cart.__file__), json.dumps({"physics_step": 1e-3}), *options]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        yield json.loads(process.stdout.readline())["port"]
    finally:
        process.terminate()
        process.wait()
        process.stdout.close()
    assert process.returncode == 0


@pytest.fixture(autouse=True)
def _a_slow_machine_is_not_suspended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(SerialCart, "longest_suspension", 60.0)


def home(cart: SerialCart, watch: Callable[[State], None] = lambda state: None) -> None:
    """Home; again if this machine was so busy that the board heard nothing for half a second."""
    while not cart.flags & Flags.HOMED:
        try:
            cart.home(watch)
        except LinkError as error:
            assert "ended homing" in str(error) or "is too slow" in str(error)  # noqa: PT017


def start(cart: SerialCart) -> None:
    """Start; again if this machine was so busy that the link seemed slow."""
    while True:
        try:
            return cart.start()
        except LinkError as error:
            if "is too slow" not in str(error):
                raise


class MovedError(Exception):
    """The cart moves."""


def test_it_moves_when_it_homes_and_stops_when_its_host_falls_silent() -> None:
    def watch(state: State) -> None:
        if state.cart_counts < -FAR:
            assert cart.flags & Flags.HOMING
            raise MovedError

    with board() as port, SerialCart(SETTINGS.model_copy(update={"port": port})) as cart:
        assert cart.information.pole_counts_per_turn == nominal_hardware().pole_counts_per_turn
        with pytest.raises(RefusedError, match="it is not homed"):
            start(cart)
        with pytest.raises(MovedError):
            home(cart, watch)
        while cart.flags & Flags.HOMING:
            state = cart.get_state()
        assert (state.motor_applied, state.fault, cart.flags) == (0, Fault.NONE, Flags(0))


@pytest.mark.nightly  # homing takes half a minute of the clock
def test_it_homes_drives_and_stops_like_any_cart_and_then_drives_by_its_own_policy() -> None:
    with (
        board("--policy", str(SHUTTLE)) as port,
        SerialCart(SETTINGS.model_copy(update={"port": port})) as cart,
    ):
        home(cart)
        before = cart.poll_state()
        assert abs(before.cart_counts) < 100
        assert abs(before.pole_counts - 2048) <= 8
        start(cart)
        pushed = []
        while not pushed or pushed[-1].cart_counts < FAR:
            cart.set_motor(PUSH)
            try:
                pushed.append(cart.get_state())
            except LinkError as error:  # this machine was busy: the board refused a value that came too late
                assert "over three periods old" in str(error)  # noqa: PT017
        assert max(state.pole_counts for state in pushed) > before.pole_counts + 3
        silent = [cart.poll_state() for _ in range(4)]
        assert silent[-1].motor_applied == 0
        assert cart.flags & Flags.WATCHDOG
        assert silent[-1].fault == Fault.NONE
        cart.stop()
        cart.start_policy()
        states = [cart.poll_state() for _ in range(100)]
        assert {110, -110} <= {state.motor_applied for state in states}
        assert states[-1].fault == Fault.NONE
        assert cart.flags & Flags.ARMED
