"""The Q-network, DQN's target computed by hand, and the ways in which the target network moves."""

import copy
from collections.abc import Sequence

import pytest
import torch
from pydantic import ValidationError
from tensordict import TensorDict
from torch import Tensor, nn

from cartpole_rl.agents.dqn import QAgent
from cartpole_rl.agents.loss import LossGradient, columns_of
from cartpole_rl.agents.network import FrameReader, MirrorQNetwork, QNetwork
from cartpole_rl.agents.settings import AgentSettings

DQN = {
    "hidden": [16],
    "recurrent": None,
    "layer_norm": True,
    "mirrored": False,
    "gamma": 0.9,
    "double": True,
    "action_gap": 0.0,
    "loss": "l2",
    "target_tau": 0.25,
    "target_period": None,
    "average_decay": 0.5,
}


def make_agent(
    mirror_signs: Sequence[int] = (-1, 1, -1),
    actions: int = 4,
    frames: Sequence[Sequence[int]] = (),
    **changes: object,
) -> QAgent:
    torch.manual_seed(0)
    return QAgent(AgentSettings(**{**DQN, **changes}), mirror_signs, actions, frames)


def disturb(agent: QAgent) -> None:
    """Move the online weights, so that online and target networks differ."""
    with torch.no_grad():
        for weight in agent.actor.parameters():
            weight.add_(torch.randn_like(weight))


def online_weights(agent: QAgent) -> Tensor:
    return torch.cat(
        [weight.detach().flatten() for weight in agent.loss.value_network_params.values(True, True)]
    )


def target_weights(agent: QAgent) -> Tensor:
    params = agent.loss.target_value_network_params
    return torch.cat([weight.detach().flatten() for weight in params.values(True, True)])


def values_of(agent: QAgent, observation: Tensor, target: bool) -> Tensor:
    """Q-values [N, A] of the online or the target network."""
    network = copy.deepcopy(agent.actor)
    params = agent.loss.target_value_network_params if target else agent.loss.value_network_params
    with params.to_module(network), torch.no_grad():
        return network(TensorDict({"observation": observation}, [len(observation)]))["action_value"]


def transitions(count: int, **changes: Tensor) -> TensorDict:
    """Random transitions as the replay gives them."""
    batch = TensorDict(
        {
            "observation": torch.randn(count, 3),
            "action": torch.randint(4, (count,)),
            "steps_to_next_obs": torch.randint(1, 6, (count, 1)),
            "next": {
                "observation": torch.randn(count, 3),
                "reward": torch.randn(count, 1),
                "terminated": torch.rand(count, 1) < 0.3,
                "done": torch.zeros(count, 1, dtype=torch.bool),
            },
        },
        [count],
    )
    batch["next", "done"] = batch["next", "terminated"] | (torch.rand(count, 1) < 0.3)
    return batch.update(changes)


@pytest.mark.parametrize("layer_norm", [True, False])
@pytest.mark.parametrize("actions", [2, 3, 9])
@pytest.mark.parametrize("recurrent", [False, True])
def test_a_mirrored_network_values_the_mirror_image_the_same(
    recurrent: bool, layer_norm: bool, actions: int
) -> None:
    torch.manual_seed(0)
    signs = torch.tensor([-1.0, 1.0, -1.0, 1.0, -1.0])
    reader = FrameReader(5, [[3, 4], [0, 1]], 4) if recurrent else None
    network = MirrorQNetwork(signs.tolist(), actions, (16, 8), layer_norm, reader)
    observation = torch.randn(50, 5)
    values = network(observation)
    assert values.shape == (50, actions)
    assert torch.allclose(network(observation * signs), values.flip(-1), atol=1e-6)
    assert values.std(-1).min() > 1e-4  # it is no constant
    assert not torch.allclose(values, values.flip(-1), atol=1e-2)


def test_a_mirrored_network_fits_what_is_odd_and_what_is_even() -> None:
    torch.manual_seed(0)
    network = MirrorQNetwork([-1, 1], 3, (64, 64), True)
    optimizer = torch.optim.Adam(network.parameters(), lr=3e-3)
    x, y = torch.rand(2, 2000) * 2 - 1
    reference = torch.stack((y - x**3, y * x**2, y + x**3), -1)
    for _ in range(600):
        error = (network(torch.stack((x, y), -1)) - reference).square().mean()
        optimizer.zero_grad()
        error.backward()
        optimizer.step()
    assert error.item() < 1e-3 * reference.var().item()


