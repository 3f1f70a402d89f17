"""Each command refuses the run folders of the others in one line, which says what can be done with them."""

import json
import math
import shutil
from collections.abc import Mapping
from pathlib import Path

import pytest
from command_line import Once, Outcome, in_process, no_pictures

from cartpole_rl.run_folder import USES, program_of, use_of, write_config

MADE_BY = (*USES, "unfinished", "multirun")
WHAT_TO_DO = {  # with a folder, by what made it
    "train": "cartpole-evaluate, cartpole-record and cartpole-finetune take it as run={0}",
    "finetune": "cartpole-evaluate, cartpole-record and cartpole-finetune take it as run={0}",
    "distill": "cartpole-evaluate, cartpole-record and cartpole-finetune take it as run={0}",
    "evaluate": "cartpole-evaluate drives one of its episodes again: repeat.run={0}",
    "record": "cartpole-replay, cartpole-identify and cartpole-model take it as from={0}",
    "import": "cartpole-identify, cartpole-replay and cartpole-model take it as from={0}",
    "replay": "cartpole-replay from=... makes new ones",
    "identify": "cartpole-train takes its files: cart={0}/cart.yaml",
    "model": "plant=learned plant.model={0}",
    "export": "its files are for other programs",
    "report": "it is a page to read: {0}/page.html",
    "unfinished": "cartpole-train resume={0} continues it",
    "multirun": "give that of one of its jobs",
}
ENDED = "has ended; cartpole-evaluate run={0} drives its agent"
AGENTS, RECORDINGS = (
    {"train", "finetune", "distill", "unfinished"},
    {"record", "identify", "finetune", "import"},
)
SETTINGS = {  # words, with the folder at {0} and an agent at {1}: what is taken, what is said of others
    "train resume={0}": ({"unfinished"}, {"train": ENDED}),
    "finetune run={0} plant=emulated": (AGENTS, {}),
    "finetune resume={0}": (set(), {"finetune": ENDED}),
    "evaluate run={0}": (AGENTS, {}),
    "record run={0}": (AGENTS, {}),
    "export format=weights run={0}": (AGENTS, {}),
    "distill run={0}": (AGENTS, {}),
    "export format=mcap from={0}": (RECORDINGS, {}),
    "replay from={0}": (RECORDINGS, {}),
    "model from={0}": (RECORDINGS, {}),
    "identify from={0}": (RECORDINGS, {}),
    "evaluate run={1} plant=learned plant.model={0}": ({"model"}, {}),
    "train compile=false plant=learned plant.model={0}": ({"model"}, {}),
    "evaluate run={1} repeat.run={0} repeat.episode=0": ({"evaluate"}, {}),
    "train cart=./{0}": (set(), {"identify": "give cart={0}/cart.yaml"}),
    "train randomization=./{0}": (set(), {"identify": "give randomization={0}/randomization.yaml"}),
    "train pole={0}/config.yaml": ({"multirun"}, {"identify": "give pole={0}/pole.yaml"}),
}


@pytest.fixture(scope="module")
def runs(
    trained: Path,
    stopped: Path,
    identified: tuple[Path, Outcome],
    tuned: tuple[Path, Outcome],
    recorded: Path,
    learned: tuple[Path, Outcome],
    once: Once,
) -> Path:
    """A folder with a toy run of each command, named after it, and an interrupted training."""
    made = {
        "train": trained,
        "unfinished": stopped,
        "identify": identified[0],
        "finetune": tuned[0],
        "record": recorded,
        "model": learned[0],
    }
    return once("runs", lambda folder: make_runs(folder / "run", made))[0]


