"""Text files are UTF-8, whatever the locale; a file that cannot be written is named and leaves no part."""

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest
from small_files import files_of_at_most

from cartpole_rl.errors import ConfigError
from cartpole_rl.files import claimed, replacing, write_text

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


def test_a_text_that_cannot_be_written_leaves_the_earlier_one(tmp_path: Path) -> None:
    path = tmp_path / "text"
    write_text(path, "earlier")
    with files_of_at_most(4096), pytest.raises(OSError, match="File too large") as caught:
        write_text(path, "x" * 100_000)
    assert (caught.value.errno, caught.value.filename) == (errno.EFBIG, str(path))
    assert path.read_text() == "earlier"
    assert [each.name for each in tmp_path.iterdir()] == ["text"]


@pytest.mark.parametrize(
    "error", [KeyboardInterrupt(), ValueError("wrong"), OSError(errno.ENOENT, "", "other")]
)
def test_other_errors_stay_and_leave_no_part(error: BaseException, tmp_path: Path) -> None:
    def fail_in_the_middle() -> None:
        with replacing(tmp_path / "text") as beside:
            beside.write_bytes(b"a part")
            raise error

    with pytest.raises(type(error)) as caught:
        fail_in_the_middle()
    assert caught.value is error
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(os.name != "posix", reason="folders have no locks")
def test_a_folder_is_claimed_once_and_until_the_end(tmp_path: Path) -> None:
    with claimed(tmp_path / "run"):
        with pytest.raises(ConfigError, match=r"another process works in .*run; wait for its end"):
            claimed(tmp_path / "run").__enter__()
        with claimed(tmp_path / "other"):
            pass
    with claimed(tmp_path / "run"):
        assert not list((tmp_path / "run").iterdir())


def test_a_file_is_no_folder_to_claim(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for folder in (tmp_path / "file", tmp_path / "file" / "run"):
        with pytest.raises(ConfigError, match="this path, or a part of it, is a file; give another folder"):
            claimed(folder).__enter__()
