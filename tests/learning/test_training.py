"""The training loop: what it counts, when it evaluates, what it converges to, that it resumes to the bit."""

import io
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from cartpole_rl.agents.dqn import QAgent
from cartpole_rl.agents.settings import AgentSettings
from cartpole_rl.choices import choice
from cartpole_rl.errors import LearningError
from cartpole_rl.learning.finetuning import Finetuning
from cartpole_rl.learning.randomness import seed_everything
from cartpole_rl.learning.settings import (
    BufferSettings,
    FinetuningSettings,
    LearningSettings,
    OptimizerSettings,
)
from cartpole_rl.learning.training import Scalars, Training
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.tasks.settings import Measure

LEARNING = {
    "transitions": 1024,
    "carts": 16,
    "chunk": 4,
    "retry_probability": 0.5,
    "updates": 2,
    "batch_size": 32,
    "n_step": 3,
    "carry": False,
    "warmup_transitions": 128,
    "epsilon": (0.5, 0.1),
    "epsilon_transitions": 400,
    "evaluations": 4,
    "evaluation_episodes": 2,
    "checkpoint_interval": 2,
}
REPLAY = {"kind": "prioritized", "size": 500, "alpha": 0.3, "beta": (0.4, 1.0), "priority_eps": 1e-3}
OPTIMIZER = {
    "kind": "adam",
    "learning_rate": 1e-3,
    "learning_rate_end": 0.05,
    "weight_decay": 0.0,
    "max_grad_norm": 10.0,
}
AGENT = {
    "hidden": (16,),
    "recurrent": None,
    "layer_norm": True,
    "mirrored": False,
    "gamma": 0.9,
    "double": True,
    "action_gap": 0.0,
    "loss": "smooth_l1",
    "target_tau": 0.05,
    "average_decay": 0.9,
    "target_period": None,
}


def episode(score: float, score_upright: float = 0.0) -> Episode:
    """Return an episode of one step with these scores."""
    rest, step = np.zeros(2), np.zeros(1)
    counts, scores = np.zeros((2, 2), int), (step + score, step + score_upright)
    return Episode(rest, rest, rest, rest, rest, counts, step.astype(int), *scores, step, "time")


class Listener:
    """A monitor that keeps all reports."""

    def __init__(self) -> None:
        self.scalars: list[tuple[int, Scalars]] = []
        self.evaluations: list[tuple[int, bool]] = []
        self.snapshots: list[tuple[int, bytes]] = []

    def on_update(self, transitions: int, scalars: Scalars) -> None:
        self.scalars.append((transitions, scalars))

    def on_evaluation(self, training: Training, episodes: Sequence[Episode], is_best: bool) -> None:
        self.evaluations.append((training.transitions, is_best))

    def on_checkpoint(self, training: Training) -> None:
        file = io.BytesIO()
        torch.save(training.snapshot(), file)
        self.snapshots.append((training.transitions, file.getvalue()))


@pytest.fixture
def make_training(make_plant: Callable, make_environment: Callable) -> Callable[..., Training]:
    def build(
        learning: dict | None = None,
        replay: dict | None = None,
        optimizer: dict | None = None,
        agent: dict | None = None,
        evaluate: Callable[[], list[Episode]] = lambda: [episode(1.0)],
        seed: int = 0,
        kind: Callable[..., Training] = Training,
        measure: Measure = "score",
        **environment: Any,
    ) -> Training:
        seed_everything(seed)
        env = make_environment(make_plant(16, seed=seed), **{"time_limit": 30, **environment})
        q_agent = QAgent(
            AgentSettings(**{**AGENT, **(agent or {})}),
            env.hardware.observation_settings.mirror_signs,
            len(env.hardware.motors),
        )
        return kind(
            LearningSettings(**{**LEARNING, **(learning or {})}),
            BufferSettings(**{**REPLAY, **(replay or {})}),
            OptimizerSettings(**{**OPTIMIZER, **(optimizer or {})}),
            q_agent,
            env,
            evaluate,
            Listener(),
            seed,
            measure=measure,
        )

    return build


def test_it_counts_transitions_and_updates(make_training: Callable[..., Training]) -> None:
    training = make_training()
    training.run()
    assert training.transitions == 1024
    assert len(training.buffer) == 500
    iterations, warmed_up = 1024 // 64, 128 // 64
    assert training.updates == 2 * (iterations - warmed_up)
    assert training.progress == 1


def test_it_evaluates_evenly_and_checkpoints_every_second_time(
    make_training: Callable[..., Training],
) -> None:
    training = make_training()
    training.run()
    assert [transitions for transitions, _ in training.monitor.evaluations] == [256, 512, 768, 1024]
    assert [transitions for transitions, _ in training.monitor.snapshots] == [512, 1024]


def test_the_best_is_the_first_of_the_highest_scores(make_training: Callable[..., Training]) -> None:
    scores = iter([1.0, 3.0, 2.0, 3.0])
    training = make_training(evaluate=lambda: [episode(next(scores))])
    training.run()
    assert [best for _, best in training.monitor.evaluations] == [True, True, False, False]
    assert (training.best_score, training.last_score) == (3.0, 3.0)


def test_the_best_of_a_balance_has_the_highest_score_upright(make_training: Callable[..., Training]) -> None:
    scores = iter([(9.0, 1.0), (1.0, 2.0), (5.0, 1.5), (2.0, 2.5)])
    training = make_training(evaluate=lambda: [episode(*next(scores))], measure="score_upright")
    training.run()
    assert [best for _, best in training.monitor.evaluations] == [True, True, False, True]
    assert (training.best_score, training.last_score) == (2.5, 2.5)