@pytest.mark.parametrize("layer_norm", [True, False])
def test_network_has_the_layers_asked_for(layer_norm: bool) -> None:
    network = QNetwork(5, 9, (16, 8), layer_norm)
    assert network(torch.randn(7, 5)).shape == (7, 9)
    norms = [layer for layer in network.layers if isinstance(layer, torch.nn.LayerNorm)]
    assert [norm.normalized_shape for norm in norms] == ([(16,), (8,)] if layer_norm else [])


def frame_reader(units: int = 16) -> FrameReader:
    """Three frames of two numbers, and one number beside them."""
    torch.manual_seed(0)
    return FrameReader(7, [[5, 6], [2, 4], [0, 1]], units)


def test_frames_are_read_from_the_oldest_to_the_newest() -> None:
    reader = frame_reader()
    scene = torch.randn(5, 7)
    state = torch.zeros(5, 16)
    for frame in (scene[:, [5, 6]], scene[:, [2, 4]], scene[:, [0, 1]]):
        state = reader.cell(frame, state)
    torch.testing.assert_close(reader(scene), torch.cat((state, scene[:, 3:4]), -1))
    torch.testing.assert_close(reader(scene.view(5, 1, 7)), reader(scene).view(5, 1, 17))
    torch.testing.assert_close(reader(scene[0]), reader(scene)[0])
    network = QNetwork(7, 3, (8,), True, reader)
    torch.testing.assert_close(network(scene), network.layers(torch.cat((state, scene[:, 3:4]), -1)))
    torch.testing.assert_close(network(scene.view(5, 1, 7)), network(scene).view(5, 1, 3))
    torch.testing.assert_close(network(scene[0]), network(scene)[0])


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_recurrent_network_learns_a_velocity_from_positions(mirrored: bool) -> None:
    """The difference of two frames, of which each alone says nothing."""
    reader = frame_reader()
    network = (
        MirrorQNetwork([-1] * 7, 2, (8,), True, reader) if mirrored else QNetwork(7, 2, (8,), True, reader)
    )
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-2)
    for _ in range(300):
        scene = torch.randn(128, 7)
        velocity = scene[:, 0] - scene[:, 2]
        reference = torch.stack((velocity, -velocity), -1)
        error = (network(scene) - reference).square().mean()
        optimizer.zero_grad()
        error.backward()
        optimizer.step()
    assert error.item() < 0.1 * reference.var().item()


def test_the_actor_takes_the_action_of_the_highest_value() -> None:
    agent = make_agent()
    chosen = agent.actor(TensorDict({"observation": torch.randn(50, 3)}, [50]))
    assert torch.equal(chosen["action"], chosen["action_value"].argmax(-1))
    assert torch.equal(chosen["chosen_action_value"].squeeze(-1), chosen["action_value"].max(-1).values)


@pytest.mark.parametrize("double", [True, False])
def test_loss_is_that_of_the_target_computed_by_hand(double: bool) -> None:
    agent = make_agent(double=double)
    disturb(agent)
    batch = transitions(64)
    following = batch["next", "observation"]
    chooser = values_of(agent, following, target=not double)
    next_value = values_of(agent, following, target=True).gather(1, chooser.argmax(1, keepdim=True))
    alive = ~batch["next", "terminated"]  # and not `done`: a time limit is no ending of the world
    target = batch["next", "reward"] + 0.9 ** batch["steps_to_next_obs"] * next_value * alive
    value = values_of(agent, batch["observation"], target=False).gather(1, batch["action"].unsqueeze(1))
    loss = agent.loss(batch)["loss"]
    assert loss.item() == pytest.approx(((value - target) ** 2).mean().item(), rel=1e-5)
    assert torch.allclose(batch["td_error"], (value - target) ** 2, rtol=1e-4, atol=1e-5)


