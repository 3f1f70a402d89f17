"""Runs a script in a headless browser."""

import html
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
BROWSER = next(filter(None, map(shutil.which, BROWSERS)), None)


def in_browser(page: str, script: str, folder: Path) -> Any:
    """Return the JSON that `script`, at the end of the page, writes into its body."""
    assert BROWSER is not None
    file = folder / "page.html"
    file.write_text(page.replace("</body>", f"<script>{script}</script></body>"))
    words = ["--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={folder / 'profile'}"]
    done = subprocess.run(
        [BROWSER, *words, "--dump-dom", file.as_uri()], capture_output=True, text=True, timeout=300
    )
    (body,) = re.findall(r"<body>(.*)</body>", done.stdout, re.S)
    return json.loads(html.unescape(body))
