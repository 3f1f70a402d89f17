"""The policy that drives chooses what the trained one would."""

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from cartpole_rl.agents.settings import AgentSettings
from cartpole_rl.choices import choice
from cartpole_rl.evaluation.driving_policy import DrivingPolicy, as_weights
from cartpole_rl.learning.agent import QAgent

SETTINGS = choice("agent/dqn") | {"hidden": [8], "mirrored": False}


def network(seed: int, **changes: object) -> nn.Module:
    torch.manual_seed(seed)
    agent = QAgent(AgentSettings(**(SETTINGS | changes)).at(0.02), [1, -1, -1, 1], 5, [[2, 3], [0, 1]])
    return agent.greedy_policy()


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("changes", [{"mirrored": True}, {"recurrent": 4, "mirrored": True}])
def test_it_acts_like_the_network_whose_weights_it_loaded(compiled: bool, changes: dict) -> None:
    policy = DrivingPolicy(network(0, **changes), compiled)
    observations = torch.randn(50, 1, 4, generator=torch.Generator().manual_seed(5))
    for seed in (0, 1):  # the second has other weights than the one that was compiled
        expected = network(seed, **changes)
        policy.load(as_weights(expected))
        for observation in observations:
            present = TensorDict({"observation": observation}, batch_size=[1])
            assert torch.equal(policy(present.clone())["action"], expected(present.clone())["action"])


def test_weights_are_copies() -> None:
    chosen = network(0)
    weights = as_weights(chosen)
    before = {name: value.copy() for name, value in weights.items()}
    for weight in chosen.parameters():
        weight.data.add_(1)
    assert all((weights[name] == before[name]).all() for name in weights)


@pytest.mark.parametrize("compiled", [False, True])
def test_it_shares_weights_until_others_are_loaded(compiled: bool) -> None:
    learning, present = network(0), TensorDict({"observation": torch.randn(50, 4)}, batch_size=[50])
    policy = DrivingPolicy(learning, compiled)
    policy(present)
    for weight in learning.parameters():
        weight.data.neg_()
    assert torch.equal(policy(present)["action"], learning(present.clone())["action"])
    policy.load(as_weights(network(1)))
    assert torch.equal(policy(present)["action"], network(1)(present.clone())["action"])
