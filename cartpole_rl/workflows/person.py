"""The person at the terminal."""

import sys
from contextlib import suppress


def confirm(text: str) -> bool:
    """Show `text` and wait for Enter; False, at once, where nobody sits at a terminal."""
    if sys.stdin is None or not sys.stdin.isatty():
        return False
    print(f"{text}.", file=sys.stderr)
    print("Check the cart. It homes as soon as you confirm: keep the track clear.", file=sys.stderr)
    forget_typed()
    print("Press Enter to go on, Ctrl-C to stop. ", end="", file=sys.stderr, flush=True)
    try:
        input()
    except EOFError:
        return False
    return True


def forget_typed() -> None:
    """Throw away what was typed before: it answers no question that is asked now."""
    try:
        import termios
    except ImportError:  # Windows
        import msvcrt

        while msvcrt.kbhit():  # type: ignore[attr-defined]
            msvcrt.getwch()  # type: ignore[attr-defined]
        return
    termios.tcflush(sys.stdin, termios.TCIFLUSH)


def tell(name: str, message: str) -> None:
    """One line on stderr, if that still leads anywhere: a closed terminal does not."""
    with suppress(OSError):
        print(f"cartpole-{name.replace('_', '-')}: {message}", file=sys.stderr)
