"""cartpole-find-port: list the USB serial ports, each with its board's chip, and name the one of the cart."""

import time
from collections.abc import Callable

from cartpole_rl.errors import PortError
from cartpole_rl.plants.serial.port import UsbPort, cart_like, changes, described, found_ports
from cartpole_rl.settings import Positive, Settings
from cartpole_rl.terminal import as_word

LOOK_EVERY = 0.2  # s
REMEDY = (
    "plug the cart in and switch it on; if it is, try another cable (many only charge), another USB socket, "
    "and install the driver of its chip (CP210x, CH340, FTDI)"
)

PortList = Callable[[], list[UsbPort]]


class FindPortConfig(Settings):
    """The settings of cartpole-find-port."""

    watch: bool = False  # name the port that vanishes or appears
    timeout: Positive = 60.0  # s that `watch` waits for it


def find_port(config: FindPortConfig) -> None:
    """List the ports, or watch them change. Raises PortError if there is none."""
    print(listing(found_ports()) if not config.watch else watched(found_ports, config.timeout))


def listing(ports: list[UsbPort]) -> str:
    """Return a line for each port, and the port of the cart. Raises PortError if there is none."""
    if not ports:
        raise PortError(f"no USB serial port was found: {REMEDY}")
    lines = [f"{port.device}  {described(port)}" for port in ports]
    carts = cart_like(ports)
    if len(carts) == 1:
        lines.append(f"The cart is probably on it. Next: {preflight_on(carts[0])}")
    elif carts:
        lines.append("`cartpole-find-port watch=true` finds out which of them is the cart")
    else:
        lines.append("None of them has a chip used on carts (CP210x, CH340, FTDI, Espressif, ST-LINK)")
    return "\n".join(lines)


def preflight_on(port: UsbPort) -> str:
    """Return the command that checks the cart on `port`."""
    return f"cartpole-preflight plant=serial {as_word('plant.port', port.device)}"


def watched(ports: PortList, timeout: float) -> str:
    """Return a line that names the next port to vanish or appear. Raises PortError after `timeout` s."""
    before = ports()
    print(f"{len(before)} found. Unplug the cart now, or plug it in if it is unplugged ...", flush=True)
    end = time.monotonic() + timeout
    while time.monotonic() < end:
        vanished, appeared = changes(before, ports())
        if changed := [*vanished, *appeared]:
            what = "vanished" if vanished else "appeared"
            lines = [
                f"{port.device} {what}: {as_word('plant.port', port.device)}  {described(port)}"
                for port in changed
            ]
            again = "Plug it in again before you use it. Next:" if vanished else "Next:"
            return "\n".join([*lines, f"{again} {preflight_on(changed[0])}"])
        time.sleep(LOOK_EVERY)
    raise PortError(f"no port appeared or vanished within {timeout:g} s: {REMEDY}")
