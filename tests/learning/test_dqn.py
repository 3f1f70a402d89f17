"""The training loop: what it collects and counts, what it converges to, that it resumes to the bit."""

import io
from collections.abc import Callable, Sequence
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from courses import ANYWHERE
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import MultiStepTransform

from cartpole_rl.agents.settings import AgentSettings
from cartpole_rl.choices import choice
from cartpole_rl.envs.build import shipped_settings, with_fitted_guard
from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.errors import LearningError
from cartpole_rl.learning.agent import QAgent
from cartpole_rl.learning.dqn import COLLECTED, Scalars, Training, n_step_transitions
from cartpole_rl.learning.retries import Retries
from cartpole_rl.learning.settings import (
    BufferSettings,
    FinetuningSettings,
    LearningSettings,
    OptimizerSettings,
    half_cosine,
    linear,
)
from cartpole_rl.learning.states import seed_everything
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.tasks.settings import Measure, RewardSettings
from cartpole_rl.workflows.finetuning_learner import Finetuning

LEARNING = choice("learning/fast") | {
    "transitions": 1024,
    "carts": 16,
    "chunk": 4,
    "retry_probability": 0.5,
    "updates": 2,
    "batch_size": 32,
    "n_step": 3,
    "staggered": False,
    "carry": False,
    "warmup_transitions": 128,
    "epsilon": (0.5, 0.1),
    "epsilon_transitions": 400,
    "evaluations": 4,
    "checkpoint_interval": 2,
}
BUFFER = choice("buffer/prioritized") | {"size": 500}
OPTIMIZER = choice("optimizer/adam") | {"learning_rate": 1e-3}
AGENT = choice("agent/dqn") | {"hidden": (16,), "mirrored": False, "gamma": 0.9, "action_gap": 0.0}
AGENT |= {"target_tau": 0.05, "average_decay": 0.9}


class Listener:
    """A monitor that keeps all reports."""

    def __init__(self) -> None:
        self.scalars: dict[int, Scalars] = {}
        self.evaluations: list[tuple[int, bool]] = []
        self.snapshots: dict[int, bytes] = {}

    def on_update(self, transitions: int, scalars: Scalars) -> None:
        self.scalars[transitions] = scalars

    def on_evaluation(self, training: Training, episodes: Sequence[Episode], is_best: bool) -> None:
        self.evaluations.append((training.transitions, is_best))

    def on_checkpoint(self, training: Training) -> None:
        file = io.BytesIO()
        torch.save(training.snapshot(), file)
        self.snapshots[training.transitions] = file.getvalue()


def episode(score: float, score_upright: float = 0.0) -> Episode:
    """Return an episode of one step with these scores."""
    rest, step = np.zeros(2), np.zeros(1)
    counts, scores = np.zeros((2, 2), int), (step + score, step + score_upright)
    return Episode(rest, rest, rest, rest, rest, counts, step.astype(int), *scores, step, "time")


@pytest.fixture(scope="session")
def make_training(simulated: Callable[..., CartPoleEnv]) -> "MakeTraining":
    def build(
        learning: dict | None = None,
        buffer: dict | None = None,
        optimizer: dict | None = None,
        agent: dict | None = None,
        evaluate: Callable[[], list[Episode]] = lambda: [episode(1.0)],
        seed: int = 0,
        kind: Callable[..., Training] = Training,
        measure: Measure = "score",
        plant: dict | None = None,
        **environment: Any,
    ) -> Training:
        seed_everything(seed)
        settings = LearningSettings(**{**LEARNING, **(learning or {})})
        env = simulated(settings.carts, {"seed": seed, **(plant or {})}, **{"time_limit": 30, **environment})
        signs, actions = env.hardware.observation_settings.mirror_signs, len(env.hardware.motors)
        return kind(
            settings,
            BufferSettings(**{**BUFFER, **(buffer or {})}),
            OptimizerSettings(**{**OPTIMIZER, **(optimizer or {})}),
            QAgent(AgentSettings(**{**AGENT, **(agent or {})}), signs, actions),
            env,
            evaluate,
            Listener(),
            seed,
            measure=measure,
        )

    return build


