"""cartpole-identify over the real path: the emulated cart is found, and what is written trains an agent."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from command_line import ONCE, QUICK, TINY, Outcome, in_process

from cartpole_rl.checking import validated
from cartpole_rl.composition import without_missing
from cartpole_rl.evaluation.recordings import read_recording, write_recording
from cartpole_rl.identification.experiments import recording
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.rig.hardware import nominal_encoders
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.workflows.config import IdentifyConfig, TrainConfig, load_settings
from cartpole_rl.workflows.identify import as_recorded, split


@pytest.fixture(scope="module")
def run(identified: tuple[Path, Outcome]) -> Path:
    return identified[0]


@pytest.fixture(scope="module")
def results(run: Path) -> dict[str, Any]:
    return json.loads((run / "identification.json").read_text())


def test_the_command_that_trains_on_it_is_printed(identified: tuple[Path, Outcome]) -> None:
    _, done = identified
    assert "cartpole-train cart=run/cart.yaml pole=run/pole.yaml" in done.out


def test_the_cart_is_found(results: dict[str, Any]) -> None:
    found = {name: each["value"] for name, each in results["quantities"].items()}
    mass, moment = 0.735 + 0.129, 0.129 * 0.1765
    assert found["viscous"] == pytest.approx(1.1 / mass, rel=0.1)
    assert found["coulomb"] == pytest.approx(0.555 / mass, rel=0.1)
    assert found["force_gain"] == pytest.approx(1e3 * 0.0198 * 1.015 / mass, rel=0.03)
    frequency = np.sqrt(moment * 9.81 / (1.22e-3 + moment * 0.1765)) / (2 * np.pi)
    assert found["pole_frequency"] == pytest.approx(frequency, rel=0.01)
    assert found["deadband"] == pytest.approx(50, rel=0.15)  # the curve's; 55 and 60 are too little above it
    assert found["latency"] + found["lag"] == pytest.approx(17, abs=3)
    assert found["angle_offset"] == pytest.approx(np.degrees(-0.01), abs=0.1)


def test_held_out_motion_is_predicted(results: dict[str, Any]) -> None:
    assert results["held_out_1_s"]["x_m"] < 5e-3
    assert results["held_out_1_s"]["theta_rad"] < np.radians(2)
    assert set(results["candidates"]) == {"linear", "sigmoid", "step", "stribeck"}


def test_what_is_written_can_be_read(run: Path) -> None:
    cart = yaml.safe_load((run / "cart.yaml").read_text())
    assert "# N s/m, +- " in (run / "cart.yaml").read_text()
    with np.load(run / "posterior.npz") as stored:
        assert stored["names"].tolist() == list(CartParameters.names())
        assert stored["carts"].shape == (len(CartParameters.names()), 200)
        viscous = stored["carts"][CartParameters.names().index("cart_viscous")]
        size = len(stored["unknowns"])
        assert stored["covariance"].shape == (size, size)
    assert np.median(viscous) == pytest.approx(cart["cart_viscous"], rel=0.2)
    page = (run / "page.html").read_text()
    for part in ("Recordings", "Identified values", "Warnings", "Next step", "spectrum.png"):
        assert part in page
    assert len(list((run / "figures").glob("*.png"))) == 6


@pytest.mark.nightly
def test_offline_is_as_online(run: Path, results: dict[str, Any], tmp_path: Path) -> None:
    done = in_process("identify", f"from={run}", *QUICK, "hydra.run.dir=again", folder=tmp_path)
    assert done.code == 0, done.err
    assert json.loads((tmp_path / "again/identification.json").read_text()) == results


def test_recordings_of_a_run_are_of_its_cart_and_its_pole(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also where the command that reads them does not repeat cart= and pole=."""
    assert {read_recording(path).pole_length for path in (run / "recordings").iterdir()} == {0.3556}
    shutil.copytree(run, tmp_path / "first")
    recorded = yaml.safe_load((run / "config.yaml").read_text())
    recorded["cart"] |= {"track_half_length": 0.3}
    recorded["pole"]["choices"] = {"mine": {"pole_mass": 0.2, "pole_com": 0.18, "pole_inertia": 0.002}}
    (tmp_path / "first/config.yaml").write_text(yaml.safe_dump(recorded))
    monkeypatch.chdir(tmp_path)
    changed = {**recorded["cart"], "cart_mass": 0.8}
    for word, taken in (
        ("label=", {"cart": recorded["cart"], "pole": recorded["pole"]}),
        ("pole=medium", {"cart": recorded["cart"]}),
        ("cart.cart_mass=0.8", {"cart": changed, "pole": recorded["pole"]}),
    ):
        words = ["from=first", word]
        used = as_recorded(load_settings(IdentifyConfig, words), words).model_dump(mode="json")
        assert {name: used[name] for name in taken} == taken
        assert ("pole" in taken) == (used["pole"] == recorded["pole"])
        assert f"note: {' and '.join(taken)} as in from=first" in capsys.readouterr().err
    done = in_process("identify", *words, "method=one_step", "carts=9", "hydra.run.dir=run", folder=tmp_path)
    assert done.code == 0, done.err
    assert "note: method=one_step does not read carts\n" in done.err
    assert yaml.safe_load((tmp_path / "run/config.yaml").read_text())["cart"] == changed


