"""The plant on a scripted cart: endings, clocks and faults. On emulated carts: test_recentring.py."""

import signal
import threading
from collections.abc import Iterable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from serial_peer import HANGING, CartPeer, HomingForever, quick_settings
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from cartpole_rl.errors import FaultError, LinkError, PortError
from cartpole_rl.plants.serial.errors import NotReadyError
from cartpole_rl.plants.serial.plant import SerialPlant
from cartpole_rl.rig.hardware import nominal_hardware
from cartpole_rl.signals import send_to_main_thread
from cartpole_rl.wire.frames import Frame
from cartpole_rl.wire.messages import (
    ClearFault,
    Fault,
    Flags,
    Home,
    Message,
    Nack,
    Reason,
    SetMotor,
    Start,
    Stop,
)


@pytest.fixture
def plant(peer: CartPeer) -> Iterator[SerialPlant]:
    plant = SerialPlant(quick_settings(peer.port))
    yield plant
    plant.close()


def step(plant: SerialPlant, motor: int) -> TensorDict:
    return plant.step(TensorDict({"motor": torch.tensor([[motor]])}, [1]))["next"]


def test_specs(plant: SerialPlant) -> None:
    check_env_specs(plant)


def test_a_reset_homes_and_arms(peer: CartPeer, plant: SerialPlant) -> None:
    first = plant.reset()
    assert first["counts"].tolist() == [[0, HANGING]]
    assert first["dt"].item() == pytest.approx(0.02)
    assert peer.flags & Flags.ARMED
    assert [type(frame.message) for frame in peer.received if isinstance(frame.message, Home | Start)] == [
        Home,
        Start,
    ]


class SilentOnceArmed(CartPeer):
    """A cart that accepts START or START_POLICY, and sends no state after it."""

    def answer(self, frame: Frame) -> Iterable[bytes]:
        answers = [*super().answer(frame)]
        return answers[:1] if self.flags & Flags.ARMED else answers


@pytest.mark.parametrize("on_board", [False, True])
def test_a_reset_that_fails_after_start_disarms_the_cart(on_board: bool) -> None:
    # without a HELLO in silence, whose state could still come after START
    with (
        SilentOnceArmed() as peer,
        closing(SerialPlant(quick_settings(peer.port, nudge_after=60))) as plant,
    ):
        plant.on_board = on_board
        with pytest.raises(LinkError, match="no state came"):
            plant.reset()
        assert not peer.flags & Flags.ARMED


class InterruptedHoming(HomingForever):
    """A cart that homes until it is stopped; Ctrl-C is pressed as soon as it homes."""

    def carry_out(self, message: Message) -> None:
        super().carry_out(message)
        if isinstance(message, Home):
            send_to_main_thread(signal.SIGINT)


def test_ctrl_c_stops_a_cart_that_homes_before_anything_else_ends() -> None:
    with InterruptedHoming() as peer, closing(SerialPlant(quick_settings(peer.port))) as plant:
        with pytest.raises(KeyboardInterrupt):
            plant.reset()
        assert not peer.flags & Flags.HOMING  # though the plant is still open


def hear_only_stop(peer: CartPeer) -> None:
    """Let all other frames be lost; the states go on."""
    peer.answer = lambda frame: (
        CartPeer.answer(peer, frame) if isinstance(frame.message, Stop) else [peer.next_state()]
    )


def driven(plant: SerialPlant, motor: int) -> int:
    """The value that drove, of a period with `motor`."""
    plant.step_one(motor)
    return plant.drove(motor)


def test_a_value_that_is_replaced_by_0_is_the_one_that_counts(
    peer: CartPeer, plant: SerialPlant, monkeypatch: pytest.MonkeyPatch
) -> None:
    plant.reset()
    commanded = []
    plant.on_command = commanded.append
    monkeypatch.setattr(plant.cart, "_is_late", lambda: True)
    given = TensorDict({"motor": torch.tensor([[200]])}, [1])
    plant._step(given)
    assert driven(plant, 200) == 0
    assert given["motor"].item() == 0
    assert commanded == [0, 0]
    monkeypatch.undo()
    assert driven(plant, 200) == 200
    assert peer.messages(SetMotor)[-1].motor == 200


def test_a_value_that_was_lost_did_not_drive(peer: CartPeer, plant: SerialPlant) -> None:
    """What drove is the value before, also in a period at whose end the watchdog or a fault sets it to 0."""
    plant.reset()
    assert driven(plant, 100) == 100
    answer = peer.answer
    hear_only_stop(peer)
    assert driven(plant, 200) == 100
    peer.state, peer.flags = replace(peer.state, motor_applied=0), peer.flags | Flags.WATCHDOG
    assert driven(plant, 200) == 100
    assert driven(plant, 200) == 0
    peer.answer, peer.flags = answer, peer.flags & ~Flags.WATCHDOG
    assert driven(plant, 200) == 200
    hear_only_stop(peer)
    peer.state = replace(peer.state, motor_applied=0, fault=Fault.STALL)
    assert driven(plant, 100) == 200


