"""The live page of a cart or a training, served on this computer alone by a process of its own.

The process reads the snapshots that the driving process leaves in shared memory, so a slow browser delays
nothing. The page asks for the newest one: it never shows an old one, and no connection stays open that the
button would have to wait for. All addresses begin with a secret of the run. The one command that the page
sends is stop: it interrupts the run as Ctrl-C does. It imports no PyTorch, so that it starts at once.
"""

import hmac
import html
import json
import math
import multiprocessing
import os
import re
import secrets
import signal
import socket
import sys
import threading
from collections.abc import Iterable
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from multiprocessing.queues import Queue
from pathlib import Path
from typing import Any, NamedTuple, Self

from cartpole_rl.drawing import filled, shared_parts
from cartpole_rl.errors import ConfigError
from cartpole_rl.evaluation.snapshots import Memory, driver, new_memory, read
from cartpole_rl.reporting.live_view import LiveView
from cartpole_rl.scheduling import lose_precedence
from cartpole_rl.signals import end_with_parent, kept_from_children

HERE = "127.0.0.1"
HOSTS = (HERE, "localhost")  # in the Host of a request: a page elsewhere may give its own name our address
LONGEST_BODY = 1000  # bytes of a request; that of the button is empty
LESS_URGENT = 10  # niceness: below the driving process, but the button answers on a busy computer, too
NOTE = "by the button of the page"
STOPPED = "Stop is sent: the motor goes to 0. The terminal says what was kept."
TRAINING_STOPPED = "The training stops; the terminal says what was kept."
CLOSED = "Closed."
HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; "
    "connect-src 'self'; form-action 'self'; frame-src 'self'; frame-ancestors 'self'; base-uri 'none'",
    "Referrer-Policy": "same-origin",
    "X-Content-Type-Options": "nosniff",
}


def chosen_view(title: str, chosen: str, pole_length: float) -> "LiveView | WebView":
    """Return the view of `view=chosen`, of a cart with a pole of `pole_length` m. Raises ConfigError."""
    return WebView(title, pole_length) if chosen == "web" else LiveView(title, chosen)


class WebView:
    """A context manager of the process that serves the page.

    The page shows the cart in `memory`, or `episodes`, as `episodes.columns` returns each. `add` adds one;
    the page of a training, which `grows`, shows the newest. Raises ConfigError where no process can interrupt
    another.
    """

    def __init__(
        self,
        title: str,
        pole_length: float,
        episodes: Iterable[dict[str, Any]] | None = None,
        grows: bool = False,
    ) -> None:
        if os.name != "posix":
            raise ConfigError("view=web needs Linux or macOS; leave it out")
        self.memory: Memory | None = new_memory() if episodes is None else None
        self._listener = socket.create_server((HERE, 0))
        self._secret = secrets.token_urlsafe(24)
        context = multiprocessing.get_context("spawn")
        self._stopped = context.RawValue("b", 0)
        with kept_from_children():
            self._added = context.Queue()  # which a thread sends: a page that hangs holds up nothing
        shown = page(title, pole_length, self.memory is None, grows)
        ignored = signal.getsignal(signal.SIGINT) == signal.SIG_IGN  # as a shell's & leaves it
        answer = STOPPED if self.memory else TRAINING_STOPPED if grows else CLOSED
        stop = Stop(os.getpid(), signal.SIGTERM if ignored else signal.SIGINT, self._stopped, answer)
        site = Site(self._secret, shown, [*map(json.dumps, episodes or ())], self.memory, stop)
        arguments = self._listener, site, self._added
        self._process = context.Process(target=serve, args=arguments, daemon=True)

    @property
    def address(self) -> str:
        """The address of the page."""
        return f"http://{HERE}:{self._listener.getsockname()[1]}/{self._secret}/"

    def __enter__(self) -> Self:
        print(f"view=web: {self.address}", file=sys.stderr)
        with kept_from_children():
            self._process.start()
        return self

    def __exit__(self, kind: object, error: BaseException | None, traceback: object) -> None:
        self._process.kill()  # it has nothing to save, and may be suspended
        self._process.join()
        self._added.cancel_join_thread()
        self._listener.close()
        if error is not None and self._stopped.value:
            error.add_note(NOTE)

    def add(self, episode: dict[str, Any]) -> None:
        """Show one more episode, unless the page's process has ended."""
        self._added.put(episode)

    def wait(self) -> None:
        """Return once the button of the page is pressed, or Ctrl-C."""
        with suppress(KeyboardInterrupt):
            self._process.join()


def page(title: str, pole_length: float, replays: bool, grows: bool = False) -> str:
    """Return the HTML of the page."""
    words = {
        "button": "Close" if replays and not grows else "Stop",
        "start": "replay" if replays else "ask",
        "grows": json.dumps(grows),
    }
    values = {**shared_parts(), **words, "title": html.escape(title), "pole": pole_length}
    return filled(Path(__file__).with_name("live.html"), values)


