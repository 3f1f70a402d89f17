"""The plant at the end of a serial port: one cart, [1], with the contract of `specs.Plant`.

Time is the cart's: `dt` comes from STATE's clock. `preparation.py` brings the cart to the start of each
episode. Every ending, by the track, a fault, the link or `close`, sets the motor to 0 and disarms first.
"""

import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from cartpole_rl.emulator.guards import LEVER, lever_um
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.errors import ConfigError, FaultError, LinkError, PlantError, PortError
from cartpole_rl.plants.emulated import BridgeProcess, CartProcess, EmulatedCart
from cartpole_rl.plants.serial.cart import RESTARTED, SerialCart
from cartpole_rl.plants.serial.errors import RefusedError, check_rig, fault_error
from cartpole_rl.plants.serial.preparation import (
    Confirm,
    FaultClearing,
    Preparation,
    StartPosition,
    always,
    asking,
    nobody,
)
from cartpole_rl.plants.serial.tracking import LinkStatistics
from cartpole_rl.plants.settings import EmulatedSettings, PortSettings, Rehome, SerialSettings
from cartpole_rl.plants.specs import TERMINATING, TRUNCATING, Numbers, OneCartPlant, PlantOutput, on_tensors
from cartpole_rl.rig.hardware import LARGEST_MOTOR, Hardware, hardware_of
from cartpole_rl.rig.parameters import completed
from cartpole_rl.tasks.episode import Ending
from cartpole_rl.wire.messages import Fault, Flags, State, seconds_between, ticks_between, went_back

REOPENED = 0.1  # s between two attempts to open the port of a cart that was lost


