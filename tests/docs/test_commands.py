"""Every command of the pages in docs/ is one that the package takes: names, groups, keys and options exist.

The commands of the README and the guides are run by test_guides.py, those of docs/extending.md by
test_extending.py, the Python blocks by workflows/test_python_api.py, test_your_own_code.py and
envs/test_torchrl_example.py. Here are those that need an extra, whose settings are composed, and scripts that
take hours: their options exist. What a Python block imports exists. No block is left out.
"""

import ast
import re
import shlex
import subprocess
import tomllib
from contextlib import suppress
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from page_commands import NEED_EXTRAS, PAGES, ROOT, guide_commands, run_here

from cartpole_rl.workflows.config import load_settings

OTHER_PAGES = [*(page for page in PAGES if page.name != "extending.md"), ROOT / "README.md"]
CHECKED = (
    "cartpole-",
    "scripts/",
    "./scripts/",
    "pip ",
    "make ",
    "tensorboard ",
)
ACTIVATE = "source .venv/bin/activate"
NEED_HARDWARE = {
    "docs/firmware.md": (
        "arduino-cli ",
        "mkdir -p ~/Arduino",
        "openocd ",
        "ln -s ",
        "make -C firmware nucleo",
    ),
    "docs/two-machines.md": ("ray start ",),  # another machine; scripts/bench/two_machines.py runs it
}
NOT_COMMANDS = {  # drawings, formulas, files, what a command prints, and a builtin of the shell
    "README.md": (ACTIVATE,),
    "docs/protocol.md": ("COBS(", "time ", "cart ", "line ", "host ", "motor ", "power, reset"),
    "docs/house.md": ("conf/ ──>",),
    "docs/first-hour.md": ("OK  ", ACTIVATE),
    "docs/safety.md": ("x + margin",),
    "docs/my-cart.md": (  # test_my_cart.py
        *("defaults:", "choices:", "pole_", "cart", "track_", "moving_mass:", "port:", "full:", "line:"),
        *("separator:", "time_unit:", "pole_unit:", "sends:", "damping:", "fastest:"),
    ),
    "docs/results/real.md": ("git clone", "git -C"),  # a gigabyte of recordings of others
    "docs/identification.md": (
        "defaults:",
        "time:",
        "position:",
        "angle:",
        "motor:",
        "keep:",
    ),  # test_logs.py
    "docs/randomization.md": ("cart_mass:", "cart_coulomb:", "pole_viscous:"),
}
BLOCKS = re.compile(r"(?:(?<=\n\n)|\A)(?:    .*\n(?:\n(?=    ))?)+")


@pytest.mark.parametrize(
    ("page", "command"),
    [
        (page, line)
        for page, line in guide_commands("cartpole-")
        if any(extra in line for extra in NEED_EXTRAS)
    ],
)
def test_the_command_that_needs_an_extra_composes(page: str, command: str, tmp_path: Path) -> None:
    if "sweep=optuna" in command and find_spec("hydra_plugins") is None:
        pytest.skip("its launcher or sweeper is an extra: scripts/sweeps runs it")
    fixed = re.sub(r" '\S+=interval\(.*?\)'", "", command)  # Hydra composes one job, not a search
    done = run_here(fixed, "--cfg", "job", cwd=tmp_path)
    assert done.returncode == 0, f"{page}: {command}\n{done.stderr}"


@pytest.mark.parametrize(("page", "command"), guide_commands("(?:\\./)?scripts/"))
def test_the_script_and_its_options_exist(page: str, command: str) -> None:
    name, *words = shlex.split(re.sub("<.*?>", "run", command))
    script = ROOT / name
    assert script.stat().st_mode & 0o100, f"{page}: {name} cannot be run"
    files = {script, *script.parent.glob("*.py"), *(script.parent / "thesis").glob("*.py")}
    code = "".join(file.read_text() for file in files)
    options = [word for word in words if word.startswith("--")]
    assert [option for option in options if option not in code] == [], f"{page}: {command}"


def test_blocks_are_found() -> None:
    pages = [page for page in OTHER_PAGES if BLOCKS.search(page.read_text())]
    assert len(pages) > 15


@pytest.mark.parametrize("page", ["python-api", "your-own-code", "torchrl"])
def test_what_a_python_block_imports_exists_and_its_settings_are_right(page: str) -> None:
    """Settings that a block builds from its own variables are left to the tests that run it."""
    text = (ROOT / f"docs/{page}.md").read_text()
    names: dict[str, Any] = {}
    for node in ast.walk(ast.parse("".join(re.findall(r"^```python\n(.*?)^```", text, re.M | re.S)))):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("cartpole_rl"):
            for name in node.names:
                names[name.name] = getattr(import_module(node.module), name.name)
        elif isinstance(node, ast.Call) and getattr(node.func, "id", "") == "load_settings":
            schema, words = node.args
            assert isinstance(schema, ast.Name)
            with suppress(ValueError):  # not literal
                load_settings(names[schema.id], ast.literal_eval(words))
    assert names


@pytest.mark.parametrize("page", OTHER_PAGES, ids=lambda page: page.name)
def test_every_line_of_a_block_is_checked_here_or_needs_hardware(page: Path) -> None:
    name = page.relative_to(ROOT).as_posix()
    known = (*CHECKED, *NEED_HARDWARE.get(name, ()), *NOT_COMMANDS.get(name, ()))
    text = re.sub(r" *\\\n +", " ", re.sub(r"^```python\n.*?^```", "", page.read_text(), flags=re.M | re.S))
    assert "```" not in text, "a fenced block that is not Python"
    lines = [line[4:] for block in BLOCKS.findall(text) for line in block.splitlines() if line.strip()]
    assert [line for line in lines if not line.startswith((" ", *known))] == []


@pytest.mark.parametrize(("page", "command"), guide_commands("pip "))
def test_the_extras_that_are_installed_exist(page: str, command: str) -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    words = shlex.split(command)
    assert words[:5] == ["pip", "install", "-c", "constraints.txt", "-e"], f"{page}: {command}"
    assert set(words[5].removeprefix(".[").removesuffix("]").split(",")) <= set(extras)


@pytest.mark.parametrize(("page", "command"), [*guide_commands("make "), *guide_commands("tensorboard ")])
def test_the_target_exists_and_the_folder_is_that_of_runs(page: str, command: str) -> None:
    words = shlex.split(command)
    if words[0] == "tensorboard":
        assert words[1:] == ["--logdir", "runs"], f"{page}: {command}"
    elif "-C" not in words:
        assert subprocess.run([*words, "--dry-run"], cwd=ROOT, capture_output=True).returncode == 0


@pytest.mark.parametrize(
    ("page", "folder", "pattern"),
    [
        ("scripts/README.md", "scripts/bench", "{}.py"),
        ("docs/randomization.md", "conf/randomization", "`{}`"),
    ],
)
def test_a_page_names_each_file_of_a_folder(page: str, folder: str, pattern: str) -> None:
    text = (ROOT / page).read_text()
    names = [path.stem for path in (ROOT / folder).iterdir() if path.suffix in (".py", ".yaml")]
    assert [name for name in names if pattern.format(name) not in text] == []
