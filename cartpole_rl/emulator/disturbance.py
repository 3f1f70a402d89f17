"""Frames that vanish, arrive with a wrong byte, twice or too late, by chance and by seed."""

import random

from cartpole_rl.emulator.settings import EmulatorSettings


class Disturbance:
    """One direction of a bad cable. The ends of frames get through, so that frames never merge or split."""

    def __init__(self, settings: EmulatorSettings, direction: str) -> None:
        """The settings' shares of frames; their seed and the direction's name decide which frames."""
        self._settings = settings
        self._damage_dice = random.Random(f"{direction} {settings.seed}")
        self._order_dice = random.Random(f"{direction} order {settings.seed}")
        self._held: list[bytes] = []  # what arrives after the next frame; one frame, or its two copies

    def carry(self, stuffed: bytes) -> list[bytes]:
        """What arrives now that a frame was sent, in order, each without its ending 0x00."""
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
