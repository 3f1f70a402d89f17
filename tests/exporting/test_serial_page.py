"""The page drives an emulated cart over Web Serial, in a headless browser.

The cart has the lockstep clock: nothing depends on how fast this machine is.
"""

import copy
import json
import re
import time
from pathlib import Path
from typing import Any

import pytest
import torch
from browser import in_browser
from emulator_host import SILENCE, EmulatorHost, emulator
from serial_bridge import Bridge, bridged, frames
from shown_pages import needs_browser

from cartpole_rl.envs.build import environment
from cartpole_rl.plants.specs import Numbers, OneCartPlant, PlantOutput
from cartpole_rl.rig.hardware import nominal_hardware
from cartpole_rl.wire.frames import Frame
from cartpole_rl.wire.messages import Flags, Hello, Home, Info, Nack, Reason, SetMotor, Start, State, Stop
from cartpole_rl.workflows.build import TrainedAgent, network_of

FAR_AND_FAST = 4_400  # counts from the middle, where a pushed cart has 0.6 m/s
VECTORS = json.loads(Path("tests/wire/vectors.json").read_text(encoding="utf-8"))

AGREED = """
element("connect").click();
await until(() => real?.asking || real?.done);
element("agree").click();
"""
DRIVEN = f"""{AGREED}
await until(() => real.driving || real.done);
"""
ENDED = """
await until(() => real.done);
report([real.line, real.answered, real.soft]);
"""
SILENT = """
WIRE.timeout = 0.3;
WIRE.stopAttempts = 2;
const earlier = real.states;
await until(() => real.states > earlier + 10 || real.done); // waits for each of them for 0.3 s
real.take = () => {};
"""
CODEC = """
const bytesOf = (hex) => hex.split(" ").map((byte) => parseInt(byte, 16));
const framesOf = (hex) => [...new Splitter().feed(bytesOf(hex))].map(decodedFrame);
const good = VECTORS.good.map(({ hex, type, sequence, flags, fields }) => {
  const values = WIRE.messages[type].fields.map((field) => fields[field]), frame = framesOf(hex)[0];
  const bytes = [...encodedFrame(type, values, sequence, flags)];
  return [bytes, bytesOf(hex), frame.name, frame.sequence, frame.flags, frame.message];
});
const damaged = VECTORS.damaged.map(({ hex }) => {
  return framesOf(`${hex} ${VECTORS.good[0].hex}`).map((frame) => frame?.name);
});
const taker = new SerialCart(null, null, null);
for (const tick of [8, 10, 9, 10]) {
  const run = encodedFrame("STATE", [tick, 0, 0, 0, 0, 0, 0, 0], 0).slice(0, -1);
  taker.take(decodedFrame(run));
}
document.body.textContent = JSON.stringify({ good, damaged, newest: [taker.fresh.tick, taker.states] });
"""


def read(bridge: Bridge, kind: type) -> list[Any]:
    """The messages of a kind that the cart sent."""
    return [frame.message for frame in frames(bridge.read) if isinstance(frame.message, kind)]


def written(bridge: Bridge, kind: type) -> list[Any]:
    """The messages of a kind that the page sent."""
    return [frame.message for frame in frames(bridge.written) if isinstance(frame.message, kind)]


def check_answers(bridge: Bridge, answered: int) -> None:
    """Each motor value answers another state that the cart has sent, in their order."""
    ticks = [motor.tick for motor in written(bridge, SetMotor)]
    assert len(ticks) == answered > 0
    assert ticks == sorted(set(ticks))
    assert set(ticks) <= {state.tick for state in read(bridge, State)}


def check_stopped(bridge: Bridge, host: EmulatorHost) -> None:
    """The last word of the page is STOP, and the cart stands disarmed."""
    assert isinstance(frames(bridge.written)[-1].message, Stop)
    state = host.ask(Hello())[-1]
    assert not state.flags & (Flags.ARMED | Flags.HOMING)
    assert isinstance(state.message, State)
    assert state.message.motor_applied == 0


def answer(
    page: str, script: str, folder: Path, stopped: bool = True, answers: bool = False, **emulated: Any
) -> tuple[str, Bridge]:
    """The line with which a script on the page of an emulated cart ends, once the cart is checked."""
    with emulator(**emulated) as host, bridged(page, script, host, folder) as bridge:
        line, answered, _ = bridge.report()
        if answers:
            check_answers(bridge, answered)
        if stopped:
            check_stopped(bridge, host)
    return line, bridge


