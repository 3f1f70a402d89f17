"""Random frame loss, corruption, duplication and reordering, repeatable by seed."""

import random

from cartpole_rl.emulator.settings import EmulatorSettings


class Disturbance:
    """One direction of a bad cable. The final 0x00 always arrives, so frames never merge or split."""

    def __init__(self, settings: EmulatorSettings, direction: str) -> None:
        """Take the shares of frames from the settings; the seed and `direction` decide which frames."""
        self._settings = settings
        self._damage_dice = random.Random(f"{direction} {settings.seed}")
        self._order_dice = random.Random(f"{direction} order {settings.seed}")
        self._held: list[bytes] = []  # one frame, or its two copies, that arrives after the next frame

    def carry(self, stuffed: bytes) -> list[bytes]:
        """Send a frame; return the frames that arrive now, in order, each without its final 0x00."""
        settings, dice = self._settings, self._damage_dice
        lost, damaged = dice.random() < settings.frame_loss, dice.random() < settings.frame_corruption
        twice = self._order_dice.random() < settings.frame_duplication
        late = self._order_dice.random() < settings.frame_reordering
        if lost:
            return []
        arriving = [self._damage(stuffed) if damaged else stuffed] * (1 + twice)
        if late and not self._held:
            self._held = arriving
            return []
        held, self._held = self._held, []
        return arriving + held

    def _damage(self, stuffed: bytes) -> bytes:
        dice = self._damage_dice
        at = dice.randrange(len(stuffed))
        wrong = dice.choice([byte for byte in range(1, 256) if byte != stuffed[at]])
        return stuffed[:at] + bytes([wrong]) + stuffed[at + 1 :]
