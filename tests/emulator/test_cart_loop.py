"""The main loop of a board, firmware/src/cart_loop.c, on hardware that the test sets."""

import ctypes
from pathlib import Path

import pytest
from firmwares import needs_compiler

from cartpole_rl.emulator.c_firmware import compile_c, firmware_folder
from cartpole_rl.wire.frames import FrameSplitter, decode_frame, encode_frame
from cartpole_rl.wire.messages import Fault, Hello, Message, StartPolicy, State

pytestmark = needs_compiler
BENCH = Path(__file__).parents[1] / "support" / "loop" / "bench.c"
PERIOD = 20_000
WRAP = 2**32


class Bench:
    """A homed cart with a policy; its clock shows `start_us` at boot. All share one hardware."""

    def __init__(self, library: Path, start_us: int = 0) -> None:
        self.library = ctypes.CDLL(str(library))
        self.library.bench_poll.restype = ctypes.c_bool
        self.library.bench_output.restype = self.library.bench_written_when_asked.restype = ctypes.c_size_t
        self.library.bench_motor.restype = ctypes.c_int16
        self._start_us = start_us
        self.library.bench_boot(ctypes.c_uint32(start_us))

    def send(self, message: Message) -> None:
        frame = encode_frame(message, 1)
        self.library.bench_send(frame, ctypes.c_size_t(len(frame)))

    def ends(self, times_us: list[int]) -> list[int]:
        """Poll at these times since the boot; return those at which a period ended."""
        poll = self.library.bench_poll
        return [us for us in times_us if poll(ctypes.c_uint32((self._start_us + us) % WRAP))]

    @property
    def output(self) -> bytes:
        room = ctypes.create_string_buffer(65_536)
        length = self.library.bench_output(room)
        return room.raw[:length]

    @property
    def states(self) -> list[State]:
        messages = [decode_frame(run).message for run in FrameSplitter().feed(self.output)]
        return [message for message in messages if isinstance(message, State)]


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("loop") / "loop.so"
    return compiled(path)


def compiled(path: Path, *flags: str) -> Path:
    compile_c(path, [*sorted(firmware_folder().glob("src/*.c")), BENCH], "-shared", "-fPIC", *flags)
    return path


@pytest.mark.parametrize("start_us", [0, WRAP - 1, WRAP - 50_000])
def test_periods_do_not_drift_while_the_clock_of_the_board_wraps(start_us: int, library: Path) -> None:
    bench = Bench(library, start_us)
    assert bench.ends(list(range(0, 10 * PERIOD + 1, 500))) == [PERIOD * n for n in range(1, 11)]
    assert [state.time_us for state in bench.states] == [PERIOD * n for n in range(1, 11)]
    assert bench.output[0] == 0  # ends the text of a boot loader


@pytest.mark.parametrize("late", [1_000, 9_999, 10_000, 20_000, 45_000])
def test_a_late_period_is_not_followed_by_a_very_short_one(late: int, library: Path) -> None:
    bench = Bench(library)
    first = PERIOD + late
    ends = bench.ends([first, *range(first + 1, first + 3 * PERIOD, 1)])
    assert ends[0] == first
    assert PERIOD // 2 < ends[1] - first <= PERIOD
    assert ends[2] - ends[1] == PERIOD


def test_a_policy_is_asked_after_state_was_written_and_its_value_is_put_on_the_motor(library: Path) -> None:
    bench = Bench(library)
    bench.send(StartPolicy())
    bench.send(Hello())
    assert bench.ends([0, 100, PERIOD]) == [PERIOD]
    assert bench.library.bench_written_when_asked() == len(bench.output)
    assert bench.states[-1].motor_applied == 0
    assert bench.library.bench_motor() == 100


def test_an_end_switch_is_read_at_each_look(tmp_path: Path) -> None:
    bench = Bench(compiled(tmp_path / "switches.so", "-DCART_SWITCHES=2"))
    bench.send(StartPolicy())
    bench.send(Hello())
    bench.ends([0, 100, PERIOD])
    assert bench.library.bench_motor() == 100
    bench.library.bench_press(3)  # the rig has no left one
    bench.ends([PERIOD + 1000, PERIOD + 2000])
    assert bench.library.bench_motor() == 0
    bench.ends([2 * PERIOD])
    assert bench.states[-1].fault == Fault.HARD_LIMIT | Fault.RIGHT_SWITCH
