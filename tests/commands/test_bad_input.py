"""Each kind of wrong input gives one line with its remedy, before any work and without a traceback."""

import shutil
from pathlib import Path

import pytest
import torch
from command_line import ONCE, TINY, Outcome, console_script, in_process, outcome

WRONG_TRAINING = [
    # arguments, setting named in the line, remedy in the line
    ("agent.gama=0.9", "agent.gama", "did you mean agent.gamma?"),
    ("+agent.foo=1", "agent.foo", "there is no such setting"),
    ("gamma=0.9", "gamma", "did you mean agent.gamma?"),
    ("~agent.double", "agent.double is missing", "give agent.double=..."),
    ("agent.loss=smoth_l1", "agent.loss=smoth_l1", "did you mean smooth_l1? give 'l2' or 'smooth_l1'"),
    ("control_period=1", "control_period=1", "give at most 0.1"),
    ("pole=null", "pole=null", "leave pole=null out"),
    ("pole=lrage", "pole=lrage", "did you mean large?"),
    ("pole=medium,large", "pole=medium,large", "-m runs each"),
    ("seed", "seed", "key=value"),
    ("=8", "=8", "key=value"),  # as $NAME=8 of a script
    ("hydra.run.dir=", "hydra.run.dir=: the value is missing", "leave hydra.run.dir= out"),  # as $NAME, too
    ("resume=", "resume=: the value is missing", "leave resume= out"),
    ("experiment medium", "experiment medium", "did you mean experiment=medium?"),
    ("learning.epsilon=0.5", "learning.epsilon=0.5", "give a list, as [0.5]"),
    ("learning.epsilon=[0.5]", "learning.epsilon: ", "value 2 is missing"),
    (
        "cart_friction=my_laws:smooth",
        "cart_friction=my_laws:smooth",
        "'model: my_laws:smooth' and 'parameters: {}'",
    ),
    ("device=gpu", "device=gpu", "did you mean cuda?"),
    ("agent.mirrored=maybe", "agent.mirrored=maybe", "give true or false"),
    ("label=a(b", "label=a(b", "text with special characters in quotes"),
    ("emulator=large", "emulator: ", "cartpole-train does not read this group"),
    ("+seed=1", "seed", "Either remove + prefix"),
    ("pole=range pole.lengths=[0,1]", "pole.lengths", "give more than 0"),
    ("pole.choices.medium.pole_mass=-0.1", "pole.choices.medium.pole_mass=-0.1", "give more than 0"),
    ("+cart.pole_mass=1", "pole_mass", "belongs to the pole"),
    ("+randomization.cart_masss={absolute:[1,2]}", "cart_masss", "did you mean 'cart_mass'?"),
    ("randomization.cart_mass.relative=[0.2,-0.2]", "randomization.cart_mass", "wrong order"),
    ("randomization=none +randomization.track_tilt={relative:[-1,1]}", "track_tilt", "give absolute bounds"),
    (
        "learning.transitions=20000 learning.evaluations=2",
        "learning.transitions=20000: nothing would be learned",
        "give at least 24576, or a shorter warm-up",
    ),
    ("learning.return_time=1", "learning.return_time=1 s is 50 control periods", "give at most 0.4"),
    ("learning.transitions=100", "learning.transitions=100 is too few", "or learning.evaluations=1"),
    (
        "resume=a learning.transitions=100",
        "resume uses that run's own config",
        "leave out learning.transitions=100",
    ),
    ("agent.target_period=10", "agent", "either target_tau or target_period"),
    ("actions.motors=[100,100]", "actions", "two or more different values"),
    ("plant=emulated", "plant=emulated: ", "use cartpole-evaluate for plant=emulated"),
    (
        "pole={choices:{mine:{pole_mass:0.5,pole_com:1.6,pole_inertia:0.4}}}",
        "pole=mine: its length is 3.2 m (twice pole_com)",
        "at most 3 m; check pole_com (m), or give guard=none",
    ),
    ("pole=range pole.lengths=[0.2,6.5]", "pole=0.2 to 6.5 m: its mean length is 3.35 m", "at most 3 m"),
    (
        "agent.action_time=500",
        "agent.action_time=500: its action gap would be all but 1",
        "give at most 200 s",
    ),
    (
        "agent.horizon=1e17",
        "agent.horizon=1e+17: its discount would be all but 1",
        "give at most 20000 s",
    ),
    ("buffer.alpha=100", "buffer.alpha=100: ", "give at most 2"),
    ("buffer.alpha=0", "buffer.alpha=0: with it, buffer.kind=prioritized draws uniformly", "buffer=uniform"),
    ("buffer=uniform buffer.kind=prioritized", "buffer.alpha=0: with it", "give buffer=prioritized, or"),
    ("task.duration=1e20", "task.duration=1e+20: ", "give at most 86400 s"),
    ("task.time_limit=100000000000000000000", "task.time_limit=1000", "give at most 20000000"),
    ("task.angle_limit=-1", "task.angle_limit=-1: ", "give rad, above 0 and at most pi; or null"),
    ("task.angle_limit=12", "task.angle_limit=12: ", "at most pi; 12 degrees are 0.2094"),
    (
        "task=balance task.start.angle_spread=3.0",
        "task.start.angle_spread=3: episodes would start up to 3 rad from upright",
        "beyond task.angle_limit=0.209; give start angles within it, or task.angle_limit=null",
    ),
    (
        "task=balance task.evaluation_start.angle=hanging",
        "task.evaluation_start.angle=hanging: episodes would start up to 3.14 rad",
        "task.angle_limit=null",
    ),
    (
        "task=balance task.start.resting_share=0.1",
        "task.start.resting_share=0.1: episodes would start up to 3.14 rad",
        "task.angle_limit=null",
    ),
]


