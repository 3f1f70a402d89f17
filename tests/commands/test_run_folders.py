"""What a run leaves behind, equal seeds, sweeps, and trainings that were killed."""

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from command_line import TINY, in_process, outcome
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from cartpole_rl.commands.composition import job_name, run_folder

RESUMABLE = (*TINY, "learning.frames=4096", "learning.evaluations=8", "learning.checkpoint_interval=2")


def read(path: Path) -> Any:
    return json.loads(path.read_text())


def history(run: Path) -> list[dict[str, float]]:
    """The evaluations of a training, without the seconds they were reached after."""
    records = [json.loads(line) for line in (run / "history.jsonl").read_text().splitlines()]
    return [{key: value for key, value in record.items() if key != "seconds"} for record in records]


def weights(run: Path) -> dict[str, torch.Tensor]:
    return torch.load(run / "checkpoints/last.pt", weights_only=True)["weights"]


def curves(run: Path) -> dict[str, list[tuple[int, float]]]:
    """The points of every TensorBoard curve that does not tell a time."""
    events = EventAccumulator(str(run), size_guidance={"scalars": 0})
    events.Reload()
    names = [tag for tag in events.Tags()["scalars"] if "second" not in tag]
    return {name: [(event.step, event.value) for event in events.Scalars(name)] for name in names}


def timeless(value: Any) -> bool:
    """Whether no key tells a duration or a date of the run itself."""
    if isinstance(value, dict):
        told = [key for key in value if "second" in key or "date" in key or "wall" in key]
        return not told and all(timeless(each) for each in value.values())
    return not isinstance(value, list) or all(timeless(each) for each in value)


def test_a_training_leaves_what_runs_readme_says(trained: Path) -> None:
    files = {str(path.relative_to(trained)) for path in trained.rglob("*") if path.is_file()}
    events = {name for name in files if name.startswith("events.out.tfevents.")}
    assert len(events) == 1
    assert files - events == {
        "config.yaml",
        "provenance.json",
        "metrics.json",
        "history.jsonl",
        *(f"checkpoints/{name}.pt" for name in ("last", "best", "resume")),
        *(f"figures/{name}" for name in ("learning_curve.png", "behaviour.png", "episode.gif")),
    }
    metrics = read(trained / "metrics.json")
    assert (metrics["plant"], metrics["pole"], len(metrics["episodes"])) == ("simulated", "medium", 2)
    assert timeless(metrics)
    config = yaml.safe_load((trained / "config.yaml").read_text())
    assert config["learning"]["frames"] == 2048
    assert config["task"]["x_max"] == config["cart"]["track_half_length"]
    provenance = read(trained / "provenance.json")
    assert provenance["seed"] == 0
    assert "learning.frames=2048" in provenance["command"]
    assert provenance["packages"]["torch"] == torch.__version__.split("+")[0]


def test_the_last_evaluation_is_that_of_the_metrics(trained: Path) -> None:
    last, metrics = history(trained)[-1], read(trained / "metrics.json")
    assert last["frames"] == 2048
    for key in ("score", "score_upright", "steps", "upright_fraction"):
        assert last[key] == pytest.approx(metrics[key]["mean"])
    assert last["score"] == pytest.approx(curves(trained)["evaluation/score"][-1][1])
    assert curves(trained)["Final/score"][0][1] == pytest.approx(last["score"])


def test_a_training_says_nothing_but_how_it_goes(tmp_path: Path) -> None:
    done = in_process("train", *TINY, folder=tmp_path)
    assert len(done.out.splitlines()) == 1
    lines = done.err.replace("\r", "\n").splitlines()
    assert all("frames/s" in line for line in lines if line.strip()), done.err


def test_equal_seeds_give_equal_runs_and_another_seed_another(trained: Path, tmp_path: Path) -> None:
    for name, seed in (("same", 0), ("other", 1)):
        done = in_process("train", *TINY, f"seed={seed}", f"hydra.run.dir={name}", folder=tmp_path)
        assert done.code == 0, done.err
    assert read(tmp_path / "same/metrics.json") == read(trained / "metrics.json")
    assert history(tmp_path / "same") == history(trained)
    assert all(
        torch.equal(weight, weights(trained)[name]) for name, weight in weights(tmp_path / "same").items()
    )
    assert read(tmp_path / "other/metrics.json") != read(trained / "metrics.json")


@pytest.mark.parametrize("plant", [["simulated", "randomization=wide"], ["emulated"]])
def test_an_evaluation_can_be_repeated(plant: list[str], trained: Path, tmp_path: Path) -> None:
    words = [f"run={trained}", "episodes=2", f"plant={plant[0]}", *plant[1:]]
    for name, seed in (("first", 0), ("second", 0), ("other", 1)):
        done = in_process("evaluate", *words, f"seed={seed}", f"hydra.run.dir={name}", folder=tmp_path)
        assert done.code == 0, done.err
    first, second, other = (read(tmp_path / name / "metrics.json") for name in ("first", "second", "other"))
    assert first == second
    assert first != other
    assert timeless(first)
    assert first["plant"] == plant[0]
    assert len(first["episodes"]) == 2
    assert {first[key] for key in ("late_ticks", "lost_frames", "bad_frames")} == {0}