@pytest.mark.parametrize("earlier", ["score", None])
def test_the_best_score_in_another_measure_is_forgotten(
    make_training: Callable[..., Training], earlier: Measure | None
) -> None:
    """Snapshots of earlier versions name no measure: it was the score."""
    training = make_training(evaluate=lambda: [episode(9.0, 1.0)], measure="score")
    training.run_evaluation()
    snapshot = training.snapshot()
    if earlier is None:
        del snapshot["measure"]
    resumed = make_training(evaluate=lambda: [episode(9.0, 1.0)], measure="score_upright")
    resumed.restore(snapshot)
    assert (resumed.best_score, resumed.last_score) == (-float("inf"), None)
    resumed.run_evaluation()
    assert (resumed.best_score, resumed.monitor.evaluations) == (1.0, [(0, True)])

    same = make_training(measure="score")
    same.restore(snapshot)
    assert (same.best_score, same.last_score) == (9.0, 9.0)


def test_exploration_falls_from_all_to_the_last_share(make_training: Callable[..., Training]) -> None:
    training = make_training()
    training.run()
    reported = {transitions: scalars["learning/epsilon"] for transitions, scalars in training.monitor.scalars}
    assert reported[64] == reported[128] == 1.0  # acted before an update could be made
    assert reported[192] == pytest.approx(0.5)  # 128 transitions were seen
    assert reported[192 + 64] == pytest.approx(0.5 - 0.4 * 64 / 400)
    assert reported[1024] == pytest.approx(0.1)


def test_learning_rate_and_beta_reach_their_ends(make_training: Callable[..., Training]) -> None:
    training = make_training()
    training.run()
    assert training.optimizer.param_groups[0]["lr"] == pytest.approx(5e-5)
    assert training.buffer.sampler.beta == pytest.approx(1.0)


def test_gradients_are_clipped(make_training: Callable[..., Training]) -> None:
    training = make_training(optimizer={"max_grad_norm": 1e-6})
    training.run()
    squares = [(weight.grad**2).sum() for weight in training.weights]
    assert torch.stack(squares).sum().sqrt().item() <= 1.001e-6


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_learning_stops_at_the_first_loss_that_is_not_finite(
    make_training: Callable[..., Training], value: float
) -> None:
    """One spoilt reward in replay: the weights stay those of the update before."""
    training = make_training()
    for _ in range(4):
        training.iterate()
    before = [weight.clone() for weight in training.weights]
    sample = training.buffer.sample()
    sample["next", "reward"][0] = value
    training.sample = lambda: sample
    with pytest.raises(LearningError, match=r"diverged after 320 transitions.*a smaller optimizer"):
        training.iterate()
    assert all(torch.equal(weight, kept) for weight, kept in zip(training.weights, before, strict=True))


def test_a_time_limit_does_not_end_the_world(make_training: Callable[..., Training]) -> None:
    """With 1 a step and gamma = 0.5 every state is worth 2, since episodes of 6 steps are only cut short."""
    training = make_training(
        learning={"transitions": 6400, "updates": 8, "n_step": 2},
        agent={"gamma": 0.5},
        optimizer={"learning_rate": 1e-2},
        reward={"kind": "constant", "scale": 1.0, "track_penalty": 0.0, "position_cost": 0.0},
        time_limit=6,
    )
    training.run()
    seen = training.buffer.sample()["observation"]
    values = training.agent.actor(TensorDict({"observation": seen}, [len(seen)]))["action_value"]
    assert values.mean().item() == pytest.approx(2.0, abs=0.02)
    assert values.std().item() < 0.05


@pytest.mark.parametrize(
    ("replay", "agent", "optimizer", "carry"),
    [
        ("prioritized", {}, "adam", False),
        ("uniform", {}, "adamw", True),
        ("prioritized", {"target_tau": None, "target_period": 7, "double": False}, "adamw", True),
    ],
)
def test_a_resumed_training_ends_with_the_same_weights(
    make_training: Callable[..., Training], replay: str, agent: dict, optimizer: str, carry: bool
) -> None:
    def build(seed: int) -> Training:
        kinds = {
            "replay": {"kind": replay},
            "optimizer": {"kind": optimizer},
            "agent": agent,
            "learning": {"carry": carry},
        }
        return make_training(seed=seed, **kinds)

    whole = build(seed=0)
    whole.run()
    transitions, state = whole.monitor.snapshots[0]
    assert transitions == 512

    resumed = build(seed=1)  # every generator has another state
    resumed.restore(torch.load(io.BytesIO(state), weights_only=True))
    resumed.run()
    assert resumed.updates == whole.updates
    ends = [training.agent.state_dict() for training in (whole, resumed)]
    assert ends[0].keys() == ends[1].keys()
    for name, weight in ends[0].items():
        assert torch.equal(weight, ends[1][name]), name


def test_no_return_reaches_from_one_fit_of_the_cart_to_the_next(
    make_training: Callable[..., Training],
) -> None:
    settings = FinetuningSettings(**choice("finetuning/gentle") | {"iterations": 1, "cart_share": 0})
    training = make_training(learning={"carry": True}, kind=partial(Finetuning, settings))
    filled = []
    for _ in range(2):
        training.simulate(training.env.plant.randomizer)
        filled.append(len(training.buffer))
    assert (
        filled == [16 * (7 * 4 - 2)] * 2
    )  # seven chunks of four periods, two of which wait for their returns


@pytest.mark.parametrize(
    "wrong",
    [
        {"transitions": 100},
        {"n_step": 5},
        {"carts": 0},
        {"epsilon": (1.5, 0.1)},
        {"evaluations": 17},
        {"speed": 1},
    ],
)
def test_settings_that_make_no_sense_are_refused(wrong: dict) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        LearningSettings(**{**LEARNING, **wrong})
