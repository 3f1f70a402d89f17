"""An agent as an ONNX model.

Input: `observation` [N, K] float32. Outputs: `action_value` [N, A] float32 and `action` [N] int64, the index
of a motor value, or -1, which means motor 0, where an observation or action value is not finite. The track
guard is not in the model. The entry `cartpole_rl` in metadata_props is agent.json of the weights file; its
checksum identifies the agent, not the model.
"""

import logging

import torch
from torch import Tensor, nn

from cartpole_rl.agents.own import METADATA
from cartpole_rl.exporting.agent import ExportedAgent
from cartpole_rl.tasks.settings import NO_ACTION


class GreedyPolicy(nn.Module):
    """A Q-network and its greedy action."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Return the action values and the greedy actions; NO_ACTION where a number is not finite."""
        values = self.network(observation)
        finite = observation.isfinite().all(-1) & values.isfinite().all(-1)
        return values, values.argmax(-1).where(finite, NO_ACTION)


def onnx_model(agent: ExportedAgent, network: nn.Module) -> bytes:
    """Return `network`, the network of `agent`, as an ONNX model."""
    example = torch.zeros(2, agent.description.sizes[0])
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # it warns that torchvision is not installed
    program = torch.onnx.export(
        GreedyPolicy(network).eval(),
        (example,),
        input_names=["observation"],
        output_names=["action_value", "action"],
        dynamic_shapes=({0: torch.export.Dim("carts")},),
        dynamo=True,
        verbose=False,
    )
    assert program is not None
    program.model.metadata_props[METADATA] = agent.json
    return program.model_proto.SerializeToString()
