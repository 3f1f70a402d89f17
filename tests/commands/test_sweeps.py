"""sweep= on the command line, and jobs that fail."""

import errno
from importlib.util import find_spec
from pathlib import Path

import pytest
from command_line import in_process
from omegaconf import OmegaConf

from cartpole_rl.composition import EXTRAS
from cartpole_rl.files import write_text
from cartpole_rl.reporting.loggers import sweep_of
from cartpole_rl.sweeps import SweepStart, _jobs, as_multirun
from cartpole_rl.workflows.config import TrainConfig

FAILS = "cart.cart_mass=-1"  # at once, by a check of the job: the type is right


def test_a_sweep_needs_no_dash_m_and_takes_values_of_the_command_line(tmp_path: Path) -> None:
    done = in_process("train", "sweep=randomization_width", "seed=7", FAILS, folder=tmp_path)
    assert done.code == 1
    (folder,) = tmp_path.glob("runs/train/*_multirun")
    report = done.err.splitlines()[-5:]
    assert report[0] == f"cartpole-train: 4 of 4 jobs failed in {folder.relative_to(tmp_path)}:"
    assert report[1:] == [
        f"cartpole-train: {number}_randomization-{width}: cart_mass is -1; it must be above 0 and at most 100"
        for number, width in enumerate(("none", "friction_6", "half", "wide"))
    ]


SWEPT = """
hydra:
  sweeper:
    params: {agent.horizon: 0.5, agent.action_gap: 0.3, cart.cart_viscous: 3, pole: "large,p.yaml"}
"""


def test_a_sweep_is_as_its_words_after_dash_m(tmp_path: Path) -> None:
    """Also where other choices give what it replaces, and where all of its jobs are shown."""
    (tmp_path / "own.yaml").write_text(SWEPT)
    (tmp_path / "p.yaml").write_text("defaults: [large]")
    words = ("sweep=own.yaml", "agent=thesis", "cart_friction=linear", "agent.action_time=0.1", "-m")
    found = []

    def note(config: TrainConfig) -> None:
        agent = config.agent.at(0.02)
        found.append((agent.gamma, agent.gap, config.nominal_cart["cart_viscous"]))

    done = in_process("train", *words, folder=tmp_path, function=note)
    assert (done.code, found) == (0, 2 * [(0.96, 0.3, 3.0)]), done.err
    for shown_words in ((*words, "--cfg", "job"), (*words[:-1], "--cfg=job")):
        shown = in_process("train", *shown_words, folder=tmp_path)
        assert (shown.code, shown.out.count("horizon: 0.5")) == (0, 2), shown.err


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        ("-m seed=0,x", "seed=x: give an integer"),
        ("-m seeed=0,1", "seeed: there is no such setting; did you mean seed?"),
        ("sweep=seeds agent.gamma=1.5", "agent.gamma=1.5: give less than 1"),
        ("-m learning.transitions=1000000,100", "learning.transitions=100 is too few"),
        ("-m learning.warmup_transitions=1000,99999999", "learning.transitions=4000000: nothing would be"),
        ("-m buffer=uniform buffer.kind=uniform,prioritized", "buffer.alpha=0: with it, buffer.kind=prior"),
        ("-m seed=0,1 hydra.run.dir=a", "hydra.run.dir=a is the folder of one run; give that of a sweep as"),
        ("-m resume=a,b", "resume= continues one run; call cartpole-train once for each, without -m"),
    ],
)
def test_a_wrong_value_ends_a_sweep_before_its_first_job(words: str, complaint: str, tmp_path: Path) -> None:
    done = in_process("train", *words.split(), folder=tmp_path)
    assert done.complaint.startswith(f"cartpole-train: {complaint}")
    assert done.code == 2
    assert not list(tmp_path.iterdir())