MakeTraining = Callable[..., Training]


@pytest.fixture(scope="module")
def whole(make_training: MakeTraining) -> Training:
    """A training from its start to its end."""
    training = make_training()
    training.run()
    return training


@pytest.mark.parametrize("schedule", [linear, half_cosine])
def test_schedules_go_from_start_to_end_and_stay_there(schedule: Callable[..., float]) -> None:
    steps = [schedule(1.0, 0.2, progress) for progress in (-1.0, 0.0, 0.01, 0.5, 0.99, 1.0, 7.0)]
    assert steps == sorted(steps, reverse=True)
    assert (steps[0], steps[1], steps[3], steps[5], steps[6]) == pytest.approx((1.0, 1.0, 0.6, 0.2, 0.2))
    if schedule is half_cosine:  # flat at both ends
        assert max(steps[1] - steps[2], steps[4] - steps[5]) < 0.1 * 0.01 * 0.8


@pytest.mark.parametrize(
    ("measure", "scores", "best"),
    [
        ("score", [(1.0, 0.0), (3.0, 0.0), (2.0, 0.0), (3.0, 0.0)], [True, True, False, False]),
        ("score_upright", [(9.0, 1.0), (1.0, 2.0), (5.0, 1.5), (2.0, 2.5)], [True, True, False, True]),
    ],
)
def test_the_best_is_the_first_of_the_highest_scores(
    make_training: MakeTraining, measure: Measure, scores: list[tuple[float, float]], best: list[bool]
) -> None:
    coming = iter(scores)
    training = make_training(evaluate=lambda: [episode(*next(coming))], measure=measure)
    training.run()
    assert [is_best for _, is_best in training.monitor.evaluations] == best
    last = scores[-1][measure == "score_upright"]
    assert (training.best_score, training.last_score) == (last, last)


@pytest.mark.parametrize("named", [True, False])
def test_the_best_score_in_another_measure_is_forgotten(make_training: MakeTraining, named: bool) -> None:
    """Snapshots of earlier versions name no measure: it was the score. They lack the past speeds, too."""
    training = make_training(evaluate=lambda: [episode(9.0, 1.0)])
    training.run_evaluation()
    snapshot = training.snapshot()
    if not named:
        del snapshot["measure"], snapshot["collector"]["current"]["speeds"]
    for measure, expected in (("score_upright", (-float("inf"), None)), ("score", (9.0, 9.0))):
        resumed = make_training(evaluate=lambda: [episode(9.0, 1.0)], measure=measure)
        resumed.restore(snapshot)
        assert (resumed.best_score, resumed.last_score) == expected
        assert resumed.current["speeds"].shape == (resumed.env.plant.carts, 0)
        resumed.run_evaluation()
        assert resumed.monitor.evaluations == [(0, measure == "score_upright")]


@pytest.mark.parametrize(
    ("value", "evaluated", "remedy"),
    [(float("nan"), False, "; try a smaller"), (float("inf"), True, "; earlier checkpoints are kept; try a")],
)
def test_learning_stops_at_the_first_loss_that_is_not_finite(
    make_training: MakeTraining, value: float, evaluated: bool, remedy: str
) -> None:
    """One spoilt reward in replay: the weights stay those of the update before."""
    training = make_training()
    for _ in range(4):
        training.iterate()
    before = [weight.clone() for weight in training.gradient.weights]
    sample = training.buffer.sample()
    sample["next", "reward"][0] = value
    training.sample = lambda: sample
    if evaluated:
        training.run_evaluation()
    with pytest.raises(LearningError, match=rf"diverged after 320 transitions.* norm [^;]+{remedy}"):
        training.iterate()
    assert all(map(torch.equal, training.gradient.weights, before))


