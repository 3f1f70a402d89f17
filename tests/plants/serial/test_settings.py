"""Settings of plant=serial reach the port and the calls that wait."""

from contextlib import closing, suppress
from dataclasses import replace

import pytest
import serial
from serial_peer import CartPeer

from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.errors import ConfigError, LinkError, PlantError
from cartpole_rl.plants.settings import SerialSettings
from cartpole_rl.wire.messages import Flags
from cartpole_rl.workflows.build import evaluated_env, evaluated_settings
from cartpole_rl.workflows.config import EvaluateConfig, TrainConfig, load_settings

TIMEOUTS = {
    "timeout": 0.35,
    "connect_timeout": 1.5,
    "answer_timeout": 0.25,
    "write_timeout": 0.07,
    "nudge_after": 0.2,
    "home_timeout": 0.11,
    "start_timeout": 0.12,
}


def evaluation(**plant: object) -> EvaluateConfig:
    overrides = {f"plant.{name}": value for name, value in plant.items()}
    return load_settings(EvaluateConfig, {"run": "lqr", "plant": "serial", **overrides})


def environment(config: EvaluateConfig) -> CartPoleEnv:
    training = load_settings(TrainConfig)
    return evaluated_env(evaluated_settings(training, config), config, prompt=lambda text: None)


def test_defaults_are_those_of_the_class() -> None:
    assert evaluation(port="COM3").plant == SerialSettings(port="COM3")


def test_timeouts_reach_the_port_and_the_calls_that_wait(
    peer: CartPeer, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened, real = [], serial.serial_for_url

    def noted(url: str, **kwargs: object) -> serial.SerialBase:
        opened.append(real(url, **kwargs))
        return opened[-1]

    monkeypatch.setattr(serial, "serial_for_url", noted)
    config = evaluation(port=peer.port, baud=115200, retries=0, **TIMEOUTS)
    with closing(environment(config)) as env:
        assert (opened[0].baudrate, opened[0].write_timeout) == (115200, 0.07)
        peer.flags = Flags.HOMING
        carry_out, peer.carry_out = peer.carry_out, lambda message: None
        with pytest.raises(PlantError, match=r"homing was not done after 0\.11 s"):
            env.reset()
        peer.carry_out, peer.flags = carry_out, Flags(0)
        peer.state = replace(peer.state, pole_counts=1500)
        with pytest.raises(PlantError, match=r"waited 0\.12 s for the pole"):
            env.reset()
        peer.answer = lambda frame: ()
        with suppress(LinkError):
            env.plant.cart.get_state()  # that of STOP
        with pytest.raises(LinkError, match=r"no state came from .* for 0\.35 s"):
            env.plant.cart.get_state()
        with pytest.raises(LinkError, match="did not answer HELLO, asked 1 times"):
            env.plant.cart.info()


@pytest.mark.parametrize(
    ("name", "value", "complaint"),
    [
        ("timeout", 0, "plant.timeout=0: give more than 0"),
        ("clear_faults", None, "plant.clear_faults=null: give an integer"),
        ("timeout", 1e20, "plant.timeout=1e[+]?20: give at most 60"),
        ("nudge_after", 0.1, "plant.nudge_after=0.1: give at least 0.2"),
        ("retries", 10**9, "plant.retries=1000000000: give at most 100"),
        ("pole_length", 33, "plant.pole_length=33: give at most 3"),
    ],
)
def test_values_out_of_range_are_refused(name: str, value: float | None, complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint):
        evaluation(port="COM3", **{name: value})
