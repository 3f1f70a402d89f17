"""Recordings as MCAP files, which Foxglove opens: JSON messages with a schema, and the heading as metadata.

A control period is a message on /cart/state, then one on /cart/action, both at the cart's time in ns. Their
fields are the columns of a recording.
"""

import json
from pathlib import Path
from typing import Any

from cartpole_rl.envs.settings import CartPoleSettings
from cartpole_rl.errors import RecordingError, reason_of
from cartpole_rl.evaluation.recordings import (
    COLUMNS,
    COUNTS,
    GUARDED,
    OF_STATE,
    OF_STEP,
    Recording,
    episode_of,
    rows_of,
)
from cartpole_rl.files import replacing

TOPICS = {"/cart/state": OF_STATE, "/cart/action": (*OF_STEP, GUARDED)}
HEADING, SETTINGS = "recording", "settings"  # names of the metadata
WHOLE = (*COUNTS, "motor", GUARDED)  # columns of whole numbers


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
        writer.add_metadata(HEADING, dict(recording.facts))
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
    if HEADING not in known:
        raise RecordingError(f"{path} holds no recording; give a file of cartpole-export format=mcap")
    episode = episode_of(path, known[HEADING], [rows[row] for row in sorted(rows)])
    return Recording(path.stem, episode, known[HEADING]), settings