def test_learning_stops_at_an_error_that_is_too_large_for_a_priority(make_training: MakeTraining) -> None:
    """The loss of such an error is finite."""
    training = make_training(buffer={"kind": "prioritized"})
    for _ in range(4):
        training.iterate()
    sample = training.buffer.sample()
    sample["next", "reward"][0] = 1e20
    training.sample = lambda: sample
    with pytest.raises(LearningError, match=r"diverged after 320 transitions: a squared error is \S+; try a"):
        training.iterate()


def test_a_time_limit_does_not_end_the_world(make_training: MakeTraining) -> None:
    """With 1 a step and gamma = 0.5 every state is worth 2, since episodes of 6 steps are only cut short."""
    training = make_training(
        learning={"transitions": 2048, "updates": 6, "n_step": 2},
        agent={"gamma": 0.5},
        optimizer={"learning_rate": 2e-2},
        reward={"kind": "constant", "scale": 1.0, "track_penalty": 0.0, "position_cost": 0.0},
        time_limit=6,
    )
    training.run()
    seen = training.buffer.sample()["observation"]
    values = training.agent.actor(TensorDict({"observation": seen}, [len(seen)]))["action_value"]
    assert values.mean().item() == pytest.approx(2.0, abs=0.05)
    assert values.std().item() < 0.1


@pytest.mark.parametrize(
    ("kind", "agent", "optimizer", "carry"),
    [
        ("prioritized", {}, "adam", False),
        ("uniform", {}, "adamw", True),
        ("prioritized", {"target_tau": None, "target_period": 7, "double": False}, "adamw", True),
    ],
)
def test_a_resumed_training_ends_with_the_same_weights(
    make_training: MakeTraining, kind: str, agent: dict, optimizer: str, carry: bool
) -> None:
    def build(seed: int) -> Training:
        changes = {"buffer": {"kind": kind}, "optimizer": {"kind": optimizer}, "learning": {"carry": carry}}
        return make_training(seed=seed, agent=agent, **changes)

    whole = build(seed=0)
    whole.run()
    resumed = build(seed=1)  # every generator has another state
    resumed.restore(torch.load(io.BytesIO(whole.monitor.snapshots[512]), weights_only=True))
    resumed.run()
    if carry:  # as in the states of earlier versions
        assert set(whole.waiting.keys()) == {"observation", "action", "next"}
    assert resumed.monitor.scalars[1024].keys() == whole.monitor.scalars[1024].keys()
    for name, value in whole.monitor.scalars[1024].items():
        assert name.startswith("speed/") or resumed.monitor.scalars[1024][name] == value, name
    weights = resumed.agent.state_dict()
    assert weights.keys() == whole.agent.state_dict().keys()
    for name, weight in whole.agent.state_dict().items():
        assert torch.equal(weight, weights[name]), name


def test_no_return_reaches_from_one_fit_of_the_cart_to_the_next(make_training: MakeTraining) -> None:
    settings = FinetuningSettings(**choice("finetuning/gentle") | {"iterations": 1, "cart_share": 0})
    training = make_training(learning={"carry": True}, kind=partial(Finetuning, settings))
    filled = []
    for _ in range(2):
        training.simulate(training.env.plant.randomizer)
        filled.append(len(training.buffer))
    assert filled == [16 * (7 * 4 - 2)] * 2  # of seven chunks of four periods, two wait for their returns


# collecting

LIMIT = 20
ONCE = {"carts": 64, "chunk": 3 * LIMIT, "transitions": 64 * 3 * LIMIT, "evaluations": 1, "n_step": 1}


def greedy(training: Training) -> Training:
    """Return a training that takes no random action, from the start."""
    settings = {"warmup_transitions": 0, "epsilon": (0.0, 0.0)}
    training.settings = training.settings.model_copy(update=settings)
    return training


def always(training: Training, action: int) -> Training:
    """Return a training whose network prefers one action."""
    with torch.no_grad():
        for weight in training.agent.actor.parameters():
            weight.zero_()
        weight[action] = 1.0  # the bias of the last layer
    return training


