#!/usr/bin/env python
"""What happens to the motor when the link, the clock, the host or an encoder fails?

    scripts/bench/safety.py --seeds 5 --jobs 6 --json safety.json

An agent drives emulated carts with a clock of their own through a TCP proxy. The proxy delays bytes in one or
both directions, from the start or from two seconds after START on: by a constant, by jitter, or in bursts (it
holds everything for a while in each second). It can also fall silent for good. Each case is driven with
`--seeds` carts and both firmwares, one episode each. Figures, by the cart's own journal:

    oldest       the longest time from the measurement of a state to the end of a motor value that answers it
    motor off    the time from the failure to the last nonzero motor value of the host, or of homing
    touched      the highest speed at which an end stop was touched, homing apart

The brake of the firmware is no motor value of the host. A command is quoted by the line that it ends with.
"""

import json
import math
import os
import random
import select
import socket
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import as_completed
from contextlib import closing
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from common import option_parser, positive_int, print_table, processes, write_json

from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.errors import CartPoleError, FrameError
from cartpole_rl.evaluation.episodes import run_episodes
from cartpole_rl.plants.emulated import EmulatedCart
from cartpole_rl.plants.serial.plant import SerialPlant
from cartpole_rl.reporting.texts import Cell
from cartpole_rl.wire.frames import FrameSplitter, decode_frame
from cartpole_rl.wire.messages import Home, Start, State
from cartpole_rl.workflows.build import TrainedAgent, evaluated_env, evaluated_settings, trained_agent
from cartpole_rl.workflows.config import EvaluateConfig, load_settings

AGENT = "pretrained/medium"
FIRMWARES = ("python", "c")
FAILS_AFTER = 2.0  # s after START, or after HOME
ROLLS_OUT = 2.0  # s for which the cart is watched after the end of an episode
LIMIT = 0.1  # m/s
LATENCY_US = 5000  # of the emulated motor, at most

Delay = Callable[[float, random.Random], float]  # s since the failure began -> s of delay


def constant(ms: float) -> Delay:
    """Return a constant delay."""
    return lambda since, dice: ms / 1e3


NO_DELAY = constant(0)


def jitter(ms: float) -> Delay:
    """Return a delay that is drawn for each packet; packets keep their order."""
    return lambda since, dice: dice.uniform(0, ms / 1e3)


def bursts(ms: float) -> Delay:
    """Return the delay of a link that holds everything for so long in each second, and then lets it go."""
    return lambda since, dice: max(0.0, ms / 1e3 - since % 1.0)


def cut(since: float, dice: random.Random) -> float:
    """Return the delay of a cable that was pulled."""
    return 1e6


@dataclass(frozen=True)
class Case:
    """One way to fail."""

    name: str
    to_cart: Delay = NO_DELAY
    to_host: Delay = NO_DELAY
    begins: str = "start"  # "open", "home" or "start": the failure begins at once, or 2 s after HOME or START
    emulator: dict[str, Any] = field(default_factory=dict)


def both(name: str, delay: Delay, begins: str = "start") -> Case:
    """Return a case in which both directions fail."""
    return Case(name, delay, delay, begins)


CASES = [
    Case("nothing fails"),
    both("2 ms each way", constant(2), "open"),
    both("15 ms each way", constant(15), "open"),
    both("40 ms each way", constant(40), "open"),
    Case("100 ms to the host", to_host=constant(100), begins="open"),
    Case("300 ms to the cart", to_cart=constant(300), begins="open"),
    both("40 ms each way, from 2 s on", constant(40)),
    both("150 ms each way, from 2 s on", constant(150)),
    Case("100 ms to the host, from 2 s on", to_host=constant(100)),
    Case("300 ms to the cart, from 2 s on", to_cart=constant(300)),
    both("jitter of up to 15 ms, from 2 s on", jitter(15)),
    both("jitter of up to 100 ms, from 2 s on", jitter(100)),
    both("bursts of 50 ms, from 2 s on", bursts(50)),
    both("bursts of 200 ms, from 2 s on", bursts(200)),
    both("cable pulled after 2 s", cut),
    Case("clock 1.3 times as fast", emulator={"clock_rate": 1.3}),
    Case("clock 0.6 times as fast", emulator={"clock_rate": 0.6}),
    both("host dies while the cart homes", cut, "home"),
    Case("pole encoder freezes at 30 s", emulator={"stuck_encoder": "pole", "stuck_at": 30.0}),
    Case("cart encoder freezes at 30 s", emulator={"stuck_encoder": "cart", "stuck_at": 30.0}),
]


