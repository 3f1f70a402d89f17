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

    def decay(self, seconds: float) -> float:
        """Return the share of the gap to the steady force that is left after `seconds`."""
        lag = self._settings.motor_time_constant
        return math.exp(-seconds / lag) if lag else 0.0

    def step(self, target: float, decay: float) -> float:
        """Approach the steady force `target`, N, up to the share `decay` of the gap; return the force, N."""
        self.force = target + (self.force - target) * decay
        return self.force