def test_transitions_equal_those_of_torchrls_collector_and_rollout(make_training: MakeTraining) -> None:
    """The same seed and policy give the same transitions, to the bit, over resets of single carts."""
    ours = greedy(make_training(ONCE, plant={"start": ANYWHERE}, time_limit=LIMIT))
    chunk, env, policy = ours.collect(), ours.env, ours.agent.actor
    periods, frames = ONCE["chunk"], ONCE["transitions"]
    env.set_seed(0)  # as it was made
    with torch.no_grad():
        rollout = env.rollout(periods, policy, break_when_any_done=False)
    env.set_seed(0)
    stock = next(iter(Collector(env, policy, frames_per_batch=frames, total_frames=frames)))
    for other in (stock, rollout):
        for key in COLLECTED:
            assert torch.equal(chunk[key], other[key]), key
    assert len(chunk["action"].unique()) == 3
    assert 0 < chunk["next", "terminated"].sum() < chunk["next", "done"].sum()


def test_ended_episodes_are_reported_once(make_training: MakeTraining) -> None:
    training = always(greedy(make_training({**ONCE, "chunk": LIMIT - 1}, time_limit=LIMIT)), 1)
    training.collect()
    assert training.retries.describe() == {}
    training.collect()  # a still, hanging pole has cos(theta / 2) = 0
    still = {"exploration/score": pytest.approx(0, abs=1e-4), "exploration/episode_length": LIMIT}
    assert training.retries.describe() == still
    assert training.retries.describe() == {}


@pytest.mark.parametrize("probability", [0.0, 0.75])
def test_a_failed_cart_is_retried(probability: float) -> None:
    """A quarter of the carts scores nothing; the mean of a period is 0.75, a whole episode's 7.5."""
    carts, random = 400, torch.Generator().manual_seed(0)
    task = SimpleNamespace(task=SimpleNamespace(periods=10))
    env = SimpleNamespace(batch_size=[carts], device="cpu", hardware=task)
    retries, fails = Retries(env, probability, random), torch.arange(carts) % 4 == 0
    kept = []
    for period in range(10, 1010):
        ends = period % 10 == 9
        outcome = {
            "score": (~fails).float().unsqueeze(-1),
            "done": torch.full((carts, 1), ends),
            "step_count": torch.full((carts, 1), 10),
        }
        retry = retries.record(TensorDict(outcome, [carts]))
        assert (retry is not None) == ends
        if retry is not None and period > 500:
            kept.append(retry)
    shares = torch.stack(kept).float().mean(0)
    assert (shares[~fails] == 0).all()
    assert shares[fails].mean().item() == pytest.approx(probability, abs=0.02)
    assert retries.describe() == {"exploration/score": pytest.approx(7.5), "exploration/episode_length": 10}


def test_a_staggered_first_episode_is_too_short_to_have_failed() -> None:
    task = SimpleNamespace(task=SimpleNamespace(periods=10))
    env = SimpleNamespace(batch_size=[2], device="cpu", hardware=task)
    retries = Retries(env, 1.0, torch.Generator())
    retries.reset(torch.tensor([0, 8]))
    scores, ends = torch.ones(2, 1), torch.tensor([[True], [True]])

    def step(done: torch.Tensor, count: int) -> torch.Tensor | None:
        outcome = {"score": 0 * scores, "done": done, "step_count": torch.full((2, 1), count)}
        return retries.record(TensorDict(outcome, [2]))

    retries._mean_score = 1.0
    assert step(~ends, 9) is None
    assert (retry := step(ends, 10)) is not None
    assert retry.tolist() == [True, False]
    assert retries.describe()["exploration/episode_length"] == 6  # of 10 and 2 periods
    assert (retry := step(ends, 10)) is not None
    assert retry.tolist() == [True, True]


def test_a_retried_cart_keeps_its_parameters(make_training: MakeTraining) -> None:
    wide = {"ranges": with_fitted_guard(shipped_settings()).ranges}
    training = always(greedy(make_training(ONCE, plant=wide, time_limit=LIMIT)), 0)
    training.retries.record = lambda outcome: torch.arange(64) % 2 == 0
    before = training.env.plant.parameters.pole_viscous.clone()
    training.collect()
    same = training.env.plant.parameters.pole_viscous == before
    assert same.tolist() == [True, False] * 32


