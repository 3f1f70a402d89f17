"""The loss against TorchRL's own, and in a loop of TorchRL's own parts."""

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.data import (
    Binary,
    Categorical,
    LazyTensorStorage,
    OneHot,
    PrioritizedSampler,
    TensorDictReplayBuffer,
)
from torchrl.modules import QValueActor
from torchrl.objectives import DQNLoss, HardUpdate, SoftUpdate, ValueEstimators
from torchrl.objectives.utils import TargetNetUpdater

from cartpole_rl.agents.loss import AdvantageLearningLoss

SPECS = {"categorical": Categorical(4), "one-hot": OneHot(4)}


def make_loss(kind: type[DQNLoss], action_space: str = "categorical", **named: object) -> DQNLoss:
    """A loss of `kind` with gamma 0.9, whose online and target networks differ; each time the same ones."""
    torch.manual_seed(0)
    network = nn.Sequential(nn.Linear(3, 16), nn.Tanh(), nn.Linear(16, 4))
    actor = QValueActor(network, in_keys=["observation"], spec=SPECS[action_space])
    loss = kind(actor, delay_value=True, action_space=SPECS[action_space], **named)
    loss.make_value_estimator(gamma=0.9)
    TargetNetUpdater(loss)
    with torch.no_grad():
        for weight in network.parameters():
            weight.add_(torch.randn_like(weight))
    return loss


def transitions(count: int, action_space: str = "categorical", steps: int = 5) -> TensorDict:
    """Random transitions of up to `steps` steps."""
    ended = torch.rand(count, 1) < 0.3
    batch = TensorDict(
        {
            "observation": torch.randn(count, 3),
            "action": SPECS[action_space].rand((count,)),
            "next": {
                "observation": torch.randn(count, 3),
                "reward": 2 * torch.randn(count, 1),
                "terminated": ended,
                "done": ended | (torch.rand(count, 1) < 0.3),
            },
        },
        [count],
    )
    if steps > 1:
        batch["steps_to_next_obs"] = torch.randint(1, steps + 1, (count, 1))
    return batch


def outcome(loss: DQNLoss, batch: TensorDict) -> tuple[Tensor, ...]:
    """Loss, TD errors and the gradient of each weight."""
    batch = batch.clone()
    value = loss(batch)["loss"]
    weights = list(loss.value_network_params.values(True, True))
    return value, batch["td_error"], *torch.autograd.grad(value, weights)


@pytest.mark.parametrize("action_space", SPECS)
@pytest.mark.parametrize("steps", [1, 5])
@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("loss_function", ["l2", "smooth_l1"])
@pytest.mark.parametrize("double_dqn", [False, True])
def test_without_an_action_gap_it_is_the_loss_of_torchrl(
    double_dqn: bool, loss_function: str, weighted: bool, steps: int, action_space: str
) -> None:
    named = {"double_dqn": double_dqn, "loss_function": loss_function, "action_space": action_space}
    own, stock = make_loss(AdvantageLearningLoss, **named), make_loss(DQNLoss, **named)
    assert own.in_keys == stock.in_keys
    assert own.out_keys == stock.out_keys
    assert own.state_dict().keys() == stock.state_dict().keys()
    for _ in range(5):
        batch = transitions(64, action_space, steps)
        if weighted:
            batch["priority_weight"] = torch.rand(64)
        torch.testing.assert_close(outcome(own, batch), outcome(stock, batch))
        words = {"_".join(key) if isinstance(key, tuple) else key: batch[key] for key in own.in_keys}
        if steps == 1 and not weighted:  # neither loss takes these two as keywords
            torch.testing.assert_close(own(**words), stock(**words))


@pytest.mark.parametrize("reduction", ["mean", "sum", "none"])
def test_masks_and_reductions_are_those_of_torchrl(reduction: str) -> None:
    batch = transitions(64)
    batch["collector", "mask"] = torch.rand(64, 1) < 0.5
    own, stock = (
        make_loss(kind, reduction=reduction)(batch.clone()) for kind in (AdvantageLearningLoss, DQNLoss)
    )
    torch.testing.assert_close(own, stock)


