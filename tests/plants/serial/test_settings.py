"""Settings of plant=serial on a command line reach the port and the calls that wait."""

from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace

import hydra
import pytest
import serial
from hydra.core.global_hydra import GlobalHydra
from serial_peer import CartPeer

from cartpole_rl.checking import checked
from cartpole_rl.choices import conf_folder
from cartpole_rl.commands.composition import as_mapping
from cartpole_rl.envs.make import CartPoleEnv
from cartpole_rl.errors import ConfigError, LinkError, PlantError
from cartpole_rl.plants.serial.settings import SerialSettings
from cartpole_rl.wire import Flags
from cartpole_rl.workflows.build import evaluated_env, evaluated_settings
from cartpole_rl.workflows.config import EvaluateConfig, TrainConfig

TIMEOUTS = {
    "timeout": 0.15,
    "connect_timeout": 1.5,
    "answer_timeout": 0.25,
    "write_timeout": 0.07,
    "nudge_after": 0.05,
    "home_timeout": 0.11,
    "start_timeout": 0.12,
}


@pytest.fixture
def peer() -> Iterator[CartPeer]:
    with CartPeer() as peer:
        yield peer


@pytest.fixture(autouse=True)
def composer() -> Iterator[None]:
    GlobalHydra.instance().clear()
    with hydra.initialize_config_dir(version_base="1.3", config_dir=str(conf_folder())):
        yield


def evaluation(*words: str) -> EvaluateConfig:
    words = ("run=lqr", "plant=serial", *words)
    return checked(EvaluateConfig, as_mapping(hydra.compose("evaluate", list(words))))


def environment(config: EvaluateConfig) -> CartPoleEnv:
    training = checked(TrainConfig, as_mapping(hydra.compose("train")))
    return evaluated_env(evaluated_settings(training, config), config, prompt=lambda text: None)


def test_defaults_are_those_of_the_class() -> None:
    assert evaluation("plant.port=COM3").plant == SerialSettings(port="COM3")


def test_timeouts_reach_the_port_and_the_calls_that_wait(
    peer: CartPeer, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened, real = [], serial.serial_for_url
    monkeypatch.setattr(
        serial, "serial_for_url", lambda url, **kwargs: opened.append(kwargs) or real(url, **kwargs)
    )
    words = (f"plant.{name}={seconds}" for name, seconds in TIMEOUTS.items())
    config = evaluation(f"plant.port={peer.port}", "plant.baud=115200", "plant.retries=0", *words)
    with closing(environment(config)) as env:
        assert (opened[0]["baudrate"], opened[0]["write_timeout"]) == (115200, 0.07)
        peer.flags = Flags.HOMING
        carry_out, peer.carry_out = peer.carry_out, lambda message: None
        with pytest.raises(PlantError, match=r"homing was not done after 0\.11 s"):
            env.reset()
        peer.carry_out, peer.flags = carry_out, Flags(0)
        peer.state = replace(peer.state, pole_counts=1500)
        with pytest.raises(PlantError, match=r"waited 0\.12 s for the pole"):
            env.reset()
        peer.answer = lambda frame: ()
        with pytest.raises(LinkError, match=r"no state came from .* for 0\.15 s"):
            env.plant.cart.get_state()
        with pytest.raises(LinkError, match="did not answer HELLO, asked 1 times"):
            env.plant.cart.info()


@pytest.mark.parametrize(
    ("word", "complaint"),
    [
        ("plant.timeout=0", "plant.timeout=0: input should be greater than 0"),
        ("plant.home_timeout=-1", "plant.home_timeout=-1: input should be greater than 0"),
        ("plant.clear_faults=null", "plant.clear_faults=null: input should be a valid integer"),
        ("plant.pole_length=33", "plant.pole_length=33: input should be less than or equal to 3"),
    ],
)
def test_values_out_of_range_are_refused(word: str, complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint):
        evaluation("plant.port=COM3", word)
