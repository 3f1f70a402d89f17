"""Any reader of MCAP finds JSON with a schema at the cart's time, and what is no such file is named."""

import json
from pathlib import Path

import pytest
from short_episode import EPISODE, FULL

from cartpole_rl.errors import RecordingError
from cartpole_rl.evaluation.exchange import read_mcap, write_mcap
from cartpole_rl.evaluation.recordings import read_recording, write_recording

REASON = 'mcap is missing: pip install "cartpole_rl[mcap]"'
writer = pytest.importorskip("mcap.writer", reason=REASON)
reader = pytest.importorskip("mcap.reader", reason=REASON)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    write_recording(tmp_path / "one.csv", EPISODE, {"pole": "medium"})
    write_mcap(tmp_path / "one.mcap", read_recording(tmp_path / "one.csv"), None)
    return tmp_path / "one.mcap"


def test_any_reader_finds_json_messages_with_a_schema(file: Path) -> None:
    with file.open("rb") as stream:
        messages = [*reader.make_reader(stream).iter_messages()]
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


def test_all_that_a_recording_holds_comes_back(tmp_path: Path) -> None:
    write_recording(tmp_path / "one.csv", FULL, {"pole": "", "cart": '{"latency": 0.1}'})
    write_mcap(tmp_path / "one.mcap", read_recording(tmp_path / "one.csv"), None)
    (name, episode, facts), _ = read_mcap(tmp_path / "one.mcap")
    write_recording(tmp_path / "again.csv", episode, facts)
    assert name == "one"
    assert (tmp_path / "again.csv").read_bytes() == (tmp_path / "one.csv").read_bytes()


def test_no_part_of_a_file_is_taken_for_the_whole(file: Path) -> None:
    whole = file.read_bytes()
    for length in range(0, len(whole), 37):
        file.write_bytes(whole[:length])
        with pytest.raises(RecordingError, match=r"one\.mcap") as raised:
            read_mcap(file)
        assert "\n" not in str(raised.value)


def test_files_of_others_are_named(tmp_path: Path) -> None:
    with (tmp_path / "other.mcap").open("wb") as stream:
        other = writer.Writer(stream)
        other.start()
        other.finish()
    with pytest.raises(RecordingError, match="give a file of cartpole-export format=mcap"):
        read_mcap(tmp_path / "other.mcap")
