"""A fine-tuning: its files, the episodes that count, and a learner that goes on as if it had not stopped."""

import io
import sys
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from short_episode import EPISODE
from short_episode import FULL as BROKEN

from cartpole_rl.choices import choice
from cartpole_rl.envs.build import simulated_env
from cartpole_rl.errors import CheckpointError, ConfigError, LinkError, RecordingError
from cartpole_rl.evaluation.driver import EpisodeRequest, Result
from cartpole_rl.evaluation.episodes import run_batch
from cartpole_rl.files import write_bytes
from cartpole_rl.learning.checkpoints import FINETUNING_FORMAT, AgentCheckpoint, load_training, save_agent
from cartpole_rl.learning.settings import BufferSettings, FinetuningSettings, LearningSettings
from cartpole_rl.learning.states import seed_everything
from cartpole_rl.physics.friction import CART_FRICTIONS
from cartpole_rl.physics.models import Models
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.physics.residual import Residual
from cartpole_rl.plants.learned import LearnedModel, save_model
from cartpole_rl.plants.serial.preparation import nobody
from cartpole_rl.plants.serial.tracking import LinkStatistics
from cartpole_rl.reporting.tensorboard import TensorBoardLog, scalars
from cartpole_rl.run_folder import file_hash, recorded_provenance, write_config
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.workflows.build import evaluated_settings, new_agent
from cartpole_rl.workflows.config import (
    EvaluateConfig,
    FinetuneConfig,
    TrainConfig,
    load_settings,
    recorded_settings,
)
from cartpole_rl.workflows.episodes import prepared
from cartpole_rl.workflows.finetune import driven_env, evaluation_config, finetune, overlaid, started_from
from cartpole_rl.workflows.finetuning_cart import FinetuningCart, FinetuningFiles, Stage
from cartpole_rl.workflows.finetuning_learner import (
    CartLearner,
    TunedAgent,
    simulated_buffer,
    simulated_learning,
)

TRAINING = {
    "task.time_limit": 60,
    "learning.carts": 16,
    "learning.chunk": 8,
    "learning.batch_size": 32,
    "learning.updates": 2,
    "observation": "history_length",
}
CONFIG = {
    "run": "somewhere",
    "seed": 5,
    "evaluation_episodes": 1,
    "episodes": 4,
    "compile": False,
    "finetuning.iterations": 3,
    "finetuning.refit": 2,
    "finetuning.cart_share": 0.5,
}


@pytest.fixture
def files(tmp_path: Path) -> FinetuningFiles:
    return FinetuningFiles(tmp_path, load_settings(FinetuneConfig, CONFIG | {"evaluation_episodes": 3}))


def test_the_recordings_say_how_far_a_run_has_come(files: FinetuningFiles) -> None:
    for stage, count in ((Stage.BEFORE, 1), (Stage.TUNE, 2)):
        for number in range(count):
            files.write_episode(stage, number, replace(EPISODE, motor=np.array([number, 7])))
    assert [files.count(stage) for stage in Stage] == [1, 2, 0]
    assert files.path(Stage.TUNE, 1) == files.folder / "recordings/tune_001.csv"
    assert [each.motor[0] for each in files.episodes(Stage.TUNE)] == [0, 1]
    assert [each.motor[0] for each in files.learned_from()] == [0, 0, 1]
    assert [each.motor[0] for each in files.learned_from(2)] == [1]
    assert "# pole_length_m: 0.3530" in files.path(Stage.BEFORE, 0).read_text()


@pytest.mark.parametrize(
    ("missing", "learned", "complaint"),
    [
        ("tune_001", 1, "tune_001.csv is missing; put it back, or move the later ones away: they are driven"),
        ("before_002", 0, "before_002.csv is missing; put it back, or move the later ones away: they are"),
        ("tune_001", 2, "tune_001.csv is missing; put it back, or start anew: .* run=some"),
        ("tune_002", 3, "tune_002.csv is missing; put it back, or start anew: .* run=some"),
        ("tune_002", 2, ""),
    ],
)
def test_no_episode_may_be_missing_before_another_one(
    missing: str, learned: int, complaint: str, files: FinetuningFiles
) -> None:
    for stage in (Stage.BEFORE, Stage.TUNE):
        for number in range(3):
            files.write_episode(stage, number, EPISODE)
    files.check(3)
    (files.folder / f"recordings/{missing}.csv").unlink()
    with pytest.raises(RecordingError, match=complaint) if complaint else nullcontext():
        files.check(learned)