class Proxy:
    """A TCP port before the cart's, which passes bytes on late. `states` has the times of states, in us."""

    def __init__(self, cart_url: str, case: Case, dice: random.Random) -> None:
        self._case, self._dice = case, dice
        host, port = cart_url.removeprefix("socket://").split(":")
        self._cart = socket.create_connection((host, int(port)))
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.url = f"socket://127.0.0.1:{self._listener.getsockname()[1]}"
        self.states: dict[int, int] = {}
        self.failed_us: int | None = None  # by the cart's clock, when the failure began
        self.started_us: int | None = None  # the same of START
        self._begins_at = 0.0 if case.begins == "open" else float("inf")
        self._newest_us = 0
        self._splitters = FrameSplitter(), FrameSplitter()  # from the host, from the cart
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        self._thread.join()
        self._cart.close()
        self._listener.close()

    def _run(self) -> None:
        self._listener.settimeout(0.1)
        while not self._ended.is_set():
            try:
                host, _ = self._listener.accept()
            except TimeoutError:
                continue
            with host:
                for line in (host, self._cart):
                    line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._pass_on(host)

    def _pass_on(self, host: socket.socket) -> None:
        """Pass bytes on until the host closes the port."""
        ways = ((host, self._cart, self._case.to_cart), (self._cart, host, self._case.to_host))
        waiting: list[list[tuple[float, bytes]]] = [[], []]
        while not self._ended.is_set():
            ready = select.select([host, self._cart], [], [], 0.001)[0]
            for number, (source, target, delay) in enumerate(ways):
                if source in ready:
                    data = source.recv(4096)
                    if not data:
                        return
                    self._look(number, data)
                    waiting[number].append((self._due(delay, waiting[number]), data))
                while waiting[number] and waiting[number][0][0] <= time.monotonic():
                    try:
                        target.sendall(waiting[number].pop(0)[1])
                    except OSError:
                        return

    def _due(self, delay: Delay, before: Sequence[tuple[float, bytes]]) -> float:
        now = time.monotonic()
        if now < self._begins_at:
            return now
        if self.failed_us is None:
            self.failed_us = self._newest_us
        return max(now + delay(now - self._begins_at, self._dice), before[-1][0] if before else 0.0)

    def _look(self, number: int, data: bytes) -> None:
        """Read what passes: the times of the states, and the frame after which the failure begins."""
        for stuffed in self._splitters[number].feed(data):
            try:
                message = decode_frame(stuffed).message
            except FrameError:
                continue
            if isinstance(message, State):
                self.states[message.tick] = self._newest_us = message.time_us
            elif isinstance(message, Start if self._case.begins == "start" else Home):
                self._begins_at = min(self._begins_at, time.monotonic() + FAILS_AFTER)
            if isinstance(message, Start):
                self.started_us = self._newest_us


@cache
def agent() -> TrainedAgent:
    """Return the agent that drives."""
    return trained_agent(Path(AGENT))


def drive(case: Case, firmware: str, seed: int) -> dict[str, Any]:
    """Drive one episode; return its figures."""
    with tempfile.TemporaryDirectory() as folder:
        journal = Path(folder, "journal")
        truth = {"firmware": firmware, "clock": "real", "port": "tcp", "seed": seed, "journal": journal}
        dice = random.Random(f"{case.name} {seed}")
        with (
            EmulatedCart(EmulatorSettings.model_validate(truth | case.emulator)) as cart,
            Proxy(cart.port, case, dice) as proxy,
        ):
            printed = episode_line(proxy.url)
            time.sleep(ROLLS_OUT)
        events = [json.loads(line) for line in journal.read_text().splitlines()]
    return {
        "case": case.name,
        "firmware": firmware,
        "seed": seed,
        "printed": printed,
        **figures(case, events, proxy),
    }


def episode_line(url: str) -> str:
    """Return the line with which an episode ends."""
    given = {"run": AGENT, "episodes": 1, "plant": "serial", "plant.port": url, "seed": 1, "threads": 1}
    config = load_settings(EvaluateConfig, given)
    try:
        with closing(evaluated_env(evaluated_settings(agent().training, config), config, print)) as env:
            (episode,) = run_episodes(env, agent().policy, 1)
            assert isinstance(env.plant, SerialPlant)
            error = env.plant.last_error
            return f"{episode.ended_by}: {error}" if error else f"{episode.ended_by}"
    except CartPoleError as error:
        return str(error).replace(url, "PORT")


