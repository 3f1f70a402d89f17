"""Lines that commands print at their end."""

import shlex
from pathlib import Path

import pytest

from cartpole_rl.plants.serial.tracking import LinkStatistics
from cartpole_rl.plants.settings import SerialSettings
from cartpole_rl.run_folder import write_config
from cartpole_rl.terminal import print_loop_time
from cartpole_rl.workflows.config import IdentifyConfig, load_settings
from cartpole_rl.workflows.poles import plant_words, words_of_run


def test_a_measured_loop_time_is_printed_with_what_it_lacks(capsys: pytest.CaptureFixture[str]) -> None:
    statistics = LinkStatistics()
    print_loop_time(statistics.latency_override())
    assert capsys.readouterr().out == ""
    statistics.loop_times.append(0.004)
    print_loop_time(statistics.latency_override())
    assert capsys.readouterr().out == (
        "measured loop time as an override of cartpole-train; add the latency that cartpole-preflight prints "
        "to both numbers: '++randomization.latency={distribution: uniform, absolute: [0.004, 0.004]}'\n"
    )


def test_the_words_for_a_cart_keep_its_line_speed_and_its_pole() -> None:
    assert plant_words(SerialSettings(port="COM3")) == "plant=serial plant.port=COM3"
    assert plant_words(SerialSettings(port="COM3", policy="onboard")) == "plant=serial plant.port=COM3"
    other = SerialSettings(port="COM3", baud=115200, pole_length=0.66)
    assert plant_words(other) == "plant=serial plant.port=COM3 plant.baud=115200 plant.pole_length=0.66"


@pytest.mark.parametrize(
    "words",
    [
        "plant=emulated",
        "plant=emulated emulator=large emulator.cart_viscous=2.0",
        "plant=emulated emulator=stand_in plant.rehome=always",
        "plant=emulated emulator.clock=real 'emulator.force_curve=[0.0,0.02,-0.9]'",
        "plant=serial plant.port=COM3 plant.clear_faults=2",
    ],
)
def test_the_words_for_a_cart_and_for_the_cart_of_a_run_choose_the_same_cart(
    words: str, tmp_path: Path
) -> None:
    given = {key: value for key, _, value in (word.partition("=") for word in shlex.split(words))}
    config = load_settings(IdentifyConfig, shlex.split(words))
    found = plant_words(config.plant, config.emulator)
    assert load_settings(IdentifyConfig, shlex.split(found)).plant == config.plant
    assert load_settings(IdentifyConfig, shlex.split(found)).emulator == config.emulator
    assert {word.partition("=")[0] for word in shlex.split(found)} == given.keys()
    identified, imported = tmp_path / "a", tmp_path / "b"
    write_config(identified, "identify", config.model_dump(mode="json", by_alias=True))
    write_config(imported, "identify", {"seed": 0, "from": str(identified)})
    assert words_of_run(imported) == found
    assert words_of_run(tmp_path) is None
