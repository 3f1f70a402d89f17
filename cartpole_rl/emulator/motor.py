"""The emulated motor: from a motor value to the force on the cart, with dead-band, asymmetry and lag."""

import math

from cartpole_rl.emulator.settings import EmulatorSettings


class Motor:
    """First-order lag behind a static force curve."""

    def __init__(self, settings: EmulatorSettings) -> None:
        self._settings = settings
        self.force = 0.0  # N, positive to the right

    def static_force(self, motor: int) -> float:
        """Return the steady force of a motor value, N."""
        settings = self._settings
        size = abs(motor)
        if size <= (settings.deadband_right if motor > 0 else settings.deadband_left):
            return 0.0
        a, b, c = settings.force_curve
        force = max(0.0, a * size * size + b * size + c)
        return force * (1 + settings.force_asymmetry) if motor > 0 else -force

    def step(self, motor: int, seconds: float) -> float:
        """Apply a motor value for `seconds`; return the force at the end, N."""
        target = self.static_force(motor)
        lag = self._settings.motor_time_constant
        self.force = target + (self.force - target) * (math.exp(-seconds / lag) if lag else 0.0)
        return self.force