def test_a_resumed_run_takes_the_words_alone() -> None:
    """Which are not those of the learner's file."""
    given, learner = {"resume": "run", "view": "none"}, {"kind": "ray", "address": "new:1", "timeout": 10}
    plant = {"kind": "serial", "port": "/dev/other", "clear_faults": 0}
    given |= {"learner": learner, "plant": plant}
    ray = {"kind": "ray", "address": "old:1", "timeout": 50}
    recorded = {
        "seed": 3,
        "view": "live",
        "learner": ray,
        "plant": {**plant, "port": "COM1", "clear_faults": 2},
    }
    words = ["resume=run", "learner=ray", "learner.address=new:1", "plant.port=/dev/other"]
    assert overlaid(recorded, given, words) == {
        **recorded,
        "resume": "run",
        "learner": {**ray, "address": "new:1"},
        "plant": {**plant, "clear_faults": 2},
    }
    local = {**recorded, "learner": {"kind": "local"}}
    assert overlaid(local, given, [*words, "view=none"])["learner"] == learner
    assert overlaid(local, given, ["view=none"]) == {**local, "resume": "run", "view": "none"}


def test_a_checkpoint_restores_its_settings(files: FinetuningFiles) -> None:
    files.save({}, 2)
    checkpoint = load_training(files.folder, FINETUNING_FORMAT)
    assert checkpoint.step == 2
    assert recorded_settings(FinetuneConfig, checkpoint.config, "resume=run") == files.config
    with pytest.raises(CheckpointError, match=r"resume=run is of another version .*prior: there is no such"):
        recorded_settings(FinetuneConfig, {"run": "somewhere", "prior": 0.1}, "resume=run")


@pytest.mark.parametrize(
    ("learned", "remedy"),
    [(0, "put it back, or move it and the later ones away: they are driven again"), (3, "or start anew")],
)
def test_a_damaged_episode_is_refused_before_the_cart_moves(
    learned: int, remedy: str, files: FinetuningFiles
) -> None:
    for stage in (Stage.BEFORE, Stage.TUNE):
        for number in range(3):
            files.write_episode(stage, number, EPISODE)
    torn = files.path(Stage.TUNE, 1)
    torn.write_text("\n".join(torn.read_text().splitlines()[:-1]))
    with pytest.raises(RecordingError, match=f"tune_001.csv is damaged: its last row is missing; .*{remedy}"):
        files.check(learned)


LONG = replace(EPISODE, time=50 * EPISODE.time)  # 2 s


class Script:
    """A driver whose episodes end as `endings` say: "encoder" is its fault, "late" a link lost after 2 s."""

    def __init__(self, *endings: str) -> None:
        self.endings = iter(endings)

    def start(self, drive: EpisodeRequest) -> None:
        """Do nothing."""

    def result(self) -> Result:
        """Return the next episode."""
        ending = next(self.endings)
        episode = {"empty": EPISODE.part(0, 0), "encoder": BROKEN, "late": LONG}.get(ending, EPISODE)
        ended_by = {"empty": "fault", "encoder": "fault", "late": "link"}.get(ending, ending)
        return replace(episode, ended_by=ended_by), LinkStatistics()


@pytest.fixture
def cart(files: FinetuningFiles) -> Iterator[FinetuningCart]:
    with TensorBoardLog(files.folder) as log:
        yield FinetuningCart(Script(), files, log, "score")


def test_an_evaluation_that_the_link_ended_is_driven_again(
    cart: FinetuningCart, files: FinetuningFiles, capsys: pytest.CaptureFixture[str]
) -> None:
    cart.driver = Script("time", "link", "encoder", "fault", "late", "link", "link")
    with pytest.raises(LinkError, match=r"before 3: the link was lost after 0\.0 s, 3 times in succession"):
        cart.evaluate(Stage.BEFORE, {})
    assert [each.ended_by for each in files.episodes(Stage.BEFORE)] == ["time", "fault"]
    told = "before 2: the link was lost after 0.0 s; the episode does not count and is driven again"
    assert capsys.readouterr().out.splitlines()[1] == told
    cart.driver = Script("link", "late")
    cart.start_tuning(0, {})
    cart.finish(Stage.TUNE, 0)  # one to learn from counts until then, unless it is too short
    assert files.episode(Stage.TUNE, 0).time[-1] == 2.0


def test_an_episode_is_scored_as_its_task_is_and_told_at_once(
    cart: FinetuningCart, monkeypatch: pytest.MonkeyPatch
) -> None:
    cart.measure, pipe = "score_upright", io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(pipe))
    scored = replace(EPISODE, score_upright=np.array([3.0, 4.0]))
    cart.keep(Stage.BEFORE, 0, scored, LinkStatistics())
    assert pipe.getvalue() == b"before 1: score_upright 7, ended by time\n"
    assert scalars(cart.files.folder, "cart/score_before") == [(1, 7.0)]


