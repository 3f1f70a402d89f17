"""Recordings in formats of others: MCAP files, and data sets of Minari.

MCAP, which Foxglove opens: JSON messages with a schema, and the heading as metadata. A control period is a
message on /cart/state, then one on /cart/action, both at the cart's time in ns. Their fields are the columns
of a recording.

Minari, for offline reinforcement learning: observations are those of the agent that was recorded, from the
recorded counts. Actions are indices of its motor values: where the track guard replaced one, that of the
value sent. They are a Box of motor values over 255 where the agent is unknown or lacks one of the values. The
infos hold the columns of a recording: those of a state in its row, those of a step in the row after it, as
`step` of an environment returns them.
"""

import copy
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces, spec
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from cartpole_rl import ENVIRONMENTS
from cartpole_rl.envs.build import make_env, shipped_settings
from cartpole_rl.envs.gymnasium import OF_TASK, TAKEN, float32
from cartpole_rl.envs.settings import CartPoleSettings
from cartpole_rl.errors import RecordingError, reason_of
from cartpole_rl.evaluation.recordings import (
    COLUMNS,
    COUNTS,
    GUARDED,
    METRES,
    OF_STATE,
    OF_STEP,
    TURN,
    Recording,
    episode_of,
    rows_of,
)
from cartpole_rl.files import replacing
from cartpole_rl.plants.recorded import RecordedPlant
from cartpole_rl.rig.hardware import LARGEST_MOTOR, hardware_of
from cartpole_rl.tasks.episode import Ending, Episode

SETTINGS, RECORDING, HEADING = "settings", "recording", "heading"  # names in metadata
TOPICS = {"/cart/state": OF_STATE, "/cart/action": (*OF_STEP, GUARDED)}
WHOLE = (*COUNTS, "motor", GUARDED)  # columns of whole numbers
TERMINATED = (Ending.TRACK, Ending.ANGLE)


def write_mcap(path: Path, recording: Recording, settings: CartPoleSettings | None) -> None:
    """Write a recording, with the `settings` of its agent if they are known."""
    from mcap.writer import Writer  # of the extra mcap

    with replacing(path) as beside, beside.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channels = {}
        for topic, names in TOPICS.items():
            fields = {name: {"type": "integer" if name in WHOLE else "number"} for name in names}
            schema = json.dumps({"type": "object", "properties": fields}).encode()
            number = writer.register_schema(topic.strip("/").replace("/", "."), "jsonschema", schema)
            channels[topic] = writer.register_channel(topic, "json", number)
        for row, values in enumerate(rows_of(recording.episode)):
            time = round(1e9 * values["time_s"])
            for topic, channel in channels.items():
                if own := {name: values[name] for name in TOPICS[topic] if name in values}:
                    data = json.dumps(own).encode()
                    writer.add_message(channel, log_time=time, data=data, publish_time=time, sequence=row)
        writer.add_metadata(RECORDING, dict(recording.facts))
        if settings:
            writer.add_metadata(SETTINGS, {SETTINGS: settings.model_dump_json()})
        writer.finish()


def read_mcap(path: Path) -> tuple[Recording, Any]:
    """Return the recording in a file of `write_mcap`, and its settings or None. Raises RecordingError."""
    from mcap.reader import make_reader

    rows: dict[int, dict[str, str]] = {}
    try:
        with path.open("rb") as file:
            reader = make_reader(file, validate_crcs=True)
            known = {each.name: each.metadata for each in reader.iter_metadata()}
            settings = json.loads(known.get(SETTINGS, {}).get(SETTINGS, "null"))
            for _, _, message in reader.iter_messages(topics=[*TOPICS]):
                row = rows.setdefault(message.sequence, dict.fromkeys((*COLUMNS, GUARDED), ""))
                row.update((name, str(value)) for name, value in json.loads(message.data).items())
    except Exception as error:  # a damaged file raises errors of many kinds
        raise RecordingError(f"{path} cannot be read as MCAP: {reason_of(error)}") from None
    if RECORDING not in known:
        raise RecordingError(f"{path} holds no recording; give a file of cartpole-export format=mcap")
    episode = episode_of(path, known[RECORDING], [rows[row] for row in sorted(rows)])
    return Recording(path.stem, episode, known[RECORDING]), settings


