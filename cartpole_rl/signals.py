"""Signals that ask a process to end. A program that drives a cart turns them into exceptions.

An exception unwinds every `with`, so that the motor is at 0 and the cart disarmed before the process ends.
"""

import signal


def ending_signals() -> list[signal.Signals]:
    """SIGTERM, and SIGHUP: a closed terminal, a dropped ssh connection.

    A SIGHUP that the parent process ignores stays ignored, since that is what nohup is for.
    """
    ending = [signal.SIGTERM]
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:
        ending.append(signal.SIGHUP)
    return ending
