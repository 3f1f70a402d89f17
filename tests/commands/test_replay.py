"""A replay of the recorded cart follows it; that of another cart does not, and its errors are reported."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml
from command_line import ENSEMBLE, Outcome, in_process

from cartpole_rl.choices import choice


def replay(source: Path, folder: Path, *words: str) -> tuple[Outcome, dict[str, Any]]:
    done = in_process("replay", f"from={source}", *words, "hydra.run.dir=run", folder=folder)
    assert done.code == 0, done.err
    return done, json.loads((folder / "run/replay.json").read_text())


def test_the_same_cart_is_followed(recorded: Path, tmp_path: Path) -> None:
    done, results = replay(recorded, tmp_path)
    soon, later, last = results["errors"]
    assert [each["after_s"] for each in results["errors"]] == [0.1, 0.5, 1.0]
    assert (soon["rms_x_mm"], soon["rms_theta_deg"]) < (0.05, 0.3)
    assert later["rms_x_mm"] < 2
    assert later["median_theta_deg"] < 3
    assert soon["windows"] == 20
    assert last["windows"] < 20  # the last stretch of an episode is cut by its end
    assert (results["pole"], results["control_period_s"], len(results["recordings"])) == ("medium", 0.02, 2)
    assert "errors of 2 episodes, pole=medium" in done.out
    assert done.out.splitlines()[-2:] == [
        "run/replay.json and figures/replay.png are written; next:",
        f"cartpole-model from={recorded}",
    ]
    assert "warning: a pole" not in done.out
    assert (tmp_path / "run/figures/replay.png").stat().st_size > 10_000
    config = yaml.safe_load((tmp_path / "run/config.yaml").read_text())
    assert config["from"] == str(recorded)


def test_another_cart_is_not_followed(recorded: Path, tmp_path: Path) -> None:
    other = "parameters={cart_coulomb:0.8}", "cart=ip02", "cart.cart_mass=0.71"
    done, results = replay(recorded / "recordings/episode_000.csv", tmp_path, *other)
    assert done.out.splitlines()[-1].endswith("episode_000.csv cart=ip02 cart.cart_mass=0.71")
    assert len(results["recordings"]) == 1
    assert results["parameters"]["cart_coulomb"] == 0.8
    assert results["errors"][0]["rms_x_mm"] > 0.3


def test_copied_recordings_tell_no_cart(recorded: Path, tmp_path: Path) -> None:
    shutil.copy(recorded / "recordings/episode_000.csv", tmp_path)
    done, _ = replay(tmp_path / "episode_000.csv", tmp_path)
    assert "tell no cart: this is cart=ip02" in done.err


def test_the_cart_of_an_import_is_followed(recorded: Path, tmp_path: Path) -> None:
    shutil.copytree(recorded / "recordings", tmp_path / "imported/recordings")
    config = yaml.safe_dump({"cart": choice("cart/ip02") | {"cart_mass": 1.5}})
    (tmp_path / "imported/config.yaml").write_text(config)
    done, results = replay(Path("imported"), tmp_path)
    assert "note: cart as in from=imported" in done.err
    assert results["parameters"]["cart_mass"] == 1.5


def test_the_cart_of_the_recorded_agent_is_followed(tmp_path: Path) -> None:
    cart = ("cart_friction=linear", "parameters={cart_viscous:3,pole_viscous:0.002}", "episodes=1")
    done = in_process("record", "run=lqr", *cart, "hydra.run.dir=recorded", folder=tmp_path)
    assert done.code == 0, done.err
    _, own = replay(tmp_path / "recorded", tmp_path)
    assert own["parameters"]["cart_viscous"] == 3
    assert own["errors_away_from_upright"][2]["median_theta_deg"] < 0.5
    assert own["errors"][2]["median_theta_deg"] < 5
    (tmp_path / "run").rename(tmp_path / "own")
    _, other = replay(tmp_path / "recorded", tmp_path, "cart=ip02", "cart_friction=sigmoid")
    assert other["errors"][2]["median_theta_deg"] > 2 * own["errors"][2]["median_theta_deg"]


def test_the_recorded_pole_is_the_simulated_one(recorded: Path, tmp_path: Path) -> None:
    text = (recorded / "recordings/episode_000.csv").read_text()
    (tmp_path / "large.csv").write_text(text.replace("pole_length_m: 0.3556", "pole_length_m: 0.6560"))
    _, results = replay(tmp_path / "large.csv", tmp_path)
    assert results["pole"] == "large"


def test_a_cart_with_other_encoders_does_not_get_the_pole_of_ip02(recorded: Path, tmp_path: Path) -> None:
    text = (recorded / "recordings/episode_000.csv").read_text()
    text = text.replace("pole_length_m: 0.3556", "pole_length_m: ").replace(
        "per_turn: 4096", "per_turn: 4095"
    )
    (tmp_path / "log.csv").write_text(text)
    words = "from=log.csv", "cart=ip02", "cart.pole_counts_per_turn=4095"
    for verb in ("replay", "model"):
        done = in_process(verb, *words, folder=tmp_path)
        assert done.code == 2
        assert "pole: the recordings do not say which one it is; give the pole of this cart" in done.complaint
    assert in_process("replay", *words, "pole=medium", folder=tmp_path).code == 0


def test_a_chosen_pole_of_another_length_is_warned_of(recorded: Path, tmp_path: Path) -> None:
    warning = "warning: a pole of 0.3556 m was recorded; pole= gives one of 0.6604 m"
    for verb in ("replay", "identify"):
        done = in_process(verb, f"from={recorded}", "pole=large", folder=tmp_path)
        assert warning in done.out, verb


@pytest.mark.parametrize(
    ("lengths", "complaint"),
    [
        (("long",), "length_m is 'long'"),
        (("0.3556", "0.6560"), "poles of 0.3556, 0.656 m were recorded; replay those of one pole"),
        (
            ("0.5000",),
            "pole: one of 0.5 m was recorded; give one of medium, large, rod_03, sensorsini, laboratorio, or",
        ),
    ],
)
def test_the_recorded_poles_are_one_that_is_known(
    lengths: tuple[str, ...], complaint: str, recorded: Path, tmp_path: Path
) -> None:
    text = (recorded / "recordings/episode_000.csv").read_text()
    for length in lengths:
        (tmp_path / f"{length}.csv").write_text(text.replace("length_m: 0.3556", f"length_m: {length}"))
    done = in_process("replay", "from=.", folder=tmp_path)
    assert complaint in done.complaint
    assert done.code in (1, 2)


def test_lengths_of_one_pole_may_differ_a_little(recorded: Path, tmp_path: Path) -> None:
    text = (recorded / "recordings/episode_000.csv").read_text()
    for length in ("0.3500", "0.3600"):
        (tmp_path / f"{length}.csv").write_text(text.replace("length_m: 0.3556", f"length_m: {length}"))
    done = in_process("replay", "from=.", folder=tmp_path)
    assert "2 episodes, pole=medium" in done.out


def test_too_short_a_recording_says_so(recorded: Path, tmp_path: Path) -> None:
    lines = (recorded / "recordings/episode_000.csv").read_text().splitlines()
    heading = sum(line.startswith("#") for line in lines)
    for words, rows, complaint in (
        (["replay"], 9, "from=short.csv: no recording lasts 0.2 s"),
        (["model", *ENSEMBLE], 80, "the held-out recordings have no 1.44 s"),
    ):
        (tmp_path / "short.csv").write_text("\n".join([*lines[: heading + rows], lines[-1]]) + "\n")
        done = in_process(*words, "from=short.csv", "hydra.run.dir=run", folder=tmp_path)
        assert f"{complaint} without a lost frame: record longer" in done.complaint
        assert done.code == 2
        assert not (tmp_path / "run").exists()


def test_wrong_parameters_and_poles_are_named(recorded: Path, tmp_path: Path) -> None:
    for word, named in {
        "parameters={cart_coulom:1}": "did you mean 'cart_coulomb'?",
        "parameters={cart_mass:-1}": "cart_mass is -1; it must be above 0",
        "pole=both": "choose one, as pole=medium",
    }.items():
        done = in_process("replay", f"from={recorded}", word, folder=tmp_path)
        assert named in done.complaint
        assert done.code == 2