def figures(case: Case, events: Sequence[dict[str, Any]], proxy: Proxy) -> dict[str, float | None]:
    """Return the figures of an episode from the cart's journal; None where there is nothing to measure."""
    ages, last = [], None
    for since, until, tick in values_of_the_host(events):
        ages.append((until - proxy.states.get(tick, since)) / 1e3)
        last = until
    homing = [event["us"] for event in events if "in_force" in event] if proxy.started_us is None else []
    if homing and proxy.failed_us is not None:
        last = homing[-1]
    started = proxy.started_us
    failed = case.emulator["stuck_at"] * 1e6 if "stuck_at" in case.emulator else proxy.failed_us
    touched = [event["touched"] for event in events if "touched" in event and event["us"] > (started or 1e18)]
    return {
        "oldest_ms": max(ages, default=None),
        "off_ms": None if failed is None or last is None else max(0.0, (last - failed) / 1e3),
        "touched": max(touched, default=0.0),
    }


def values_of_the_host(events: Sequence[dict[str, Any]]) -> Iterator[tuple[int, float, int]]:
    """Yield (since, until, tick) of each nonzero motor value of the host, in us, from its arrival on.

    It ends with the arrival of the next one, or when the firmware replaces it; never (infinity) if neither
    happens. A value that never came into force is left out.
    """
    in_force = 0
    for number, taken in enumerate(events):
        in_force = taken.get("in_force", in_force)
        if taken.get("took") != "SET_MOTOR" or not taken["motor"]:
            continue
        in_force_by, began = taken["us"] + LATENCY_US, in_force == taken["motor"]
        for event in events[number + 1 :]:
            began |= event.get("in_force") == taken["motor"]
            if not began and event["us"] > in_force_by:
                break  # the firmware refused it, or its time was over
            ended = began and "in_force" in event and event["in_force"] != taken["motor"]
            if event.get("took") in ("SET_MOTOR", "STOP") or ended:
                yield taken["us"], event["us"], taken["tick"]
                break
        else:
            if began:
                yield taken["us"], math.inf, taken["tick"]


def summary(results: Sequence[dict[str, Any]]) -> list[dict[str, Cell]]:
    """Return a row for each case."""
    rows: list[dict[str, Cell]] = []
    for case in CASES:
        of_case = [each for each in results if each["case"] == case.name]
        if not of_case:
            continue
        lines = Counter(each["printed"].split(";")[0].split(": check")[0] for each in of_case)

        def worst(name: str, group: Sequence[dict[str, Any]] = of_case) -> float | None:
            return max((each[name] for each in group if each[name] is not None), default=None)

        said = "; ".join(f"{count} x {line}" for line, count in lines.most_common(2))
        oldest, off = worst("oldest_ms"), worst("off_ms")
        rows.append(
            {
                "case": case.name,
                "episodes": len(of_case),
                "oldest, ms": "-" if oldest is None else f"{oldest:.0f}",
                "motor off, ms": "-" if off is None or case.begins == "open" else f"{off:.0f}",
                "touched, m/s": f"{worst('touched'):.3f}",
                "printed": said,
            }
        )
    return rows


def main() -> int:
    """Drive all cases; return 1 if a stop was touched faster than LIMIT or a motor value never ended."""
    parser = option_parser(__doc__)
    parser.add_argument("--seeds", type=positive_int, default=5, help="carts for each case and firmware (5)")
    parser.add_argument("--jobs", type=positive_int, default=os.cpu_count() or 1, help="episodes at once")
    parser.add_argument("--only", default="", help="only the cases whose name contains this")
    options = parser.parse_args()
    jobs = [
        (case, firmware, seed)
        for seed in range(options.seeds)
        for case in range(len(CASES))
        if options.only in CASES[case].name
        for firmware in FIRMWARES
    ]
    results = []
    with processes(options.jobs) as pool:
        for done in as_completed([pool.submit(drive_number, *job) for job in jobs]):
            results.append(done.result())
            print(json.dumps(results[-1]), flush=True)
    results.sort(key=lambda each: (each["case"], each["firmware"], each["seed"]))
    write_json(options.json, results)
    print_table(summary(results))
    too_fast = sum(each["touched"] > LIMIT for each in results)
    endless = sum(each["oldest_ms"] == math.inf for each in results)
    print(f"{len(results)} episodes; a stop was touched faster than {LIMIT} m/s in {too_fast}")
    print(f"a motor value never ended in {endless}")
    return 1 if too_fast or endless else 0


def drive_number(number: int, firmware: str, seed: int) -> dict[str, Any]:
    """Drive the case of this number, in a process of its own."""
    return drive(CASES[number], firmware, seed)


if __name__ == "__main__":
    sys.exit(main())
