"""An exported agent is the trained one; its weights file comes back whole or is refused in one clear line."""

import copy
import io
import itertools
import json
import math
import shutil
import zipfile
from collections import defaultdict, deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from parity import assert_same_actions
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import nn

from cartpole_rl.agents.network import FrameReader, MirrorQNetwork, QNetwork
from cartpole_rl.envs.build import simulated_env
from cartpole_rl.errors import CheckpointError, ConfigError
from cartpole_rl.exporting.agent import (
    ExportedAgent,
    Floats,
    Layer,
    definitions,
    observed_numbers,
    read_agent,
)
from cartpole_rl.learning.agent import QAgent
from cartpole_rl.learning.checkpoints import load_agent, save_agent
from cartpole_rl.tasks.features import Quantity
from cartpole_rl.workflows.build import (
    TrainedAgent,
    exported_agent,
    network_of,
    new_agent,
    provenance,
    trained_agent,
)
from cartpole_rl.workflows.config import ExportConfig, TrainConfig, load_settings
from cartpole_rl.workflows.export import export
from examples.drive_without_torch import action_values

Change = Callable[[dict[str, bytes]], object]  # of the members of a file
SIGNS = [-1, 1, -1, -1]


OBSERVATIONS: dict[str, dict[str, Any]] = {
    "history": {},
    "raw": {"observation": "raw"},
    "positions": {"observation": "positions"},
    "length": {"observation": "history_length", "pole": "range", "observation.past_velocities": 2},
}


@pytest.mark.parametrize("overrides", OBSERVATIONS.values(), ids=OBSERVATIONS)
def test_the_definition_is_the_observation(overrides: dict[str, Any]) -> None:
    training = load_settings(TrainConfig, {**overrides, "guard": "none", "task.time_limit": 30})
    numbers = observed_numbers(training.observation)
    env = simulated_env(training, training.plant, 1, training.task.start, seed=1)
    past: deque = deque([defaultdict(float)] * 17, 17)
    present = env.reset()
    for period in range(20):
        x, x_dot, theta, theta_dot = present["state"][0].tolist()
        now = {"x": x, "x_dot": x_dot, "theta": theta, "theta_dot": theta_dot}
        now |= {"cos_theta": math.cos(theta), "sin_theta": math.sin(theta)}
        past.appendleft(now | {"pole_length": float(env.plant.pole_length)})
        found = [past[number.periods_ago][number.name] / number.scale for number in numbers]
        assert found == pytest.approx(present["observation"][0].tolist(), rel=1e-5, abs=1e-6)
        action = torch.tensor([7 * period % len(env.hardware.motors)])
        past[0]["motor"] = env.hardware.motors[action].item()
        present = env.step(present.set("action", action))["next"].exclude("reward")


def test_a_quantity_without_a_name_is_refused() -> None:
    with pytest.raises(ConfigError, match="has no name; name its Quantity"):
        definitions([Quantity(lambda state: state.x, -1)], 0)


@pytest.mark.parametrize(
    ("mirrored", "layer_norm", "hidden"),
    itertools.product((False, True), (False, True), ([], [8], [12, 6])),
)
def test_plain_layers_are_the_network(
    mirrored: bool, layer_norm: bool, hidden: list[int], exported: ExportedAgent
) -> None:
    torch.manual_seed(0)
    kind, first = (MirrorQNetwork, SIGNS) if mirrored else (QNetwork, len(SIGNS))
    network = kind(first, 5, hidden, layer_norm)
    for weight in network.parameters():  # a new layer normalization has no effect of its gain
        weight.data += 0.3 * torch.randn_like(weight)
    layers = [Layer(*each) for each in network.plain_layers()]
    about = exported.description.model_copy(update={"norm_groups": 2 if mirrored else 1})
    observations = torch.randn(20, len(SIGNS))
    for observation, values in zip(observations, network(observations), strict=True):
        found = action_values(about, layers, observation.numpy())
        assert found == pytest.approx(values.detach().numpy(), abs=1e-5)


def test_a_recurrent_network_is_refused() -> None:
    with pytest.raises(ConfigError, match="a recurrent agent"):
        QNetwork(4, 5, [8], True, FrameReader(4, [[0, 1], [2, 3]], 8)).plain_layers()


def smooth(agent: QAgent) -> TensorDictModuleBase:
    """With another activation than the plain layers have."""
    policy: Any = agent.greedy_policy()
    layers = policy.module[0].module.layers
    for place, module in enumerate(layers):
        layers[place] = nn.SiLU() if isinstance(module, nn.ReLU) else module
    return policy


