"""When a process runs, and when it collects garbage: driving a cart takes precedence over learning."""

import gc
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from importlib import import_module
from typing import Any

PRIORITY = 20  # real-time priority, 1 to 99; interrupt threads of Linux's real-time kernels have 50


def take_precedence() -> bool:
    """Give this process real-time priority (`SCHED_FIFO`); return False if the system does not allow it.

    Linux allows it to root, with CAP_SYS_NICE, or if `ulimit -r` is at least `PRIORITY`.
    """
    if not hasattr(os, "SCHED_FIFO"):
        return False
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except PermissionError:
        return False
    return True


@contextmanager
def taking_precedence() -> Iterator[None]:
    """Give this process real-time priority within the `with`, if it has none and the system allows it."""
    if not hasattr(os, "SCHED_FIFO") or os.sched_getscheduler(0) in (os.SCHED_FIFO, os.SCHED_RR):
        yield
        return
    with _same_policy_afterwards():
        take_precedence()
        yield


def lose_precedence(niceness: int) -> None:
    """Give this process no real-time priority, which it may have inherited, and raise its niceness."""
    if hasattr(os, "SCHED_OTHER"):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    os.nice(niceness)


@contextmanager
def giving_precedence() -> Iterator[None]:
    """Give this process the lowest priority: `SCHED_IDLE`, or niceness 19 on other systems.

    The earlier priority returns at the end, if the system allows it; niceness stays.
    """
    if not hasattr(os, "SCHED_IDLE"):
        if hasattr(os, "nice"):
            os.nice(19)
        yield
        return
    with _same_policy_afterwards():
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
        yield


@contextmanager
def _same_policy_afterwards() -> Iterator[None]:
    """Restore the scheduling policy of this process at the end, if the system allows it."""
    policy, param = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        yield
    finally:
        with suppress(PermissionError):
            os.sched_setscheduler(0, policy, param)


@contextmanager
def no_garbage_collection() -> Iterator[None]:
    """Collect young garbage now, and none within the `with`: it would take longer than a tick allows."""
    enabled = gc.isenabled()
    gc.collect(1)  # a full collection takes 0.4 s; the next automatic one finds the rest
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def imported(module: str, name: str) -> Any:
    """Return an object of a module, which is imported without garbage collection: a quarter of its time."""
    gc.disable()  # imports make no garbage
    try:
        return getattr(import_module(module), name)
    finally:
        gc.enable()


class ImportedFast(partial):
    """A function as the target of a spawned process, which `imported` finds there."""

    def __reduce__(self) -> tuple[Any, ...]:
        return imported, (self.func.__module__, self.func.__qualname__)
