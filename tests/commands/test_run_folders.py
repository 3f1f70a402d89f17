"""Contents of run folders, equal seeds, sweeps, and trainings that were killed."""

import json
import shutil
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from command_line import (
    COARSE,
    TINY,
    console_script,
    in_process,
    interrupt_after,
    no_pictures,
    prints_only_progress,
)
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.errors import LinkError
from cartpole_rl.evaluation.episodes import Policy, run_episodes
from cartpole_rl.files import claimed
from cartpole_rl.learning.checkpoints import save_training
from cartpole_rl.sweeps import LONGEST_NAME, constant_settings, job_name, run_folder
from cartpole_rl.tasks.episode import Episode

LONGER = ("learning.transitions=2000000", "learning.evaluations=2000")  # than the test


def read(path: Path) -> Any:
    return json.loads(path.read_text())


def history(run: Path) -> list[dict[str, float]]:
    """The evaluations of a training, without the seconds they were reached after."""
    records = [json.loads(line) for line in (run / "history.jsonl").read_text().splitlines()]
    return [{key: value for key, value in record.items() if key != "seconds"} for record in records]


def weights(run: Path) -> dict[str, torch.Tensor]:
    return torch.load(run / "checkpoints/last.pt", weights_only=True)["weights"]


def curves(run: Path) -> dict[str, list[tuple[int, float]]]:
    """Return the points of every TensorBoard curve that is not a duration, by step."""
    events = EventAccumulator(str(run), size_guidance={"scalars": 0})
    events.Reload()
    names = [tag for tag in events.Tags()["scalars"] if "second" not in tag]
    return {name: sorted((event.step, event.value) for event in events.Scalars(name)) for name in names}


def timeless(value: Any) -> bool:
    """Return True if no key holds a duration or a date."""
    if isinstance(value, dict):
        told = [key for key in value if "second" in key or "date" in key or "wall" in key]
        return not told and all(timeless(each) for each in value.values())
    return not isinstance(value, list) or all(timeless(each) for each in value)


def test_a_training_that_runs_is_not_resumed(stopped: Path) -> None:
    before = (stopped / "provenance.json").read_bytes()
    with claimed(stopped):
        done = in_process("train", f"resume={stopped}", folder=stopped.parent)
    remedy = f"another process works in {stopped}; wait for its end, or stop it"
    assert (done.complaint, done.code) == (f"cartpole-train: {remedy}", 2)
    assert (stopped / "provenance.json").read_bytes() == before


@pytest.mark.parametrize("part", ["agent", "collector"])
def test_a_training_whose_state_lacks_a_part_is_not_resumed(part: str, stopped: Path, tmp_path: Path) -> None:
    run = shutil.copytree(stopped, tmp_path / "run")
    content = torch.load(run / "checkpoints/resume.pt", weights_only=True)
    del content["state"][part]
    torch.save(content, run / "checkpoints/resume.pt")
    before = (run / "history.jsonl").read_text()
    done = in_process("train", f"resume={run}", folder=tmp_path)
    last = done.err.splitlines()[-1]
    assert (f"lacks '{part}'; start anew" if part != "agent" else "other weights; train it again") in last
    assert "Traceback" not in done.err
    assert done.code == 1
    assert (run / "history.jsonl").read_text() == before


