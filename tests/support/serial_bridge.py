"""A browser whose Web Serial leads to an emulated cart: bytes go through HTTP to its `EmulatorHost`."""

import json
import select
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from browser import BROWSER
from emulator_host import SILENCE, EmulatorHost

from cartpole_rl.errors import FrameError
from cartpole_rl.wire.frames import Frame, FrameSplitter, decode_frame

READ_SLICE = 0.05  # s

# A port as https://wicg.github.io/serial/ describes it. The cable is pulled when the bridge ends its answer.
PORT = """<script>
class BridgedPort {
  readable = null;
  failures = 0; // of the next writes
  isFatal = false; // a failure: no other stream follows
  endsQuietly = false; // the stream, when the cable is pulled
  async open(options) {
    this.options = options;
    const answer = await fetch("/read");
    const pulled = (control) => {
      if (this.endsQuietly) return;
      this.readable = null;
      control.error(new DOMException("The device has been lost.", "NetworkError"));
    };
    this.readable = answer.body.pipeThrough(new TransformStream({ flush: pulled }));
    this.renewWritable();
  }
  renewWritable() {
    const write = async (bytes) => {
      if (!this.failures) return fetch("/write", { method: "POST", body: bytes });
      this.failures -= 1;
      this.writable = null;
      if (!this.isFatal) this.renewWritable();
      throw new DOMException("The write failed.", this.isFatal ? "NetworkError" : "UnknownError");
    };
    this.writable = new WritableStream({ write });
  }
  async setSignals(signals) { this.signals = signals; }
  async close() { await fetch("/close", { method: "POST" }); }
}
const port = new BridgedPort();
Object.defineProperty(navigator, "serial", { value: { requestPort: async () => port } });
</script>"""
SCRIPT = """<script>
const report = (found) => fetch("/report", { method: "POST", body: JSON.stringify(found) });
window.onerror = report;
</script><script>
const until = async (what) => { while (!what()) await new Promise((next) => setTimeout(next, 10)); };
const shown = (id) => !element(id).hidden;
const said = () => element("link").textContent;
WIRE.timeout = 200; // a slow machine is no silent cart
WIRE.attempts = WIRE.connectAttempts = WIRE.stopAttempts = 400;
WIRE.trips = 0; // the time of a cart in lockstep passes with each question, also with a repeated one
(async () => { %s })().catch((error) => report(`${error.stack}`));
</script></body>"""


class Bridge(ThreadingHTTPServer):
    """Serves a page, and copies bytes between its port and `host`."""

    daemon_threads = True

    def __init__(self, host: EmulatorHost, page: str) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.host, self.page = host, page.encode()
        self.written, self.read = b"", b""
        self.reported: SimpleQueue[Any] = SimpleQueue()
        self.closed, self.idle = threading.Event(), threading.Event()
        self.idle.set()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Print nothing: a browser that was ended takes no answer."""

    def report(self) -> Any:
        """Wait for what the script reports."""
        return self.reported.get(timeout=SILENCE)

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.server_port}/"


class Handler(BaseHTTPRequestHandler):
    """One request of the browser."""

    protocol_version = "HTTP/1.1"
    server: Bridge

    def log_message(self, format: str, *arguments: Any) -> None:
        """Print nothing."""

    def answer(self, content: bytes = b"", kind: str = "text/html; charset=utf-8") -> None:
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def do_GET(self) -> None:
        if self.path != "/read":
            self.answer(self.server.page if self.path == "/" else b"")
            return
        self.send_response(200)
        self.send_header("Content-Type", "application/octet-stream")
        self.send_header("X-Content-Type-Options", "nosniff")  # Chrome would wait for bytes to look at
        self.send_header("Connection", "close")
        self.end_headers()
        self.wfile.flush()
        bridge, port = self.server, self.server.host.serial
        bridge.closed.clear()
        bridge.idle.clear()
        with suppress(OSError):  # the cable is pulled, or the page has closed its port
            while not bridge.closed.is_set():
                if select.select([port], [], [], READ_SLICE)[0]:
                    data = port.read(port.in_waiting or 1)
                    bridge.read += data
                    self.wfile.write(data)
        bridge.idle.set()

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"] or 0))
        bridge = self.server
        if self.path == "/write":
            bridge.written += body
            with suppress(OSError):  # the cable is pulled
                bridge.host.serial.write(body)
        elif self.path == "/close":
            bridge.closed.set()
            bridge.idle.wait(SILENCE)
        self.answer()
        if self.path == "/report":  # the browser may be ended now
            bridge.reported.put(json.loads(body))


@contextmanager
def bridged(page: str, script: str, host: EmulatorHost, folder: Path, *options: str) -> Iterator[Bridge]:
    """Show a page with a port that leads to `host`, and run `script` in it, which may `await`.

    It has `until`, which waits for a condition, and ends with `report(value)`.
    """
    assert BROWSER is not None
    page = page.replace("<body>", f"<body>{PORT}").replace("</body>", SCRIPT % script)
    with Bridge(host, page) as bridge:
        threading.Thread(target=bridge.serve_forever, daemon=True).start()
        words = [
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            f"--user-data-dir={folder / 'profile'}",
            *options,
        ]
        command = [BROWSER, *words, "--remote-debugging-port=0", bridge.address]
        browser = subprocess.Popen(command, stderr=subprocess.DEVNULL)
        try:
            yield bridge
        finally:
            browser.terminate()
            browser.wait()
            bridge.closed.set()
            bridge.idle.wait(SILENCE)
            bridge.shutdown()


def frames(data: bytes) -> list[Frame]:
    """Return the undamaged frames in the bytes of one direction."""
    found = []
    for run in FrameSplitter().feed(data):
        try:
            found.append(decode_frame(run))
        except FrameError:
            continue
    return found
