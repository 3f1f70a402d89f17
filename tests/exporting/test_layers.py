"""Plain layers compute the action values of the network that they were made from."""

import itertools

import numpy as np
import pytest
import torch
from parity import assert_same_actions

from cartpole_rl.agents.network import FrameReader, MirrorQNetwork, QNetwork
from cartpole_rl.errors import ConfigError
from cartpole_rl.exporting.agent import ExportedAgent, Floats
from cartpole_rl.exporting.layers import plain_layers
from examples.drive_without_torch import action_values

SIGNS = [-1, 1, -1, -1]


def make_network(mirrored: bool, layer_norm: bool, hidden: list[int]) -> QNetwork | MirrorQNetwork:
    torch.manual_seed(0)
    network = (
        MirrorQNetwork(SIGNS, 5, hidden, layer_norm)
        if mirrored
        else QNetwork(len(SIGNS), 5, hidden, layer_norm)
    )
    for weight in network.parameters():  # a new layer normalization has no effect of its gain
        weight.data += 0.3 * torch.randn_like(weight)
    return network


@pytest.mark.parametrize(
    ("mirrored", "layer_norm", "hidden"),
    itertools.product((False, True), (False, True), ([], [8], [12, 6])),
)
def test_plain_layers_are_the_network(
    mirrored: bool, layer_norm: bool, hidden: list[int], exported: ExportedAgent
) -> None:
    network = make_network(mirrored, layer_norm, hidden)
    layers = plain_layers(network)
    agent = exported.description.model_copy(update={"norm_groups": 2 if mirrored else 1})
    observations = torch.randn(20, len(SIGNS))
    for observation, values in zip(observations, network(observations), strict=True):
        found = action_values(agent, layers, observation.numpy())
        assert found == pytest.approx(values.detach().numpy(), abs=1e-5)


def test_the_medium_agent_acts_as_in_pytorch(
    exported: ExportedAgent, observed: tuple[Floats, Floats]
) -> None:
    observations, expected = (each[::10] for each in observed)
    found = np.array(
        [action_values(exported.description, exported.layers, observation) for observation in observations]
    )
    assert found == pytest.approx(expected, abs=1e-4)
    assert_same_actions(found.argmax(1), expected)


def test_a_recurrent_network_is_refused() -> None:
    reader = FrameReader(4, [[0, 1], [2, 3]], 8)
    with pytest.raises(ConfigError, match="a recurrent agent"):
        plain_layers(QNetwork(4, 5, [8], True, reader))