def limited(peer: CartPeer, *applied: int) -> None:
    """Let a limit of the track act, with these motor values in force at the ends of the next periods."""
    answer, values = peer.answer, iter(applied)

    def override(frame: Frame) -> Iterator[bytes]:
        *answers, _ = answer(frame)
        yield from answers
        yield peer.next_state(motor_applied=next(values, 0))

    peer.answer, peer.flags = override, peer.flags | Flags.SOFT_LIMIT


def test_a_value_that_a_limit_of_the_track_replaced_did_not_drive(peer: CartPeer, plant: SerialPlant) -> None:
    """What drove is the cart's own value, 0 or the brake's: nothing is learned of the one that was sent."""
    plant.reset()
    commanded = []
    plant.on_command = commanded.append
    limited(peer, -255, 0)
    for motor in (-255, 0):
        given = TensorDict({"motor": torch.tensor([[200]])}, [1])
        assert plant._step(given)["motor_applied"].item() == motor
        assert given["motor"].item() == motor
    assert commanded == [200, 200]
    del peer.answer
    peer.flags &= ~Flags.SOFT_LIMIT
    assert driven(plant, 200) == 200


def test_the_value_that_drove_longest_counts_where_a_limit_begins_or_ends(
    peer: CartPeer, plant: SerialPlant
) -> None:
    plant.reset()
    limited(peer, 0, -255, 200, 200)
    assert driven(plant, 200) == 200  # the limit took it away at the end
    assert driven(plant, 200) == -255
    assert driven(plant, 200) == -255  # the brake let go at the end
    peer.flags &= ~Flags.SOFT_LIMIT
    assert driven(plant, 200) == 200


def test_a_value_that_a_fault_refused_did_not_drive(peer: CartPeer, plant: SerialPlant) -> None:
    """Even if the state with the fault was lost: the next one has the counts, and the time that passed."""
    plant.reset()
    plant.step_one(100)
    answer = peer.answer

    def refuse(frame: Frame) -> Iterator[bytes]:
        peer.answer = answer
        yield peer.encode(Nack(frame.sequence, frame.message.TYPE, Reason.FAULT_LATCHED))
        yield peer.next_state(cart_counts=400)
        peer.next_state(cart_counts=800, fault=Fault.STALL)

    peer.answer = refuse
    frame = plant.step_one(200)
    assert plant.ended_by == "fault"
    assert plant.fault == Fault.STALL
    assert plant.drove(200) == 100
    assert frame.counts[0] == 800
    assert frame.dt[0] > 0.05


def test_a_count_that_the_host_finds_frozen_is_homed_again(peer: CartPeer, plant: SerialPlant) -> None:
    plant.reset()
    plant.distrust()
    plant.reset()
    assert len(peer.messages(Home)) == 2


@pytest.mark.parametrize("motor", [256, -30_000])
def test_a_motor_value_that_no_cart_has_is_a_lost_link(
    peer: CartPeer, plant: SerialPlant, motor: int
) -> None:
    """It would be observed and learned from."""
    plant.reset()
    hear_only_stop(peer)
    peer.state = replace(peer.state, motor_applied=motor)
    frame = plant.step_one(100)
    assert (frame.truncated, frame.motor_applied) == ((True,), (0,))
    assert f"has motor value {motor}, which is beyond 255" in str(plant.last_error)


def test_the_call_before_the_start_finds_the_cart_ready_and_disarmed(
    peer: CartPeer, plant: SerialPlant
) -> None:
    found = []
    plant.before_start = lambda: found.append(peer.flags & (Flags.HOMED | Flags.ARMED))
    plant.reset()
    assert found == [Flags.HOMED]
    assert peer.flags & Flags.ARMED


def test_a_step_carries_the_carts_own_numbers(peer: CartPeer, plant: SerialPlant) -> None:
    plant.reset()
    peer.state = replace(peer.state, cart_counts=-123, pole_counts=-5000)
    frame = step(plant, 77)
    assert frame["counts"].tolist() == [[-123, -5000]]
    assert frame["motor_applied"].item() == 77
    assert not frame["done"]


def test_dt_is_the_carts_clock_across_its_wrap(peer: CartPeer) -> None:
    peer.state = replace(peer.state, time_us=2**32 - 1_000_000)
    with closing(SerialPlant(quick_settings(peer.port))) as plant:
        plant.reset()
        assert peer.state.time_us > 2**31
        while peer.state.time_us > 2**31:
            frame = step(plant, 0)
            assert not frame["done"]
            assert frame["dt"].item() == pytest.approx(0.02, abs=1e-6)