class Stop:
    """Interrupts the parent process, which then sets the motor to 0 and reports.

    `answer` is what the page says then.
    """

    def __init__(self, process: int, number: int, stopped: Any, answer: str) -> None:
        self.process, self._number, self._stopped, self.answer = process, number, stopped, answer

    def __call__(self, memory: Memory | None) -> None:
        """Send the signal, unless that process has ended; also to the one that drives the cart in `memory`.

        A terminal sends it to both: a fine-tuning learns at the lowest priority, and may stop the motor late.
        """
        self._stopped.value = 1
        if os.getppid() != self.process:
            return
        os.kill(self.process, self._number)  # first: it takes the other one's end for an error
        driving = driver(memory) if memory else 0
        if driving not in (0, self.process):
            with suppress(ProcessLookupError):
                os.kill(driving, self._number)


class Site(NamedTuple):
    """The page `shown` under the path /`secret`/, and what it asks for: the cart, or a recording."""

    secret: str
    shown: str
    recording: list[str]  # each episode as JSON; a process that serves a training appends them
    memory: Memory | None
    stop: Stop

    def newest(self) -> str:
        """Return the newest snapshot and its number as JSON; null for a number that is not finite."""
        number, snapshot = (self.memory and read(self.memory)) or (0, None)
        shown = snapshot and {
            name: value if math.isfinite(value) else None for name, value in snapshot._asdict().items()
        }
        return json.dumps({"number": number, "snapshot": shown})


def serve(listener: socket.socket, site: Site, added: "Queue[dict[str, Any]]") -> None:
    """Answer requests until the process is ended or its parent ends."""
    end_with_parent(site.stop.process)
    lose_precedence(LESS_URGENT)

    def receive() -> None:
        while True:
            site.recording.append(json.dumps(added.get()))

    threading.Thread(target=receive, daemon=True).start()
    Server(listener, site).serve_forever()


class Server(ThreadingHTTPServer):
    """Answers requests to a site at an open port."""

    daemon_threads = True

    def __init__(self, listener: socket.socket, site: Site) -> None:
        super().__init__(listener.getsockname(), Handler, bind_and_activate=False)
        self.socket.close()
        self.socket, self.site = listener, site

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Do nothing: a browser that goes away is no error."""


class Handler(BaseHTTPRequestHandler):
    """Answers a request; one to another host, or without the secret, is refused."""

    protocol_version = "HTTP/1.1"
    timeout = 10  # s, of a connection that says nothing
    server: Server

    def do_GET(self) -> None:
        """Answer with the page, the newest snapshot, or the episodes from number n on: recording?from=n."""
        name = self.wanted()
        known = re.fullmatch(r"recording\?from=(\d{1,9})", name or "", re.ASCII)
        if name == "":
            self.answer(200, self.server.site.shown, "text/html")
        elif name == "now":
            self.answer(200, self.server.site.newest(), "application/json")
        elif known:
            episodes = self.server.site.recording[int(known[1]) :]
            self.answer(200, f"[{','.join(episodes)}]", "application/json")
        elif name is not None:
            self.answer(404, "There is nothing here.")

    def do_POST(self) -> None:
        """Stop the run. A page of another origin is refused, although it cannot know the secret."""
        length = self.headers.get("Content-Length", "0")
        self.close_connection = True
        if not length.isdecimal() or int(length) > LONGEST_BODY:
            self.answer(413, "The request is too long.")
            return
        self.rfile.read(int(length))
        name, origin = self.wanted(), self.headers.get("Origin")
        if name is not None and origin not in (None, f"http://{self.headers['Host']}"):
            self.answer(403, "Another page asked.")
        elif name == "stop":
            text = f'<meta name="color-scheme" content="light dark">{self.server.site.stop.answer}'
            try:  # first: the parent ends this process
                self.answer(200, text, "text/html")
            finally:
                self.server.site.stop(self.server.site.memory)
        elif name is not None:
            self.answer(404, "There is nothing here.")

    def wanted(self) -> str | None:
        """Return what follows the secret in the path; None once the request is refused."""
        secret, _, name = self.path.removeprefix("/").partition("/")
        if self.headers.get("Host", "").partition(":")[0] not in HOSTS:
            self.answer(403, "This page is for its own computer alone.")
        elif not hmac.compare_digest(secret.encode(), self.server.site.secret.encode()):
            self.answer(404, "There is nothing here.")
        else:
            return name
        return None

    def answer(self, status: int, text: str, kind: str = "text/plain") -> None:
        """Send a response; the connection ends after a refusal."""
        content = text.encode()
        self.close_connection |= status != 200
        self.send_response(status)
        lengths = {"Content-Type": f"{kind}; charset=utf-8", "Content-Length": str(len(content))}
        for name, value in {**HEADERS, **lengths}.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format: str, *arguments: Any) -> None:
        """Print nothing: the terminal is the run's."""