def test_an_evaluation_may_take_another_task_cart_and_pole(trained: Path, tmp_path: Path) -> None:
    words = [
        "task=balance",
        "pole=large",
        "cart=ip02",
        "cart_friction=stribeck",
        "reward=constant",
        "episodes=3",
    ]
    more = ["parameters={cart_coulomb:0.8,pole_mass:0.25}", "hydra.run.dir=it"]
    done = in_process("evaluate", f"run={trained}", *words, *more, folder=tmp_path)
    assert done.code == 0, done.err
    assert "plant=simulated, 3 episodes" in done.out
    metrics = read(tmp_path / "it/metrics.json")
    assert metrics["pole"] == "large"
    assert all(episode["reward"] == episode["steps"] for episode in metrics["episodes"])
    evaluated = yaml.safe_load((tmp_path / "it/config.yaml").read_text())["evaluated"]
    assert evaluated["cart"]["cart_coulomb"] == 0.8
    assert evaluated["pole"]["choices"]["large"]["pole_mass"] == 0.25
    assert evaluated["task"]["angle_limit"] is not None
    assert evaluated["task"]["x_max"] == 0.38


def test_each_explicit_parameter_has_an_effect(trained: Path, tmp_path: Path) -> None:
    scores = set()
    for index, parameters in enumerate(("null", "{cart_mass:1.5}", "{pole_com:0.3}", "{cart_viscous:5}")):
        words = [f"parameters={parameters}", "episodes=1", f"hydra.run.dir={index}"]
        done = in_process("evaluate", f"run={trained}", *words, folder=tmp_path)
        assert done.code == 0, done.err
        scores.add(read(tmp_path / f"{index}/metrics.json")["score"]["mean"])
    assert len(scores) == 4


def test_the_emulated_pole_is_the_one_that_is_told(trained: Path, tmp_path: Path) -> None:
    words = ["plant=emulated", "emulator=large", "episodes=1", "hydra.run.dir=it"]
    done = in_process("evaluate", f"run={trained}", *words, folder=tmp_path)
    assert done.code == 0, done.err
    assert read(tmp_path / "it/metrics.json")["pole"] == "0.66 m"


def test_a_checkpoint_file_will_do_as_a_run(trained: Path, tmp_path: Path) -> None:
    words = [f"run={trained / 'checkpoints/best.pt'}", "episodes=1"]
    assert in_process("evaluate", *words, folder=tmp_path).code == 0
    (folder,) = tmp_path.glob("runs/evaluate/*")
    assert (folder / "metrics.json").exists()


def test_a_sweep_makes_a_folder_a_job(tmp_path: Path) -> None:
    swept = ["randomization=friction_3,friction_6", "seed=0,1"]
    done = in_process("train", "-m", *TINY, *swept, folder=tmp_path)
    assert done.code == 0, done.err
    (sweep,) = tmp_path.glob("runs/train/*_multirun")
    jobs = sorted(path for path in sweep.iterdir() if path.is_dir())
    assert [job.name for job in jobs] == [
        "0_randomization-friction_3_seed-0",
        "1_randomization-friction_3_seed-1",
        "2_randomization-friction_6_seed-0",
        "3_randomization-friction_6_seed-1",
    ]
    for job in jobs:
        assert len(read(job / "metrics.json")["episodes"]) == 2
        assert len(history(job)) == 2
        assert (job / "checkpoints/last.pt").exists()
        assert {path.name for path in (job / "figures").iterdir()} >= {"learning_curve.png", "behaviour.png"}
        assert "Final/score" in curves(job)
        spread = yaml.safe_load((job / "config.yaml").read_text())["randomization"]["cart_coulomb"][
            "relative"
        ]
        assert spread == ([-0.03, 0.03] if "friction_3" in job.name else [-0.06, 0.06])
    assert read(jobs[0] / "metrics.json") != read(jobs[1] / "metrics.json")
    evaluated = in_process("evaluate", f"run={jobs[0]}", "episodes=1", folder=tmp_path)
    assert evaluated.code == 0, evaluated.err  # the name needs no quotes


def test_names_of_jobs_tell_what_differs(monkeypatch: pytest.MonkeyPatch) -> None:
    words = ["-m", "compile=false", "agent.hidden=[64,64],[8]", "run=runs/a,runs/b", "seed=range(0,2)"]
    monkeypatch.setattr(sys, "argv", ["cartpole-train", *words])
    job = ["compile=False", "agent.hidden=[64,64]", "run=runs/a", "seed=0"]
    assert job_name(7, job) == "7_agent.hidden-64-64_run-runs-a_seed-0"
    assert job_name(0, ["compile=False"]) == "0"


def test_runs_that_start_in_the_same_second_do_not_share_a_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    folders = {run_folder("train", "mine") for _ in range(5)}
    assert len(folders) == 5
    assert all(Path(folder).is_dir() and "_mine" in folder for folder in folders)


def train_process(*words: str, folder: Path) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        [sys.executable, "-m", "cartpole_rl.commands.train", *words],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def test_a_killed_training_goes_on_as_if_it_had_not_been(tmp_path: Path) -> None:
    words = (*RESUMABLE, "replay=prioritized", "pole=both")
    killed = train_process(*words, "hydra.run.dir=killed", folder=tmp_path)
    while not (tmp_path / "killed/checkpoints/resume.pt").exists():
        assert killed.poll() is None, killed.communicate()
        time.sleep(0.002)
    killed.kill()
    killed.communicate()
    assert not (tmp_path / "killed/metrics.json").exists()
    done = outcome(train_process("resume=killed", folder=tmp_path))
    assert done.code == 0, done.err

    assert in_process("train", *words, "hydra.run.dir=whole", folder=tmp_path).code == 0
    runs = tmp_path / "whole", tmp_path / "killed"
    whole, resumed = map(weights, runs)
    assert whole.keys() == resumed.keys()
    assert all(torch.equal(weight, resumed[name]) for name, weight in whole.items())
    assert history(runs[0]) == history(runs[1])
    assert len(history(runs[0])) == 8
    assert read(runs[0] / "metrics.json") == read(runs[1] / "metrics.json")
    assert curves(runs[0]) == curves(runs[1])
    assert len(read(runs[1] / "provenance.json")["resumed"]) == 1