def test_the_action_gap_equals_a_reward_reduced_by_the_online_shortfall() -> None:
    plain, gap = (make_loss(AdvantageLearningLoss, action_gap=alpha, double_dqn=True) for alpha in (0.0, 0.5))
    batch = transitions(64)
    lowered = batch.clone()
    values = gap.value_network(batch.select("observation"))["action_value"].detach()
    shortfall = values.max(1).values - values.gather(1, batch["action"].unsqueeze(1)).squeeze(1)
    assert shortfall.max() > 0.1
    lowered["next", "reward"] -= 0.5 * shortfall.unsqueeze(1)
    torch.testing.assert_close(outcome(gap, batch), outcome(plain, lowered))
    assert (outcome(gap, batch)[0] - outcome(plain, batch)[0]).abs() > 0.01


@pytest.mark.parametrize("updater", ["soft", "hard"])
def test_it_learns_in_a_loop_of_torchrls_own_parts(updater: str) -> None:
    loss = make_loss(AdvantageLearningLoss, double_dqn=True, action_gap=0.5)
    update = (
        SoftUpdate(loss, tau=0.1) if updater == "soft" else HardUpdate(loss, value_network_update_interval=4)
    )
    replay = TensorDictReplayBuffer(
        storage=LazyTensorStorage(256),
        sampler=PrioritizedSampler(256, alpha=0.6, beta=0.4),
        batch_size=64,
        priority_key="td_error",
    )
    data = transitions(256)  # each next state has value 0, so the value of an action is its reward
    data["next", "observation"] = torch.zeros(256, 3)
    data["next", "reward"] = data["observation"][:, :1]
    replay.extend(data)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2)
    online, target = loss.value_network_params, loss.target_value_network_params
    losses = []
    for step in range(1, 201):
        before, sample = target.data.clone(), replay.sample()
        value = loss(sample)["loss"]
        optimizer.zero_grad()
        value.backward()
        optimizer.step()
        update.step()
        replay.update_tensordict_priority(sample)
        losses.append(value.item())
        share = 0.1 if updater == "soft" else float(step % 5 == 0)  # it copies in every fifth step
        for name, weight in target.items(True, True):
            torch.testing.assert_close(weight, before[name].lerp(online[name].detach(), share))
    assert sum(losses[-20:]) < 0.1 * sum(losses[:20])


def test_a_prioritized_replay_gets_the_squared_error_of_each_transition() -> None:
    loss, batch = make_loss(AdvantageLearningLoss, reduction="none"), transitions(64)
    each = loss(batch)["loss"]
    torch.testing.assert_close(batch["td_error"], each.detach().unsqueeze(-1))
    assert not batch["td_error"].requires_grad


@pytest.mark.parametrize("gap", [-0.1, 1.0, float("nan")])
def test_an_action_gap_out_of_range_is_refused(gap: float) -> None:
    with pytest.raises(ValueError, match=f"action_gap={gap}: give at least 0 and less than 1"):
        make_loss(AdvantageLearningLoss, action_gap=gap)


def test_actions_without_an_index_are_refused() -> None:
    actor = QValueActor(nn.Linear(3, 4), in_keys=["observation"], spec=Binary(4), action_space="binary")
    with pytest.raises(ValueError, match="action_space=binary: give categorical or one-hot"):
        AdvantageLearningLoss(actor, action_space="binary")


def test_estimators_other_than_td0_are_refused() -> None:
    loss = make_loss(AdvantageLearningLoss)
    for estimator in (ValueEstimators.TDLambda, ValueEstimators.TD1):
        with pytest.raises(NotImplementedError, match="TD0"):
            loss.make_value_estimator(estimator, gamma=0.9)
    with pytest.raises(TypeError, match="average_rewards"):
        loss.make_value_estimator(gamma=0.9, average_rewards=True)


def test_the_discount_factor_is_that_of_torchrl_where_none_is_set() -> None:
    losses = []
    for kind in (AdvantageLearningLoss, DQNLoss):
        torch.manual_seed(0)
        actor = QValueActor(nn.Linear(3, 4), in_keys=["observation"], spec=Categorical(4))
        loss = kind(actor, delay_value=True)
        TargetNetUpdater(loss)
        losses.append(loss(transitions(64))["loss"])
    torch.testing.assert_close(*losses)
