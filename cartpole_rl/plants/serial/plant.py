"""The plant at the end of a serial port: one cart, [1], with the contract of `specs.Plant`.

Time is the cart's: `dt` comes from STATE's clock. The first reset homes the cart, later ones bring it back
to the middle; after a fault, a restart or a lost link it is homed again. Every ending, by the track, a fault,
the link or `close`, sets the motor to 0 and disarms first.
"""

import logging
import math
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Protocol

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from cartpole_rl.errors import ConfigError, FaultError, LinkError, PlantError, PortError
from cartpole_rl.plants.serial.cart import RESTARTED, SerialCart
from cartpole_rl.plants.serial.errors import RefusedError, fault_error
from cartpole_rl.plants.serial.faults import Confirm, FaultClearing, nobody
from cartpole_rl.plants.serial.information import check_scales
from cartpole_rl.plants.serial.recentring import recentre
from cartpole_rl.plants.serial.settings import SerialPlantSettings
from cartpole_rl.plants.specs import Plant, one_cart
from cartpole_rl.wire import (
    Fault,
    Flags,
    State,
    microseconds_between,
    seconds_between,
    ticks_between,
    went_back,
)

LOGGER = logging.getLogger(__name__)

UPRIGHT_TOLERANCE = math.radians(3)
HANGING_TOLERANCE = math.radians(5)
UPRIGHT_SWAY = math.radians(1.5)  # a hand is never quite still
HANGING_SWAY = math.radians(1)  # homing is content with eight counts of 4096 a turn
STILL_SECONDS = 0.3  # for so long the pole has to stay, by the cart's clock


class Owned(Protocol):
    """What a plant may own: an emulated cart, closed with it."""

    @property
    def died(self) -> str:
        """How it ended by itself, in words; empty while it lives."""

    def close(self) -> None:
        """End it."""


