"""The ONNX model acts as the agent in PyTorch and carries its description."""

import json

import numpy as np
import pytest
from parity import assert_same_actions

from cartpole_rl.exporting.agent import ExportedAgent, Floats
from cartpole_rl.workflows.agents import TrainedAgent
from cartpole_rl.workflows.export import network_of

pytest.importorskip("onnxscript", reason='onnxscript is missing: pip install "cartpole_rl[export]"')
onnxruntime = pytest.importorskip("onnxruntime", reason="pip install onnxruntime")


def test_it_acts_as_in_pytorch_and_is_described(
    exported: ExportedAgent, medium_agent: TrainedAgent, observed: tuple[Floats, Floats]
) -> None:
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
    one = session.run(["action"], {"observation": observations[:1]})
    assert one[0].shape == (1,)
    about = json.loads(session.get_modelmeta().custom_metadata_map["cartpole_rl"])
    assert about == json.loads(exported.json)
    assert about["sha256"] == exported.checksum
