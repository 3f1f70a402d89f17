"""Studies: each file is valid, and each run has settings that its command takes, in a possible order."""

import re
from functools import cache
from pathlib import Path

import pytest
import yaml
from plan import Task, plan, study_tasks
from small_results import CARTS, a_study
from study import FIRST_SEED, STUDIES, load_study, overrides_of, study_names

from cartpole_rl.checking import validated
from cartpole_rl.composition import compose
from cartpole_rl.errors import ConfigError
from cartpole_rl.settings import Settings
from cartpole_rl.workflows import config

ROOT = Path("runs/reproduce/quick")
NAMES = sorted(path.stem for path in STUDIES.glob("*.yaml"))
CONFIGS: dict[str, type[Settings]] = {
    "train": config.TrainConfig,
    "evaluate": config.EvaluateConfig,
    "finetune": config.FinetuneConfig,
    "identify": config.IdentifyConfig,
    "model": config.ModelConfig,
}
ROWS = 18  # of the thesis's list
FILES = ("cart=", "pole=", "randomization=")  # of runs that do not exist here
FOLDERS = ("runs", "my runs", "a,b", "a #b", "a: b", "[x]", "x]", "{seed}", "{runs}", "it's", '"', "~")


@cache
def composed(command: str, words: tuple[str, ...]) -> Settings:
    return validated(CONFIGS[command], compose(command, overrides_of(words)))


def words_of(task: Task) -> tuple[str, ...]:
    """The overrides, with one agent for all and without the files of other runs, which do not exist here."""
    kept = (word for word in task.words if not (word.startswith(FILES) and word.endswith(".yaml")))
    own = "run=lqr", "run=pid:balance"
    return tuple("run=somewhere" if word.startswith("run=") and word not in own else word for word in kept)


@pytest.mark.nightly
@pytest.mark.parametrize("name", NAMES)
def test_every_run_of_a_study_has_valid_settings(name: str) -> None:
    for size in ("quick", "full"):
        tasks = [task for task in study_tasks(name, size, ROOT) if str(FIRST_SEED) in task.folder.parts]
        runs = tasks if size == "full" else tasks[:2]  # the sizes share their arms and evaluations
        assert all(composed(task.command, words_of(task)) for task in runs)


def test_every_row_of_the_list_has_a_study() -> None:
    orders = {load_study(name).order for name in study_names()}
    assert {10 * row for row in range(1, ROWS + 1)} <= {order // 10 * 10 for order in orders}


def test_every_run_that_is_needed_is_planned_before() -> None:
    done: set[Path] = set()
    waiting = plan(study_names(), "full", ROOT)
    assert len(waiting) > 4000
    while ready := [task for task in waiting if done.issuperset(task.needs)]:
        done |= {task.folder for task in ready}
        waiting = [task for task in waiting if task.folder not in done]
    assert not waiting


def test_an_arm_that_names_its_agent_gives_its_other_overrides_to_every_evaluation(tmp_path: Path) -> None:
    agent = "{runs}/todays_agents/medium/{seed}"
    arm = {"name": "other", "label": "other", "overrides": [f"run={agent}", "cart_friction=step"]}
    evaluation = {"name": "heavy", "label": "heavy", "overrides": ["parameters={cart_mass: 1.0}"]}
    mine = a_study(arms=[arm], evaluations=[evaluation], sizes={"quick": {"seeds": 1}})
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(mine.model_dump(mode="json")))
    (task,) = study_tasks("mine", "quick", ROOT, tmp_path)
    needed = ROOT / "todays_agents/medium/10"
    assert task.words == (f"run={needed}", "cart_friction=step", "parameters={cart_mass: 1.0}", "seed=10")
    assert task.needs == (needed,)


def test_an_evaluation_has_its_own_episodes_and_those_of_an_arm() -> None:
    words = {"overrides": ["randomization=wide", "episodes=100"], "of_arms": {"wide": ["plant.substeps=1"]}}
    wide, plain = a_study(evaluations=[{**CARTS[0], **words}, CARTS[1]]).evaluations
    assert wide.words("wide", ("episodes=10",)) == ("randomization=wide", "episodes=100", "plant.substeps=1")
    assert plain.words("wide", ("episodes=10",)) == ("episodes=10",)


@pytest.mark.parametrize("folder", FOLDERS)
def test_the_folder_of_all_studies_may_have_any_name(folder: str) -> None:
    root = Path(folder, "quick")
    agents = {root / "swingup/thesis/10", root / "todays_agents/medium/10"}
    tasks = plan(["recovery"], "quick", root)
    assert agents <= {task.folder for task in tasks}
    evaluations = [task for task in tasks if task.study == "recovery"]
    assert agents <= {Path(task.overrides["run"]) for task in evaluations}
    assert agents <= {need for task in evaluations for need in task.needs}
    word = f"from=[{root}/a/b/1,{root}/c/d/1]"
    assert overrides_of([word], root) == {"from": [f"{root}/a/b/1", f"{root}/c/d/1"]}


def test_a_needed_study_that_is_not_there_is_named_with_the_one_that_needs_it(tmp_path: Path) -> None:
    text = (STUDIES / "recovery.yaml").read_text().replace("{runs}/swingup", "{runs}/nope")
    (tmp_path / "recovery.yaml").write_text(text)
    complaint = f"recovery: it needs runs of the study nope, which is not in {tmp_path}"
    with pytest.raises(ConfigError, match=re.escape(complaint)):
        plan(["recovery"], "quick", ROOT, tmp_path)


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"colour": "red"}, "colour: there is no such setting"),
        ({"ratio": True}, "ratio=true needs two evaluations"),
        ({"arms": [{"name": "a", "label": "a"}] * 2}, "arms: a is there more than once"),
        ({"arms": [{"name": name, "label": "same"} for name in "ab"]}, "arms: same is there more than once"),
        ({"arms": [{"name": "../a", "label": "a"}]}, "arms.0.name"),
        ({"size": "huge"}, "size: huge is not in sizes; give one of full"),
        ({"finding": {"size": "huge", "verdict": "agrees", "comment": ""}}, "finding.size: huge is not in"),
        ({"judged": ["moon"], "evaluations": CARTS}, "judged: moon is unknown; give some of simulated,"),
        ({"evaluations": [{**CARTS[0], "of_arms": {"half": []}}]}, "of_arms: half is unknown; give some of"),
        ({"command": "swim"}, "command=swim: give 'train'"),
    ],
)
def test_a_study_that_cannot_be_is_refused(changes: dict[str, object], complaint: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(complaint)):
        a_study(**changes)