def test_the_action_gap_takes_the_shortfall_off_the_reward() -> None:
    agent, plain = make_agent(action_gap=0.5), make_agent()
    disturb(agent)
    plain.load_state_dict(agent.state_dict())
    batch = transitions(64)
    values = values_of(agent, batch["observation"], target=False)
    shortfall = values.max(1).values - values.gather(1, batch["action"].unsqueeze(1)).squeeze(1)
    assert shortfall.max() > 0
    reward = batch["next", "reward"] - 0.5 * shortfall.unsqueeze(1)
    lowered, given = batch.clone().set(("next", "reward"), reward), batch.clone()
    torch.testing.assert_close(agent.loss(batch), plain.loss(lowered))
    torch.testing.assert_close(batch["td_error"], lowered["td_error"])
    assert not torch.allclose(batch["next", "reward"], reward)  # what was given stays as it was
    assert torch.equal(batch["next", "reward"], given["next", "reward"])
    assert torch.equal(plain.loss(batch)["loss"], plain.loss(given)["loss"])


def test_the_action_gap_widens_and_keeps_the_best_action() -> None:
    """One state, two actions worth 1 and 0.9, the end: what is left is 1 and 1 - 0.1 / (1 - 0.5)."""
    learned = {}
    for gap in (0.0, 0.5):
        agent = make_agent(actions=2, action_gap=gap, target_tau=0.1, layer_norm=False)
        optimizer = torch.optim.Adam(agent.loss.parameters(), lr=1e-2)
        batch = transitions(2)
        batch["observation"][:] = 0.5
        batch["action"] = torch.tensor([0, 1])
        batch["next", "reward"] = torch.tensor([[1.0], [0.9]])
        batch["next", "terminated"][:] = True
        for _ in range(600):
            optimizer.zero_grad()
            agent.loss(batch)["loss"].backward()
            optimizer.step()
            agent.update_target()
        learned[gap] = values_of(agent, batch["observation"][:1], target=False)[0]
    assert torch.allclose(learned[0.0], torch.tensor([1.0, 0.9]), atol=0.01)
    assert torch.allclose(learned[0.5], torch.tensor([1.0, 0.8]), atol=0.01)


def test_double_and_single_differ_where_the_networks_disagree() -> None:
    losses = []
    for double in (True, False):
        agent = make_agent(double=double)
        disturb(agent)
        torch.manual_seed(1)
        losses.append(agent.loss(transitions(64))["loss"].item())
    assert losses[0] != pytest.approx(losses[1], rel=1e-3)


def test_importance_weights_scale_each_transition() -> None:
    agent = make_agent()
    batch = transitions(8)
    agent.loss(batch)
    errors = batch["td_error"].squeeze(-1)
    weights = torch.linspace(0.1, 1, 8)
    loss = agent.loss(batch.set("priority_weight", weights))["loss"]
    assert loss.item() == pytest.approx((weights * errors).sum().item() / weights.sum().item(), rel=1e-5)


@pytest.mark.parametrize(  # compilation takes long
    ("compiled", "weighted", "max_norm"),
    [(False, False, 100.0), (False, True, 1e-2), (True, False, 100.0), (True, True, 1e-2)],
)
@pytest.mark.parametrize(
    "network", [{"mirrored": True}, {"recurrent": 8}, {"recurrent": 8, "mirrored": True}]
)
def test_the_gradient_is_that_of_the_loss(
    network: dict, compiled: bool, weighted: bool, max_norm: float
) -> None:
    agent = make_agent(action_gap=0.5, frames=[[1], [0]], **network)
    disturb(agent)
    gradient = LossGradient(agent.loss, max_norm, compiled)
    for seed in range(2):  # the second batch meets what was traced for the first, and other weights
        torch.manual_seed(seed)
        batch = transitions(64)
        if weighted:
            batch["priority_weight"] = torch.rand(64)
        reference = batch.clone()
        loss = agent.loss(reference)["loss"]
        expected = torch.autograd.grad(loss, gradient.weights)
        length = nn.utils.get_total_norm(expected).item()
        value, norm, errors = gradient(columns_of(batch))
        assert value.item() == pytest.approx(loss.item(), rel=1e-5)
        assert norm.item() == pytest.approx(length, rel=1e-4)
        assert torch.allclose(errors, reference["td_error"], rtol=1e-4, atol=1e-5)
        share = min(1.0, max_norm / length)
        for weight, part in zip(gradient.weights, expected, strict=True):
            assert weight.grad is not None
            assert torch.allclose(weight.grad, share * part, rtol=1e-4, atol=1e-5)
        disturb(agent)
        agent.update_target()