def test_a_training_writes_the_files_of_runs_readme(trained: Path) -> None:
    files = {str(path.relative_to(trained)) for path in trained.rglob("*") if path.is_file()}
    events = {name for name in files if name.startswith("events.out.tfevents.")}
    assert len(events) == 1
    assert files - events == {
        "config.yaml",
        "provenance.json",
        "metrics.json",
        "history.jsonl",
        *(f"checkpoints/{name}.pt" for name in ("last", "best")),
        *(f"figures/{name}" for name in ("learning_curve.png", "behaviour.png", "episode.gif")),
    }
    metrics = read(trained / "metrics.json")
    assert (metrics["plant"], metrics["pole"], len(metrics["episodes"])) == ("simulated", "medium", 2)
    assert timeless(metrics)
    config = yaml.safe_load((trained / "config.yaml").read_text())
    assert config["learning"]["transitions"] == 2048
    assert config["task"]["x_max"] == config["cart"]["track_half_length"]
    provenance = read(trained / "provenance.json")
    assert (provenance["program"], provenance["seed"]) == ("cartpole-train", 0)
    assert "learning.transitions=2048" in provenance["command"]
    assert provenance["packages"]["torch"] == torch.__version__.split("+")[0]


def test_the_last_evaluation_is_that_of_the_metrics(trained: Path) -> None:
    last, metrics = history(trained)[-1], read(trained / "metrics.json")
    assert last["transitions"] == 2048
    for key in ("score", "score_upright", "steps", "upright_fraction"):
        assert last[key] == pytest.approx(metrics[key]["mean"])
    assert last["score"] == pytest.approx(curves(trained)["evaluation/score"][-1][1])
    assert curves(trained)["summary/score"][0][1] == pytest.approx(last["score"])


def test_tensorboard_shows_the_score_first_and_describes_everything(trained: Path) -> None:
    events = EventAccumulator(str(trained)).Reload()
    tags = [tag for kind in ("scalars", "images", "histograms") for tag in events.Tags()[kind]]
    assert min(tags) == "evaluation/score"
    assert max(events.Tags()["scalars"]).startswith("summary/")  # a point each
    assert [tag for tag in tags if not events.SummaryMetadata(tag).summary_description] == []


@pytest.mark.usefixtures("without_pictures")
@pytest.mark.parametrize("plant", ["simulated", pytest.param("emulated", marks=pytest.mark.nightly)])
def test_an_evaluation_can_be_repeated(plant: str, trained: Path, tmp_path: Path) -> None:
    words = [f"run={trained}", "episodes=2", f"plant={plant}", *[COARSE] * (plant == "emulated")]
    for name in ("first", "second"):
        done = in_process("evaluate", *words, f"hydra.run.dir={name}", folder=tmp_path)
        assert done.code == 0, done.err
    first, second = (read(tmp_path / name / "metrics.json") for name in ("first", "second"))
    assert first == second
    assert timeless(first)
    assert first["plant"] == plant
    assert len(first["episodes"]) == 2
    assert {first[key] for key in ("late_ticks", "lost_frames", "bad_frames")} == {0}


@pytest.mark.usefixtures("without_pictures")
def test_seed_and_explicit_parameters_have_an_effect(trained: Path, tmp_path: Path) -> None:
    scores = set()
    changes = ("seed=0", "seed=1", "parameters={cart_mass:1.5}", "parameters={pole_com:0.3}")
    for index, change in enumerate(changes):
        words = [change, "episodes=1", f"hydra.run.dir={index}"]
        done = in_process("evaluate", f"run={trained}", *words, folder=tmp_path)
        assert done.code == 0, done.err
        scores.add(read(tmp_path / f"{index}/metrics.json")["score"]["mean"])
    assert len(scores) == len(changes)


@pytest.mark.usefixtures("without_pictures")
def test_an_evaluation_may_take_another_task_cart_and_pole(trained: Path, tmp_path: Path) -> None:
    words = ["task=balance", "pole=large", "cart=ip02", "cart_friction=stribeck", "reward=constant"]
    more = ["episodes=3", "parameters={cart_coulomb:0.8,pole_mass:0.25}", "hydra.run.dir=it"]
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