@pytest.mark.parametrize("on_board", [False, True])
def test_a_host_that_was_suspended_while_it_waited_is_a_lost_link(
    peer: CartPeer, plant: SerialPlant, on_board: bool
) -> None:
    """A person may have moved the cart meanwhile: the motor stays at 0, and the cart is homed."""
    plant.on_board = on_board
    plant.reset_one()
    assert not (plant.listen_one() if on_board else plant.step_one(50)).ends
    peer.state = replace(peer.state, time_us=peer.state.time_us + 500_000)
    frame = plant.listen_one() if on_board else plant.step_one(50)
    assert (frame.truncated, frame.motor_applied, plant.ended_by) == ((True,), (0,), "link")
    assert "did not answer" in str(plant.last_error)
    assert_stopped(peer)
    plant.reset_one()
    assert len(peer.messages(Home)) == 2


def test_a_value_that_was_not_sent_is_not_recorded(
    plant: SerialPlant, monkeypatch: pytest.MonkeyPatch
) -> None:
    plant.reset_one()
    plant.step_one(50)

    def suspended(value: int) -> int:
        raise LinkError("did not answer")

    monkeypatch.setattr(plant.cart, "set_motor", suspended)
    assert plant.step_one(-50).truncated == (True,)
    assert plant.drove(-50) == 50


@pytest.mark.parametrize("side", [-1, 1])
def test_beyond_the_soft_limit_the_episode_ends_on_the_track(
    peer: CartPeer, plant: SerialPlant, side: int
) -> None:
    plant.reset()
    peer.state = replace(peer.state, cart_counts=side * (peer.info.soft_limit_counts - 1))
    assert not step(plant, 100)["done"]
    peer.state = replace(peer.state, cart_counts=side * peer.info.soft_limit_counts)
    frame = step(plant, 100)
    assert frame["terminated"]
    assert not frame["truncated"]
    assert plant.ended_by == "track"
    assert_stopped(peer)


@pytest.mark.parametrize("fault", list(Fault))
def test_a_latched_fault_is_not_cleared_with_nobody_asked(
    peer: CartPeer, plant: SerialPlant, fault: Fault
) -> None:
    """Only that of the hard limit is an ending on the track."""
    plant.reset()
    peer.state = replace(peer.state, fault=int(fault))
    frame = step(plant, 100)
    on_track = fault == Fault.HARD_LIMIT
    assert (frame["terminated"], frame["truncated"]) == (on_track, not on_track)
    assert plant.ended_by == ("track" if on_track else "fault")
    homings = len(peer.messages(Home))
    with pytest.raises(FaultError, match=r"check the cart, then confirm in a terminal that it may move"):
        plant.reset()
    assert not peer.messages(ClearFault)
    assert len(peer.messages(Home)) == homings


def fault_and_reset(peer: CartPeer, plant: SerialPlant) -> None:
    """Latch a fault in a step, and begin the next episode."""
    peer.state = replace(peer.state, fault=int(Fault.STALL))
    step(plant, 100)
    assert plant.ended_by == "fault"
    assert isinstance(plant.last_error, FaultError)
    assert_stopped(peer)
    assert not plant.reset()["done"]
    assert plant.ended_by == ""


def test_a_person_who_agrees_lets_a_fault_be_cleared(peer: CartPeer) -> None:
    asked: list[str] = []

    def agree(text: str) -> bool:
        asked.append(text)
        return True

    peer.carry_out = lambda message: clear(peer, message)
    with closing(SerialPlant(quick_settings(peer.port), confirm=agree)) as plant:
        plant.reset()
        for _ in range(2):
            fault_and_reset(peer, plant)
    assert len(asked) == 2
    assert "the motor was driven but the cart did not move" in asked[0]
    assert len(peer.messages(Home)) == 3  # once at first, and after each fault


def test_unattended_work_gives_up_after_the_stated_number_of_faults(peer: CartPeer) -> None:
    """An attempt at which the cause persists counts, too."""
    with closing(SerialPlant(quick_settings(peer.port, clear_faults=2))) as plant:
        plant.reset()
        with pytest.raises(FaultError, match="motor"):
            fault_and_reset(peer, plant)
        peer.carry_out = lambda message: clear(peer, message)
        assert not plant.reset()["done"]
        with pytest.raises(
            FaultError, match=r"2 faults were cleared unattended \(plant.clear_faults\): check"
        ):
            fault_and_reset(peer, plant)


@pytest.mark.parametrize("fault", [0, int(Fault.STALL)])
def test_a_step_after_the_end_sends_nothing(peer: CartPeer, plant: SerialPlant, fault: int) -> None:
    plant.reset()
    peer.state = replace(peer.state, fault=fault, cart_counts=peer.info.soft_limit_counts)
    ended = step(plant, 100)
    sent = len(peer.received)
    again = step(plant, 200)
    assert len(peer.received) == sent
    assert again["done"]
    assert again["counts"].tolist() == ended["counts"].tolist()


