"""A policy of one's own drives as a trained agent does, and what is wrong with it is one line."""

import json
import sys
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

from cartpole_rl.agents.own import OwnPolicy
from cartpole_rl.errors import CheckpointError, ConfigError
from cartpole_rl.evaluation.episodes import choose
from cartpole_rl.tasks.settings import NO_ACTION
from cartpole_rl.workflows.checks import check_agent, check_evaluation
from cartpole_rl.workflows.config import EvaluateConfig, load_settings

MODULE = """
import torch
from tensordict.nn import TensorDictModule

network = torch.nn.Linear(2, 3)
torch.nn.init.eye_(network.weight)
torch.nn.init.zeros_(network.bias)
of_tensordict = TensorDictModule(network, in_keys=["observation"], out_keys=["action_value"])

def largest(observation):
    return observation.argmax(-1)

def mask(observation):
    return torch.nn.functional.pad(observation, (0, 1)) > 0

def complex_values(observation):
    return torch.zeros(2, 3, dtype=torch.complex64)

def on_another_device(observation):
    return torch.zeros(2, 3, device="meta")

def unsigned(observation):
    return observation.argmax(-1).to(torch.uint16)

def of_8_bits(observation):
    return torch.nn.functional.pad(observation, (0, 1)).to(torch.float8_e5m2)

def as_list(observation):
    return [int(row[1] > row[0]) for row in observation]

def not_finite(observation):
    return torch.tensor([torch.nan, torch.inf])

def values_not_finite(observation):
    return torch.cat((observation, observation * torch.nan), -1)[:, :3]

def high(observation):
    return torch.tensor([0, 3])

def half(observation):
    return torch.tensor([0.5, 0.0])

def flat(observation):
    return torch.zeros(5)

def fails(observation):
    raise RuntimeError("no weights")

class Driver:
    pass
"""
MOTORS = (-255, 0, 255)


@pytest.fixture(autouse=True)
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.delitem(sys.modules, "own_policies", raising=False)
    Path("own_policies.py").write_text(MODULE)


def chosen(run: str) -> list[int]:
    observation = torch.tensor([[1.0, 0.0], [0.0, 1.0]])
    with torch.no_grad():
        return choose(OwnPolicy(Path(run), MOTORS), TensorDict({"observation": observation}, [2])).tolist()


@pytest.mark.parametrize(
    "name", ["network", "of_tensordict", "largest", "as_list", "mask", "unsigned", "of_8_bits"]
)
def test_it_chooses_from_values_or_gives_the_action(name: str) -> None:
    assert chosen(f"own_policies:{name}") == [0, 1]


@pytest.mark.parametrize("name", ["not_finite", "values_not_finite"])
def test_what_is_not_finite_is_motor_value_0(name: str) -> None:
    assert chosen(f"own_policies:{name}") == [NO_ACTION, NO_ACTION]


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("high", "it chose 3; give integers from 0 to 2"),
        ("half", "it chose 0.5; give integers from 0 to 2"),
        ("flat", r"shape \[5\] for observations \[2, 2\]; give actions \[2\] or action values \[2, 3\]"),
        ("complex_values", "it gave complex numbers; give real ones"),
        ("on_another_device", "NotImplementedError: Cannot copy out of meta tensor"),
        ("fails", r"RuntimeError: no weights \(.*own_policies.py, line [34]\d\)"),
        ("Driver", "it is a class; give a function"),
        ("none", "has no 'none'"),
    ],
)
def test_a_wrong_policy_is_one_line(name: str, message: str) -> None:
    with pytest.raises(ConfigError, match=f"^run=own_policies:{name}: .*{message}"):
        chosen(f"own_policies:{name}")


def test_an_onnx_file_drives_with_its_own_motor_values(monkeypatch: pytest.MonkeyPatch) -> None:
    onnx = pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    ends = [onnx.helper.make_tensor_value_info(name, 1, ["carts", 2]) for name in ("seen", "values")]
    node = onnx.helper.make_node("Identity", ["seen"], ["values"])
    graph = onnx.helper.make_graph([node], "identity", ends[:1], ends[1:])
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 18)], ir_version=10)
    onnx.save(model, "own.onnx")
    monkeypatch.setattr(sys.modules[__name__], "MOTORS", (-255, 255))
    assert chosen("own.onnx") == [0, 1]
    onnx.helper.set_model_props(model, {"cartpole_rl": '{"motors": [-200, 200]}'})
    onnx.save(model, "own.onnx")
    with pytest.raises(ConfigError, match=r"motors \[-200, 200\], not \[-255, 255\]; choose them by"):
        chosen("own.onnx")
    for damaged in ("no JSON", "[1]", '{"motors": null, "hardware": null}'):
        onnx.helper.set_model_props(model, {"cartpole_rl": damaged})
        onnx.save(model, "own.onnx")
        with pytest.raises(
            ConfigError, match=r"^run=own\.onnx: its entry cartpole_rl is damaged; export the"
        ):
            OwnPolicy(Path("own.onnx"), MOTORS, {"hardware": {"track_span": 0.8}})
    about = {"control_period": 0.02, "hardware": {"track_span": 0.8, "moving_mass": 1.0}}
    onnx.helper.set_model_props(model, {"cartpole_rl": json.dumps(about)})
    onnx.save(model, "own.onnx")
    assert OwnPolicy(Path("own.onnx"), MOTORS, {"control_period": 0.02, "hardware": {"track_span": 0.8}})
    for driven, message in (
        ({"control_period": 0.05}, r"control_period 0\.02, not 0\.05; choose it by control_period="),
        ({"hardware": {"track_span": 0.6}}, r"hardware track_span=0\.8, not 0\.6; choose its cart by cart="),
    ):
        with pytest.raises(ConfigError, match=f"^run=own.onnx: it was exported with {message}"):
            OwnPolicy(Path("own.onnx"), MOTORS, driven)


def test_where_it_cannot_be_used_the_command_says_so_before_any_work() -> None:
    config = load_settings(EvaluateConfig, {"run": "own.onnx", "observation": "raw"})
    with pytest.raises(CheckpointError, match=r"own\.onnx: there is no such file"):
        check_evaluation(config, [])
    with pytest.raises(ConfigError, match="only cartpole-evaluate and cartpole-record drive a policy"):
        check_agent(Path("own_policies:network"))
    with pytest.raises(ConfigError, match="observation: an agent observes what it did in its training"):
        load_settings(EvaluateConfig, {"run": "pretrained/medium", "observation": "raw"})
