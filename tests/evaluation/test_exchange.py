"""Programs that know nothing of this package read its MCAP files and Minari data; damaged ones are named."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from short_episode import EPISODE, FULL

from cartpole_rl.envs.build import shipped_settings
from cartpole_rl.envs.settings import CartPoleSettings
from cartpole_rl.errors import ConfigError, RecordingError
from cartpole_rl.evaluation.exchange import MinariData, read_mcap, read_minari, write_mcap
from cartpole_rl.evaluation.recordings import Recording, read_recording, write_recording
from cartpole_rl.tasks.episode import Episode

NAME = "cartpole_rl/first-v0"  # of a data set


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A recording as MCAP."""
    pytest.importorskip("mcap", reason='mcap is missing: pip install "cartpole_rl[mcap]"')
    write_recording(tmp_path / "one.csv", EPISODE, {"pole": "medium"})
    write_mcap(tmp_path / "one.mcap", read_recording(tmp_path / "one.csv"), None)
    return tmp_path / "one.mcap"


@pytest.fixture
def minari(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Minari, with its data sets in `tmp_path`."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    return pytest.importorskip("minari", reason='minari is missing: pip install "cartpole_rl[minari]"')


@pytest.fixture(scope="module")
def settings() -> CartPoleSettings:
    return shipped_settings({"pole": "large", "actions": "three", "observation": "raw"})


def written(folder: Path, episode: Episode, settings: CartPoleSettings | None) -> Path:
    """A data set of one recording."""
    data = MinariData([Recording("one", episode, {"pole": "large"})], settings)
    data.write(folder / NAME / "data", NAME)
    return folder / NAME / "data"


@pytest.mark.parametrize("form", ["mcap", "minari"])
def test_all_that_a_recording_holds_comes_back(form: str, tmp_path: Path) -> None:
    pytest.importorskip(form, reason=f'{form} is missing: pip install "cartpole_rl[{form}]"')
    write_recording(tmp_path / "one.csv", FULL, {"pole": "", "cart": '{"latency": 0.1}'})
    recording, other = read_recording(tmp_path / "one.csv"), tmp_path / "one.mcap"
    if form == "mcap":
        write_mcap(other, recording, None)
        (name, episode, facts), _ = read_mcap(other)
    else:
        MinariData([recording], None).write(other, NAME)
        [(name, episode, facts)], _ = read_minari(other)
    write_recording(tmp_path / "again.csv", episode, facts)
    assert name == "one"
    assert (tmp_path / "again.csv").read_bytes() == (tmp_path / "one.csv").read_bytes()


def test_any_reader_of_mcap_finds_json_messages_with_a_schema(file: Path) -> None:
    from mcap.reader import make_reader

    with file.open("rb") as stream:
        messages = [*make_reader(stream).iter_messages()]
    assert [(channel.topic, message.log_time) for _, channel, message in messages] == [
        ("/cart/state", 0),
        ("/cart/action", 0),
        ("/cart/state", 20_000_000),
        ("/cart/action", 20_000_000),
        ("/cart/state", 40_000_000),
    ]
    for schema, channel, message in messages:
        assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
        properties = json.loads(schema.data)["properties"]
        for name, value in json.loads(message.data).items():
            assert isinstance(value, {"number": float, "integer": int}[properties[name]["type"]])
    assert json.loads(messages[2][2].data)["x_m"] == 0.1


def test_no_part_of_a_file_is_taken_for_the_whole(file: Path) -> None:
    whole = file.read_bytes()
    for length in range(0, len(whole), 37):
        file.write_bytes(whole[:length])
        with pytest.raises(RecordingError, match=r"one\.mcap") as raised:
            read_mcap(file)
        assert "\n" not in str(raised.value)


def test_a_file_of_others_is_named(file: Path) -> None:
    from mcap.writer import Writer

    with file.open("wb") as stream:
        other = Writer(stream)
        other.start()
        other.finish()
    with pytest.raises(RecordingError, match="give a file of cartpole-export format=mcap"):
        read_mcap(file)


@pytest.mark.parametrize(("ended_by", "terminated"), [("track", True), ("time", False)])
def test_it_loads_as_episodes_of_our_environment(
    ended_by: str, terminated: bool, minari: Any, tmp_path: Path, settings: CartPoleSettings
) -> None:
    right, left = settings.actions.motors[-1], settings.actions.motors[0]
    motor, reward = np.array([right, left]), np.array([0.25, 0.5])
    written(tmp_path, dataclasses.replace(EPISODE, motor=motor, reward=reward, ended_by=ended_by), settings)
    data = minari.load_dataset(NAME)
    (episode,) = data.iterate_episodes()
    assert episode.observations.shape == (3, settings.observation.size)
    np.testing.assert_array_equal(episode.actions, [2, 0])
    np.testing.assert_array_equal(episode.rewards, reward)
    np.testing.assert_array_equal(episode.terminations, [False, terminated])
    np.testing.assert_array_equal(episode.truncations, [False, not terminated])
    np.testing.assert_array_equal(episode.infos["motor"], [0, right, left])
    environment = data.recover_environment()
    assert environment.observation_space == data.spec.observation_space
    assert environment.action_space == data.spec.action_space
    settings_again = environment.unwrapped.env.hardware
    assert settings_again.motors.tolist() == [*settings.actions.motors]
    assert [*minari.list_local_datasets()] == [NAME]


def test_observations_are_those_that_the_environment_gave(
    minari: Any, tmp_path: Path, settings: CartPoleSettings
) -> None:
    """An environment that drove the recorded episode."""
    environment = gymnasium.make(
        "cartpole_rl/SwingUp-v0", pole="large", actions="three", observation="raw", guard="none"
    )
    cart = environment.unwrapped.env.one_cart  # type: ignore[attr-defined]
    seen, counts, times = [environment.reset(seed=1)[0]], [cart.frame.counts], [0.0]
    for action in (2, 0):
        seen.append(environment.step(action)[0])
        counts.append(cart.frame.counts)
        times.append(times[-1] + cart.frame.dt[0])
    motor = np.array([settings.actions.motors[action] for action in (2, 0)])
    driven = dataclasses.replace(EPISODE, counts=np.array(counts), time=np.array(times), motor=motor)
    written(tmp_path, driven, settings)
    (episode,) = minari.load_dataset(NAME).iterate_episodes()
    np.testing.assert_allclose(episode.observations, seen, atol=1e-6)


def test_motor_values_of_no_action_are_a_box(minari: Any, tmp_path: Path, settings: CartPoleSettings) -> None:
    """Those of a log, or of an experiment."""
    folder = written(tmp_path, dataclasses.replace(EPISODE, motor=np.array([51, -255])), settings)
    data = minari.MinariDataset(folder)
    np.testing.assert_array_equal(data[0].actions, np.float32([[0.2], [-1]]))
    assert data.env_spec is None


def test_an_observation_that_the_recording_lacks_is_named() -> None:
    observant = shipped_settings({"pole": "range", "observation": "history_length"})
    with pytest.raises(ConfigError, match="which the recording does not have"):
        MinariData([Recording("one", EPISODE, {})], observant)


def test_damaged_and_other_data_sets_are_named(minari: Any, tmp_path: Path) -> None:
    folder = written(tmp_path, EPISODE, None)
    file = folder / "main_data.hdf5"
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(RecordingError, match="cannot be read by Minari"):
        read_minari(folder)
    file.write_bytes(whole)
    minari.MinariDataset(folder).storage.update_episode_metadata([{"heading": "{}"}])
    with pytest.raises(RecordingError, match="give a data set of cartpole-export format=minari"):
        read_minari(folder)
