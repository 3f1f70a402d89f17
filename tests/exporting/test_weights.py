"""A weights file comes back whole, and every damaged one is named in one clear line."""

import io
import json
import math
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cartpole_rl.errors import CheckpointError
from cartpole_rl.exporting.agent import ExportedAgent
from cartpole_rl.exporting.weights import read_agent, weights_file

Members = dict[str, bytes]


@pytest.fixture
def file(exported: ExportedAgent, tmp_path: Path) -> Path:
    (tmp_path / "agent.npz").write_bytes(weights_file(exported))
    return tmp_path / "agent.npz"


def complaint(path: Path) -> str:
    with pytest.raises(CheckpointError) as caught:
        read_agent(path)
    text = str(caught.value)
    assert str(path) in text
    assert "\n" not in text
    return text


def test_an_agent_comes_back(exported: ExportedAgent, file: Path) -> None:
    found = read_agent(file)
    assert found.description == exported.description
    assert found.checksum == exported.checksum
    for (name, values), (other, expected) in zip(found.arrays(), exported.arrays(), strict=True):
        assert name == other
        assert np.array_equal(values, expected)


def test_equal_agents_make_equal_files(exported: ExportedAgent, file: Path) -> None:
    assert weights_file(exported) == file.read_bytes()


def test_the_description_defines_the_observation(file: Path) -> None:
    with np.load(file) as archive:
        about = json.loads(archive["agent.json"])
    names = [(number["name"], number["periods_ago"], number["scale"]) for number in about["numbers"]]
    assert names == [
        ("x", 0, 0.38),
        ("x_dot", 0, 1.0),
        ("cos_theta", 0, 1.0),
        ("sin_theta", 0, 1.0),
        ("theta_dot", 0, 8.0),
        ("motor", 1, 255.0),
        ("motor", 2, 255.0),
        ("motor", 3, 255.0),
        ("x_dot", 1, 1.0),
        ("theta_dot", 1, 8.0),
    ]
    assert about["motors"] == [-250, -200, -150, -100, 0, 100, 150, 200, 250]
    assert about["guard"] == {"margin": 0.0145, "delay": 0.0967, "deceleration": 6.384}
    assert about["control_period"] == 0.02
    assert about["pole_lengths"] == [0.3556, 0.3556]
    assert about["provenance"]["command"][:2] == ["cartpole-train", "experiment=medium"]


def rewritten(file: Path, change: Callable[[Members], object]) -> Path:
    """Change the members of a file."""
    with zipfile.ZipFile(file) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    change(members)
    with zipfile.ZipFile(file, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return file


def array(values: Any, kind: Any = np.float32) -> bytes:
    content = io.BytesIO()
    np.save(content, np.asarray(values, kind))
    return content.getvalue()


def change_json(members: Members, **changes: Any) -> None:
    members["agent.json"] = json.dumps(json.loads(members["agent.json"]) | changes).encode()


DAMAGE: dict[str, tuple[Callable[[Members], object], str]] = {
    "another weight": (
        lambda members: members.update({"layer0.bias.npy": array(np.zeros(128))}),
        "checksum",
    ),
    "another guard": (lambda members: change_json(members, guard=None), "checksum"),
    "another motor value": (
        lambda members: change_json(members, motors=[-255, -200, -150, -100, 0, 100, 150, 200, 250]),
        "checksum",
    ),
    "no checksum": (lambda members: change_json(members, sha256=None), "checksum"),
    "an array too many": (lambda members: members.update({"extra.npy": array([1])}), "checksum"),
    "a missing array": (lambda members: members.pop("layer1.bias.npy"), "layer1.bias"),
    "no gain": (lambda members: members.pop("layer0.gain.npy"), "layer0.gain"),
    "a missing layer": (lambda members: members.pop("layer2.weight.npy"), "layer2"),
    "another shape": (
        lambda members: members.update({"layer0.bias.npy": array(np.zeros(3))}),
        "layer0.bias has shape (3,), not (128,)",
    ),
    "not a number": (
        lambda members: members.update({"layer0.bias.npy": array(np.full(128, np.nan))}),
        "layer0.bias is not finite",
    ),
    "another format": (lambda members: change_json(members, format="other"), "its format is 'other'"),
    "an unknown key": (lambda members: change_json(members, more=1), "more in agent.json"),
    "a motor value out of range": (lambda members: change_json(members, motors=[-300] * 9), "motors"),
    "other scales": (lambda members: change_json(members, numbers=[]), "contradicts itself"),
    "no description": (lambda members: members.pop("agent.json"), "is not a weights file"),
    "no JSON": (lambda members: members.update({"agent.json": b"{"}), "is not a weights file"),
    "an infinite number": (
        lambda members: change_json(members, provenance={"score": math.inf}),
        "is not a weights file",
    ),
    "no sizes": (lambda members: change_json(members, sizes=[]), "sizes in agent.json"),
    "one size": (lambda members: change_json(members, sizes=[10]), "sizes in agent.json"),
    "text": (
        lambda members: members.update({"layer0.bias.npy": array(["one"] * 128, str)}),
        "is not a weights file",
    ),
    "bytes": (lambda members: members.update({"layer0.bias.npy": b"one"}), "is not a weights file"),
    "a member more": (lambda members: members.update({"more.txt": b"one"}), "is not a weights file"),
    "a list": (lambda members: members.update({"agent.json": b"[]"}), "is not a weights file"),
    "a pickle": (
        lambda members: members.update({"layer0.bias.npy": pickled()}),
        "is not a weights file",
    ),
}


def pickled() -> bytes:
    content = io.BytesIO()
    np.save(content, np.array([{}]), allow_pickle=True)
    return content.getvalue()


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_file_is_refused(damage: str, file: Path) -> None:
    change, expected = DAMAGE[damage]
    assert expected in complaint(rewritten(file, change))


@pytest.mark.parametrize("kind", [np.float64, np.complex128, ">f4"])
def test_numbers_of_another_kind_are_refused(kind: Any, exported: ExportedAgent, file: Path) -> None:
    """Converted to float32, these are the weights of the file, and have its checksum."""
    members = {"layer0.bias.npy": array(exported.layers[0].bias, kind)}
    assert "is not a weights file" in complaint(rewritten(file, lambda found: found.update(members)))


def test_encoders_of_another_cart_are_refused(exported: ExportedAgent, tmp_path: Path) -> None:
    for changes in ({"cart_metres_per_count": 4.5e-5}, {"pole_counts_per_turn": 2048}):
        about = exported.description.model_copy(update=changes)
        (tmp_path / "agent.npz").write_bytes(weights_file(ExportedAgent(about, exported.layers)))
        assert "contradicts itself" in complaint(tmp_path / "agent.npz")


def test_a_file_that_is_none_is_refused(file: Path, tmp_path: Path) -> None:
    assert "there is no such file" in complaint(tmp_path / "nowhere.npz")
    file.write_bytes(file.read_bytes()[:1000])
    assert "is not a weights file, or is damaged" in complaint(file)
    file.write_text("text")
    assert "is not a weights file" in complaint(file)


def test_an_agent_that_is_not_finite_is_refused(exported: ExportedAgent) -> None:
    first = exported.layers[0]
    broken = first._replace(bias=np.full_like(first.bias, np.inf))
    with pytest.raises(CheckpointError, match=r"run: layer0\.bias is not finite"):
        ExportedAgent(exported.description, (broken, *exported.layers[1:])).check("run")