WRONG_INFO = [
    ({"pole_counts_per_turn": 2048}, "pole_counts_per_turn 2048, not 4096"),
    ({"cart_nanometres_per_count": 45498}, "cart_nanometres_per_count 45498, not 22749"),
    ({"motor_limit": 100}, "motor limit 100, not 255"),
    ({"period_us": 200_000}, "period 200000 us, not 5000 to 100000"),
    ({"soft_limit_counts": 5000}, "soft limit 114 mm"),
    ({"soft_limit_counts": 17500}, "soft limit 398 mm"),
    ({"hard_limit_counts": 60000}, "hard limit 1365 mm"),
]


@pytest.mark.parametrize(("changes", "words"), WRONG_INFO)
def test_a_cart_of_another_kind_is_never_armed(peer: CartPeer, changes: dict, words: str) -> None:
    peer.info = replace(peer.info, **changes)
    with pytest.raises(NotReadyError, match=words):
        SerialPlant(quick_settings(peer.port)).reset()
    assert not peer.messages(Start)
    assert not any(message.motor for message in peer.messages(SetMotor))


def test_firmware_without_the_end_switches_of_the_file_neither_homes_nor_drives(peer: CartPeer) -> None:
    rig = nominal_hardware().model_copy(update={"left_switch": 1})
    with pytest.raises(NotReadyError, match="the cart reports left_switch 0, not 1"):
        SerialPlant(quick_settings(peer.port), hardware=rig).reset()
    assert not peer.messages(Home)
    assert not peer.messages(Start)
    peer.flags |= Flags.LEFT_SWITCH
    SerialPlant(quick_settings(peer.port), hardware=rig).reset()
    assert peer.messages(Start)


def test_a_cart_that_restarts_is_a_lost_link(peer: CartPeer, plant: SerialPlant) -> None:
    plant.reset()
    peer.flags = Flags(0)
    frame = step(plant, 0)
    assert frame["truncated"]
    assert not frame["terminated"]
    assert plant.ended_by == "link"
    assert "restarted" in str(plant.last_error)


def test_a_silent_cart_truncates_with_the_last_counts_and_can_come_back(
    peer: CartPeer, plant: SerialPlant
) -> None:
    plant.reset()
    peer.state = replace(peer.state, cart_counts=42)
    step(plant, 100)
    talk, peer.answer = peer.answer, lambda frame: ()
    frame = step(plant, 100)
    assert frame["truncated"]
    assert not frame["terminated"]
    assert frame["counts"].tolist() == [[42, HANGING]]
    assert frame["motor_applied"].item() == 0
    assert plant.ended_by == "link"
    with pytest.raises(LinkError, match=r"was lost \(no state came.*no cart answers"):
        plant.reset()
    peer.answer = talk
    assert plant.reset()["counts"].tolist() == [[42, HANGING]]


def test_a_port_that_is_gone_for_a_moment_is_opened_again(peer: CartPeer, tmp_path: Path) -> None:
    port = tmp_path / "port"
    port.symlink_to(peer.port)
    with closing(SerialPlant(quick_settings(str(port), connect_timeout=60.0))) as plant:
        plant.reset()
        plant.cart.close()  # as after a lost link
        port.unlink()
        threading.Timer(0.2, port.symlink_to, [peer.port]).start()
        assert not plant.reset()["truncated"]


class Owned:
    closed, told, died, board = False, False, "", ""

    def death(self) -> str:
        return ""

    def close(self) -> None:
        self.closed = True


def test_close_stops_the_motor_and_closes_what_is_owned(peer: CartPeer) -> None:
    owned = Owned()
    plant = SerialPlant(quick_settings(peer.port), owned=owned)
    plant.reset()
    step(plant, 200)
    plant.close()
    assert_stopped(peer)
    assert owned.closed
    assert plant.is_closed


def test_what_is_owned_is_closed_when_the_port_cannot_be_opened() -> None:
    owned = Owned()
    with pytest.raises(PortError):
        SerialPlant(quick_settings("/dev/nosuch0"), owned=owned)
    assert owned.closed


def clear(peer: CartPeer, message: object) -> None:
    if isinstance(message, ClearFault):
        peer.state = replace(peer.state, fault=0)
    CartPeer.carry_out(peer, message)


def assert_stopped(peer: CartPeer) -> None:
    assert [type(frame.message) for frame in peer.received[-2:]] == [SetMotor, Stop]
    assert peer.messages(SetMotor)[-1] == SetMotor(0)
    assert peer.state.motor_applied == 0
