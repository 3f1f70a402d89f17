"""A user of Minari loads recordings as episodes of our Gymnasium environment."""

import dataclasses
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from short_episode import EPISODE, FULL

from cartpole_rl.envs.build import shipped_settings
from cartpole_rl.envs.settings import CartPoleSettings
from cartpole_rl.errors import ConfigError, RecordingError
from cartpole_rl.evaluation.exchange import MinariData, read_minari
from cartpole_rl.evaluation.recordings import Recording, read_recording, write_recording
from cartpole_rl.tasks.episode import Episode

minari = pytest.importorskip("minari", reason='minari is missing: pip install "cartpole_rl[minari]"')
NAME = "cartpole_rl/first-v0"


@pytest.fixture(scope="module")
def settings() -> CartPoleSettings:
    return shipped_settings({"pole": "large", "actions": "three", "observation": "raw"})


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    return tmp_path


def written(root: Path, episode: Episode, settings: CartPoleSettings | None) -> Path:
    data = MinariData([Recording("one", episode, {"pole": "large"})], settings)
    data.write(root / NAME / "data", NAME)
    return root / NAME / "data"


@pytest.mark.parametrize(("ended_by", "terminated"), [("track", True), ("time", False)])
def test_it_loads_as_episodes_of_our_environment(
    ended_by: str, terminated: bool, root: Path, settings: CartPoleSettings
) -> None:
    right, left = settings.actions.motors[-1], settings.actions.motors[0]
    motor, reward = np.array([right, left]), np.array([0.25, 0.5])
    written(root, dataclasses.replace(EPISODE, motor=motor, reward=reward, ended_by=ended_by), settings)
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


def test_observations_are_those_that_the_environment_gave(root: Path, settings: CartPoleSettings) -> None:
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
    written(root, driven, settings)
    (episode,) = minari.load_dataset(NAME).iterate_episodes()
    np.testing.assert_allclose(episode.observations, seen, atol=1e-6)


def test_all_that_a_recording_holds_comes_back(tmp_path: Path) -> None:
    write_recording(tmp_path / "one.csv", FULL, {"pole": "", "cart": '{"latency": 0.1}'})
    MinariData([read_recording(tmp_path / "one.csv")], None).write(tmp_path / "data", NAME)
    [(name, episode, facts)], _ = read_minari(tmp_path / "data")
    write_recording(tmp_path / "again.csv", episode, facts)
    assert name == "one"
    assert (tmp_path / "again.csv").read_bytes() == (tmp_path / "one.csv").read_bytes()


def test_motor_values_of_no_action_are_a_box(root: Path, settings: CartPoleSettings) -> None:
    """Those of a log, or of an experiment."""
    folder = written(root, dataclasses.replace(EPISODE, motor=np.array([51, -255])), settings)
    data = minari.MinariDataset(folder)
    np.testing.assert_array_equal(data[0].actions, np.float32([[0.2], [-1]]))
    assert data.env_spec is None


def test_an_observation_that_the_recording_lacks_is_named() -> None:
    observant = shipped_settings({"pole": "range", "observation": "history_length"})
    with pytest.raises(ConfigError, match="which the recording does not have"):
        MinariData([Recording("one", EPISODE, {})], observant)


def test_damaged_and_other_data_sets_are_named(root: Path) -> None:
    folder = written(root, EPISODE, None)
    file = folder / "main_data.hdf5"
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(RecordingError, match="cannot be read by Minari"):
        read_minari(folder)
    file.write_bytes(whole)
    minari.MinariDataset(folder).storage.update_episode_metadata([{"heading": "{}"}])
    with pytest.raises(RecordingError, match="give a data set of cartpole-export format=minari"):
        read_minari(folder)