@pytest.mark.parametrize("stage", [Stage.BEFORE, Stage.TUNE])
def test_an_episode_without_a_measured_period_is_driven_again(stage: Stage, cart: FinetuningCart) -> None:
    cart.driver = Script("empty", "empty", "fault", "empty", "empty", "empty")
    cart.start({}, 0.0, 0)
    cart.finish(stage, 0)
    assert [each.steps for each in cart.files.episodes(stage)] == [2]
    with pytest.raises(LinkError, match=r"2: the cart reported a fault after 0\.0 s, 3 times in succession"):
        cart.finish(stage, 1)


def test_without_its_copy_of_the_agent_a_run_takes_the_same_one_and_no_other(tmp_path: Path) -> None:
    run = tmp_path / "agent.pt"
    save_agent(run, AgentCheckpoint({}, {}, transitions=10, score=None))
    config = load_settings(FinetuneConfig, CONFIG | {"run": str(run)})
    write_config(tmp_path / "run", "finetune", config.model_dump(mode="json"), agent=run)
    interrupted = FinetuningFiles(tmp_path / "run", config)
    assert started_from(interrupted) == run
    save_agent(run, AgentCheckpoint({}, {}, transitions=20, score=None))
    with pytest.raises(CheckpointError) as raised:
        started_from(interrupted)
    assert str(raised.value) == (
        f"resume={interrupted.folder}: it holds no checkpoints/start.pt, and by provenance.json the agent of "
        f"run={run} is not the one that it started from; cartpole-finetune run={run} starts anew"
    )
    write_bytes(interrupted.start, b"a copy")
    assert started_from(interrupted) == interrupted.start


def test_the_agent_is_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The training that it is of goes on, and replaces it."""
    training, run, folder = load_settings(TrainConfig, TRAINING), tmp_path / "agent.pt", tmp_path / "run"
    agent = AgentCheckpoint(training.model_dump(mode="json"), new_agent(training).state_dict(), 10, None)
    save_agent(run, agent)

    def write_and_train(*words: Any, **named: Any) -> None:
        write_config(*words, **named)
        save_agent(run, replace(agent, transitions=20))

    def check(files: FinetuningFiles, tuned: TunedAgent, *_: object) -> None:
        assert file_hash(files.start) == recorded_provenance(folder)["agent_sha256"] != file_hash(run)
        assert tuned.start.transitions == 10

    monkeypatch.setattr("cartpole_rl.workflows.finetune.write_config", write_and_train)
    monkeypatch.setattr("cartpole_rl.workflows.finetune.drive_all", check)
    finetune(load_settings(FinetuneConfig, CONFIG | {"run": str(run)}), folder)


def test_what_a_person_has_to_do_is_shown_at_once(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A pipe behind standard output, such as tee, gets its text only at the end."""
    for module in ("finetune", "episodes"):
        name = f"cartpole_rl.workflows.{module}.evaluated_env"
        monkeypatch.setattr(name, lambda settings, config, prompt, confirm: prompt("Hold the pole"))
    config: Any = None
    driven_env(config, config, None, nobody)
    prepared(load_settings(EvaluateConfig, {"run": "lqr"}))
    assert capsys.readouterr() == ("", "cartpole-finetune: Hold the pole\nHold the pole\n")


def test_learning_in_simulation_follows_the_settings() -> None:
    learning = LearningSettings(**choice("learning/fast"))
    gentle = FinetuningSettings(**choice("finetuning/gentle"))
    simulated = simulated_learning(learning, gentle, episodes=20)
    assert simulated.iterations == 20 * gentle.iterations
    assert simulated.epsilon == gentle.simulated_epsilon == (0.1, 0.02)
    assert simulated.epsilon_transitions == simulated.transitions // 2
    assert simulated.warmup_transitions == 0
    assert simulated.batch_size == learning.batch_size


