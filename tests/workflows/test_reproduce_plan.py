"""Studies: each file is valid, and each run of each size has settings that its command takes."""

from collections import Counter
from functools import cache
from pathlib import Path

import hydra
import pytest

from cartpole_rl.checking import checked
from cartpole_rl.choices import compose, conf_folder
from cartpole_rl.commands.hydra_application.composition import as_mapping
from cartpole_rl.errors import ConfigError
from cartpole_rl.reporting.studies.settings import FIRST_SEED
from cartpole_rl.settings import Settings
from cartpole_rl.workflows.config import (
    EvaluateConfig,
    FinetuneConfig,
    IdentifyConfig,
    ModelConfig,
    TrainConfig,
)
from cartpole_rl.workflows.reproduce.plan import Task, plan, study_tasks
from cartpole_rl.workflows.studies import load_study, overrides_of, study_names

pytestmark = pytest.mark.usefixtures("hydra_reads_conf")

ROOT = Path("runs/reproduce/quick")
STUDIES = sorted(path.stem for path in (conf_folder() / "study").glob("*.yaml"))
CONFIGS: dict[str, type[Settings]] = {
    "train": TrainConfig,
    "evaluate": EvaluateConfig,
    "finetune": FinetuneConfig,
    "identify": IdentifyConfig,
    "model": ModelConfig,
}
ROWS = 18  # of the thesis's list
FILES = ("cart=", "pole=", "randomization=")  # of runs that do not exist here


@cache
def without_hydra(command: str, words: tuple[str, ...]) -> Settings:
    return checked(CONFIGS[command], compose(command, overrides_of(words)))


def words_of(task: Task) -> tuple[str, ...]:
    """The overrides, with one agent for all and without the files of other runs, which do not exist here."""
    kept = (word for word in task.words if not (word.startswith(FILES) and word.endswith(".yaml")))
    return tuple("run=somewhere" if word.startswith("run=") else word for word in kept)


def settings_of(study: str, size: str) -> set[tuple[str, tuple[str, ...]]]:
    """The commands with their overrides of the first seed."""
    tasks = [task for task in study_tasks(study, size, ROOT) if str(FIRST_SEED) in task.folder.parts]
    return {(task.command, words_of(task)) for task in tasks}


@pytest.mark.parametrize("study", STUDIES)
def test_every_run_of_a_study_has_valid_settings(study: str) -> None:
    for command, words in settings_of(study, "quick") | settings_of(study, "full"):
        assert without_hydra(command, words)


@pytest.mark.parametrize("study", STUDIES)
def test_hydra_reads_the_overrides_of_the_last_arm_and_evaluation_alike(study: str) -> None:
    *_, own, last = study_tasks(study, "full", ROOT)
    for task in {own.command: own, last.command: last}.values():
        words = words_of(task)
        with_hydra = checked(CONFIGS[task.command], as_mapping(hydra.compose(task.command, list(words))))
        assert with_hydra == without_hydra(task.command, words), task.folder


def test_every_row_of_the_list_has_a_study() -> None:
    orders = {load_study(name).order for name in study_names()}
    assert {10 * row for row in range(1, ROWS + 1)} <= {order // 10 * 10 for order in orders}


def test_the_figures_with_ten_agents_have_them() -> None:
    for name in ("friction_models", "perturbations"):
        agents = [task for task in study_tasks(name, "full", ROOT) if task.folder.parent.parent.name == name]
        assert {*Counter(task.folder.parent.name for task in agents).values()} == {10}


def test_every_run_that_is_needed_is_planned_before() -> None:
    done: set[Path] = set()
    waiting = plan(study_names(), "full", ROOT)
    while ready := [task for task in waiting if done.issuperset(task.needs)]:
        done |= {task.folder for task in ready}
        waiting = [task for task in waiting if task.folder not in done]
    assert not waiting


def test_a_study_brings_the_agents_that_it_needs() -> None:
    folders = {task.folder.relative_to(ROOT).parts[:2] for task in plan(["recovery"], "quick", ROOT)}
    assert {("swingup", "thesis"), ("todays_agents", "medium")} <= folders


def test_an_arm_that_names_its_agent_gives_its_other_overrides_to_every_evaluation(tmp_path: Path) -> None:
    agent = "{runs}/todays_agents/medium/{seed}"
    (tmp_path / "mine.yaml").write_text(f"""
        title: Mine
        order: 300
        question: Does it work?
        arms: [{{name: other, label: another cart, overrides: ["run={agent}", cart_friction=step]}}]
        evaluations: [{{name: heavy, label: heavy, overrides: ["parameters={{cart_mass: 1.0}}"]}}]
        sizes: {{quick: {{seeds: 1}}}}
        """)
    (task,) = study_tasks("mine", "quick", ROOT, tmp_path)
    needed = ROOT / "todays_agents/medium/10"
    assert task.words == (f"run={needed}", "cart_friction=step", "parameters={cart_mass: 1.0}", "seed=10")
    assert task.needs == (needed,)


@pytest.mark.parametrize("folder", ["a #b", "a: b", "[x]", "a,b", "x]", "{seed}", "{runs}", "it's", "é"])
def test_the_folder_of_all_studies_may_have_any_name(folder: str) -> None:
    root = Path(folder, "quick")
    agents = {root / "swingup/thesis/10", root / "todays_agents/medium/10"}
    tasks = [task for task in study_tasks("recovery", "quick", root) if str(FIRST_SEED) in task.folder.parts]
    assert agents <= {Path(task.overrides["run"]) for task in tasks}
    assert agents <= {need for task in tasks for need in task.needs}


@pytest.mark.parametrize(
    ("name", "size", "complaint"),
    [
        ("friction_model", "quick", "friction_model: there is no such study; did you mean friction_models?"),
        ("baseline", "fulll", "study baseline: fulll: there is no such size; did you mean full?"),
        ("x", "quick", "x: there is no such study; --list names them"),
    ],
)
def test_a_wrong_name_gets_the_nearest_one(name: str, size: str, complaint: str) -> None:
    with pytest.raises(ConfigError) as caught:
        plan([name], size, ROOT)
    assert str(caught.value) == complaint


def test_a_needed_study_that_is_not_there_is_named_with_the_one_that_needs_it(tmp_path: Path) -> None:
    text = (conf_folder() / "study/recovery.yaml").read_text().replace("{runs}/swingup", "{runs}/nope")
    (tmp_path / "recovery.yaml").write_text(text)
    with pytest.raises(ConfigError) as caught:
        plan(["recovery"], "quick", ROOT, tmp_path)
    assert str(caught.value) == f"recovery: it needs runs of the study nope, which is not in {tmp_path}"


EXTENDING = [
    path.stem
    for path in sorted((conf_folder() / "experiment").glob("*.yaml"))
    if "\n  - thesis" in path.read_text()
]


@pytest.mark.parametrize("experiment", [*EXTENDING, "friction_models_fig_6_8", "perturbations_fig_6_14"])
def test_an_experiment_that_extends_another_composes_alike_with_and_without_hydra(experiment: str) -> None:
    words = (f"experiment={experiment}",)
    assert checked(TrainConfig, as_mapping(hydra.compose("train", list(words)))) == without_hydra(
        "train", words
    )
