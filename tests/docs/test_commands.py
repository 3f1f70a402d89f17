"""Every command of the pages in docs/ is one that the package takes: names, groups, keys and options exist.

The README's commands are run by tests/readme; those of docs/extending.md by test_extending.py.
"""

import re
import shlex
from importlib.util import find_spec
from pathlib import Path

import pytest
from command_line import in_process

ROOT = Path(__file__).parents[2]
PAGES = sorted([*ROOT.glob("docs/**/*.md"), ROOT / "runs/README.md", ROOT / "CONTRIBUTING.md"])
CHOICE_FILES = {
    "cart": "conf/cart/ip02.yaml",
    "pole": "conf/pole/medium.yaml",
    "randomization": "conf/randomization/wide.yaml",
}


def commands(start: str) -> list[tuple[str, str]]:
    """The commands in indented blocks that begin with `start`, each with its page."""
    found = []
    for page in PAGES:
        text = re.sub(r" *\\\n +", " ", page.read_text())
        for line in re.findall(rf"^    ({start}.*?)(?:\s+#.*)?$", text, re.M):
            found.append((page.relative_to(ROOT).as_posix(), line))
    return found


def needs_extra(words: list[str]) -> bool:
    """Return True for a launcher or a sweeper that is not part of Hydra."""
    starts = "sweep=optuna", "hydra/launcher=", "hydra/sweeper="
    return any(word.startswith(starts) for word in words) and find_spec("hydra_plugins") is None


@pytest.mark.parametrize(("page", "command"), commands("cartpole-"))
def test_the_command_composes(page: str, command: str, tmp_path: Path) -> None:
    name, *words = shlex.split(re.sub("<.*?>", "run", command))
    for group, file in CHOICE_FILES.items():
        words = [re.sub(rf"^{group}=runs/.*\.yaml$", f"{group}={ROOT / file}", word) for word in words]
    if needs_extra(words):
        pytest.skip("its launcher or sweeper is an extra: scripts/sweeps runs it")
    if "-m" in words:  # Hydra does not compose a sweep as a whole: its first job
        words = [re.sub(r"=range\(.*\)$", "=0", word).partition(",")[0] for word in words if word != "-m"]
    verb = name.removeprefix("cartpole-").replace("-", "_")
    done = in_process(verb, *words, "--cfg", "job", folder=tmp_path)
    assert done.code == 0, f"{page}: {command}\n{done.err}"


@pytest.mark.parametrize(("page", "command"), commands("(?:\\./)?scripts/"))
def test_the_script_and_its_options_exist(page: str, command: str) -> None:
    name, *words = shlex.split(re.sub("<.*?>", "run", command))
    script = ROOT / name
    assert script.stat().st_mode & 0o100, f"{page}: {name} cannot be run"
    code = "".join(file.read_text() for file in {script, *script.parent.glob("*.py")})
    options = [word for word in words if word.startswith("--")]
    assert [option for option in options if option not in code] == [], f"{page}: {command}"