def weak(agent: QAgent) -> TensorDictModuleBase:
    """Without full motor to the left."""

    def masked(value: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        value = value.index_fill(-1, torch.tensor(0), -1e3)
        return value, value.argmax(-1)

    keys = ["action_value", "action"]
    return TensorDictSequential(*agent.greedy_policy().module, TensorDictModule(masked, keys[:1], keys))


@pytest.mark.parametrize("changed", [smooth, weak])
def test_layers_that_are_not_the_policy_are_refused(
    changed: Callable[[QAgent], TensorDictModuleBase],
) -> None:
    training = load_settings(TrainConfig, {"agent.hidden": [16], "agent.mirrored": False, "guard": "none"})
    policy = changed(new_agent(training))
    with pytest.raises(ConfigError, match="its `plain_layers` give other action values than its policy"):
        exported_agent(TrainedAgent(training, policy), {})


def test_the_medium_agent_acts_as_in_pytorch(
    exported: ExportedAgent, observed: tuple[Floats, Floats]
) -> None:
    observations, expected = (each[::10] for each in observed)
    found = np.array([action_values(exported.description, exported.layers, each) for each in observations])
    assert found == pytest.approx(expected, abs=1e-4)
    assert_same_actions(found.argmax(1), expected)


def test_the_onnx_model_acts_as_in_pytorch_and_is_described(
    exported: ExportedAgent, medium_agent: TrainedAgent, observed: tuple[Floats, Floats]
) -> None:
    pytest.importorskip("onnxscript", reason='onnxscript is missing: pip install "cartpole_rl[export]"')
    onnxruntime = pytest.importorskip("onnxruntime", reason="pip install onnxruntime")
    from cartpole_rl.exporting.onnx_model import onnx_model

    session = onnxruntime.InferenceSession(onnx_model(exported, network_of(medium_agent)))
    observations, expected = observed
    values, actions = session.run(None, {"observation": observations})
    assert np.abs(values - expected).max() < 1e-4
    assert_same_actions(actions, expected)
    for number in (np.nan, np.inf, -np.inf):
        broken = observations[:2].copy()
        broken[0, 4] = number
        assert session.run(["action"], {"observation": broken})[0].tolist() == [-1, actions[1]]
    assert session.run(["action"], {"observation": observations[:1]})[0].shape == (1,)
    about = json.loads(session.get_modelmeta().custom_metadata_map["cartpole_rl"])
    assert about == json.loads(exported.json)
    assert about["sha256"] == exported.checksum


def test_a_weight_that_is_not_finite_is_refused_for_every_format(medium_agent: TrainedAgent) -> None:
    broken = TrainedAgent(medium_agent.training, copy.deepcopy(medium_agent.policy))
    with torch.no_grad():
        next(broken.policy.parameters()).fill_(torch.nan)
    with pytest.raises(CheckpointError, match=r"run: layer0\.weight is not finite"):
        exported_agent(broken, {})


@pytest.mark.parametrize("text", ["", "[]", '{"command": [1]}', '{"seed": Infinity}', "\xff"])
def test_a_damaged_provenance_is_left_out(text: str, medium_agent: TrainedAgent, tmp_path: Path) -> None:
    shutil.copy("cartpole_rl/pretrained/medium/agent.pt", tmp_path)
    (tmp_path / "provenance.json").write_text(text, encoding="latin-1")
    agent = exported_agent(medium_agent, provenance(tmp_path / "agent.pt", medium_agent))
    assert agent.description.origin == "unknown"
    assert len(agent.checksum) == 64


def test_the_provenance_is_that_of_the_exported_weights(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Their training goes on, and replaces its checkpoint."""
    medium, run = load_agent(Path("pretrained/medium")), tmp_path / "agent.pt"
    save_agent(run, replace(medium, transitions=10))

    def read(given: Path) -> TrainedAgent:
        agent = trained_agent(given)
        save_agent(run, replace(medium, transitions=20))
        return agent

    monkeypatch.setattr("cartpole_rl.workflows.export.trained_agent", read)
    export(load_settings(ExportConfig, {"format": "weights", "run": str(run)}), tmp_path / "run")
    assert read_agent(tmp_path / "run/agent.npz").description.provenance["transitions"] == 10


@pytest.fixture
def file(exported: ExportedAgent, tmp_path: Path) -> Path:
    (tmp_path / "agent.npz").write_bytes(exported.weights_file())
    return tmp_path / "agent.npz"


def test_an_agent_comes_back(exported: ExportedAgent, file: Path) -> None:
    found = read_agent(file)
    assert found.description == exported.description
    assert found.checksum == exported.checksum
    for (name, values), (other, expected) in zip(found.arrays(), exported.arrays(), strict=True):
        assert name == other
        assert np.array_equal(values, expected)
    assert found.weights_file() == file.read_bytes()  # equal agents make equal files


def test_a_file_from_before_it_had_the_rig_is_read(exported: ExportedAgent, tmp_path: Path) -> None:
    about = exported.description.model_copy(update={"hardware": {}})
    older = ExportedAgent(about, exported.layers)
    assert older.checksum == older._digest(about.model_dump(mode="json", exclude={"hardware"}))
    (tmp_path / "agent.npz").write_bytes(older.weights_file())
    assert read_agent(tmp_path / "agent.npz").identity == exported.identity


def test_the_description_defines_the_agent(file: Path) -> None:
    with np.load(file) as archive:
        about = json.loads(archive["agent.json"])
    numbers = [(number["name"], number["periods_ago"], number["scale"]) for number in about["numbers"]]
    present = [("x", 0, 0.38), ("x_dot", 0, 1), ("cos_theta", 0, 1), ("sin_theta", 0, 1), ("theta_dot", 0, 8)]
    motors = [("motor", ago, 255) for ago in (1, 2, 3)]
    assert numbers == [*present, *motors, ("x_dot", 1, 1), ("theta_dot", 1, 8)]
    assert about["motors"] == [-250, -200, -150, -100, 0, 100, 150, 200, 250]
    assert about["guard"] == {"margin": 0.0145, "delay": 0.0967, "deceleration": 6.384}
    assert about["control_period"] == 0.02
    assert about["pole_lengths"] == [0.3556, 0.3556]
    assert about["provenance"]["command"][:2] == ["cartpole-train", "experiment=medium"]


def with_member(name: str, content: bytes) -> Change:
    return lambda members: members.update({name: content})


def with_array(name: str, values: Any, kind: Any = np.float32) -> Change:
    content = io.BytesIO()
    np.save(content, np.asarray(values, kind), allow_pickle=True)
    return with_member(f"{name}.npy", content.getvalue())


def with_json(**changes: Any) -> Change:
    return lambda members: members.update(
        {"agent.json": json.dumps(json.loads(members["agent.json"]) | changes).encode()}
    )


def without(name: str) -> Change:
    return lambda members: members.pop(name)


NO_FILE = "is not a weights file"
DAMAGE: dict[str, tuple[Change, str]] = {
    "another weight": (with_array("layer0.bias", np.zeros(128)), "checksum"),
    "another guard": (with_json(guard=None), "checksum"),
    "another motor value": (with_json(motors=[-255, -200, -150, -100, 0, 100, 150, 200, 250]), "checksum"),
    "no checksum": (with_json(sha256=None), "checksum"),
    "a missing array": (without("layer1.bias.npy"), "layer1.bias"),
    "a missing layer": (without("layer2.weight.npy"), "layer2"),
    "another shape": (with_array("layer0.bias", np.zeros(3)), "layer0.bias has shape (3,), not (128,)"),
    "not a number": (with_array("layer0.bias", np.full(128, np.nan)), "layer0.bias is not finite"),
    "another format": (with_json(format="other"), "its format is 'other'"),
    "an unknown key": (with_json(more=1), "more in agent.json"),
    "a motor value out of range": (with_json(motors=[-300] * 9), "motors"),
    "other scales": (with_json(numbers=[]), "contradicts itself"),
    "no description": (without("agent.json"), NO_FILE),
    "no JSON": (with_member("agent.json", b"{"), NO_FILE),
    "an infinite number": (with_json(provenance={"score": math.inf}), NO_FILE),
    "no sizes": (with_json(sizes=[]), "sizes in agent.json"),
    "bytes": (with_member("layer0.bias.npy", b"one"), NO_FILE),
    "a pickle": (with_array("layer0.bias", [{}], object), NO_FILE),
}


def rewritten(file: Path, change: Change) -> Path:
    """Change the members of a file."""
    with zipfile.ZipFile(file) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    change(members)
    with zipfile.ZipFile(file, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return file


def check_refused(path: Path, expected: str) -> None:
    with pytest.raises(CheckpointError) as caught:
        read_agent(path)
    assert str(path) in str(caught.value)
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_file_is_refused(damage: str, file: Path) -> None:
    change, expected = DAMAGE[damage]
    check_refused(rewritten(file, change), expected)


@pytest.mark.parametrize("kind", [np.float64, np.complex128, ">f4"])
def test_numbers_of_another_kind_are_refused(kind: Any, exported: ExportedAgent, file: Path) -> None:
    """Converted to float32, these are the weights of the file, and have its checksum."""
    check_refused(rewritten(file, with_array("layer0.bias", exported.layers[0].bias, kind)), NO_FILE)


def test_a_file_that_is_none_is_refused(file: Path, tmp_path: Path) -> None:
    check_refused(tmp_path / "nowhere.npz", "there is no such file")
    file.write_bytes(file.read_bytes()[:1000])
    check_refused(file, f"{NO_FILE}, or is damaged")
    file.write_text("text")
    check_refused(file, NO_FILE)