def test_every_weight_of_the_online_network_is_learned() -> None:
    agent = make_agent(mirrored=True)
    learned = {weight.data_ptr() for weight in LossGradient(agent.loss, 1.0).weights}
    assert learned == {weight.data_ptr() for weight in agent.actor.parameters()}


def test_the_names_of_the_weights_in_a_checkpoint_stay() -> None:
    """Checkpoints of every version so far have these; a new name would need a mapping from the old one."""
    layers = [f"module.0.module.layers.{layer}.{part}" for layer in (0, 2) for part in ("weight", "bias")]
    networks = ("actor", "loss.value_network_params", "loss.target_value_network_params", "average")
    weights = {f"{network}.{layer}" for network in networks for layer in layers}
    assert make_agent(layer_norm=False).state_dict().keys() == weights | {
        "updates",
        "loss._value_estimator.gamma",
    }


def test_the_target_begins_as_a_copy() -> None:
    agent = make_agent()
    assert torch.equal(online_weights(agent), target_weights(agent))


@pytest.mark.parametrize("period", [1, 2, 5])
def test_a_hard_update_copies_at_each_period_and_never_between(period: int) -> None:
    agent = make_agent(target_tau=None, target_period=period)
    for update in range(1, 4 * period + 1):
        disturb(agent)
        before = target_weights(agent)
        agent.update_target()
        expected = online_weights(agent) if update % period == 0 else before
        assert torch.equal(target_weights(agent), expected), update


def test_a_soft_update_moves_by_tau() -> None:
    agent = make_agent(target_tau=0.25)
    disturb(agent)
    before = target_weights(agent)
    agent.update_target()
    assert torch.allclose(target_weights(agent), 0.75 * before + 0.25 * online_weights(agent), atol=1e-6)


def policy_weights(policy: nn.Module) -> Tensor:
    return torch.cat([weight.detach().flatten() for weight in policy.parameters()])


def actor_weights(agent: QAgent) -> Tensor:
    return policy_weights(agent.actor)


def test_the_greedy_policy_acts_with_the_average_of_the_weights_as_they_move() -> None:
    agent = make_agent(average_decay=0.75)
    policy = agent.greedy_policy()
    disturb(agent)
    agent.update_target()
    expected = actor_weights(agent)  # the first update is the average itself
    for averages in range(1, 40):
        assert torch.allclose(policy_weights(policy), expected, atol=1e-5)
        disturb(agent)
        agent.update_target()
        share = max(0.25, 10 / (10 + averages))  # of the newest: the untrained weights are soon forgotten
        expected = (1 - share) * expected + share * actor_weights(agent)


def test_the_greedy_policy_follows_weights_that_are_loaded_later() -> None:
    trained, agent = make_agent(), make_agent()
    for _ in range(2):
        disturb(trained)
        trained.update_target()
    policy = agent.greedy_policy()
    agent.load_state_dict(trained.state_dict())
    assert torch.equal(policy_weights(policy), policy_weights(trained.greedy_policy()))
    assert not torch.equal(policy_weights(policy), actor_weights(trained))


def test_without_an_average_the_greedy_policy_is_the_online_network() -> None:
    agent = make_agent(target_tau=None, target_period=5, average_decay=None)
    policy = agent.greedy_policy()
    disturb(agent)
    agent.update_target()
    observation = torch.randn(200, 3)
    taken = policy(TensorDict({"observation": observation}, [200]))["action"]
    assert torch.equal(taken, values_of(agent, observation, target=False).argmax(1))


@pytest.mark.parametrize(
    "wrong",
    [
        {"target_period": 10},
        {"target_tau": None},
        {"target_tau": 0.0},
        {"target_tau": None, "target_period": 0},
        {"gamma": 1.0},
        {"action_gap": 1.0},
        {"loss": "l3"},
        {"hidden": [0]},
        {"hidden": [15], "mirrored": True},
        {"dropout": 0.1},
    ],
)
def test_settings_that_make_no_sense_are_refused(wrong: dict) -> None:
    with pytest.raises(ValidationError):
        AgentSettings(**{**DQN, **wrong})
