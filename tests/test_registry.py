"""Extensions by name: ours, a module's, an installed package's; one line for each that cannot be used."""

import copy
import pickle
import sys
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Annotated, Any

import pytest

from cartpole_rl import registry
from cartpole_rl.checking import validated
from cartpole_rl.errors import ConfigError
from cartpole_rl.registry import Extension, Registry
from cartpole_rl.settings import Settings


class Law(Extension):
    def __init__(self, name: str, item: Any, reads: tuple[str, ...] = ()) -> None:
        super().__init__(name, item)
        self.reads = reads


def is_short(item: Any) -> None:
    if len(item.__name__) > 9:
        raise ValueError("its name is too long")


LAWS = Registry("test_law", __name__, Law, is_short, decorated=True)
SHAPES = Registry("test_shape", __name__)


@LAWS.register("double", reads=("x",))
def double(x: float) -> float:
    return 2 * x


SHAPES.add("path", "pathlib:PurePosixPath")


class Chosen(Settings):
    law: Annotated[Law, LAWS]
    shape: Annotated[Extension, SHAPES] = SHAPES.find("path")


@pytest.fixture(autouse=True)
def own_modules(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Modules of a user in the current folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setattr(LAWS, "_entries", {**LAWS._entries})
    sys.modules.pop("own_laws", None)
    (tmp_path / "own_laws.py").write_text(
        "from cartpole_rl.registry import Registry\n"
        "register = Registry.all['test_law'].register\n"
        "@register(reads=('y',))\ndef triple(x): return 3 * x\n"
        "@register('named')\ndef other(x): return x\n"
        "def bare(x): return x\n"
    )
    (tmp_path / "long_laws.py").write_text(
        "from cartpole_rl.registry import Registry\n"
        "@Registry.all['test_law'].register()\ndef overly_long(x): return x\n"
    )
    (tmp_path / "broken.py").write_text("import os\nundefined\n")


def test_ours_equal_their_names_and_pass_calls_on() -> None:
    chosen = Chosen(law="double")
    assert chosen.law == "double"
    assert (chosen.law(4), chosen.law.reads, chosen.law.item) == (8, ("x",), double)
    assert chosen.shape("a/b").name == "b"
    assert chosen.model_dump(mode="json") == {"law": "double", "shape": "path"}
    assert type(chosen.model_dump(mode="json")["law"]) is str
    assert Chosen(**chosen.model_dump()).law is chosen.law


@pytest.mark.parametrize("name", ["own_laws:triple", "own_laws:other"])
def test_a_decorated_object_of_a_users_module(name: str) -> None:
    chosen = Chosen(law=name)
    assert chosen.law == name
    assert chosen.law.reads == (("y",) if name.endswith("triple") else ())
    assert chosen.law(2) == (6 if name.endswith("triple") else 2)


@pytest.mark.parametrize("name", ["double", "own_laws:other"])
def test_pickled_and_copied_it_is_the_same(name: str) -> None:
    law = LAWS.find(name)
    assert copy.deepcopy(law) is law
    assert pickle.loads(pickle.dumps(law)) == law


def test_the_entry_point_of_an_installed_package(monkeypatch: pytest.MonkeyPatch) -> None:
    point = EntryPoint("installed", "own_laws:triple", "cartpole_rl.test_law")
    monkeypatch.setattr(registry, "entry_points", lambda group: [point] if group == point.group else [])
    registry._entry_points.cache_clear()
    assert LAWS.names == ["double", "installed"]
    assert Chosen(law="installed").law(2) == 6
    registry._entry_points.cache_clear()


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("doubel", "law=doubel: did you mean double? give 'double', or your own as module:name"),
        (3, "law=3: give text"),
        ("own_laws:", "write it as module:name"),
        (
            "nowhere:law",
            "there is no module 'nowhere' in the current folder, on PYTHONPATH or among installed packages",
        ),
        ("own_laws:no", "the module own_laws has no 'no'"),
        ("own_laws:bare", "own_laws:bare is not registered as a test law; docs/extending.md shows how"),
        ("long_laws:overly_long", "long_laws:overly_long is no test law: its name is too long"),
        ("broken:law", "broken cannot be imported: NameError: name 'undefined' is not defined ("),
    ],
)
def test_the_others_are_refused_in_one_line(name: Any, message: str) -> None:
    with pytest.raises(ConfigError) as raised:
        validated(Chosen, {"law": name})
    assert message in str(raised.value)
    assert str(raised.value).startswith(f"law={name}: ")
    assert "\n" not in str(raised.value)
    if isinstance(name, str):
        with pytest.raises(ConfigError, match=f"^test law '{name}'"):
            LAWS.find(name)


def test_a_name_is_taken_once() -> None:
    with pytest.raises(ConfigError, match="there is a test law 'double' already"):
        LAWS.add("double", is_short)


def test_a_module_that_fails_once_can_be_imported_when_it_is_mended(tmp_path: Path) -> None:
    """Also in the same process: what it registered before it failed is registered again."""
    module = tmp_path / "own_laws.py"
    right = module.read_text()
    module.write_text(f"{right}undefined\n")
    for _ in range(2):
        with pytest.raises(ConfigError, match="NameError: name 'undefined' is not defined"):
            LAWS.find("own_laws:triple")
    module.write_text(right)
    sys.modules.pop("own_laws", None)
    assert LAWS.find("own_laws:triple")(4) == 12
