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
from command_line import ONCE, TINY, Outcome, console_script, in_process, outcome
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from cartpole_rl.commands.composition import job_name, run_folder


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


def test_equal_seeds_give_equal_runs_and_another_seed_another(trained: Path, tmp_path: Path) -> None:
    for name, seed in (("same", 0), ("other", 1)):
        done = in_process("train", *TINY, f"seed={seed}", f"hydra.run.dir={name}", folder=tmp_path)
        assert done.code == 0, done.err
        assert_tells_only_how_it_goes(done)
    assert read(tmp_path / "same/metrics.json") == read(trained / "metrics.json")
    assert history(tmp_path / "same") == history(trained)
    assert all(
        torch.equal(weight, weights(trained)[name]) for name, weight in weights(tmp_path / "same").items()
    )
    assert read(tmp_path / "other/metrics.json") != read(trained / "metrics.json")


def assert_tells_only_how_it_goes(done: Outcome) -> None:
    """No warning, no log of a library: a progress bar, and one line at the end."""
    assert len(done.out.splitlines()) == 1
    lines = done.err.replace("\r", "\n").splitlines()
    assert all("frames/s" in line for line in lines if line.strip()), done.err


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


def test_a_sweep_makes_a_folder_a_job(tmp_path: Path) -> None:
    swept = ["randomization=friction_3,friction_6", "seed=0,1"]
    done = in_process("train", "-m", *TINY, ONCE, *swept, folder=tmp_path)
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
        assert len(history(job)) == 1
        assert (job / "checkpoints/last.pt").exists()
        assert {path.name for path in (job / "figures").iterdir()} >= {"learning_curve.png", "behaviour.png"}
        assert "Final/score" in curves(job)
        spread = yaml.safe_load((job / "config.yaml").read_text())["randomization"]["cart_coulomb"][
            "relative"
        ]
        assert spread == ([-0.03, 0.03] if "friction_3" in job.name else [-0.06, 0.06])
    assert read(jobs[0] / "metrics.json") != read(jobs[1] / "metrics.json")
    run = f"run={jobs[0]}/checkpoints/best.pt"  # the name needs no quotes
    evaluated = in_process("evaluate", run, "episodes=1", folder=tmp_path)
    assert evaluated.code == 0, evaluated.err


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


def when_saved(process: "subprocess.Popen[str]", checkpoint: Path) -> None:
    """Wait until the process replaces a checkpoint, or writes it for the first time."""
    before = checkpoint.stat().st_mtime_ns if checkpoint.exists() else 0
    while not checkpoint.exists() or checkpoint.stat().st_mtime_ns == before:
        assert process.poll() is None, process.communicate()
        time.sleep(0.002)


def test_a_training_that_was_stopped_goes_on_as_if_it_had_not_been(tmp_path: Path) -> None:
    """Killed, resumed, terminated, resumed: the same to the bit as one that ran through."""
    words = (*TINY, "learning.frames=4096", "learning.evaluations=8", "replay=prioritized", "pole=both")
    checkpoint = tmp_path / "stopped/checkpoints/resume.pt"

    killed = console_script("train", *words, "hydra.run.dir=stopped", folder=tmp_path)
    when_saved(killed, checkpoint)
    killed.kill()
    killed.communicate()
    assert len(history(tmp_path / "stopped")) < 8

    terminated = console_script("train", "resume=stopped", folder=tmp_path)
    when_saved(terminated, checkpoint)
    terminated.terminate()
    done = outcome(terminated)
    assert done.code == 143
    assert done.err.splitlines()[-1] == "cartpole-train: terminated"
    assert "Traceback" not in done.err
    assert not (tmp_path / "stopped/metrics.json").exists()

    assert in_process("train", "resume=stopped", folder=tmp_path).code == 0
    assert in_process("train", *words, "hydra.run.dir=whole", folder=tmp_path).code == 0
    runs = tmp_path / "whole", tmp_path / "stopped"
    whole, resumed = map(weights, runs)
    assert whole.keys() == resumed.keys()
    assert all(torch.equal(weight, resumed[name]) for name, weight in whole.items())
    assert history(runs[0]) == history(runs[1])
    assert len(history(runs[0])) == 8
    assert read(runs[0] / "metrics.json") == read(runs[1] / "metrics.json")
    assert curves(runs[0]) == curves(runs[1])
    assert len(read(runs[1] / "provenance.json")["resumed"]) == 2
