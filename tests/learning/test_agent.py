"""The agent: its loss against TorchRL's, its gradient, and how the target network and the average move."""

import copy
from collections.abc import Callable

import pytest
import torch
from pydantic import ValidationError
from tensordict import TensorDict, TensorDictParams
from torch import Tensor, nn
from torchrl.data import Binary, Categorical, OneHot
from torchrl.modules import QValueActor
from torchrl.objectives import DQNLoss, ValueEstimators
from torchrl.objectives.utils import TargetNetUpdater

from cartpole_rl.agents.settings import AgentSettings
from cartpole_rl.choices import choice
from cartpole_rl.compilation import LossGradient
from cartpole_rl.learning.agent import QAgent
from cartpole_rl.learning.dqn import LEARNED, AdvantageLearningLoss

SPECS = {"categorical": Categorical(4), "one-hot": OneHot(4)}
DQN = choice("agent/dqn") | {"hidden": [16], "mirrored": False, "gamma": 0.9, "action_gap": 0.0, "loss": "l2"}
DQN |= {"target_tau": 0.25, "average_decay": 0.5}


def make_loss(kind: type[DQNLoss], action_space: str = "categorical", **named: object) -> DQNLoss:
    """A loss of `kind` with gamma 0.9, whose online and target networks differ; each time the same ones."""
    torch.manual_seed(0)
    network = nn.Sequential(nn.Linear(3, 16), nn.Tanh(), nn.Linear(16, 4))
    actor = QValueActor(network, in_keys=["observation"], spec=SPECS[action_space])
    loss = kind(actor, delay_value=True, action_space=SPECS[action_space], **named)
    loss.make_value_estimator(gamma=0.9)
    TargetNetUpdater(loss)
    disturb(network)
    return loss


def make_agent(actions: int = 4, **changes: object) -> QAgent:
    torch.manual_seed(0)
    return QAgent(AgentSettings(**{**DQN, **changes}), (-1, 1, -1), actions, [[1], [0]])


def disturb(network: nn.Module) -> None:
    """Move the weights, so that online and target networks differ."""
    with torch.no_grad():
        for weight in network.parameters():
            weight.add_(torch.randn_like(weight))


def transitions(count: int, action_space: str = "categorical", steps: int = 5) -> TensorDict:
    """Random transitions of up to `steps` steps, as the replay gives them."""
    ended = torch.rand(count, 1) < 0.3
    batch = {
        "observation": torch.randn(count, 3),
        "action": SPECS[action_space].rand((count,)),
        "next": {
            "observation": torch.randn(count, 3),
            "reward": 2 * torch.randn(count, 1),
            "terminated": ended,
            "done": ended | (torch.rand(count, 1) < 0.3),
        },
    }
    if steps > 1:
        batch["steps_to_next_obs"] = torch.randint(1, steps + 1, (count, 1))
    return TensorDict(batch, [count])


def outcome(loss: DQNLoss, batch: TensorDict) -> tuple[Tensor, ...]:
    """Loss, TD errors and the gradient of each weight."""
    batch = batch.clone()
    value = loss(batch)["loss"]
    weights = list(loss.value_network_params.values(True, True))
    return value, batch["td_error"], *torch.autograd.grad(value, weights)


@pytest.mark.parametrize("action_space", SPECS)
@pytest.mark.parametrize("steps", [1, 5])
@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize(("loss_function", "double_dqn"), [("l2", False), ("smooth_l1", True)])
def test_without_an_action_gap_it_is_the_loss_of_torchrl(
    double_dqn: bool, loss_function: str, weighted: bool, steps: int, action_space: str
) -> None:
    named = {"double_dqn": double_dqn, "loss_function": loss_function, "action_space": action_space}
    own, stock = make_loss(AdvantageLearningLoss, **named), make_loss(DQNLoss, **named)
    assert (own.in_keys, own.out_keys) == (stock.in_keys, stock.out_keys)
    assert own.state_dict().keys() == stock.state_dict().keys()
    batch = transitions(64, action_space, steps)
    if weighted:
        batch["priority_weight"] = torch.rand(64)
    torch.testing.assert_close(outcome(own, batch), outcome(stock, batch))
    words = {"_".join(key) if isinstance(key, tuple) else key: batch[key] for key in own.in_keys}
    if steps == 1 and not weighted:  # neither loss takes these two as keywords
        torch.testing.assert_close(own(**words), stock(**words))


@pytest.mark.parametrize("double", [True, False])
def test_loss_is_that_of_the_target_computed_by_hand(double: bool) -> None:
    """y = r - alpha (max Q(s, .) - Q(s, a)) + gamma^n Q(s', .), if the pole did not fall."""
    agent = make_agent(double=double, action_gap=0.5)
    target_network = copy.deepcopy(agent.actor.module[0].module)
    disturb(agent.actor)
    online, batch = agent.actor.module[0].module, transitions(64)
    given, seen, following = batch.clone(), batch["observation"], batch["next", "observation"]
    with torch.no_grad():
        values, next_values = online(seen), target_network(following)
        chooser = online(following) if double else next_values
        value = values.gather(1, batch["action"].unsqueeze(1))
        alive = ~batch["next", "terminated"]  # and not `done`: a time limit is no ending of the world
        following_value = next_values.gather(1, chooser.argmax(1, keepdim=True)) * alive
        shortfall = values.max(1, keepdim=True).values - value
        target = (
            batch["next", "reward"] - 0.5 * shortfall + 0.9 ** batch["steps_to_next_obs"] * following_value
        )
    assert shortfall.max() > 0.1
    loss = agent.loss(batch)["loss"]
    torch.testing.assert_close(loss, (value - target).square().mean())
    torch.testing.assert_close(batch["td_error"], (value - target).square())
    assert (batch.exclude("td_error") == given).all()