@pytest.mark.parametrize(("warmup", "learns"), [(4 * 3 * 16 * 8 - 1, True), (4 * 3 * 16 * 8, False)])
def test_a_fine_tuning_that_would_learn_nothing_is_refused(
    warmup: int, learns: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before the cart moves, and before a file is written; the buffer is filled before these transitions."""
    training, run, driven = load_settings(TrainConfig, TRAINING), tmp_path / "agent.pt", list[bool]()
    agent = AgentCheckpoint(training.model_dump(mode="json"), new_agent(training).state_dict(), 10, None)
    save_agent(run, agent)
    monkeypatch.setattr("cartpole_rl.workflows.finetune.drive_all", lambda *_: driven.append(True))
    config = load_settings(
        FinetuneConfig, {**CONFIG, "run": str(run), "finetuning.warmup_transitions": warmup}
    )
    complaint = r"^finetuning\.warmup_transitions=1536: nothing would be learned, as .* 1536 transitions "
    with nullcontext() if learns else pytest.raises(ConfigError, match=complaint):
        finetune(config, tmp_path / "run")
    assert bool(driven) == (tmp_path / "run").exists() == learns


def test_priorities_of_simulated_transitions_have_an_effect() -> None:
    """A training with buffer=uniform leaves alpha at 0; another one keeps its numbers."""
    gentle = choice("finetuning/gentle") | {"cart_share": 0.0}
    prioritized = FinetuningSettings(**gentle | {"buffer_kind": "prioritized"})
    uniform = BufferSettings(**choice("buffer/uniform") | {"size": 5000})
    own = BufferSettings(**choice("buffer/prioritized") | {"alpha": 0.5, "size": 5000})
    given = choice("buffer/prioritized") | {"size": 5000}
    assert simulated_buffer(uniform, prioritized) == BufferSettings(**given)
    assert simulated_buffer(own, prioritized) == own
    assert simulated_buffer(own, FinetuningSettings(**gentle)) == own.model_copy(update={"kind": "uniform"})
    assert simulated_buffer(uniform, FinetuningSettings(**gentle)) == uniform


def new_learner(**changes: Any) -> CartLearner:
    """A learner with a new agent, the same one each time; its cart brakes later than that of the training.

    `changes` are of the training's settings.
    """
    seed_everything(3)
    training = load_settings(TrainConfig, TRAINING | changes)
    config = load_settings(FinetuneConfig, CONFIG)
    settings = evaluated_settings(training, evaluation_config(config))
    numbers = settings.guard.active
    other = numbers.model_copy(update={"margin": 2 * numbers.margin})
    guard = settings.guard.model_copy(update={"numbers": other})
    return CartLearner(config, training, settings.model_copy(update={"guard": guard}), new_agent(training))


@pytest.fixture(scope="module")
def recorded() -> list[Episode]:
    """Three episodes of random motor values."""
    training = load_settings(TrainConfig, TRAINING)
    env = simulated_env(training, training.plant, 3, training.task.start, seed=1)
    random, actions = torch.Generator().manual_seed(0), len(training.actions.motors)
    return run_batch(
        env, lambda current: current.set("action", torch.randint(actions, (3,), generator=random))
    )


@pytest.fixture(scope="module")
def late(recorded: list[Episode]) -> CartLearner:
    """A learner that starts after two episodes, without the state of the earlier one."""
    learner = new_learner()
    learner.candidates = learner.candidates[:1]
    learner.start(recorded, learned=2)
    return learner


def from_disk(state: dict[str, Any]) -> dict[str, Any]:
    """`state` as `save_training` and `load_training` would return it."""
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


def go_on(learner: CartLearner, episode: Episode) -> None:
    learner.round()
    learner.add(episode)
    learner.round()


def test_a_resumed_fine_tuning_equals_one_that_was_not_stopped(recorded: list[Episode]) -> None:
    """The pole's length is observed; the simulator is fitted anew before the stop."""
    whole = new_learner()
    whole.candidates = whole.candidates[1:]  # not the law of the training, so that it has to be restored
    whole.start(recorded[:2], learned=1)
    whole.round()
    carts = whole.carts
    whole.add(recorded[2])
    assert not torch.equal(whole.carts, carts)
    saved = from_disk(whole.snapshot())
    go_on(whole, recorded[1])
    resumed = new_learner()
    resumed.agent.load_state_dict(saved["agent"])
    resumed.restore(recorded, saved)
    assert resumed.models == whole.models
    go_on(resumed, recorded[1])
    assert resumed.loop.iteration == 12
    weights = resumed.agent.state_dict()
    assert all(torch.equal(weights[name], weight) for name, weight in whole.agent.state_dict().items())
    assert all(weight.isfinite().all() for weight in weights.values())


def test_a_state_that_lacks_a_part_is_named(late: CartLearner, recorded: list[Episode]) -> None:
    state = late.snapshot()
    for part in ("carts", "chooser", "optimizer"):
        with pytest.raises(CheckpointError, match=rf"its state lacks '{part}'; start anew"):
            new_learner().restore(recorded[:1], {key: each for key, each in state.items() if key != part})


def test_a_learner_that_starts_later_continues_the_schedules(late: CartLearner) -> None:
    assert late.loop.iteration == 2 * late.config.finetuning.iterations
    assert late.loop.epsilon < late.loop.settings.epsilon[0]


def test_simulation_brakes_as_the_cart_does(late: CartLearner) -> None:
    """The guard of a cart with another pole is not that of the training."""
    assert late.loop.env.hardware.guard == late.settings.guard.numbers != late.training.guard.numbers


def test_a_refit_that_fails_keeps_the_earlier_fit(
    late: CartLearner, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """An encoder came loose: learning goes on."""
    carts, capacity = late.carts.clone(), len(late.loop.buffer)
    jumps = np.random.default_rng(0).integers(-(10**6), 10**6, late.recorded[0].counts.shape)
    loose = [replace(each, counts=each.counts + jumps) for each in late.recorded]
    monkeypatch.setattr(late, "recorded", loose)
    late.refit()
    assert "the simulator stays as it is: no cart moves as" in capsys.readouterr().err.splitlines()[-1]
    assert torch.equal(late.carts, carts)
    assert len(late.loop.buffer) == capacity


def test_learning_begins_without_a_fit_and_takes_a_later_one(
    recorded: list[Episode], capsys: pytest.CaptureFixture[str]
) -> None:
    """The pole fell at once in each episode before the fine-tuning. The first fit chooses the friction."""
    learner = new_learner()
    candidates = [*learner.candidates]
    assert learner.start([recorded[0].part(0, 9)])["cart/score_in_simulation"] > 0
    line = capsys.readouterr().err.splitlines()[-1]
    told = "the simulator is not fitted yet, its carts are drawn as in training: no recording lasts 0.5 s"
    assert line == f"cartpole-finetune: {told}: record longer"
    assert learner.candidates == candidates
    assert learner.snapshot()["cart_friction"] == "sigmoid"
    carts, iteration = learner.carts, learner.loop.iteration
    learner.candidates = [each for each in candidates if each.cart_friction == "step"]
    for episode in recorded[:2]:
        learner.add(episode)
    assert not torch.equal(learner.carts, carts)
    assert learner.loop.env.plant.models == learner.models == learner.candidates[0]
    assert learner.snapshot()["cart_friction"] == "step"
    assert learner.loop.iteration == iteration


def test_the_carts_of_a_training_on_a_learned_model_are_those_of_the_model(
    recorded: list[Episode], tmp_path: Path
) -> None:
    """With its friction law: where no cart can be fitted, and in the prior share of a fit."""
    training = load_settings(TrainConfig, TRAINING)
    identified = training.nominal_with(training.pole.nominal) | {"cart_mass": 1.3, "latency": 0.03}
    residual = Residual.untrained(3, 8, torch.Generator().manual_seed(0), 0.02, 4.0, 0.814)
    models = Models(cart_friction=CART_FRICTIONS.find("step"))
    save_model(tmp_path / "model.pt", LearnedModel(identified, models, 0.02, 4, residual))
    learner = new_learner(plant={"kind": "learned", "model": str(tmp_path), "prior_share": 0.0})
    learner.start([recorded[0].part(0, 9)])
    drawn, rows = learner.randomizer().prior.draw(9, torch.Generator()), CartParameters.names()
    for name in ("cart_mass", "latency"):
        for carts in (learner.carts, drawn):
            assert torch.equal(carts[rows.index(name)].unique(), torch.tensor([identified[name]]))
    assert learner.models == learner.candidates[0] == models
    assert learner.snapshot()["cart_friction"] == "step"


def test_what_is_not_learned_from_is_told(
    late: CartLearner, recorded: list[Episode], capsys: pytest.CaptureFixture[str]
) -> None:
    """The cart's own brake drove in one period, then in a tenth of them."""
    motor, steps = recorded[0].motor, recorded[0].measured_steps
    assert len(late.transitions(replace(recorded[0], motor=np.r_[motor[:10], -255, motor[11:]]))) == 2
    assert not capsys.readouterr().err
    many = steps // 10
    odd = replace(recorded[0], motor=np.r_[motor[:10], [-255] * many, motor[10 + many :]])
    assert [chunk.shape[1] for chunk in late.transitions(odd)] == [10, steps - 10 - many]
    (line,) = capsys.readouterr().err.splitlines()
    assert line == (
        f"cartpole-finetune: {many} of {steps} steps of an episode are not learned from: the cart's own "
        "brake or a late command drove them, or their frame was late or lost"
    )
    assert [chunk.shape[1] for chunk in late.transitions(recorded[0])] == [steps]