@pytest.mark.parametrize("guarded", [True, False])
def test_the_share_of_periods_under_the_track_guard(make_training: MakeTraining, guarded: bool) -> None:
    """It is the share of motor values sent that are not those of the agent's actions."""
    guard = with_fitted_guard(shipped_settings()).guard.active if guarded else None
    training = always(greedy(make_training(ONCE, guard=guard)), 2)
    chunk, training.seconds = training.collect(), 1.0
    assert (chunk["action"] == 2).all()
    env, replaced = training.env, 0
    env.set_seed(0)  # as it was made
    current = env.reset()
    for _ in range(ONCE["chunk"]):
        current["action"] = torch.full((64,), 2)
        replaced += int((env.hardware.command(current)["motor"] != env.hardware.motors[2]).sum())
        _, current = env.step_and_maybe_reset(current)
    share = replaced / chunk.numel()
    assert (0 < share < 1) == guarded
    found = training.describe(chunk).get("exploration/guarded_fraction")
    assert found == (pytest.approx(share) if guarded else None)


# n-step returns


def random_chunk(carts: int, periods: int, seed: int) -> TensorDict:
    """Transitions [N, T] in which a tenth of the periods terminate and a tenth are truncated."""
    generator = torch.Generator().manual_seed(seed)
    end = torch.rand(carts, periods, 1, generator=generator)
    return TensorDict(
        {
            "observation": torch.randn(carts, periods, 2, generator=generator),
            "action": torch.randint(3, (carts, periods), generator=generator),
            "next": {
                "observation": torch.randn(carts, periods, 2, generator=generator),
                "reward": torch.randn(carts, periods, 1, generator=generator),
                "terminated": end < 0.1,
                "done": end < 0.2,
            },
        },
        [carts, periods],
    )


@pytest.mark.parametrize("n", range(1, 6))
@pytest.mark.parametrize("periods", [1, 3, 8])
def test_n_step_transitions_are_those_of_a_loop_over_rows(n: int, periods: int) -> None:
    chunk = random_chunk(6, periods, seed=n)
    result = n_step_transitions(chunk, n, 0.9)
    assert result.batch_size == (6 * periods,)
    for row, start in torch.cartesian_prod(torch.arange(6), torch.arange(periods)).tolist():
        reward, reached = 0.0, start
        for ahead in range(n):
            reached = start + ahead
            reward += 0.9**ahead * chunk["next", "reward"][row, reached].item()
            if chunk["next", "done"][row, reached] or reached == periods - 1:
                break
        got, (now, last) = result[row * periods + start], chunk[row, [start, reached]].unbind(0)
        assert got["next", "reward"].item() == pytest.approx(reward, abs=1e-5)
        assert got["steps_to_next_obs"].item() == reached - start + 1
        assert torch.equal(got["observation"], now["observation"])
        assert got["action"] == now["action"]
        for key in ("observation", "terminated", "done"):
            assert torch.equal(got["next", key], last["next", key])


def returns_of(training: Training, chunk: TensorDict, size: int, **settings: Any) -> list[TensorDict]:
    """Return the transitions of a training for each part of `chunk`, `size` periods long."""
    training.settings = training.settings.model_copy(update=settings)
    training.waiting = None
    return [training.returns(part) for part in chunk.split(size, 1)]


