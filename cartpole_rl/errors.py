"""The error tree. Messages say in one line what is wrong and what to do."""

import copyreg
from typing import Any


class CartPoleError(Exception):
    """The base of all errors of this package. Commands print it in one line and exit with `exit_code`."""

    exit_code = 1

    def __reduce__(self) -> tuple[Any, ...]:
        """Support pickling, whatever arguments the constructor takes."""
        return copyreg.__newobj__, (type(self), *self.args), vars(self)  # type: ignore[attr-defined]


def reason_of(error: Exception) -> str:
    """Return the first line of an error of a library, or its name where it has no text."""
    return [*str(error).splitlines(), type(error).__name__][0]


class ConfigError(CartPoleError):
    """A setting is unknown, has the wrong type, is out of range, or contradicts another."""

    exit_code = 2


class LearningError(CartPoleError):
    """A training cannot continue."""


class LearnerError(CartPoleError):
    """The learner on another machine cannot be reached or used."""


class CheckpointError(CartPoleError):
    """A checkpoint is missing, damaged, or not of this package."""


class RecordingError(CartPoleError):
    """A recording is missing, damaged, or incomplete."""

    exit_code = 2


class PlantError(CartPoleError):
    """A cart cannot be driven."""


class PortError(PlantError):
    """A serial port does not exist, is busy, or may not be opened."""


class LinkError(PlantError):
    """The cart stopped answering, or was unplugged."""


class FaultError(PlantError):
    """The cart latched a fault; it does not move until CLEAR_FAULT."""


class EmulatorError(PlantError):
    """The emulated cart did not start, or stopped too early."""


class FrameError(CartPoleError):
    """Bytes on the wire that are not a valid frame: bad stuffing, checksum, version, type or length."""
