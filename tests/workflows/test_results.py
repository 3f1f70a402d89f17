"""Lines that commands print at their end."""

import pytest

from cartpole_rl.plants.serial.statistics import LinkStatistics
from cartpole_rl.plants.settings import SerialSettings
from cartpole_rl.terminal import print_loop_time
from cartpole_rl.workflows.poles import plant_words


def test_a_measured_loop_time_is_printed_with_what_it_lacks(capsys: pytest.CaptureFixture[str]) -> None:
    statistics = LinkStatistics()
    print_loop_time(statistics.latency_override())
    assert capsys.readouterr().out == ""
    statistics.loop_times.add(0.004)
    print_loop_time(statistics.latency_override())
    assert capsys.readouterr().out == (
        "measured loop time as an override of cartpole-train; add the latency that cartpole-preflight prints "
        "to both numbers: '++randomization.latency={distribution: uniform, absolute: [0.004, 0.004]}'\n"
    )


def test_the_words_for_a_cart_keep_its_line_speed_and_its_pole() -> None:
    assert plant_words(SerialSettings(port="COM3")) == "plant=serial plant.port=COM3"
    other = SerialSettings(port="COM3", baud=115200, pole_length=0.66)
    assert plant_words(other) == "plant=serial plant.port=COM3 plant.baud=115200 plant.pole_length=0.66"