class MinariData:
    """A data set of `recordings`; `settings` are those of the recorded agent, None where it is unknown.

    Raises ConfigError if the recordings lack what the agent observes.
    """

    def __init__(self, recordings: Sequence[Recording], settings: CartPoleSettings | None) -> None:
        self.recordings, self.settings, self.agent = recordings, settings, settings or shipped_settings()
        motors = {motor for each in recordings for motor in each.episode.motor.tolist()}
        self.indexed = settings is not None and motors <= {*settings.actions.motors}
        self.episodes = [arrays(each, self.agent, self.indexed) for each in recordings]

    def write(self, folder: Path, name: str) -> None:
        """Write the data set into `folder`, which does not exist, under a name of Minari's."""
        from minari import __version__  # of the extra minari
        from minari.data_collector import EpisodeBuffer
        from minari.dataset.minari_storage import MinariStorage

        folder.mkdir(parents=True)
        storage = MinariStorage.new(
            folder,
            spaces.Box(-np.inf, np.inf, (self.agent.observation.size,), np.float32),
            spaces.Discrete(len(self.agent.actions.motors))
            if self.indexed
            else spaces.Box(-1, 1, (1,), np.float32),
            environment_spec(self.agent) if self.indexed else None,
        )
        settings = {SETTINGS: self.settings.model_dump_json()} if self.settings else {}
        storage.update_metadata({"dataset_id": name, "minari_version": __version__, **settings})
        storage.update_episodes(EpisodeBuffer(**each) for each in self.episodes)
        storage.update_episode_metadata(
            {RECORDING: each.name, HEADING: json.dumps(dict(each.facts))} for each in self.recordings
        )


def arrays(recording: Recording, agent: CartPoleSettings, indexed: bool) -> dict[str, Any]:
    """Return the arrays of an episode as Minari has them."""
    episode, motor = recording.episode, recording.episode.motor
    rows = rows_of(episode)
    last = np.arange(episode.steps) == episode.steps - 1
    terminated = episode.ended_by in TERMINATED
    steps = [name for name in (*OF_STEP, GUARDED) if name in rows[0]]
    return {
        "observations": observations(episode, recording.pole_length, agent),
        "actions": np.array([agent.actions.motors.index(value) for value in motor.tolist()])
        if indexed
        else (motor[:, None] / LARGEST_MOTOR).astype(np.float32),
        "rewards": episode.reward,
        "terminations": last & terminated,
        "truncations": last & (not terminated),
        "infos": {name: np.array([row[name] for row in rows]) for name in OF_STATE}
        | {name: np.array([0, *(row[name] for row in rows[:-1])]) for name in steps},
    }


def observations(episode: Episode, length: float | None, agent: CartPoleSettings) -> NDArray[np.float32]:
    """Return what the agent observes at each state of an episode, [T + 1, K]; `length` of the pole in m."""
    scales = {METRES: round(1e9 * episode.encoders.metres), TURN: episode.encoders.turn}
    plant = RecordedPlant(episode, length, hardware_of(scales))
    task, reward = agent.task.at(agent.control_period), agent.reward.at(agent.control_period)
    cart = make_env(plant, agent.actions, task, agent.observation, reward).one_cart
    seen = [cart.reset(), *(cart.step(0) for _ in range(episode.steps))]
    return np.stack([float32(each.observation) for each in seen])


def environment_spec(agent: CartPoleSettings) -> EnvSpec | None:
    """Return the Gymnasium environment with the settings of `agent`; None for a task of one's own."""
    task = agent.task.name
    if task not in OF_TASK:
        return None
    (name,) = (name for name, each in ENVIRONMENTS.items() if each == task)
    found, values = copy.deepcopy(spec(name)), agent.model_dump(mode="json")
    choices = {name: values[name] for name in TAKEN if name in values}
    found.kwargs = {"task": task, "period": agent.control_period, **choices}
    found.max_episode_steps = agent.task.at(agent.control_period).periods
    return found


def read_minari(folder: Path) -> tuple[list[Recording], Any]:
    """Return the recordings in a data set of `MinariData`, and its settings or None.

    Raises RecordingError.
    """
    from minari import MinariDataset

    try:
        data = MinariDataset(folder)
        settings = json.loads(data.storage.metadata.get(SETTINGS, "null"))
        about = [*data.storage.get_episode_metadata(range(data.total_episodes))]
        names = [Path(str(each.get(RECORDING))).name for each in about]
        infos = [episode.infos for episode in data.iterate_episodes()]
        headings = [json.loads(each.get(HEADING, "{}")) for each in about]
        tables = [rows(each) if facts else [] for each, facts in zip(infos, headings, strict=True)]
    except Exception as error:  # a damaged data set raises errors of many kinds
        raise RecordingError(f"{folder} cannot be read by Minari: {reason_of(error)}") from None
    if not all(headings):
        raise RecordingError(
            f"{folder} holds no recordings; give a data set of cartpole-export format=minari"
        )
    parts = zip(names, headings, tables, strict=True)
    return [Recording(name, episode_of(folder / name, *each), each[0]) for name, *each in parts], settings


def rows(infos: Mapping[str, NDArray[Any]]) -> list[dict[str, str]]:
    """Return the rows of a recording as text cells, from the infos of an episode."""
    columns = {name: [*map(str, infos[name].tolist())] for name in infos}
    columns |= {name: [*columns[name][1:], ""] for name in (*OF_STEP, GUARDED) if name in columns}
    columns.setdefault(GUARDED, [""] * len(infos[OF_STATE[0]]))
    return [dict(zip(columns, cells, strict=True)) for cells in zip(*columns.values(), strict=True)]