class SerialPlant(Plant):
    """One cart on a wire. It connects when it is made, and again in a reset after the link was lost.

    A reset stops, clears faults, homes or re-centres the cart (`settings.rehome`), waits for the start (for
    `upright` it asks a person by `prompt` to hold the pole up), arms, and returns the first state. Faults are
    cleared when a person agrees by `confirm`, and `settings.clear_faults` times without asking.
    `terminated`: the cart is beyond its soft limit, or latched a fault. `truncated`: the link was lost, or
    the cart restarted; the counts are then the last that came. `ended_by` is the last ending, "track",
    "fault" or "link", and empty while an episode runs; `last_error` is the error behind "fault" or "link".

    After an ending or `halt`, steps send nothing until the next reset: they repeat the last frame, truncated
    if nothing else has ended the episode.

    Raises PortError or LinkError when it cannot connect, NotReadyError if INFO describes another kind of
    cart. A reset raises LinkError after a loss that stays, FaultError for a fault that does not clear or that
    nobody agrees to clear, or for a homing that fails, and PlantError if the start is not reached in time.
    `owned` is closed with the plant.
    """

    def __init__(
        self,
        settings: SerialPlantSettings,
        prompt: Callable[[str], None] = print,
        owned: Owned | None = None,
        confirm: Confirm = nobody,
    ) -> None:
        super().__init__(carts=1)
        self.settings = settings
        self.cart = SerialCart(settings)
        self.ended_by = ""
        self.last_error: PlantError | None = None
        self._hanging: int | None = None  # pole count after homing; None before it, and once it may be wrong
        self._driving = False  # an episode is under way
        self._turns = 0  # pole counts of the whole turns that the pole has made before this episode
        self._prompt = prompt
        self._faults = FaultClearing(settings.clear_faults, confirm)
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
        """Motor to 0 and disarm, between episodes; does not raise."""
        self._driving = False
        with suppress(PlantError):  # the cart's watchdog does it where the link cannot
            self.cart.stop()

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Motor to 0, disarm, give the port back, close what is owned."""
        try:
            self.cart.close()
        finally:
            if self._owned is not None:
                self._owned.close()
            super().close(raise_if_closed=raise_if_closed)

    def _set_seed(self, seed: int | None) -> None:
        """Nothing to do: a real cart draws its own chances, an emulated one has its seed in its settings."""

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDict:
        if tensordict is not None and "_reset" in tensordict and not tensordict["_reset"].any():
            return self.frame(*self._report(self.settings.control_period))
        self._reach()
        restarts = self.cart.restarts
        try:
            self._make_ready()
        except PlantError:
            if self.cart.restarts == restarts:
                raise
            self._hanging = None
            self._make_ready()  # a cart that restarts again is left alone
        self.cart.start()
        self._state = self.cart.get_state()
        self._turns = self._whole_turns()
        self.ended_by = ""
        self.last_error = None
        self._driving = True
        return self.frame(*self._report(self.settings.control_period))

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        if not self._driving:
            return self.step_frame(*self._report(self.settings.control_period))
        before = self._state
        try:
            self.cart.set_motor(int(tensordict["motor"]))
            state = self.cart.get_state()
            if went_back(ticks_between(before.tick, state.tick)):
                raise LinkError(RESTARTED)
            self._state = state
        except (LinkError, RefusedError, FaultError) as error:
            self._break_off(error)
            return self.step_frame(*self._report(self.settings.control_period))
        self._end_if_due()
        return self.step_frame(*self._report(seconds_between(before.time_us, self._state.time_us)))

    def _end_if_due(self) -> None:
        """Set `ended_by` and stop the motor if the new state ends the episode."""
        state, limit = self._state, self.cart.information.soft_limit_counts
        if state.fault & ~int(Fault.HARD_LIMIT):
            self.ended_by, self.last_error = "fault", fault_error(state.fault)
        elif abs(state.cart_counts) >= limit or state.fault:
            self.ended_by = "track"
        elif not self.cart.flags & Flags.ARMED:
            self.ended_by, self._hanging = "link", None
            self.last_error = LinkError("the cart is not armed any more: it has restarted; check its power")
        if self.ended_by:
            self.halt()

    def _break_off(self, error: PlantError) -> None:
        """End the episode for want of a state: with the counts that came last, the motor taken as 0."""
        self.ended_by, self.last_error = "fault" if isinstance(error, FaultError) else "link", error
        self._driving, self._hanging = False, None
        if isinstance(error, LinkError):
            self.cart.close()
        else:
            self.halt()
        last = self._state
        self._state = State(
            last.tick, last.time_us, last.cart_counts, last.pole_counts, 0, last.last_sequence, last.fault, 0
        )

    def _report(self, dt: float) -> tuple[Tensor, ...]:
        """What the cart says: counts, dt, motor_applied, terminated, truncated; `dt` in s."""
        state = self._state
        counts = (state.cart_counts, state.pole_counts - self._turns)
        terminated, truncated = self.ended_by in ("track", "fault"), self.ended_by == "link"
        halted = not self._driving and not self.ended_by
        return one_cart(counts, dt, state.motor_applied, terminated, truncated or halted)

    def _whole_turns(self) -> int:
        """Pole counts by which the newest state is whole turns from where an episode begins."""
        turn = self.cart.information.pole_counts_per_turn
        begins = 0 if self.settings.start == "upright" else turn // 2
        return turn * round((self._state.pole_counts - begins) / turn)

    def _reach(self) -> None:
        """A stopped cart that answers; connects anew after a loss. Raises LinkError."""
        if self.cart.is_open:
            with suppress(LinkError):
                self.cart.stop()
                return
            self.cart.close()
        self._hanging = None
        try:
            self._connect()
        except (PortError, LinkError) as error:
            lost = f" ({self.last_error})" if self.last_error else ""
            why = self._owned.died if self._owned is not None and self._owned.died else error
            raise LinkError(f"the link to the cart was lost{lost} and is not there again: {why}") from error

    def _connect(self) -> None:
        """Open the port and check the cart's scales. Raises PortError, LinkError, NotReadyError."""
        self.cart.open()
        check_scales(self.cart.information)

    def _clear_faults(self) -> None:
        """Clear latched faults if there are any and somebody agrees. Raises FaultError."""
        if fault := self.cart.poll_state().fault:
            self._hanging = None
            self._faults.clear(self.cart, fault)

    def _make_ready(self) -> None:
        """Clear faults, find the middle, set the period, and wait for the pole in its start position."""
        self._clear_faults()
        if not self._is_recentred():
            self._hanging = None
            self._hanging = self.cart.home(self.settings.home_timeout).pole_counts
        period_us = round(self.settings.control_period * 1e6)
        if self.cart.info().period_us != period_us:  # the cart may have restarted since it was last asked
            self.cart.set_period(period_us)
        self.cart.get_state()  # read before more is asked, so that a lockstep run is the same each time
        if self.settings.start == "upright":
            self._prompt("Hold the pole upright and still; let go when the cart begins to move.")
            self._await_pole(0.0, UPRIGHT_TOLERANCE, UPRIGHT_SWAY)
        else:
            self._await_pole(math.pi, HANGING_TOLERANCE, HANGING_SWAY)

    def _is_recentred(self) -> bool:
        """Whether the cart is in the middle again without homing. False if it has to be homed.

        Raises LinkError.
        """
        homed = bool(self.cart.flags & Flags.HOMED)
        if self.settings.rehome == "always" or self._hanging is None or not homed:
            return False
        try:
            recentre(self.cart, self._hanging)
        except LinkError:
            raise
        except PlantError as error:
            LOGGER.warning("homing, as the cart could not be brought back to the middle: %s", error)
            self._clear_faults()
            return False
        return True

    def _await_pole(self, angle: float, tolerance: float, sway: float) -> None:
        """Wait until the pole stays within `tolerance` of `angle` and moves less than `sway`, in rad."""
        turn = self.cart.information.pole_counts_per_turn
        window: deque[tuple[int, float]] = deque()  # (us, rad) of the last STILL_SECONDS
        deadline = time.perf_counter() + self.settings.start_timeout
        while True:
            state = self.cart.poll_state()
            if not self.cart.flags & Flags.HOMED:
                raise LinkError(RESTARTED)
            pole = 2 * math.pi * state.pole_counts / turn
            off = math.remainder(pole - angle, 2 * math.pi)
            window.append((state.time_us, pole))
            if abs(off) > tolerance or _spread(window) > sway:
                window.clear()
            elif microseconds_between(window[0][0], state.time_us) >= STILL_SECONDS * 1e6:
                return
            if time.perf_counter() > deadline:
                raise PlantError(
                    f"waited {self.settings.start_timeout:g} s for the pole to be still within "
                    f"{math.degrees(tolerance):.0f} deg of {self.settings.start}; "
                    f"it is {math.degrees(off):+.1f} deg off: {_REMEDY[self.settings.start]}"
                )


_REMEDY = {
    "upright": "hold it up by hand until the cart begins to move",
    "hanging": "let it hang until it is still; it may not be touched during homing",
}


def _spread(window: deque[tuple[int, float]]) -> float:
    """Largest minus smallest angle in rad."""
    angles = [angle for _, angle in window]
    return max(angles) - min(angles)