@pytest.fixture(scope="module")
def sweep(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """The run folders of two jobs, the first of which has the settings of `trained`."""
    folder = tmp_path_factory.mktemp("sweep")
    swept = ["actions=two", "randomization=wide", "seed=0,1"]  # as `trained`
    with no_pictures():
        done = in_process("train", "-m", *TINY, *swept, folder=folder)
    assert done.code == 0, done.err
    assert prints_only_progress(done, trainings=2)
    (made,) = folder.glob("runs/train/*_multirun")
    return sorted(path for path in made.iterdir() if path.is_dir())


def test_a_sweep_makes_a_folder_a_job(sweep: list[Path]) -> None:
    assert [job.name for job in sweep] == ["0_seed-0", "1_seed-1"]
    for job in sweep:
        config = yaml.safe_load((job / "config.yaml").read_text())
        assert config["seed"] == int(job.name[-1])
        assert len(read(job / "metrics.json")["episodes"]) == 2
        assert len(history(job)) == 2
        assert (job / "checkpoints/last.pt").exists()
        assert "summary/score" in curves(job)


def test_equal_seeds_give_equal_runs_and_another_seed_another(trained: Path, sweep: list[Path]) -> None:
    same, other = sweep
    assert read(same / "metrics.json") == read(trained / "metrics.json")
    assert history(same) == history(trained)
    assert all(torch.equal(weight, weights(trained)[name]) for name, weight in weights(same).items())
    assert read(other / "metrics.json") != read(trained / "metrics.json")


def test_names_of_jobs_show_what_differs(monkeypatch: pytest.MonkeyPatch) -> None:
    words = ["-m", "compile=false", "agent.hidden=[64,64],[8]", "run=runs/a,runs/b", "seed=range(0,2)"]
    monkeypatch.setattr(sys, "argv", ["cartpole-train", *words])
    job = ["compile=False", "agent.hidden=[64,64]", "run=runs/a", "seed=0"]
    assert job_name(7, job, constant_settings()) == "7_agent.hidden-64-64_run-runs-a_seed-0"
    assert job_name(0, ["compile=False"], constant_settings()) == "0"
    assert len(job_name(0, [f"label={200 * 'é'}"], ()).encode()) <= LONGEST_NAME


def test_runs_that_start_in_the_same_second_do_not_share_a_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    folders = {run_folder("train", "mine") for _ in range(5)}
    assert len(folders) == 5
    assert all(Path(folder).is_dir() and "_mine" in folder for folder in folders)


@pytest.mark.usefixtures("without_pictures")
@pytest.mark.usefixtures("all_carts")  # as the process that is killed
def test_a_stopped_training_resumes_identically(tmp_path: Path) -> None:
    """Killed, resumed, terminated, resumed: the same to the bit as one that ran through."""
    words = (*TINY, "learning.transitions=4096", "learning.evaluations=8", "buffer=prioritized", "pole=both")
    checkpoint = tmp_path / "stopped/checkpoints/resume.pt"

    killed = console_script("train", *words, "hydra.run.dir=stopped", folder=tmp_path)
    while not checkpoint.exists():
        assert killed.poll() is None, killed.communicate()
        time.sleep(0.002)
    killed.kill()
    killed.communicate()
    assert len(history(tmp_path / "stopped")) < 8

    interrupt_after(checkpoint, signal.SIGTERM)
    done = in_process("train", "resume=stopped", folder=tmp_path)
    assert done.code == 143
    assert done.err.splitlines()[-1].startswith("cartpole-train: terminated; cartpole-train resume=")
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
    assert not any((run / "checkpoints/resume.pt").exists() for run in runs)


@pytest.mark.usefixtures("without_pictures")
def test_a_training_that_ends_before_it_can_be_resumed_says_so(tmp_path: Path) -> None:
    interrupt_after(tmp_path / "run/checkpoints/last.pt")
    words = (*TINY, *LONGER, "learning.checkpoint_interval=2000", "hydra.run.dir=run")
    done = in_process("train", *words, folder=tmp_path)
    why = "it was stopped before its first checkpoints/resume.pt; start cartpole-train again"
    assert done.err.splitlines()[-1] == f"cartpole-train: interrupted; {why}"


@pytest.mark.usefixtures("without_pictures")
def test_a_training_ends_where_its_folder_was_moved_and_continues_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def moving(run: Path, *state: Any) -> None:
        save_training(run, *state)
        run.rename(tmp_path / "moved")

    with monkeypatch.context() as patch:
        patch.setattr("cartpole_rl.workflows.train.save_training", moving)
        done = in_process("train", *TINY, "hydra.run.dir=run", folder=tmp_path)
    assert done.err.splitlines()[-1].endswith(
        "run was moved or removed; cartpole-train resume=<its new place> continues it"
    )
    assert [*tmp_path.iterdir()] == [tmp_path / "moved"]
    (tmp_path / "moved/config.yaml").unlink()
    assert in_process("train", "resume=moved", folder=tmp_path).code == 0
    assert (tmp_path / "moved/config.yaml").exists()


def test_a_training_resumes_with_the_carts_that_it_drew(tmp_path: Path) -> None:
    (tmp_path / "carts.csv").write_text("cart_mass\n0.9\n1.1\n")
    interrupt_after(tmp_path / "run/checkpoints/resume.pt")
    words = (*TINY, *LONGER, "randomization={posterior:carts.csv}", "hydra.run.dir=run")
    with no_pictures():
        assert in_process("train", *words, folder=tmp_path).code == 130
    content = torch.load(tmp_path / "run/checkpoints/resume.pt", weights_only=True)
    del content["state"]["collector"]  # so that it does not go on to its end
    torch.save(content, tmp_path / "run/checkpoints/resume.pt")
    warning = "warning: carts.csv has changed since: the training goes on with other carts"
    for mass in ("1.1", "1.2"):
        (tmp_path / "carts.csv").write_text(f"cart_mass\n0.9\n{mass}\n")
        done = in_process("train", "resume=run", folder=tmp_path)
        assert "lacks 'collector'" in done.err
        assert (warning in done.err) == (mass == "1.2")
    (tmp_path / "carts.csv").unlink()
    done = in_process("train", "resume=run", folder=tmp_path)
    assert "posterior=carts.csv cannot be read: there is no such file; put it back, or start in" in done.err


def test_a_resume_file_holds_only_the_filled_buffer(stopped: Path) -> None:
    """Its replay buffer holds 1500 transitions; the default one holds a million."""
    state = torch.load(stopped / "checkpoints/resume.pt", weights_only=True)
    kept = state["state"]["replay"]["transitions"]
    waiting = 4 * 32  # the last n_step - 1 periods of each cart
    assert {len(column) for column in kept.values()} == {min(state["step"] - waiting, 1500)}
    assert not (stopped / "metrics.json").exists()


def test_episodes_before_a_broken_link_are_reported(
    trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One episode ran when the cable was pulled out."""

    def pulled(env: CartPoleEnv, policy: Policy, episodes: int, knocks: None) -> Iterator[Episode]:
        yield next(run_episodes(env, policy, episodes))
        raise LinkError("the cart was unplugged")

    monkeypatch.setattr("cartpole_rl.workflows.episodes.run_episodes", pulled)
    done = in_process("evaluate", f"run={trained}", "hydra.run.dir=it", folder=tmp_path)
    assert done.code == 1
    assert done.err.splitlines()[-1] == "cartpole-evaluate: the cart was unplugged"
    assert "plant=simulated, 1 episode " in done.out
    assert "±" not in done.out  # one episode shows no spread
    metrics = read(tmp_path / "it/metrics.json")
    assert len(metrics["episodes"]) == 1
    assert metrics["score"]["low"] is None


@pytest.mark.parametrize("label", ["small/fast", "../../small"])
def test_a_label_leads_to_no_other_folder(
    label: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    made = Path(run_folder("train", label))
    assert [*Path("runs/train").iterdir()] == [made]
    assert made.name.endswith(label.replace("/", "-"))
