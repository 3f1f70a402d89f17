"""Files in place of choices: the copies that Hydra reads, and run folders that are no choices."""

import json
from pathlib import Path
from typing import Any

import pytest
from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf

from cartpole_rl.commands.hydra_application.choice_files import with_choice_files
from cartpole_rl.errors import ConfigError


def stored(group: str, name: str) -> dict[str, Any]:
    """The choice that a file became."""
    return OmegaConf.to_container(ConfigStore.instance().repo[group][f"{name}.yaml"].node)


def test_words_without_files_stay_as_they_are() -> None:
    words = ["pole=large,medium", "seed=0", "run=mine.yaml", "+experiment=balance"]
    with with_choice_files(words) as replaced:
        assert replaced == words


def test_a_file_becomes_a_choice_while_the_command_runs(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text("posterior: ${here}/posterior.npz\n")
    with with_choice_files(["seed=0", f"randomization={file}"]) as words:
        assert words == ["seed=0", "randomization=mine"]
        assert stored("randomization", "mine") == {"posterior": f"{tmp_path}/posterior.npz"}
    assert "mine.yaml" not in ConfigStore.instance().repo.get("randomization", {})


def test_files_of_equal_names_get_different_ones(tmp_path: Path) -> None:
    for number, name in enumerate(("first", "second")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "cart.yaml").write_text(f"defaults: [ip02]\ncart_mass: {number}\n")
    both = f"cart={tmp_path}/first/cart.yaml,{tmp_path}/second/cart.yaml"
    with with_choice_files([both]) as words:
        assert words[0] == "cart=cart,second_cart"
        assert [stored("cart", name)["cart_mass"] for name in ("cart", "second_cart")] == [0, 1]


def test_choices_and_files_can_be_mixed(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("")
    for given, name in {
        "large,{}": "large,mine",
        "{},large": "mine,large",
        "[large,{}]": "[large,mine]",
    }.items():
        with with_choice_files([f"pole={given.format(tmp_path / 'mine.yaml')}"]) as words:
            assert words[0] == f"pole={name}"


def refused(word: str) -> str:
    with pytest.raises(ConfigError) as caught, with_choice_files([word]):
        pass
    return str(caught.value)


def test_a_missing_file_is_refused() -> None:
    assert refused("cart=nowhere/cart.yaml") == "cart=nowhere/cart.yaml: there is no such file"


def test_a_folder_is_refused_with_its_file_of_that_group(tmp_path: Path) -> None:
    assert f"cart={tmp_path} is a folder; give a file" in refused(f"cart={tmp_path}")
    (tmp_path / "cart.yaml").write_text("")
    assert refused(f"cart={tmp_path}") == f"cart={tmp_path} is a folder; give cart={tmp_path}/cart.yaml"


def test_another_groups_file_of_a_run_is_refused(tmp_path: Path) -> None:
    (tmp_path / "provenance.json").write_text(json.dumps({"program": "cartpole-identify"}))
    for name in ("cart", "pole"):
        (tmp_path / f"{name}.yaml").write_text("")
    complaint = refused(f"cart={tmp_path}/pole.yaml")
    assert complaint.endswith(f"give cart={tmp_path}/cart.yaml")
    assert "is not a cart but another file of a run of cartpole-identify" in complaint