@pytest.mark.parametrize(
    ("seconds", "held_out"),
    [
        ([30, 6], ["1"]),
        ([30, 2], ["the last fifth of 0"]),
        ([2, 30], ["1"]),
        ([30, 25, 2], ["1"]),
        ([9, 9, 9, 9, 6, 9], ["4"]),
        ([9, 9, 9, 9, 2, 9], ["5"]),
        ([2, 40, 2, 2, 2], ["the last fifth of 1"]),
        ([40], ["the last fifth of 0"]),
    ],
)
def test_recordings_that_are_long_enough_are_held_out(seconds: list[int], held_out: list[str]) -> None:
    def moving(rows: int) -> Episode:
        counts = np.zeros((rows + 1, 2), np.int64)
        return recording(counts, np.full(rows, 0.02), np.zeros(rows, np.int64), "time", nominal_encoders())

    recordings = {str(number): moving(50 * each) for number, each in enumerate(seconds)}
    fitted, judges = split(recordings)
    assert [*judges] == held_out
    assert sum(each.steps for each in (*fitted.values(), *judges.values())) == 50 * sum(seconds)


def test_the_cart_is_fitted_with_the_period_of_its_recordings(run: Path, tmp_path: Path) -> None:
    """Of 20.3 ms, which is near enough to the setting of 20 ms not to be refused."""
    for path in (run / "recordings").iterdir():
        episode = read_recording(path).episode
        write_recording(tmp_path / "slower" / path.name, replace(episode, time=1.015 * episode.time))
    found = []
    for folder, word in {"default": "label=", "given": "control_period=0.0203"}.items():
        words = "from=slower", "method=one_step", word, f"hydra.run.dir={folder}"
        done = in_process("identify", *words, folder=tmp_path)
        assert done.code == 0, done.err
        note = (
            "note: the recordings have a period of 0.0203 s, which is used in place of control_period=0.02\n"
        )
        assert (note in done.err) == (folder == "default")
        assert yaml.safe_load((tmp_path / folder / "config.yaml").read_text())["control_period"] == 0.0203
        found.append(json.loads((tmp_path / folder / "identification.json").read_text()))
    assert found[0] == found[1]


@pytest.mark.parametrize("friction", ["", "cart_friction=linear"])
def test_the_printed_command_drives_the_identified_cart_exactly(
    identified: tuple[Path, Outcome], results: dict[str, Any], friction: str
) -> None:
    """Under the selected friction model and any other, which replaces no identified number."""
    run, done = identified
    _, *words = done.out.splitlines()[-1].split()
    words = [friction if friction and word.startswith("cart_friction") else word for word in words]
    shown = in_process("train", *words, "--cfg", "job", "--resolve", folder=run.parent)
    config = validated(TrainConfig, without_missing(yaml.safe_load(shown.out)))
    assert config.nominal_with(config.pole.nominal) == results["parameters"]
    assert config.cart_friction.model == (friction.partition("=")[2] or results["cart_friction"])


