"""With `CI` set nothing that tests need is missing; otherwise a skip says what to install."""

import os
import re
import shutil
import sys
import sysconfig
from importlib.util import find_spec
from pathlib import Path

import pytest

REMEDIES = {
    "av": 'pip install "cartpole_rl[video]"',
    "mcap": 'pip install "cartpole_rl[mcap]"',
    "minari": 'pip install "cartpole_rl[minari]"',
    "mlflow": 'pip install "cartpole_rl[mlflow]"',
    "mujoco": 'pip install "cartpole_rl[emulator]"',
    "onnxruntime": 'pip install "cartpole_rl[dev]"',
    "onnxscript": 'pip install "cartpole_rl[export]"',
    "psutil": 'pip install "cartpole_rl[dev]"',
    "pyarrow": 'pip install "cartpole_rl[parquet]"',
    "sphinx": 'pip install "cartpole_rl[docs]"',
    "wandb": 'pip install "cartpole_rl[wandb]"',
    "g++": "install a C++ compiler",
    "Python.h": "install Python's headers",
}


def is_there(what: str) -> bool:
    """Return True if a module, a program or Python's header is available."""
    if what == "Python.h":
        return Path(sysconfig.get_path("include"), what).exists()
    if what == "g++":
        return shutil.which(what) is not None
    try:
        return find_spec(what) is not None
    except ValueError:  # `None` among the modules, as the test below has it
        return False


def require(what: str) -> None:
    """Fail in CI, otherwise skip, if it is missing."""
    if is_there(what):
        return
    message = f"{what} is missing, and tests are skipped without it: {REMEDIES[what]}"
    if os.environ.get("CI", "").lower() not in ("", "0", "false"):
        pytest.fail(message)
    pytest.skip(message)


@pytest.mark.parametrize("what", list(REMEDIES))
def test_requirements_of_tests_are_installed(what: str) -> None:
    require(what)


@pytest.mark.parametrize("what", ["av", "g++", "Python.h"])
def test_nothing_can_be_missing_in_ci(what: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, what, None)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(sysconfig, "get_path", lambda name: str(tmp_path))
    assert not is_there(what)
    monkeypatch.setenv("CI", "true")
    with pytest.raises(pytest.fail.Exception, match="install"):
        require(what)
    for outside in ("", "false"):
        monkeypatch.setenv("CI", outside)
        with pytest.raises(pytest.skip.Exception, match="install"):
            require(what)


def test_the_stages_of_the_dockerfile_run_the_scripts_of_the_readme() -> None:
    root = Path(__file__).parents[2]
    text = (root / "Dockerfile").read_text()
    assert re.findall(r'^CMD \["(.+)"\]$', text, re.M) == ["scripts/demo", "scripts/test"]
    extras = re.findall(r"^RUN scripts/install --cpu (\S+)$", text, re.M)
    assert [f"scripts/install {each}" for each in extras] == [
        next(line for line in (root / script).read_text().splitlines() if line.startswith("scripts/install "))
        for script in ("scripts/demo", "scripts/test")
    ]
