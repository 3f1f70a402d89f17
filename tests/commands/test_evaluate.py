"""Repeated episodes: same cart, same start, same score. Predicted ones: nominal cart, start of the cart."""

import errno
import io
import json
import shutil
from collections.abc import Iterator
from contextlib import closing, redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from command_line import in_process, no_pictures
from PIL import Image

from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.evaluation.recordings import as_stored, read_origin, read_recording
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.plants.emulated import EmulatedCart
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.workflows import checks
from cartpole_rl.workflows.build import predicting_env
from cartpole_rl.workflows.config import EvaluateConfig, load_settings
from cartpole_rl.workflows.episodes import Evaluation, prepared
from cartpole_rl.workflows.evaluate import evaluate as evaluate_agent
from cartpole_rl.workflows.evaluate import next_command, predicted_episode

SAME = ("score", "score_upright", "reward", "steps", "ended_by", "min_track_margin_m", "rms_motor_change")


def read(run: Path) -> dict[str, Any]:
    return json.loads((run / "metrics.json").read_text())


def guard_of(run: Path) -> dict[str, Any]:
    return yaml.safe_load((run / "config.yaml").read_text())["evaluated"]["guard"]


@pytest.fixture(scope="module")
def evaluated(trained: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with evaluations: `wide` of drawn carts, `noisy` where much is left to chance.

    `older` is `wide` without its carts, `damaged` has half a metrics.json.
    """
    folder = tmp_path_factory.mktemp("evaluated")
    noisy = "parameters={latency:0.01,latency_jitter:0.002,angle_noise:0.002}"
    emulated = ("plant=emulated", "episodes=1", "animation.simulation=true")
    short = ("task=swingup", "task.time_limit=100")
    wide = ("randomization=wide", "pole=both", *short, "seed=5", "episodes=7")
    with no_pictures():
        evaluate(trained, folder, "wide", *wide)
        evaluate(trained, folder, "noisy", noisy, *short, "episodes=3")
    evaluate(trained, folder, "emulated", *emulated)
    for name in ("older", "damaged"):
        shutil.copytree(folder / "wide", folder / name)
    metrics = read(folder / "wide")
    for each in (metrics, *metrics["episodes"]):
        del each["cart"]
    (folder / "older/metrics.json").write_text(json.dumps(metrics))
    (folder / "damaged/metrics.json").write_text('{"plant": "simu')
    return folder


def evaluate(trained: Path, folder: Path, name: str, *words: str) -> None:
    done = in_process("evaluate", f"run={trained}", *words, f"hydra.run.dir={name}", folder=folder)
    assert done.code == 0, done.err
    (folder / name / "printed.txt").write_text(done.out)


def repeat(trained: Path, folder: Path, run: str, number: int, *words: str):
    given = (f"repeat.run={run}", f"repeat.episode={number}", f"hydra.run.dir=again_{run}_{number}")
    with no_pictures():
        return in_process("evaluate", f"run={trained}", *given, *words, folder=folder)


def test_the_same_cart_from_the_same_start_scores_the_same(trained: Path, evaluated: Path) -> None:
    """Also where a repetition is repeated, and where the agent has moved."""
    then, agent = read(evaluated / "wide"), trained
    for run, number, folder in (("wide", 6, "again_wide_6"), ("again_wide_6", 0, "again_again_wide_6_0")):
        done = repeat(agent, evaluated, run, number)
        agent = shutil.copytree(trained, evaluated / "moved", dirs_exist_ok=True)
        assert done.code == 0, done.err
        now = read(evaluated / folder)
        assert len(now["episodes"]) == 1
        for key in SAME:
            assert now["episodes"][0][key] == then["episodes"][6][key], key
        assert read_origin(now, 0) == read_origin(then, 6)
        assert guard_of(evaluated / folder) == guard_of(evaluated / "wide")
        assert f"episode {number} of {run} had score" in done.out
        assert "now exactly the same" in done.out


def test_the_baseline_of_another_pole_is_that_of_then(tmp_path: Path) -> None:
    """It is designed for the chosen pole."""
    other = ("parameters={pole_mass:0.35,pole_com:0.12}", "task=swingup", "task.time_limit=60", "episodes=2")
    with no_pictures():
        done = in_process("evaluate", "run=lqr", *other, "hydra.run.dir=other", folder=tmp_path)
    assert done.code == 0, done.err
    done = repeat(Path("lqr"), tmp_path, "other", 1)
    assert "now exactly the same" in done.out, done.err


class ClosedTerminal(io.StringIO):
    def write(self, text: str) -> int:
        raise OSError(errno.EIO, "Input/output error")


def test_results_outlive_the_terminal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    episodes = Evaluation.episodes

    def interrupted(evaluation: Evaluation) -> Iterator[Episode]:
        yield next(episodes(evaluation))
        raise KeyboardInterrupt

    monkeypatch.setattr(Evaluation, "episodes", interrupted)
    given = {"run": "lqr", "task": "swingup", "task.time_limit": 30}
    with no_pictures(), redirect_stdout(ClosedTerminal()), pytest.raises(KeyboardInterrupt):
        evaluate_agent(load_settings(EvaluateConfig, given), tmp_path / "run")
    assert len(read(tmp_path / "run")["episodes"]) == 1


def test_the_carts_of_an_evaluation_differ_and_are_told_whole(evaluated: Path) -> None:
    metrics = read(evaluated / "wide")
    origins = [read_origin(metrics, number) for number in range(7)]
    assert all({*origin.parameters} == {*CartParameters.names()} for origin in origins)
    assert len({origin.parameters["cart_mass"] for origin in origins}) == 7
    assert len({origin.state["x"] for origin in origins}) == 7
    assert "cart_mass" not in metrics["cart"]
    assert metrics["cart"]["force_linear"] == 0.02
    scores = {episode["score"] for episode in metrics["episodes"]}
    assert len(scores) == 7


def test_what_is_left_to_chance_is_said(trained: Path, evaluated: Path) -> None:
    done = repeat(trained, evaluated, "noisy", 2)
    assert done.code == 0, done.err
    assert "latency_jitter, angle_noise is random, so the episode cannot be repeated exactly" in done.out
    then, now = read(evaluated / "noisy"), read(evaluated / "again_noisy_2")
    assert read_origin(now, 0) == read_origin(then, 2)


def test_an_episode_is_recorded_again(trained: Path, evaluated: Path) -> None:
    words = (f"run={trained}", "repeat.run=wide", "repeat.episode=5", "hydra.run.dir=recorded")
    done = in_process("record", *words, folder=evaluated)
    assert done.code == 0, done.err
    (path,) = (evaluated / "recorded/recordings").iterdir()
    then = read(evaluated / "wide")
    assert read_recording(path).episode.score.sum() == then["episodes"][5]["score"]
    heading = dict(line[2:].split(": ", 1) for line in path.read_text().splitlines() if line[0] == "#")
    origin = read_origin(then, 5)
    assert json.loads(heading["cart"]) == origin.parameters
    assert json.loads(heading["start"]) == origin.state


def test_numbers_come_back_to_the_bit() -> None:
    generator = np.random.default_rng(0)
    bits = generator.integers(0, 2**32, 20_000, dtype=np.uint32).view(np.float32)
    values = bits[np.isfinite(bits)]
    stored = [json.loads(json.dumps(as_stored(float(value)))) for value in values]
    assert (np.array(stored).astype(np.float32).view(np.uint32) == values.view(np.uint32)).all()
    assert as_stored(float(np.float32(0.7))) == 0.7


@pytest.mark.parametrize(
    ("words", "named", "remedy"),
    [
        ("repeat.run=wide repeat.episode=7", "repeat.episode=7", "has episodes 0 to 6"),
        ("repeat.run=wide repeat.episode=-1", "repeat.episode=-1", "give at least 0"),
        ("repeat.run=wide", "repeat.episode is missing", "repeat.episode=0 to 6"),
        ("repeat.episode=1", "repeat.run is missing", "the run folder of an evaluation"),
        ("repeat.run=nowhere repeat.episode=1", "repeat.run=nowhere", "give the run folder of one"),
        ("repeat.run=emulated repeat.episode=0", "plant=emulated", "give a run with plant=simulated"),
        ("repeat.run=older repeat.episode=0", "repeat.run=older", "evaluate again"),
        ("repeat.run=damaged repeat.episode=0", "repeat.run=damaged", "give the run folder of one"),
        ("repeat.run=wide repeat.episode=1 seed=3 plant=emulated", "seed=3, plant=emulated", "own settings"),
    ],
)
def test_bad_input_is_told_in_a_line(
    words: str, named: str, remedy: str, trained: Path, evaluated: Path
) -> None:
    done = in_process("evaluate", f"run={trained}", *words.split(), folder=evaluated)
    assert done.code in (1, 2)
    assert named in done.complaint
    assert remedy in done.complaint
    assert not list(evaluated.glob("runs/evaluate/*"))


def test_the_cart_of_a_board_that_tells_nothing_is_compared(trained: Path, tmp_path: Path) -> None:
    board = ("plant=text", f"plant.port={tmp_path}/none", "plant.full=255")
    done = in_process("evaluate", f"run={trained}", *board, "cart=stepper", folder=tmp_path)
    assert done.complaint == (
        "cartpole-evaluate: cart: it has 25000 nm and 1/4096 turn a count, 0.6 m of track, but the agent was "
        "trained for 22749 nm and 1/4096 turn a count, 0.814 m of track; train one for this cart"
    )


def test_scores_are_kept_if_a_figure_cannot_be_written(trained: Path, tmp_path: Path) -> None:
    """As on a full disk."""
    (tmp_path / "full").mkdir()
    (tmp_path / "full/figures").write_text("a file in the place of the folder")
    words = (f"run={trained}", "episodes=1", "task=swingup", "task.time_limit=20", "hydra.run.dir=full")
    done = in_process("evaluate", *words, folder=tmp_path)
    assert done.code == 1
    assert "figures" in done.complaint
    score = read(tmp_path / "full")["score"]["mean"]
    assert f"{score:.0f}" in done.out


def test_the_next_command_identifies_the_pole_that_is_stated() -> None:
    """Whatever pole the agent knows: the pole's numbers set every force that is identified."""
    with EmulatedCart(EmulatorSettings()) as cart:
        on_cart = {"run": "pretrained/medium", "plant": "serial", "plant.port": cart.port}
        for stated, pole in (({}, "medium"), ({"pole": "large"}, "large")):
            evaluation = prepared(load_settings(EvaluateConfig, {**on_cart, **stated}))
            with closing(evaluation.env):
                assert next_command(evaluation).endswith(f" pole={pole}")


def test_the_first_episode_is_drawn_beside_its_prediction(evaluated: Path) -> None:
    with Image.open(evaluated / "emulated/figures/beside_simulation.gif") as animation:
        assert animation.size == (960, 320)
        assert animation.n_frames > 2
    score = read(evaluated / "emulated")["episodes"][0]["score"]
    line = f"first episode: score {score:.0f}, predicted by simulation "
    assert line in (evaluated / "emulated/printed.txt").read_text()


def test_the_prediction_starts_where_the_cart_did_and_drives_the_nominal_cart(trained: Path) -> None:
    words = {"run": trained, "randomization": "wide", "task": "swingup", "task.time_limit": 9, "episodes": 1}
    evaluation = prepared(load_settings(EvaluateConfig, words))
    (episode,) = evaluation.episodes()
    simulation = predicting_env(evaluation.settings, evaluation.training.plant, seed=0)
    predicted = predicted_episode(simulation, evaluation.policy, episode)
    for name in ("x", "theta"):  # the encoders round
        assert getattr(predicted, name)[0] == pytest.approx(getattr(episode, name)[0], abs=0.002)
    assert episode.origin is not None
    assert predicted.origin is not None
    nominal = evaluation.training.nominal_with(evaluation.training.pole.nominal)
    drawn = [name for name, value in nominal.items() if episode.origin.parameters[name] != as_f32(value)]
    assert len(drawn) > 5
    assert predicted.origin.parameters == {
        **predicted.origin.parameters,
        **{name: as_f32(value) for name, value in nominal.items()},
    }


def as_f32(value: float) -> float:
    return float(np.float32(value))


@pytest.mark.parametrize(
    ("command", "words", "remedy"),
    [
        ("evaluate", "animation.simulation=true", "plant=simulated is simulated itself"),
        ("record", "plant=emulated animation.simulation=true", "use cartpole-evaluate"),
        ("evaluate", "animation.mp4=true", 'pip install "cartpole_rl[video]"'),
    ],
)
def test_an_animation_that_cannot_be_drawn_is_refused(
    command: str, words: str, remedy: str, trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(checks, "find_spec", lambda name: None)  # no library is installed
    done = in_process(command, f"run={trained}", *words.split(), folder=tmp_path)
    assert done.code == 2
    assert remedy in done.complaint
