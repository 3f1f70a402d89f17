"""The policy that drives chooses what the trained one would."""

from itertools import product

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn

from cartpole_rl.agents.settings import AgentSettings
from cartpole_rl.choices import choice
from cartpole_rl.evaluation.driving_policy import DrivingPolicy, as_weights
from cartpole_rl.evaluation.episodes import Policy
from cartpole_rl.learning.agent import QAgent

SETTINGS = choice("agent/dqn") | {"hidden": [8], "mirrored": False}


def network(seed: int, **changes: object) -> nn.Module:
    torch.manual_seed(seed)
    agent = QAgent(AgentSettings(**(SETTINGS | changes)).at(0.02), [1, -1, -1, 1], 5, [[2, 3], [0, 1]])
    return agent.greedy_policy()


@pytest.mark.parametrize(
    ("changes", "carts", "compiled"),
    [
        ({}, 50, False),
        *product(({"mirrored": True}, {"recurrent": 4, "mirrored": True}), (1,), (False, True)),
    ],
)
def test_it_acts_like_its_network_until_other_weights_are_loaded(
    changes: dict, carts: int, compiled: bool
) -> None:
    observations = torch.randn(50, 4, generator=torch.Generator().manual_seed(5)).reshape(-1, carts, 4)

    def actions(policy: Policy) -> Tensor:
        each = (TensorDict({"observation": seen}, batch_size=[carts]) for seen in observations)
        return torch.stack([policy(present)["action"] for present in each])

    learning = network(0, **changes)
    policy, before = DrivingPolicy(learning, compiled), actions(learning)
    assert torch.equal(actions(policy), before)
    for weight in learning.parameters():  # they are shared
        weight.data.neg_()
    assert torch.equal(actions(policy), actions(learning))
    assert not torch.equal(actions(learning), before)
    for seed in (0, 1):
        policy.load(as_weights(network(seed, **changes)))
        assert torch.equal(actions(policy), actions(network(seed, **changes)))


def test_weights_are_copies() -> None:
    chosen = network(0)
    weights = as_weights(chosen)
    before = {name: value.copy() for name, value in weights.items()}
    for weight in chosen.parameters():
        weight.data.add_(1)
    assert all((weights[name] == before[name]).all() for name in weights)