def make_runs(folder: Path, runs: Mapping[str, Path]) -> None:
    """Fill a folder with copies of `runs` and those of the other commands."""
    for name, run in runs.items():
        shutil.copytree(run, folder / name)
    small = [f"distillation.{name}=2" for name in ("carts", "rounds", "periods", "updates", "batch_size")]
    rows = "".join(f"{row / 50},{math.sin(row / 9) / 9},{row / 9},{row % 2}\n" for row in range(100))
    (folder / "log.csv").write_text(f"time,position,angle,motor\n{rows}")
    made = (
        ("evaluate", "run=train", "episodes=1", "hydra.run.dir=evaluate"),
        ("record", "-m", "run=train", "episodes=1", "seed=0", "hydra.sweep.dir=multirun"),
        ("import", "from=log.csv", "hydra.run.dir=import"),
        ("replay", "from=record", "hydra.run.dir=replay"),
        ("distill", "run=train", *small, "hydra.run.dir=distill"),
        ("export", "run=train", "format=weights", "hydra.run.dir=export"),
        ("report", "runs=evaluate", "animations=false", "hydra.run.dir=report"),
    )
    with no_pictures():
        for command, *words in made:
            done = in_process(command, *words, folder=folder)
            assert done.code == 0, done.err


def contents(folder: Path) -> dict[str, tuple[int, int]]:
    """Size and time of every file."""
    files = (path for path in folder.rglob("*") if path.is_file())
    return {str(path): (path.stat().st_size, path.stat().st_mtime_ns) for path in files}


def test_a_job_that_can_be_resumed_is_named(runs: Path, tmp_path: Path) -> None:
    jobs = tmp_path / "sweep"
    shutil.copytree(runs / "multirun", jobs)
    complaint = in_process("train", "resume=sweep", folder=tmp_path).complaint
    assert complaint.endswith("is a folder of a multirun; give that of one of its jobs")
    shutil.copytree(runs / "unfinished", jobs / "9_seed-1")
    complaint = in_process("train", "resume=sweep", folder=tmp_path).complaint
    assert complaint.endswith("give that of one of its jobs: resume=sweep/9_seed-1")


def test_runs_that_cannot_be_used_as_others_of_their_command(tmp_path: Path) -> None:
    """An evaluation of a cart cannot be repeated; an interrupted identification has recordings alone."""
    for command, about in (
        ("evaluate", "its results are metrics.json and figures/"),
        ("identify", f"it was stopped before its end; cartpole-identify from={tmp_path}/identify reads"),
    ):
        write_config(tmp_path / command, command, {"seed": 0})
        (tmp_path / command / "metrics.json").write_text('{"plant": "serial"}')
        if command == "identify":
            assert "start cartpole-identify again" in use_of(tmp_path / command, command)
            (tmp_path / command / "recordings").mkdir()
            (tmp_path / command / "recordings/00_ramps.csv").touch()
        assert about in use_of(tmp_path / command, command)


def test_every_run_says_what_made_it(runs: Path) -> None:
    for command in USES:
        provenance = json.loads((runs / command / "provenance.json").read_text())
        assert provenance["program"] == f"cartpole-{command}"
        assert program_of(runs / command) == command
    assert program_of(runs) is None


@pytest.mark.parametrize("words", SETTINGS)
def test_the_runs_of_other_commands_are_refused(words: str, runs: Path) -> None:
    """Each gets two of the others, to save time, and each of these meets several commands."""
    (command, *_), (taken, special) = words.split(), SETTINGS[words]
    number = [*SETTINGS].index(words)
    shown = {*special, *(MADE_BY[(2 * number + shift) % len(MADE_BY)] for shift in range(2))}
    for maker in sorted(shown - taken):
        before = contents(runs)
        done = in_process(command, *words.format(maker, "train").split()[1:], folder=runs)
        assert done.code in (1, 2), done
        remedy = special.get(maker, WHAT_TO_DO[maker]).format(maker)
        assert remedy in done.complaint, done.complaint
        assert maker in done.complaint
        assert "Traceback" not in done.complaint
        assert done.out == ""
        assert contents(runs) == before
        assert not list(runs.glob("runs/*/*"))


@pytest.mark.parametrize("damaged", ['{"program": "cartpole-tr', "[]", None])
def test_a_run_whose_provenance_is_damaged_can_be_resumed(damaged: str | None, tmp_path: Path) -> None:
    write_config(tmp_path, "train", {"seed": 4})
    (tmp_path / "provenance.json").unlink()
    if damaged is not None:
        (tmp_path / "provenance.json").write_text(damaged)
    write_config(tmp_path, "train", {"seed": 4}, resumed=True)
    assert program_of(tmp_path) == "train"
    again = json.loads((tmp_path / "provenance.json").read_text())
    assert (again["seed"], len(again["resumed"])) == (4, 1)
