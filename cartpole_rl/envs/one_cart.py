"""The hardware transform over a plant of one cart, on plain numbers: a tick takes microseconds.

Perception is that of `perception.py`, and the plant is the one below the TorchRL environment, so both drive
the same cart in the same way (tests/envs/test_one_cart.py). Frames and percepts hold k numbers in place of
each tensor [k, N].
"""

import torch

from cartpole_rl.envs.hardware import HardwareTransform
from cartpole_rl.envs.perception import Percept, Previous
from cartpole_rl.plants.specs import Numbers, Plant, PlantOutput
from cartpole_rl.scalar import Scalar, plain
from cartpole_rl.tasks.settings import NO_ACTION


class OneCart:
    """One cart under the hardware transform. `reset` starts an episode and `step` drives a period.

    Raises ConfigError for an observation that the plant cannot give.
    """

    def __init__(self, plant: Plant, hardware: HardwareTransform) -> None:
        self.plant, self.hardware = plant, hardware
        self._motors: list[int] = hardware.motors.tolist()
        self._inward: list[int] = hardware.inward.tolist()
        length, track_end = hardware.scaled_length(), hardware.track_end()
        count, flag = torch.zeros(1, 1, dtype=torch.int64), torch.zeros(1, 1, dtype=torch.bool)
        counts, number = count.repeat(2, 1), torch.zeros(1, 1)
        state, past = number.repeat(4, 1), number.repeat(hardware.observation_settings.past_size, 1)
        speeds = number.repeat(hardware.speed_periods - 1, 1)
        frame = PlantOutput(counts, number, count, flag, flag)
        self._perceive_first = Scalar(
            lambda frame, cart: hardware.first_perception(frame, *cart), frame, (length, track_end)
        )
        previous = Previous(counts, state, past, speeds, count, count, length, track_end)
        self._perceive = Scalar(hardware.perception, previous, frame)
        self._any_period = tuple(
            tuple(plain(torch.ones_like(each)) for each in part) for part in (previous, frame)
        )
        self.frame: PlantOutput[Numbers]  # the newest
        self.sent = 0  # motor value of the newest period
        self.percept: Percept[Numbers]  # of the newest frame

    def motor(self, action: int) -> int:
        """Return the motor value of an action; 0 for NO_ACTION. Raises IndexError if it does not exist."""
        if action == NO_ACTION:
            return 0
        if action < 0:
            raise IndexError(f"action {action} does not exist")
        return self._motors[action]

    def sent_motor(self, action: int) -> int:
        """Return the motor value to send: that of the action, or full motor inward under the track guard."""
        return self.guarded_motor(action, self.percept)

    def guarded_motor(self, action: int, percept: Percept[Numbers]) -> int:
        """Return the motor value that would be sent for an action on a percept."""
        motor, (side,) = self.motor(action), percept.guard
        if side == 0 or action == NO_ACTION:
            return motor
        return self._inward[side]

    def reset(self) -> Percept[Numbers]:
        """Start an episode. Raises the errors of the plant's reset."""
        self.frame = self.plant.reset_one()
        self._length, self._track_end = map(plain, (self.hardware.scaled_length(), self.hardware.track_end()))
        self.percept = self._perceive_first(self.frame, (self._length, self._track_end))
        return self.percept

    def rehearse(self) -> Percept[Numbers]:
        """Perceive a period of ones, which changes nothing."""
        now: Percept[Numbers] = self._perceive(*self._any_period)
        return now

    def step(self, action: int) -> Percept[Numbers]:
        """Drive one period."""
        motor = self.sent_motor(action)
        frame = self.plant.step_one(motor)
        self.sent = self.plant.drove(motor)
        return self.advance(self.sent, frame if action != NO_ACTION else frame._replace(truncated=(True,)))

    def advance(self, motor: int, frame: PlantOutput[Numbers]) -> Percept[Numbers]:
        """Perceive the frame at the end of a period under a motor value."""
        before, earlier, self.frame = self.percept, self.frame.counts, frame
        memory = before.state, before.past, before.speeds, before.step_count
        previous = Previous(earlier, *memory, (motor,), self._length, self._track_end)
        self.percept = self._perceive(previous, frame)
        return self.percept
