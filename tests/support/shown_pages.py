"""What a page loads, and what a browser without a network shows of it."""

import html
import json
import re
import subprocess
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
from browser import BROWSER, BROWSERS

PROBE = """<script>
const broken = [];
window.addEventListener("error", event => broken.push(event.message));
window.addEventListener("load", () => {
  const wide = window.innerWidth;
  document.body.dataset.found = JSON.stringify({
    errors: broken,
    images: [...document.images].map(image => [image.alt, image.naturalWidth]),
    figures: [...document.querySelectorAll("svg[role=img]")].map(
      figure => [figure.getAttribute("aria-label"), figure.getBoundingClientRect().height]),
    lost: [...document.querySelectorAll("a")].map(link => link.getAttribute("href")).filter(
      href => !href.startsWith("#") || !document.getElementById(href.slice(1))),
    overflow: document.documentElement.scrollWidth - wide,
    paper: getComputedStyle(document.body).backgroundColor,
    text: getComputedStyle(document.querySelector("svg text")).fill,
  });
});
</script>"""
needs_browser = pytest.mark.skipif(
    BROWSER is None, reason=f"no browser among {', '.join(BROWSERS)}: apt-get install chromium"
)


class _Sources(HTMLParser):
    """Everything that a page loads."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.found: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        names = ("src", "srcset", "data") if tag not in ("link",) else ("href",)
        self.found += [value or "" for name, value in attrs if name in names]


def loaded(page: str) -> list[str]:
    """Return the sources of everything that a page loads."""
    return _Sources(page).found


def shown(page: str, *options: str) -> dict[str, Any]:
    """Open a page in a browser without a network; return what it shows."""
    probed = Path("probed.html").resolve()
    probed.write_text(page.replace("<head>", f"<head>{PROBE}"))
    assert BROWSER
    words = ["--headless", "--no-sandbox", "--disable-gpu", "--proxy-server=127.0.0.1:9"]
    words += ["--enable-logging=stderr", "--virtual-time-budget=10000", *options, "--dump-dom"]
    done = subprocess.run([BROWSER, *words, probed.as_uri()], capture_output=True, text=True, timeout=300)
    console = [line for line in done.stderr.splitlines() if ":CONSOLE" in line]
    found = re.search(r'data-found="([^"]*)"', done.stdout)
    assert found, done.stderr[-2000:]
    return {**json.loads(html.unescape(found[1])), "console": console}