@pytest.mark.parametrize(
    ("name", "columns", "said"),
    [
        ("05_excite", ("theta_rad", "pole_counts"), "the pole"),
        ("06_held_out", ("motor",), "the motor value is 0 throughout; record it with others, or leave it"),
    ],
)
def test_a_recording_of_no_cart_gives_no_cart(
    run: Path, tmp_path: Path, name: str, columns: tuple[str, ...], said: str
) -> None:
    shutil.copytree(run / "recordings", tmp_path / "recordings")
    file = tmp_path / f"recordings/{name}.csv"
    lines = file.read_text().splitlines()
    first = next(number for number, line in enumerate(lines) if not line.startswith("#"))
    names = lines[first].split(",")
    for number, line in enumerate(lines[first + 1 :], first + 1):
        cells = zip(names, line.split(","), strict=True)
        lines[number] = ",".join("0" if column in columns and cell else cell for column, cell in cells)
    file.write_text("\n".join(lines) + "\n")
    done = in_process("identify", "from=recordings", *QUICK, "hydra.run.dir=out", folder=tmp_path)
    assert done.code == 2
    assert done.complaint.startswith(f"cartpole-identify: recordings/{name}.csv: {said}")
    assert not (tmp_path / "out").exists()


def test_words_for_a_pole_change_that_of_the_run(run: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(run, tmp_path / "run", ignore=shutil.ignore_patterns("figures"))
    recorded = yaml.safe_load((folder / "config.yaml").read_text())
    recorded["pole"]["choices"]["medium"]["pole_com"] = 0.2
    (folder / "config.yaml").write_text(yaml.safe_dump(recorded))
    words = [f"from={folder}", "pole.choices.medium.pole_mass=0.13"]
    pole = as_recorded(load_settings(IdentifyConfig, words), words).pole.nominal
    assert (pole.pole_mass, pole.pole_com) == (0.13, 0.2)


@pytest.mark.usefixtures("without_pictures")
def test_an_agent_trains_on_what_was_found(run: Path, tmp_path: Path) -> None:
    run = shutil.copytree(run, tmp_path / "moved")  # a run folder can be moved
    files = [f"{group}={run}/{group}.yaml" for group in ("cart", "pole", "randomization")]
    friction = ["cart_friction=step", "pole_friction=bearing"]
    done = in_process("train", *files, *friction, *TINY, ONCE, "hydra.run.dir=trained", folder=tmp_path)
    assert done.code == 0, done.err
    config = yaml.safe_load((tmp_path / "trained/config.yaml").read_text())
    assert config["cart"] == yaml.safe_load((run / "cart.yaml").read_text())
    assert list(config["pole"]["choices"]) == ["identified"]
    assert config["randomization"]["posterior"] == str(run / "posterior.npz")
    given = json.loads((tmp_path / "trained/provenance.json").read_text())["command"]
    assert files[0] in given


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("train cart=nowhere/cart.yaml", "cart=nowhere/cart.yaml: there is no such file"),
        ("train randomization=./randomization.yaml", "posterior.npz cannot be read"),
        ("identify from=empty", "it contains no recording; give a run of cartpole-record or cartpole-id"),
        ("identify from=single", "the last fifth of swing: the motor value is 0 throughout"),
        (
            "identify from=recorded plant=serial plant.port=/dev/ttyUSB0",
            "plant: from=recorded reads recordings and drives no cart; leave one of them out",
        ),
        (
            "identify from=recorded plant.rehome=always emulator.latency=0.01",
            "plant, emulator: from=recorded reads recordings and drives no cart; leave one of them out",
        ),
        ("identify pole=both", "an identification takes one pole"),
        ("identify from=run control_period=0.01", "a frame every 20 ms, not every 10 ms"),
        (
            "identify from=large pole.choices.medium.pole_mass=0.12",
            "pole.choices.medium.pole_mass=: from=large has the pole large; give pole= with it",
        ),
    ],
)
def test_bad_input_is_refused_in_a_line(words: str, said: str, run: Path, tmp_path: Path) -> None:
    shutil.copy(run / "randomization.yaml", tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "single").mkdir()
    shutil.copy(run / "recordings/01_swing.csv", tmp_path / "single")
    (tmp_path / "run").symlink_to(run)
    shutil.copytree(run, tmp_path / "large", ignore=shutil.ignore_patterns("figures"))
    config = yaml.safe_load((run / "config.yaml").read_text())
    config["pole"]["choices"] = {"large": config["pole"]["choices"]["medium"]}
    (tmp_path / "large/config.yaml").write_text(yaml.safe_dump(config))
    command, *given = words.split()
    done = in_process(command, *given, folder=tmp_path)
    assert said in done.complaint
    assert done.code == 2