def test_a_defect_in_a_job_leaves_its_traceback(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cartpole_rl.workflows.checks.check_training", lambda: 1 / 0)
    done = in_process("train", "-m", "seed=0,1", folder=tmp_path)
    assert done.code == 1
    assert done.err.splitlines()[-1] == "cartpole-train: 1_seed-1: ZeroDivisionError: division by zero"
    (error,) = tmp_path.glob("runs/train/*_multirun/1_seed-1/error.txt")
    assert "Traceback" in error.read_text()


def test_a_sweep_goes_on_after_a_job_without_room_for_its_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def write(path: Path, text: str) -> None:
        if path.parent.name == "1_seed-1":
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        write_text(path, text)

    monkeypatch.setattr("cartpole_rl.sweeps.write_text", write)
    words = ("-m", "seed=0,1,2", "hydra.sweep.dir=sweep")
    done = in_process("train", *words, folder=tmp_path, function=lambda folder: (folder / "run").touch())
    assert (done.code, (tmp_path / "sweep/2_seed-2/run").exists()) == (1, True)
    error = tmp_path / "sweep/1_seed-1/error.txt"
    assert f"the sweep was stopped: {error}: No space left on device; make room" in done.err.splitlines()[-1]


@pytest.mark.parametrize("is_sweep", [True, False], ids=["sweep", "single run"])
def test_an_error_that_an_interrupt_caused_ends_the_command(
    is_sweep: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As that of a C extension whose import is interrupted, or of tensordict."""

    def interrupted() -> None:
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as error:
            raise ImportError("initialization failed") from error

    monkeypatch.setattr("cartpole_rl.workflows.checks.check_training", interrupted)
    done = in_process("train", *(("-m", "seed=0,1") if is_sweep else ()), folder=tmp_path)
    assert done.code == 130
    jobs = ["cartpole-train: job 0_seed-0"] if is_sweep else []
    assert done.err.splitlines() == [*jobs, "cartpole-train: interrupted"]


def test_a_sweep_names_its_jobs_and_the_command_that_compares_them(tmp_path: Path) -> None:
    words = ("-m", "seed=0,1", "hydra.sweep.dir=sweep")
    done = in_process("train", *words, folder=tmp_path, function=lambda folder: (folder / "run").touch())
    assert done.err.splitlines() == ["cartpole-train: job 0_seed-0", "cartpole-train: job 1_seed-1"]
    assert done.out.splitlines() == ["sweep/ holds 2 runs; next:", "cartpole-report runs=sweep"]


def test_a_sweep_leaves_the_runs_of_an_earlier_one_alone(tmp_path: Path) -> None:
    (run := tmp_path / "sweep/1_seed-1").mkdir(parents=True)
    (run / "config.yaml").touch()
    words = ("-m", "seed=0,1", "hydra.sweep.dir=sweep")
    done = in_process("train", *words, folder=tmp_path, function=lambda: None)
    assert done.complaint.endswith("sweep/1_seed-1: it holds a run already; give another hydra.sweep.dir")
    assert [*run.iterdir()] == [run / "config.yaml"]
    assert [*run.parent.iterdir()] == [run]


def test_every_sweeper_gets_its_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As Optuna's, which makes none, and writes no multirun.yaml."""
    monkeypatch.setattr(SweepStart, "folder", folder := tmp_path / "sweep")
    assert _jobs() == []
    sweeper = {"_target_": "OptunaSweeper", "storage": f"sqlite:///{tmp_path}/runs/optuna.db"}
    job = {"config": {"override_dirname": {"exclude_keys": []}}}
    given = {"sweeper": sweeper, "sweep": {"dir": str(folder)}, "job": job}
    SweepStart().on_multirun_start(OmegaConf.create({"hydra": given}))
    assert sweep_of(folder / "0") == "sweep"
    assert (tmp_path / "runs").is_dir()


def test_commands_without_a_run_folder_report_too(tmp_path: Path) -> None:
    done = in_process("preflight", "-m", "plant.port=nowhere,nothing", folder=tmp_path)
    assert done.code == 1
    assert "2 of 2 jobs failed in multirun/" in done.err


@pytest.mark.parametrize("choice", EXTRAS)
def test_a_missing_extra_is_named(choice: str, tmp_path: Path) -> None:
    group, _, name = choice.rpartition("/")
    if find_spec("hydra_plugins") and any(
        find_spec(f"hydra_plugins.hydra_{EXTRAS[choice]}_{kind}") for kind in ("launcher", "sweeper")
    ):
        pytest.skip(f"the extra {EXTRAS[choice]} is installed")
    done = in_process("train", "-m", f"{group}={name}", "seed=0,1", folder=tmp_path)
    assert done.code == 2
    assert done.complaint.endswith(
        f'needs the extra {EXTRAS[choice]}: pip install "cartpole_rl[{EXTRAS[choice]}]"'
    )


def test_dash_m_is_added_once() -> None:
    assert as_multirun(["sweep=seeds"]) == ["sweep=seeds", "--multirun"]
    assert as_multirun(["-m", "sweep=seeds"]) == ["-m", "sweep=seeds"]
    assert as_multirun(["seed=1"]) == ["seed=1"]