def assert_refused(command: str, words: str, named: str, remedy: str, code: int, folder: Path) -> None:
    done = in_process(command, *words.split(), folder=folder)
    assert done.complaint.startswith(f"cartpole-{command}: ")
    assert named in done.complaint
    assert remedy in done.complaint
    assert (done.code, done.out) == (code, "")
    assert not (folder / "runs" / command).exists()


@pytest.mark.parametrize(
    ("words", "named", "remedy"), WRONG_TRAINING, ids=[case[0] for case in WRONG_TRAINING]
)
def test_training(words: str, named: str, remedy: str, tmp_path: Path) -> None:
    assert_refused("train", words, named, remedy, 2, tmp_path)
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "cart_mass is missing; give it, or take what is missing from a choice: defaults: [ip02]"),
        ("mas: 1\n", "mas: there is no such setting; did you mean cart_mass?"),
        ("defaults: [ip02]\nmas: 1\n", "mas: there is no such setting; did you mean cart_mass?"),
        ("defaults: [ip02]\ncart_mass: -1\n", "cart_mass is -1; it must be above 0 and at most 100"),
        (
            "defaults: [ip2]\n",
            "defaults: there is no choice ip2; did you mean ip02? "
            "there are ip02, laboratorio, sensorsini, stepper, thesis",
        ),
    ],
)
def test_a_cart_file_names_what_is_wrong_with_it(text: str, complaint: str, tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text(text)
    done = in_process("train", "cart=mine.yaml", folder=tmp_path)
    assert (done.complaint, done.code) == (f"cartpole-train: cart=mine.yaml: {complaint}", 2)


def test_a_pole_file_without_a_name_is_told_the_form(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("pole_mass: 0.05\npole_com: 0.2\npole_inertia: 6.7e-4\n")
    done = in_process("train", "pole=mine.yaml", folder=tmp_path)
    form = "mine.yaml: pole: the numbers of a pole stand under its name: choices: {mine: {pole_mass: ...}}"
    assert form in done.complaint
    assert "did you mean" not in done.complaint
    assert done.complaint.count(form) == 1


@pytest.mark.parametrize("command", ["finetune", "distill"])
def test_the_baseline_has_nothing_to_train_further(command: str, tmp_path: Path) -> None:
    done = in_process(command, "run=lqr", folder=tmp_path)
    remedy = "the baseline has no network; give a training, such as run=pretrained/medium"
    assert (done.complaint, done.code) == (f"cartpole-{command}: run=lqr: {remedy}", 2)


def test_a_plant_file_without_a_kind(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("")
    done = in_process("finetune", "run=run", "plant=mine.yaml", folder=tmp_path)
    assert (
        done.complaint
        == "cartpole-finetune: plant: kind is missing; give plant=emulated, serial, text, driver, or begin "
        "its file with one of them, as in `defaults: [driver]`"
    )
    assert done.code == 2


def test_a_refused_command_leaves_the_other_runs(tmp_path: Path) -> None:
    earlier = tmp_path / "runs/evaluate/earlier"
    earlier.mkdir(parents=True)
    (tmp_path / "mine").mkdir()
    for words in ((), ("hydra.run.dir=mine/run",)):
        assert in_process("train", "seed=abc", *words, folder=tmp_path).code == 2
        assert [path.relative_to(tmp_path).as_posix() for path in sorted(tmp_path.rglob("*"))] == [
            "mine",
            "runs",
            "runs/evaluate",
            "runs/evaluate/earlier",
        ]


WRONG_EVALUATION = [
    ("", "run is missing", "give run=runs/train/<run>", 2),
    ("run=text.pt", "text.pt", "give one that cartpole-train wrote", 1),
    ("run=cut.pt", "cut.pt", "damaged", 1),
    ("run=other.pt", "other.pt", "not an agent of this package", 1),
    ("run=empty", "run=empty", "holds no checkpoints/last.pt", 1),
    ("run=resume.pt", "resume.pt", "not an agent of this package: it is the state that a training", 1),
    ("run=run plant.substeps=0", "plant.substeps=0", "give at least 1", 2),
    ("run=run parameters={pole_mass:0.2} pole=range", "pole_mass", "choose one pole", 2),
    (
        "run=run plant=emulated parameters={cart_mass:1}",
        "parameters: ",
        "has its own cart; set emulator.*",
        2,
    ),
    (
        "run=run randomization=wide parameters={latency:0.05}",
        "parameters.latency: randomization.latency draws it from 0 to 0.022",
        "leave one of them out",
        2,
    ),
    ("run=run plant=emulated pole=large", "pole", "emulator=large", 2),
    ("run=run plant=emulated emulator.latencyy=1", "emulator.latencyy", "did you mean emulator.latency?", 2),
    ("run=run plant=emulated task=swingup task.evaluation_start.angle=any", "angle=any", "hanging", 2),
    ("run=run plant=emulated task=swingup emulator.start=upright", "start=upright", "leave it out", 2),
    ("run=run emulator.latency=0.01", "emulator", "give plant=emulated", 2),
    (
        "run=run plant.port=/dev/ttyUSB0",
        "plant.port belongs to plant=driver, serial or text",
        "give one of them",
        2,
    ),
    ("run=run plant=serial", "plant.port is missing", "give plant.port=/dev/ttyUSB0", 2),
    (
        "run=run plant=serial plant.port=x pole=medium plant.pole_length=0.66",
        "plant.pole_length=0.66: pole=medium has the centre of mass of a rod of 0.36 m",
        "leave plant.pole_length or pole= out",
        2,
    ),
    ("run=run plant=serial plant.port=nowhere", "nowhere does not exist", "plug the cart in", 1),
    (
        "run=run plant=serial plant.port=/dev/null",
        "/dev/null is not a serial port",
        "cartpole-find-port lists them",
        1,
    ),
]


@pytest.fixture(scope="module")
def files(trained: Path, stopped: Path) -> Path:
    """A folder with a trained run, and files that are not checkpoints."""
    folder = trained.parent
    shutil.copy(stopped / "checkpoints/resume.pt", folder)
    (folder / "text.pt").write_text("no checkpoint at all\n")
    (folder / "cut.pt").write_bytes((trained / "checkpoints/last.pt").read_bytes()[:2000])
    torch.save({"model": torch.zeros(3)}, folder / "other.pt")
    (folder / "empty").mkdir()
    return folder


@pytest.mark.parametrize(
    ("words", "named", "remedy", "code"), WRONG_EVALUATION, ids=[case[0] for case in WRONG_EVALUATION]
)
def test_evaluation(words: str, named: str, remedy: str, code: int, files: Path) -> None:
    assert_refused("evaluate", words, named, remedy, code, files)


@pytest.mark.parametrize("command", ["finetune", "identify", "preflight"])
def test_a_real_cart_does_not_read_the_emulator(command: str, tmp_path: Path) -> None:
    done = in_process(command, "plant=serial", "plant.port=p", "emulator.cart_viscous=9", folder=tmp_path)
    remedy = "emulator: plant=serial does not read it; give plant=emulated"
    assert (done.complaint, done.code) == (f"cartpole-{command}: {remedy}", 2)


def test_a_folder_that_cannot_be_made(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    done = in_process("train", "hydra.run.dir=file/run", folder=tmp_path)
    assert "file" in done.complaint
    assert done.code == 1


def test_a_run_is_never_overwritten(trained: Path) -> None:
    before = (trained / "config.yaml").read_text()
    done = in_process("train", *TINY, "seed=1", f"hydra.run.dir={trained}", folder=trained.parent)
    assert "holds a run already; give another folder" in done.complaint
    assert done.code == 2
    assert (trained / "config.yaml").read_text() == before


@pytest.mark.parametrize(
    ("words", "remedy"),
    [("seed=1", "leave out seed=1"), ("hydra.run.dir=other", "leave out hydra.run.dir")],
)
def test_resuming_takes_no_other_setting(words: str, remedy: str, trained: Path) -> None:
    done = in_process("train", f"resume={trained}", words, folder=trained.parent)
    assert remedy in done.complaint
    assert done.code == 2
    assert not (trained.parent / "other").exists()


def test_a_run_whose_checkpoint_was_removed(trained: Path, tmp_path: Path) -> None:
    shutil.copytree(trained, tmp_path / "mine")
    (tmp_path / "mine/checkpoints/last.pt").unlink()
    complaint = in_process("evaluate", "run=mine", folder=tmp_path).complaint
    removed = "run=mine: it holds no checkpoints/last.pt; the file was removed"
    assert complaint == f"cartpole-evaluate: {removed}; start cartpole-train again"
    (tmp_path / "mine/checkpoints/resume.pt").write_text("")
    complaint = in_process("evaluate", "run=mine", folder=tmp_path).complaint
    assert complaint == f"cartpole-evaluate: {removed}; cartpole-train resume=mine continues it"


def test_a_checkpoint_of_another_version(trained: Path, files: Path) -> None:
    content = torch.load(trained / "checkpoints/last.pt", weights_only=True)
    torch.save({**content, "config": {**content["config"], "new_setting": 1}}, files / "newer.pt")
    done = in_process("evaluate", "run=newer.pt", folder=files)
    assert "another version of this package: new_setting" in done.complaint
    assert done.code == 1


def test_an_agent_away_from_its_own_code_is_told_where_that_is_looked_for(trained: Path, files: Path) -> None:
    content = torch.load(trained / "checkpoints/last.pt", weights_only=True)
    own = {**content["config"]["agent"], "kind": "nowhere:Agent", "network": "nowhere:deep"}
    torch.save({**content, "config": {**content["config"], "agent": own}}, files / "own.pt")
    done = in_process("evaluate", "run=own.pt", folder=files)
    missing = "there is no module 'nowhere' in the current folder, on PYTHONPATH or among installed packages"
    assert done.complaint == f"cartpole-evaluate: run=own.pt: agent.kind=nowhere:Agent: {missing}"


def test_a_checkpoint_with_another_network(trained: Path, files: Path) -> None:
    content = torch.load(trained / "checkpoints/last.pt", weights_only=True)
    weights = {
        name: torch.cat((each, each)) if each.ndim else each for name, each in content["weights"].items()
    }
    torch.save({**content, "weights": weights}, files / "older.pt")
    done = in_process("evaluate", "run=older.pt", folder=files)
    assert done.complaint.endswith(
        "run=older.pt is of another version of this package: its network has other weights; train it again"
    )
    assert done.code == 1


def test_without_a_compiler_the_remedy_is_stated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CXX", "no-such-compiler")
    done = in_process("train", "compile=true", folder=tmp_path)
    assert "no-such-compiler" in done.complaint
    assert "compile=false" in done.complaint
    assert done.code == 2
    assert not list(tmp_path.glob("runs/train/*"))


@pytest.mark.usefixtures("without_pictures")
def test_in_a_multirun_the_other_jobs_run(tmp_path: Path) -> None:
    done = in_process("train", "-m", *TINY, ONCE, "cart.cart_mass=-1,0.9", folder=tmp_path)
    assert done.code == 1
    assert "cart_mass is -1; it must be above 0" in done.err.splitlines()[1]
    assert "Traceback" not in done.err
    finished = list(tmp_path.glob("runs/train/*_multirun/*/metrics.json"))
    assert [path.parent.name for path in finished] == ["1_cart.cart_mass-0.9"]
    assert not (finished[0].parent / "error.txt").exists()
    assert done.err.splitlines()[-2:] == [
        f"cartpole-train: 1 of 2 jobs failed in {finished[0].parents[1].relative_to(tmp_path)}:",
        "cartpole-train: 0_cart.cart_mass--1: cart_mass is -1; it must be above 0 and at most 100",
    ]


def test_through_a_real_process(tmp_path: Path) -> None:
    """As above, in a separate process that could show a traceback."""
    done = outcome(console_script("evaluate", "run=nowhere", folder=tmp_path))
    assert done.complaint == (
        "cartpole-evaluate: run=nowhere: there is no such file or folder; give a run folder or a checkpoint"
    )
    assert (done.code, done.out) == (1, "")


def test_an_interrupt_is_reported_in_one_line(interrupted: tuple[Path, Outcome]) -> None:
    _, done = interrupted
    assert done.code == 130
    last = done.err.splitlines()[-1]
    assert last.startswith("cartpole-train: interrupted; cartpole-train resume=")
    assert last.endswith(" continues it")
    assert "Traceback" not in done.err
    assert done.out == ""


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        ("pole=mine.yml", "pole=mine.yml: there is no such file; did you mean mine.yaml?"),
        ("hydra.run.dirr=a", "hydra.run.dirr: there is no such setting; --cfg job shows the settings"),
    ],
)
def test_a_wrong_file_or_name_is_told_nothing_wrong(words: str, complaint: str, tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text(
        "choices: {mine: {pole_mass: 0.1, pole_com: 0.2, pole_inertia: 1e-3}}"
    )
    assert in_process("train", words, folder=tmp_path).complaint == f"cartpole-train: {complaint}"