@pytest.mark.parametrize("size", [8, 20])
@pytest.mark.parametrize("n", [1, 2, 5])
def test_carried_returns_are_those_of_one_long_chunk_and_of_torchrl(
    whole: Training, n: int, size: int
) -> None:
    chunk = random_chunk(16, 40, seed=n)
    long = n_step_transitions(chunk, n, 0.9).reshape(16, 40)[:, : 40 - (n - 1)]
    parts = returns_of(whole, chunk, size, carry=True, n_step=n)
    assert [len(part) for part in parts] == [16 * (size - (n - 1))] + [16 * size] * (40 // size - 1)
    together = torch.cat([part.reshape(16, -1) for part in parts], 1)
    assert (together == long).all()
    stock = MultiStepTransform(n_steps=n, gamma=0.9, done_keys=[])
    theirs = torch.cat([stock.inv(part.clone()) for part in chunk.split(size, 1)], 1)  # [16, 40 - n]
    theirs["steps_to_next_obs"] = theirs["steps_to_next_obs"].unsqueeze(-1)
    for key, value in together[:, : 40 - n].items(True, True):
        torch.testing.assert_close(theirs[key], value)


def test_without_carry_returns_end_with_their_chunk(whole: Training) -> None:
    chunk = random_chunk(16, 40, seed=0)
    parts = torch.cat(returns_of(whole, chunk, 8, carry=False, n_step=5))
    assert (parts == torch.cat([n_step_transitions(part, 5, 0.9) for part in chunk.split(8, 1)])).all()


def test_schedules_reach_their_ends(whole: Training) -> None:
    share = {seen: scalars["learning/epsilon"] for seen, scalars in whole.monitor.scalars.items()}
    assert share[64] == share[128] == 1.0  # acted before an update could be made
    assert share[192] == pytest.approx(0.5)  # 128 transitions were seen
    assert share[192 + 64] == pytest.approx(0.5 - 0.4 * 64 / 400)
    assert share[1024] == pytest.approx(0.1)
    assert whole.optimizer.param_groups[0]["lr"] == pytest.approx(5e-5)
    assert whole.buffer.sampler.beta == pytest.approx(1.0)


@pytest.mark.parametrize(("count", "end"), [(1, 7), (3, 10), (12, 427), (5, 5)])
def test_evaluations_are_evenly_spaced_up_to_the_end(count: int, end: int) -> None:
    each = {"carts": 1, "chunk": 1, "n_step": 1, "transitions": end, "evaluations": count}
    spaced = LearningSettings(**{**LEARNING, **each}).evaluated_iterations
    gaps = [after - before for before, after in zip([0, *spaced], spaced, strict=False)]
    assert (len(spaced), spaced[-1]) == (count, end)
    assert 1 <= min(gaps) <= max(gaps) <= min(gaps) + 1


WRONG = {"n_step": 5, "carts": 0, "epsilon": (1.5, 0.1), "speed": 1}


@pytest.mark.parametrize("name", WRONG)
def test_settings_that_make_no_sense_are_refused(name: str) -> None:
    with pytest.raises(ValueError, match=name):
        LearningSettings(**{**LEARNING, name: WRONG[name]})


def test_seconds_give_the_same_learning_at_any_control_period() -> None:
    agent, learning = AgentSettings(**choice("agent/dqn")), LearningSettings(**choice("learning/fast"))
    found = {
        period: (agent.at(period).gamma, agent.at(period).action_gap, learning.at(period).n_step)
        for period in (0.01, 0.02, 0.1)
    }
    assert found == {0.01: (0.995, 0.85, 10), 0.02: (0.99, 0.7, 5), 0.1: (0.95, 0.0, 1)}
    assert (learning.at(0.01).chunk, learning.at(0.01).updates) == (10, 80)  # 64 updates for 8 periods
    given = learning.model_copy(update={"n_step": 3})
    assert (given.at(0.01).n_step, given.at(0.01).chunk) == (3, 8)
    reward = RewardSettings(**choice("reward/score"))
    assert (reward.at(0.01).scale, reward.at(0.02).scale) == (0.025, 0.05)
    assert reward.model_copy(update={"period": None}).at(0.01).scale == 0.05


@pytest.mark.parametrize(("size", "spread"), [(16 * 60, True), (16 * 80, False)])
def test_with_a_short_buffer_the_episodes_end_one_after_the_other(
    size: int, spread: bool, make_training: MakeTraining
) -> None:
    training = make_training({"staggered": None}, buffer={"size": size})  # an episode has 30 periods
    started = training.current["step_count"].squeeze(-1).tolist()
    assert started == ([30 * cart // 16 for cart in range(16)] if spread else [0] * 16)