class RecordedPlant(OneCartPlant):
    """A cart that moves as another one did while the page drove it, whatever is sent."""

    def __init__(self, states: list[Frame], soft_limit_counts: int) -> None:
        super().__init__()
        self.states = iter(states)
        self.track_end = soft_limit_counts * self.hardware.encoders.metres

    @property
    def track_half_length(self) -> torch.Tensor:
        return torch.tensor([self.track_end])

    def reset_one(self) -> PlantOutput[Numbers]:
        self.time_us = 0
        return self.step_one(0)

    def step_one(self, motor: int) -> PlantOutput[Numbers]:
        frame = next(self.states)
        state, self.limited = frame.message, frame.flags & Flags.SOFT_LIMIT
        assert isinstance(state, State)
        dt = (state.time_us - self.time_us) * 1e-6
        self.time_us, self.motor = state.time_us, state.motor_applied
        return PlantOutput((state.cart_counts, state.pole_counts), (dt,), (self.motor,), (False,), (False,))

    def drove(self, given: int) -> int:
        return self.motor if self.limited else given


@torch.no_grad()
def chosen(trained: TrainedAgent, bridge: Bridge) -> list[int]:
    """The motor values that this program chooses on the states that the page answered."""
    states = {state.tick: frame for frame in frames(bridge.read) if isinstance(state := frame.message, State)}
    answered = [states[motor.tick] for motor in written(bridge, SetMotor)]
    plant = RecordedPlant([*answered, answered[-1]], read(bridge, Info)[-1].soft_limit_counts)
    cart, network = environment(trained.training, plant).one_cart, copy.deepcopy(network_of(trained)).double()
    step, motors = cart.reset(), []
    for _ in answered:
        action = int(network(torch.tensor(step.observation, dtype=torch.float64)).argmax())
        motors.append(cart.sent_motor(action))
        step = cart.step(action)
    return motors


@needs_browser
def test_its_frames_are_those_of_the_vectors(page: str, tmp_path: Path) -> None:
    found = in_browser(page, f"const VECTORS = {json.dumps(VECTORS)};{CODEC}", tmp_path)
    for vector, (encoded, expected, *frame) in zip(VECTORS["good"], found["good"], strict=True):
        assert encoded == expected
        assert frame == [vector[key] for key in ("type", "sequence", "flags", "fields")]
    for *damaged, next_one in found["damaged"]:
        assert not any(damaged)
        assert next_one == VECTORS["good"][0]["type"]
    assert found["newest"] == [10, 2]


@needs_browser
def test_without_web_serial_one_line_says_so(page: str, tmp_path: Path) -> None:
    script = """
    drawSerial();
    document.body.textContent = JSON.stringify([element("connect").disabled, element("link").textContent]);
    """
    without = page.replace("<body>", "<body><script>delete Navigator.prototype.serial;</script>")
    disabled, words = in_browser(without, script, tmp_path)
    assert disabled
    assert "has no Web Serial" in words


@needs_browser
def test_it_homes_a_cart_swings_its_pole_up_and_stops(
    page: str, medium_agent: TrainedAgent, tmp_path: Path
) -> None:
    stand = """
    await until(() => upright > 1 || real.done);
    element("stop").click();
    """
    with emulator() as host, bridged(page, DRIVEN + stand + ENDED, host, tmp_path) as bridge:
        line, answered, soft_limit = bridge.report()
        assert line == "Stopped by hand."
        check_answers(bridge, answered)
        check_stopped(bridge, host)
    before, *_, measured = [information.soft_limit_counts for information in read(bridge, Info)]
    assert soft_limit == measured != before
    assert len(written(bridge, Home)) == len(written(bridge, Start)) == 1
    motors = [motor.motor for motor in written(bridge, SetMotor)]
    assert any(motors)
    assert motors == chosen(medium_agent, bridge)


@needs_browser
def test_a_hidden_page_stops_a_cart_on_a_bad_line(page: str, tmp_path: Path) -> None:
    hide = """
    await until(() => real.answered >= 100 || real.done);
    Object.defineProperty(document, "hidden", { value: true });
    document.dispatchEvent(new Event("visibilitychange"));
    """
    shares = dict.fromkeys(("frame_loss", "frame_corruption", "frame_duplication", "frame_reordering"), 0.005)
    line, _ = answer(page, DRIVEN + hide + ENDED, tmp_path, answers=True, **shares)
    assert line.startswith("The page was hidden")


