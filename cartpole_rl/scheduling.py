"""Which process the operating system lets compute first, where several want to.

Driving a cart goes ahead of learning. Both calls are for a whole process, and last until it ends.
"""

import os

PRIORITY = 20  # of 1 to 99 among real-time processes; interrupts of Linux's real-time kernels have 50


def compute_first() -> bool:
    """Compute at once whenever there is something to do, ahead of every usual process (`SCHED_FIFO`).

    Returns whether the operating system allows it: Linux does for root, with CAP_SYS_NICE, or where
    `ulimit -r` is at least `PRIORITY`.
    """
    if not hasattr(os, "SCHED_FIFO"):
        return False
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except PermissionError:
        return False
    return True


def compute_last() -> None:
    """Compute only where no other process wants to (`SCHED_IDLE`, elsewhere the highest niceness)."""
    if hasattr(os, "SCHED_IDLE"):
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    elif hasattr(os, "nice"):
        os.nice(19)
