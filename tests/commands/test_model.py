"""A model is learned from recordings, judged by what it did not see, and is a plant to train on."""

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from command_line import ENSEMBLE, ONCE, TINY, Outcome, in_process

from cartpole_rl.envs.build import driven_carts, simulated_env, with_fitted_guard
from cartpole_rl.envs.guard import centre_of_mass, stopping_distance
from cartpole_rl.evaluation.recordings import read_recording, write_recording
from cartpole_rl.plants.learned import load_model, save_model
from cartpole_rl.run_folder import experiments
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.tasks.features import Measured
from cartpole_rl.terminal import noting
from cartpole_rl.workflows.config import TrainConfig, load_settings
from cartpole_rl.workflows.model import next_command
from cartpole_rl.workflows.train import print_notes


def frozen(episode: Episode) -> Episode:
    """With a pole that is not counted for two seconds."""
    theta, counts = episode.theta.copy(), episode.counts.copy()
    theta[100:200], counts[100:200, 1] = theta[100], counts[100, 1]
    return replace(episode, theta=theta, counts=counts)


def shuffled(episode: Episode) -> Episode:
    """With the motor values of no cart."""
    return replace(episode, motor=np.random.default_rng(0).permutation(episode.motor))


def reversed_motor(episode: Episode) -> Episode:
    return replace(episode, motor=-episode.motor)


def slower(episode: Episode) -> Episode:
    return replace(episode, time=1.1 * episode.time)


@pytest.mark.parametrize(
    ("change", "everywhere", "said"),
    [
        (reversed_motor, True, "positive motor values push the cart towards smaller counts"),
        (slower, False, "episode_001.csv has a frame every 22 ms, "),
        (frozen, False, "episode_001.csv: the pole's count stays at"),
        (shuffled, False, "episode_001.csv: no cart explains this recording"),
    ],
)
def test_recordings_that_teach_a_wrong_model_are_refused(
    change: Callable[[Episode], Episode], everywhere: bool, said: str, recorded: Path, tmp_path: Path
) -> None:
    for path in experiments(recorded).values():
        episode = read_recording(path).episode
        chosen = everywhere or path.stem == "episode_001"
        write_recording(tmp_path / path.name, change(episode) if chosen else episode)
    for command in ("model", "replay") if change is slower else ("model",):
        small = ENSEMBLE if command == "model" else ()
        done = in_process(command, f"from={tmp_path}", *small, "hydra.run.dir=run", folder=tmp_path)
        assert done.code == 2
        assert said in done.complaint
        assert not (tmp_path / "run").exists()


def report(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "model.json").read_text())


def test_its_errors_are_written_and_printed(learned: tuple[Path, Outcome]) -> None:
    folder, done = learned
    results = report(folder)
    assert (results["pole"], results["control_period_s"], len(results["recordings"])) == ("medium", 0.02, 2)
    for model in ("physics alone", "physics + network"):
        assert [line["after_s"] for line in results["errors"][model]] == [0.1, 0.5, 1.0]
        assert model in done.out
        assert 0 < results["errors"][model][0]["rms_x_mm"] < 5
    assert results["errors"]["physics alone"][0]["windows"] == results["held_out_windows"] > 0
    assert "RMS errors and ensemble spreads" in done.out
    assert len(results["left_out_loss"]) == 2
    assert (folder / "figures/model.png").stat().st_size > 10_000
    config = yaml.safe_load((folder / "config.yaml").read_text())
    second = Path(config["from"][1])  # maybe the copy of another worker
    assert second.is_file()
    assert second.is_absolute()
    assert second.parts[-2:] == ("recordings", "episode_001.csv")
    assert config["ensemble"]["members"] == 2


def test_the_next_command_names_a_pole_that_is_not_the_default(learned: tuple[Path, Outcome]) -> None:
    words = "cartpole-train plant=learned plant.model=run"
    assert learned[1].out.splitlines()[-1] == words
    assert next_command(load_model(learned[0] / "model.pt"), "large", Path("run")) == f"{words} pole=large"