def test_what_the_loss_cannot_do_is_refused() -> None:
    actor = QValueActor(nn.Linear(3, 4), in_keys=["observation"], spec=Binary(4), action_space="binary")
    with pytest.raises(ValueError, match="action_space=binary: give categorical or one-hot"):
        AdvantageLearningLoss(actor, action_space="binary")
    loss = make_loss(AdvantageLearningLoss)
    for estimator in (ValueEstimators.TDLambda, ValueEstimators.TD1):
        with pytest.raises(NotImplementedError, match="TD0"):
            loss.make_value_estimator(estimator, gamma=0.9)
    with pytest.raises(TypeError, match="average_rewards"):
        loss.make_value_estimator(gamma=0.9, average_rewards=True)


RECURRENT = ({"recurrent": 8, "mirrored": True}, False, 100.0)


@pytest.mark.parametrize(
    ("network", "weighted", "max_norm", "compiled"),
    [
        ({"mirrored": True}, True, 1e-2, False),
        ({"mirrored": True}, True, 1e-2, True),
        (*RECURRENT, False),
        pytest.param(*RECURRENT, True, marks=pytest.mark.nightly),
    ],
)
def test_the_gradient_is_that_of_the_loss(
    network: dict, weighted: bool, max_norm: float, compiled: bool
) -> None:
    agent = make_agent(action_gap=0.5, **network)
    disturb(agent)
    gradient = LossGradient(agent.loss, LEARNED, max_norm, compiled)
    learned = {weight.data_ptr() for weight in gradient.weights}
    assert learned == {weight.data_ptr() for weight in agent.actor.parameters()}
    for seed in range(2):  # the second batch meets what was traced for the first, and other weights
        torch.manual_seed(seed)
        batch = transitions(64)
        if weighted:
            batch["priority_weight"] = torch.rand(64)
        reference = batch.clone()
        loss = agent.loss(reference)["loss"]
        expected = torch.autograd.grad(loss, gradient.weights)
        length = nn.utils.get_total_norm(expected).item()
        value, norm, errors = gradient(gradient.columns(batch))
        assert (value.item(), norm.item()) == pytest.approx((loss.item(), length), rel=1e-4)
        torch.testing.assert_close(errors, reference["td_error"], rtol=1e-4, atol=1e-5)
        for weight, part in zip(gradient.weights, expected, strict=True):
            torch.testing.assert_close(weight.grad, min(1, max_norm / length) * part, rtol=1e-4, atol=1e-5)
        disturb(agent)
        agent.update_target()


def test_the_names_of_the_weights_in_a_checkpoint_stay() -> None:
    """Checkpoints of every version so far have these; a new name would need a mapping from the old one."""
    layers = [f"module.0.module.layers.{layer}.{part}" for layer in (0, 2) for part in ("weight", "bias")]
    networks = ("actor", "loss.value_network_params", "loss.target_value_network_params", "average")
    weights = {f"{network}.{layer}" for network in networks for layer in layers}
    other = {"updates", "loss._value_estimator.gamma"}
    assert make_agent(layer_norm=False).state_dict().keys() == weights | other


def flat(weights: nn.Module) -> Tensor:
    """All weights of a module or of a tensordict in one tensor."""
    parts = weights.values(True, True) if isinstance(weights, TensorDictParams) else weights.parameters()
    return torch.cat([weight.detach().flatten() for weight in parts])


def hard(period: int) -> Callable[[int], float]:
    return lambda update: float(update % period == 0)


@pytest.mark.parametrize(
    ("settings", "share"),
    [({"target_tau": 0.25}, lambda update: 0.25)]
    + [({"target_tau": None, "target_period": period}, hard(period)) for period in (1, 2, 5)],
)
def test_the_target_network_moves_by_tau_or_at_each_period(settings: dict, share: Callable) -> None:
    agent = make_agent(**settings)
    online, target = agent.loss.value_network_params, agent.loss.target_value_network_params
    expected = flat(online)
    assert torch.equal(flat(target), expected)  # it begins as a copy
    for update in range(1, 11):
        disturb(agent.actor)
        agent.update_target()
        expected = expected.lerp(flat(online), share(update))
        torch.testing.assert_close(flat(target), expected)


def test_the_greedy_policy_acts_with_the_average_of_the_weights_as_they_move() -> None:
    agent = make_agent(average_decay=0.75)
    policy, expected = agent.greedy_policy(), flat(agent.actor)
    for updates in range(1, 41):
        disturb(agent.actor)
        agent.update_target()
        share = max(0.25, 10 / (9 + updates))  # of the newest: the untrained weights are soon forgotten
        expected = (1 - share) * expected + share * flat(agent.actor)
        assert torch.allclose(flat(policy), expected, atol=1e-5)
    other = make_agent(average_decay=0.75)
    policy = other.greedy_policy()
    other.load_state_dict(agent.state_dict())  # it follows weights that are loaded later
    assert torch.equal(flat(policy), flat(agent.greedy_policy()))


WRONG = [
    *(
        {"target_period": 10},
        {"target_tau": None},
        {"target_tau": 0.0},
        {"target_tau": None, "target_period": 0},
    ),
    *({"gamma": 1.0}, {"action_gap": 1.0}, {"loss": "l3"}, {"dropout": 0.1}),
    *({"hidden": [0]}, {"hidden": [15], "mirrored": True}),
    *({"hidden": [16, 1]}, {"hidden": [2], "mirrored": True}),  # with layer_norm
]


@pytest.mark.parametrize("wrong", WRONG)
def test_settings_that_make_no_sense_are_refused(wrong: dict) -> None:
    with pytest.raises(ValidationError):
        AgentSettings(**{**DQN, **wrong})
