"""Frames that vanish or arrive with a wrong byte, by chance and by seed."""

import random


class Disturbance:
    """One direction of a bad cable. The ends of frames get through, so that frames never merge or split."""

    def __init__(self, loss: float, corruption: float, seed: str) -> None:
        """Probabilities a frame of vanishing, and of a wrong byte."""
        self._loss = loss
        self._corruption = corruption
        self._random = random.Random(seed)

    def carry(self, stuffed: bytes) -> bytes | None:
        """What arrives of a frame, without its ending 0x00; None for nothing."""
        lost, damaged = self._random.random() < self._loss, self._random.random() < self._corruption
        if lost:
            return None
        return self._damage(stuffed) if damaged else stuffed

    def _damage(self, stuffed: bytes) -> bytes:
        at = self._random.randrange(len(stuffed))
        wrong = self._random.choice([byte for byte in range(1, 256) if byte != stuffed[at]])
        return stuffed[:at] + bytes([wrong]) + stuffed[at + 1 :]