@needs_browser
def test_a_port_that_never_closes_or_is_in_use_leaves_the_reader_a_way_on(page: str, tmp_path: Path) -> None:
    script = """
    const close = port.close.bind(port);
    port.close = () => close().then(() => new Promise(() => {}));
    element("connect").click();
    await until(() => real?.asking || real?.done);
    element("stop").click();
    await until(() => real.done);
    drawSerial();
    const first = real, canConnect = shown("connect");
    port.open = async () => { throw new DOMException("Failed to open serial port.", "NetworkError"); };
    element("connect").click();
    await until(() => real !== first && real.done);
    report([[first.line, canConnect, real.line], 0, 0]);
    """
    (ended, can_connect, refused), _ = answer(page, script, tmp_path)
    assert ended == "Stopped by hand."
    assert can_connect
    assert refused == (
        "Failed to open serial port. End other programs and pages that use the port, or reload this page."
    )


@needs_browser
def test_a_cart_of_another_rig_is_refused(page: str, tmp_path: Path) -> None:
    other = nominal_hardware().model_copy(update={"pole_counts_per_turn": 4000, "right_switch": 1})
    line, bridge = answer(page, AGREED + ENDED, tmp_path, hardware=other.model_dump())
    words = "pole_counts_per_turn 4000, not 4096, switches 128, not 0"
    assert line == f"This cart is not of the agent's kind; it reports {words}."
    assert not written(bridge, Home)


@needs_browser
def test_another_version_of_the_protocol_is_refused(page: str, tmp_path: Path) -> None:
    script = f"WIRE.version = 3; WIRE.connectAttempts = 2; {AGREED}{ENDED}"
    line, _ = answer(page, script, tmp_path, stopped=False)
    assert line.startswith("No cart answers: it speaks protocol version 2, this page 3; update")


@needs_browser
@pytest.mark.parametrize("quietly", [False, True], ids=["error", "end of the stream"])
def test_a_pulled_cable_ends_it_with_one_line(page: str, tmp_path: Path, quietly: bool) -> None:
    script = f"port.endsQuietly = {str(quietly).lower()}; {AGREED}{ENDED}"
    with emulator() as host, bridged(page, script, host, tmp_path) as bridge:
        end = time.monotonic() + SILENCE
        while not written(bridge, Home) and time.monotonic() < end:
            time.sleep(0.02)
        host.process.terminate()  # the end of the emulator is that of its cable
        host.process.wait(SILENCE)
        line, *_ = bridge.report()
        assert isinstance(frames(bridge.written)[-1].message, Stop)
    assert line.startswith("The cable to the cart was pulled")
    assert not written(bridge, Start)


@needs_browser
@pytest.mark.parametrize(
    ("trouble", "words"),
    [
        ({"reset_at": 3.0}, "The cart has restarted"),
        ({"stuck_encoder": "cart"}, "The cart latched a fault"),
    ],
    ids=["restart", "fault"],
)
def test_trouble_ends_it_with_one_line(
    page: str, tmp_path: Path, trouble: dict[str, Any], words: str
) -> None:
    line, bridge = answer(page, AGREED + ENDED, tmp_path, **trouble)
    assert line.startswith(words)
    assert not written(bridge, Start)


@needs_browser
@pytest.mark.parametrize("is_fatal", [False, True], ids=["passing", "fatal"])
def test_a_failed_write_stops_the_cart_unless_its_cable_was_pulled(
    page: str, tmp_path: Path, is_fatal: bool
) -> None:
    """A motor value fails, and the STOP after it."""
    fail = f"""
    await until(() => real.answered >= 20 || real.done);
    Object.assign(port, {{ failures: 2, isFatal: {str(is_fatal).lower()} }});
    """
    line, _ = answer(page, DRIVEN + fail + ENDED, tmp_path, stopped=not is_fatal)
    if is_fatal:
        assert line.startswith("The cable to the cart was pulled")
    else:
        assert line == "The port took no bytes: check its cable, then connect again."


