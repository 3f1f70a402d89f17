"""Scheduling priority of a whole process, until it ends: driving a cart takes precedence over learning."""

import os

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


def give_precedence() -> None:
    """Give this process the lowest priority: `SCHED_IDLE`, or niceness 19 on other systems."""
    if hasattr(os, "SCHED_IDLE"):
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    elif hasattr(os, "nice"):
        os.nice(19)
