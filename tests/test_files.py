"""Text files are UTF-8, whatever the locale."""

import os
import subprocess
import sys
from pathlib import Path

SCRIPT = r"""
import sys
from pathlib import Path
from cartpole_rl.files import write_text
write_text(Path(sys.argv[1]), "press \u2190")
"""


def test_text_is_utf_8_in_every_locale(tmp_path: Path) -> None:
    environment = {**os.environ, "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    subprocess.run([sys.executable, "-c", SCRIPT, tmp_path / "text"], env=environment, check=True)
    assert (tmp_path / "text").read_bytes() == b"press \xe2\x86\x90"
