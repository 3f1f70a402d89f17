"""A small study to make pages of, and to damage."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from small_study import make_study


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of all studies, with one in it; it is not to be changed."""
    root = tmp_path_factory.mktemp("studies") / "quick"
    make_study(root / "friction")
    return root


@pytest.fixture
def study(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the study, to damage; the working directory is above the folder of all studies."""
    shutil.copytree(made, tmp_path / "quick")
    monkeypatch.chdir(tmp_path)
    return Path("quick/friction")


@pytest.fixture
def edit() -> Callable[[Path, Callable[[Any], object]], None]:
    """Change a JSON or YAML file in place."""

    def change(path: Path, how: Callable[[Any], object]) -> None:
        is_json = path.suffix == ".json"
        content = (json.loads if is_json else yaml.safe_load)(path.read_text())
        how(content)
        path.write_text((json.dumps if is_json else yaml.safe_dump)(content))

    return change