@pytest.mark.usefixtures("without_pictures")
def test_an_agent_is_trained_on_it_and_judged_on_it(learned: tuple[Path, Outcome], tmp_path: Path) -> None:
    model = f"plant.model={learned[0]}"
    done = in_process("train", "plant=learned", model, *TINY, ONCE, "hydra.run.dir=run", folder=tmp_path)
    assert done.code == 0, done.err
    assert "does not learn on" not in done.err  # it is judged on the model's cart
    assert json.loads((tmp_path / "run/metrics.json").read_text())["plant"] == "learned"
    words = ["plant=learned", model, "run=run", "episodes=2", "hydra.run.dir=learned"]
    done = in_process("evaluate", *words, folder=tmp_path)
    assert done.code == 0, done.err
    metrics = json.loads((tmp_path / "learned/metrics.json").read_text())
    assert (metrics["plant"], len(metrics["episodes"])) == ("learned", 2)


def test_the_notes_and_the_preview_are_about_its_carts(
    learned: tuple[Path, Outcome], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def notes(**settings: Any) -> str:
        given = {"plant": "learned", "plant.model": str(learned[0]), **settings}
        config = load_settings(TrainConfig, given)
        with noting([f"{name}={value}" for name, value in given.items()]):
            print_notes(config, *driven_carts(config, config.plant))
        return capsys.readouterr().err

    other = {"step": "sigmoid", "sigmoid": "step"}[report(learned[0])["cart_friction"]]
    slope = {"+randomization.sigmoid_slope": {"absolute": [50, 200]}}
    assert ("sigmoid_slope has no effect with cart_friction=step" in notes(**slope)) == (other == "sigmoid")
    assert f"note: cart_friction={other}: plant=learned has its own cart" in notes(cart_friction=other)
    assert notes(**{"plant.prior_share": 0.0}).count("note: ") == 1
    words = ["plant=learned", f"plant.model={learned[0]}", "randomization=none", "preview=true"]
    done = in_process("train", *words, "hydra.run.dir=run", folder=tmp_path)
    assert (done.code, (tmp_path / "run/figures/randomization.png").exists()) == (0, True)


def test_its_guard_is_that_of_its_carts(learned: tuple[Path, Outcome], tmp_path: Path) -> None:
    model = load_model(learned[0])
    heavy = {**model.parameters, "cart_mass": 1.2, "latency": 0.06}
    save_model(tmp_path / "model.pt", replace(model, parameters=heavy))
    settings = {
        "plant": "learned",
        "plant.model": str(tmp_path),
        "plant.prior_share": 0.0,
        "guard": "careful",
    }
    config = load_settings(TrainConfig, settings)
    own, wide = (with_fitted_guard(config, plant).guard.active for plant in (config.plant, None))
    hanging = Measured(*torch.tensor([[0.0], [1.0], [math.pi], [0.0]]))
    ways = [
        stopping_distance(hanging.x_dot, guard, centre_of_mass(hanging, guard.pole, None))
        for guard in (own, wide)
    ]
    assert ways[0] > ways[1] + 0.03
    assert simulated_env(config, config.plant, 2, config.task.start, 0).hardware.guard == own


def test_a_model_that_does_not_fit_is_refused(learned: tuple[Path, Outcome], tmp_path: Path) -> None:
    model = f"plant.model={learned[0]}"
    for word, complaint in {
        "pole=large": "pole: plant.model has one of 0.36 m, not 0.66 m",
        "cart=stepper pole=medium": "cart: plant.model has 22749 nm and 1",
        "control_period=0.01": "control_period=0.01: plant.model has 0.02 s",
        "actions=nine_newtons": "actions: plant.model has actuator force_curve",
    }.items():
        done = in_process("train", "plant=learned", model, *word.split(), *TINY, folder=tmp_path)
        assert done.complaint.startswith(f"cartpole-train: {complaint}"[:60]), done.complaint
        assert done.code == 2
    done = in_process(
        "evaluate", "run=lqr", "plant=learned", model, "randomization=wide", "pole=medium", folder=tmp_path
    )
    assert done.complaint == "cartpole-evaluate: randomization, pole: plant=learned does not read it"


def test_a_missing_or_damaged_model_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "damaged.pt").write_bytes(b"not a model")
    for given, complaint, code in (
        ("plant.model=damaged.pt", "plant.model=damaged.pt is not a learned model, or is damaged", 1),
        ("label=", "plant.model is missing; give plant.model=runs/model/<run>", 2),
    ):
        done = in_process("train", "plant=learned", given, *TINY, folder=tmp_path)
        assert done.complaint.startswith(f"cartpole-train: {complaint}")
        assert done.code == code