class SerialPlant(OneCartPlant):
    """One cart on a wire. It connects when it is made, and again in a reset after the link was lost.

    A reset prepares the cart (`Preparation`), arms it, and returns the first state. For a start `upright` it
    asks a person by `prompt` to hold the pole up. Faults are cleared when a person agrees by `confirm`, and
    `settings.clear_faults` times without asking. `control_period` in s is set on the cart before an episode,
    if it has another one. With `on_board` the policy on the cart's board drives from the reset on, and
    `listen_one` takes the place of `step_one`.

    `terminated`: the cart is beyond its soft limit. `truncated`: the cart latched a fault, the link was
    lost, or the cart restarted; the counts are then the last ones received. `ended_by` is the last ending,
    "track", "fault" or "link", and empty while an episode runs; `last_error` is the error behind "fault" or
    "link".

    After an ending or `halt`, steps send nothing until the next reset: they repeat the last frame, truncated
    if nothing else has ended the episode.

    Raises PortError or LinkError when it cannot connect, NotReadyError if INFO describes another kind of
    cart. A reset raises LinkError if the cart cannot be reached again, and what `Preparation.prepare` raises.
    `owned` is closed with the plant.
    """

    def __init__(
        self,
        settings: SerialSettings,
        start: StartPosition = "hanging",
        control_period: float = 0.02,
        prompt: Callable[[str], None] = print,
        owned: CartProcess | None = None,
        confirm: Confirm = nobody,
        hardware: Hardware | None = None,
        before_homing: Callable[[], None] = lambda: None,
    ) -> None:
        super().__init__(hardware)
        self.settings = settings
        self.cart = SerialCart(settings, self.hardware, before_homing, owned)
        self.ended_by = ""
        self.last_error: PlantError | None = None
        self.on_board = False  # resets start the policy on the cart's board; `listen_one` passes periods
        faults = FaultClearing(settings.clear_faults, confirm)
        self._preparation = Preparation(self.cart, start, control_period, faults, prompt)
        self._driving = False  # an episode is under way
        self._drove = 0  # the motor value of the newest period
        self._turns = 0  # pole counts of the whole turns that the pole had made before this episode
        self._owned = owned
        self._state = State(0, 0, 0, 0, 0, 0, 0, 0)
        try:
            self._connect()
        except BaseException:
            self.close()
            raise

    @property
    def pole_length(self) -> Tensor:
        """m, [1]: the length in the settings; nothing measures it. Raises ConfigError if it is not set."""
        if self.settings.pole_length is None:
            raise ConfigError("this agent observes the pole's length: set plant.pole_length, in m")
        return torch.tensor([self.settings.pole_length])

    def halt(self) -> None:
        """Set the motor to 0 and disarm, between episodes; does not raise."""
        self._driving = False
        with suppress(PlantError):  # the cart's watchdog does it if the link cannot
            self.cart.stop()

    def distrust(self) -> None:
        """Home in the next reset."""
        self._preparation.require_homing()

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Set the motor to 0, disarm, give the port back, close what is owned."""
        try:
            self.cart.close()
        finally:
            if self._owned is not None:
                self._owned.close()
            super().close(raise_if_closed=raise_if_closed)

    @property
    def statistics(self) -> LinkStatistics:
        """Frames and times on the link, over all connections."""
        return self.cart.statistics

    def link_figures(self) -> dict[str, Any]:
        """Return the counts of lost, damaged and late frames, and the measured latency."""
        latency = {"latency_override": self.statistics.latency_override()}
        return {**super().link_figures(), **latency}

    def check_policy(self, identity: int) -> None:
        """Raise PlantError unless the board has the agent of this `identity`."""
        self.cart.check_policy(identity)

    @property
    def fault(self) -> Fault:
        """The latched faults in the newest state."""
        return Fault(self._state.fault)

    @property
    def track_half_length(self) -> Tensor:
        """m, [1]: the soft limit of the cart, from the span that it measured in homing."""
        return torch.tensor([self.cart.information.soft_limit_counts * self.hardware.encoders.metres])

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDict:
        if tensordict is not None and "_reset" in tensordict and not tensordict["_reset"].any():
            return self.first_output(on_tensors(self._frame(self._preparation.control_period)))
        return super()._reset()

    def reset_one(self) -> PlantOutput[Numbers]:
        """Prepare the cart, arm it, and return the first frame of an episode."""
        self._reach()
        try:
            self._preparation.prepare()
            if self.before_start is not None:
                self.before_start()
            self._state = self._armed()
        except BaseException:
            self.halt()  # at once: what unwinds before `close`, such as a view, may block
            raise
        self._turns = self._whole_turns()
        self._drove = 0
        self.ended_by = ""
        self.last_error = None
        self._driving = True
        return self._frame(self._preparation.control_period)

    def _armed(self) -> State:
        """Arm the cart and return the next state."""
        if self.on_board:
            self.cart.start_policy()
        else:
            self.cart.start()
        return self.cart.get_state()

    def step_one(self, motor: int) -> PlantOutput[Numbers]:
        """Send a motor value; return the frame at the end of the period.

        If the cart does not acknowledge the value, or its limits changed one, what drove is what it reports:
        the motor value in force. Two values lasted longer than the one in force at the end: that of a brake
        which has just let go, and the one sent if the limit has only just taken it away. If its watchdog or a
        fault has just set the motor to 0, that was the value of the period before; so it was if no value
        could be sent.
        """
        drove = self._drove

        def answer() -> State:
            nonlocal drove
            before = self.cart.flags
            sent = drove = self.cart.set_motor(motor)
            if self.on_command is not None:  # in the time until the next state
                self.on_command(drove)
            try:
                state = self.cart.get_state()
            except FaultError:  # it refused the value
                drove = self._drove
                raise
            took = self.cart.took_motor(state)
            if self.cart.flags & Flags.SOFT_LIMIT:
                drove = self._under_limit(state, before, sent) if took else state.motor_applied
            elif not took:
                has_just_stopped = state.fault or self.cart.flags & ~before & Flags.WATCHDOG
                drove = self._drove if has_just_stopped else state.motor_applied
            return state

        frame = self._pass_period(answer)
        self._drove = drove
        return frame

    def drove(self, given: int) -> int:
        """Return the motor value that drove the newest period."""
        return self._drove

    def _under_limit(self, state: State, before: Flags, sent: int) -> int:
        """Return the motor value that drove most of a period in which a limit of the track acted.

        `before` are the flags of the state before, `sent` is the value that the cart would have held.
        """
        if not before & Flags.SOFT_LIMIT:
            return state.motor_applied or sent
        has_let_go = state.motor_applied == sent and abs(self._drove) == LARGEST_MOTOR
        return self._drove if has_let_go else state.motor_applied

    def listen_one(self) -> PlantOutput[Numbers]:
        """Let the policy on the board drive; return the frame at the end of the period."""

        def listen() -> State:
            if self.on_command is not None:
                self.on_command(self._state.motor_applied)
            before, state = self.cart.flags, self.cart.follow_policy()
            applied, limited = state.motor_applied, self.cart.flags & Flags.SOFT_LIMIT
            self._drove = self._under_limit(state, before, applied) if limited else applied
            return state

        return self._pass_period(listen)

    def _pass_period(self, next_state: Callable[[], State]) -> PlantOutput[Numbers]:
        """Return the frame of the next state, or the last one after an ending."""
        if not self._driving:
            return self._frame(self._preparation.control_period)
        before = self._state
        try:
            state = next_state()
            if went_back(ticks_between(before.tick, state.tick)):
                raise LinkError(RESTARTED)
            self.cart.check_suspension(seconds_between(before.time_us, state.time_us))
            self._state = state
        except (LinkError, RefusedError, FaultError) as error:
            self._break_off(error)
            passed = seconds_between(before.time_us, self._state.time_us)
            return self._frame(passed or self._preparation.control_period)
        self._end_if_due()
        return self._frame(seconds_between(before.time_us, self._state.time_us))

    def _end_if_due(self) -> None:
        """Set `ended_by` and stop the motor if the new state ends the episode."""
        state, limit = self._state, self.cart.information.soft_limit_counts
        if state.fault & ~int(Fault.HARD_LIMIT):
            self.ended_by, self.last_error = Ending.FAULT, fault_error(state.fault)
        elif abs(state.cart_counts) >= limit or state.fault:
            self.ended_by = Ending.TRACK
        elif not self.cart.flags & Flags.ARMED:
            self.ended_by = Ending.LINK
            self.last_error = LinkError("the cart is not armed any more: it has restarted; check its power")
            self._preparation.require_homing()
        if self.ended_by:
            self.halt()

    def _break_off(self, error: PlantError) -> None:
        """End the episode: the motor counts as 0, and without a newer state the last counts are kept."""
        self.ended_by = Ending.FAULT if isinstance(error, FaultError) else Ending.LINK
        self.last_error = error
        self._driving = False
        self._preparation.require_homing()
        if isinstance(error, LinkError):
            self.cart.close()
        else:
            self.halt()
            if isinstance(error, FaultError):
                try:
                    self._state = self.cart.poll_state()
                except PlantError:
                    self.ended_by = Ending.LINK
        self._state = replace(self._state, motor_applied=0, command_age_ms=0)

    def _frame(self, dt: float) -> PlantOutput[Numbers]:
        """Return the frame of the newest state; `dt` in s."""
        state, ending = self._state, self.ended_by
        halted = not self._driving and not ending
        return PlantOutput(
            (state.cart_counts, state.pole_counts - self._turns),
            (dt,),
            (state.motor_applied,),
            (ending in TERMINATING,),
            (halted or ending in TRUNCATING,),
        )

    def _whole_turns(self) -> int:
        """Return the pole counts of the whole turns between the start position and the newest state."""
        turn = self.cart.information.pole_counts_per_turn
        start = 0 if self._preparation.start == "upright" else turn // 2
        return turn * round((self._state.pole_counts - start) / turn)

    def _reach(self) -> None:
        """Stop the cart; connect again if the link was lost, also if its port is gone for a moment.

        Raises LinkError.
        """
        if self.cart.is_open:
            with suppress(LinkError):
                self.cart.stop()
                return
            self.cart.close()
        self._preparation.require_homing()
        lost = f" ({self.last_error})" if self.last_error else ""
        deadline = time.monotonic() + self.settings.connect_timeout
        while True:
            try:
                self._connect()
                return
            except (PortError, LinkError) as error:
                if not isinstance(error, PortError) or time.monotonic() > deadline:
                    raise LinkError(
                        f"the link to the cart was lost{lost} and not restored: {error}"
                    ) from error
            time.sleep(REOPENED)

    def _connect(self) -> None:
        """Open the port and check which rig the cart is. Raises PortError, LinkError, NotReadyError."""
        self.cart.open()
        check_rig(self.cart.information, self.cart.flags, self.hardware)


def cart_on_port(
    plant: PortSettings,
    emulator: EmulatorSettings,
    control_period: float,
    start: StartPosition,
    prompt: Callable[[str], None],
    confirm: Confirm,
    cart: Mapping[str, float],
) -> SerialPlant:
    """Return the plant of the settings `plant`, whose cart has the numbers `cart`.

    plant=emulated makes a new cart with the settings `emulator` and the start `start`, which needs nobody to
    confirm. The bridge of plant=text and plant=driver lives as long as the plant; its brake knows the pole if
    `cart` has the numbers of one.

    Raises PortError, LinkError, NotReadyError, EmulatorError; ConfigError if an emulated cart has another
    start, or a board does not measure as often as the period needs.
    """
    if isinstance(plant, EmulatedSettings):
        if emulator.start not in ("hanging", start):
            raise ConfigError(f"emulator.start={emulator.start}: this cart starts {start}; leave it out")
        emulator = emulator.of_cart(cart).model_copy(update={"start": start})
        return emulated_plant(emulator, control_period, prompt, plant.rehome)
    hardware = hardware_of(cart)
    if isinstance(plant, SerialSettings):
        return SerialPlant(plant, start, control_period, prompt, confirm=confirm, hardware=hardware)
    numbers = completed(cart)
    lever = lever_um(numbers) if {"cart_mass", "pole_mass", "pole_com"} <= numbers.keys() else LEVER
    bridge = BridgeProcess(plant, hardware, control_period, lever)
    settings, asked = plant.over(bridge.port), asking(plant, hardware, confirm)
    return SerialPlant(settings, start, control_period, prompt, bridge, confirm, hardware, asked)


def emulated_plant(
    emulator: EmulatorSettings,
    control_period: float = 0.02,
    prompt: Callable[[str], None] = lambda text: None,
    rehome: Rehome = "once",
) -> SerialPlant:
    """Return a serial plant on an emulated cart that lives as long as the plant.

    The pole's length and the start position are those of the emulator. Faults are cleared without asking.
    """
    cart = EmulatedCart(emulator)
    settings = cart.settings.model_copy(update={"rehome": rehome, "pole_length": 2 * emulator.pole_com})
    return SerialPlant(
        settings, emulator.start, control_period, prompt, cart, confirm=always, hardware=emulator.hardware
    )
