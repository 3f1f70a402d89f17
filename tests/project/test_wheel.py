"""The wheel holds conf/, firmware/ and the console scripts; what it installs trains and evaluates alone."""

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from command_line import ONCE, TINY

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.nightly


def pip(*words: str | Path) -> None:
    done = subprocess.run([sys.executable, "-m", "pip", "--quiet", *words], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    pip("wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", folder, ROOT)
    (built,) = folder.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def installed(wheel: Path) -> Path:
    """A folder that holds the package as a user's site-packages would."""
    target = wheel.parent / "site-packages"
    pip("install", "--no-deps", "--target", target, wheel)
    return target


def run(installed: Path, *commands: list[str]) -> Path:
    """Run commands of the installed package in a process that has no other copy of it; their folder."""
    environment = {**os.environ, "PYTHONPATH": str(installed), "PYTHONSAFEPATH": "1"}
    home = installed.parent / "home"
    home.mkdir()
    script = "import sys\nfrom cartpole_rl.cli import evaluate, train\n" + "".join(
        f"sys.argv = {['cartpole-' + name, *words]!r}\n{name}()\n" for name, *words in commands
    )
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=home, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return home


def test_it_holds_the_package_conf_and_the_scripts(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        (scripts,) = (archive.read(name).decode() for name in names if name.endswith("entry_points.txt"))
    shipped = {
        f"cartpole_rl/conf/{path.relative_to(ROOT / 'conf')}" for path in (ROOT / "conf").rglob("*.yaml")
    }
    firmware = {
        f"cartpole_rl/{path.relative_to(ROOT)}" for path in (ROOT / "firmware").rglob("*") if path.is_file()
    }
    modules = {str(path.relative_to(ROOT)) for path in (ROOT / "cartpole_rl").rglob("*.py")}
    assert shipped <= names
    assert modules | {"cartpole_rl/py.typed"} <= names
    assert firmware <= names
    assert {name.split("/")[0] for name in names if ".dist-info" not in name} == {"cartpole_rl"}
    for command in ("train", "evaluate", "emulate"):
        assert f"cartpole-{command} = cartpole_rl.cli:{command}" in scripts


def test_what_it_installs_trains_and_evaluates_by_its_own_conf(installed: Path) -> None:
    """Its own, as is seen by a seed that is changed there alone."""
    conf = installed / "cartpole_rl/conf/train.yaml"
    conf.write_text(conf.read_text().replace("\nseed: 0\n", "\nseed: 7\n"))
    home = run(
        installed,
        ["train", *TINY, ONCE, "hydra.run.dir=trained"],
        ["evaluate", "run=trained", "plant=emulated", "episodes=1", "hydra.run.dir=evaluated"],
    )
    assert json.loads((home / "evaluated/metrics.json").read_text())["plant"] == "emulated"
    provenance = json.loads((home / "trained/provenance.json").read_text())
    assert provenance["seed"] == 7
    assert provenance["git_commit"] is None  # it did not run from the checkout