@needs_browser
@pytest.mark.parametrize("is_lost", [False, True], ids=["heard", "lost"])
def test_home_is_asked_again_while_the_brake_acts(page: str, tmp_path: Path, is_lost: bool) -> None:
    """The last host left a homed cart at speed. BUSY after a first HOME that was lost means the same."""
    script = f"""
    const send = SerialCart.prototype.send;
    let left = {int(is_lost)};
    SerialCart.prototype.send = function (name, ...values) {{
      const isLost = name === "HOME" && left-- > 0;
      WIRE.answerTimeout = isLost ? 0.1 : 200; // a repetition would pass another period
      if (!isLost) return send.call(this, name, ...values);
      this.sequence = (this.sequence + 1) & 0xff;
      return this.sequence;
    }};
    SerialCart.prototype.consent = async function () {{
      do this.asked = this.send("HELLO");
      while ((await this.seen(true)).motor_applied !== -255);
    }};
    element("connect").click();
    await until(() => real?.newest?.flags & WIRE.flags.HOMING || real?.driving || real?.done);
    element("stop").click();
    {ENDED}
    """
    with emulator() as host:
        host.home()
        host.ask(Start())
        while host.ask(SetMotor(255))[-1].message.cart_counts < FAR_AND_FAST:
            pass
        with bridged(page, script, host, tmp_path) as bridge:
            line, *_ = bridge.report()
            assert line == "Stopped by hand."
            check_stopped(bridge, host)
    refused = [(refusal.type, refusal.reason) for refusal in read(bridge, Nack)]
    assert set(refused) == {(Home.TYPE, Reason.BUSY)}
    assert len(written(bridge, Home)) > len(refused)


@needs_browser
def test_a_cart_that_homes_although_its_acknowledgement_was_lost_is_not_refused(
    page: str, tmp_path: Path
) -> None:
    script = f"""
    const take = SerialCart.prototype.take;
    let lost = 0;
    SerialCart.prototype.take = function (frame) {{
      if (frame?.name !== "ACK" || NAMES[frame.message.type] !== "HOME" || lost++) take.call(this, frame);
    }};
    {AGREED}
    await until(() => real.soft || real.done);
    element("stop").click();
    {ENDED}
    """
    line, bridge = answer(page, script, tmp_path)
    assert line == "Stopped by hand."
    assert {(refusal.type, refusal.reason) for refusal in read(bridge, Nack)} == {(Home.TYPE, Reason.BUSY)}


@needs_browser
@pytest.mark.parametrize(
    ("event", "words"),
    [
        ("window.dispatchEvent(new KeyboardEvent('keydown', { key: 'Escape' }));", "Stopped by hand."),
        (SILENT, "No state came for 0.3 s"),
        (
            "WIRE.offCentre = -1; WIRE.startTimeout = 1;",
            "The cart is off the middle of its track: bring it back",
        ),
    ],
    ids=["escape", "silence", "off the middle"],
)
def test_no_episode_begins(page: str, tmp_path: Path, event: str, words: str) -> None:
    script = f"{AGREED} await until(() => real.newest.flags & WIRE.flags.HOMING); {event} {ENDED}"
    line, _ = answer(page, script, tmp_path)
    assert line.startswith(words)


@needs_browser
def test_an_agent_that_is_told_the_length_asks_whether_it_is_right(page: str, tmp_path: Path) -> None:
    asked = """
    WIRE.needsLength = true;
    const asked = [];
    for (const length of [DATA.trained, DATA.poles.length - 1]) {
      element("pole").value = length;
      element("pole").dispatchEvent(new Event("input"));
      element("connect").click();
      await until(() => real?.asking || real?.done);
      asked.push(real.line);
      element("stop").click();
      await until(() => real.done);
      drawSerial();
      asked.push(element("simulated").disabled);
      real = null;
    }
    report([asked, 0, 0]);
    """
    (first, disabled, second, _), _ = answer(page, asked, tmp_path)
    end = "m long? If not, press Stop, choose its length, and connect again. The cart moves by"
    assert (first.partition(end)[0], second.partition(end)[0]) == ("Is your pole 0.36 ", "Is your pole 1.00 ")
    assert not disabled


@needs_browser
def test_a_number_that_is_not_finite_ends_it(page: str, tmp_path: Path) -> None:
    broken = "await until(() => real.answered >= 10 || real.done); LAYERS[0].bias[0] = Infinity;"
    line, _ = answer(page, f"{DRIVEN} {broken} {ENDED}", tmp_path, answers=True)
    assert line == "The agent gave a number that is not finite."


@needs_browser
def test_it_waits_until_a_hand_holds_the_pole_up(balancing_page: str, tmp_path: Path) -> None:
    line, _ = answer(balancing_page, AGREED + ENDED, tmp_path, answers=True, start="upright")
    assert re.match(r"The pole fell\.|The cart reached the end of its track\.", line)
