"""The recordings that a folder holds, and what a run knows of the runs that it needs."""

from pathlib import Path

import pytest
from worker import write_inputs

from cartpole_rl.errors import RecordingError
from cartpole_rl.run_folder import experiments, is_outdated, recordings, write_config


def write(folder: Path, *names: str) -> list[Path]:
    folder.mkdir(exist_ok=True)
    for name in names:
        (folder / name).write_text("")
    return [folder / name for name in names]


def test_a_folder_gives_its_recordings_in_order(tmp_path: Path) -> None:
    last, first = write(tmp_path, "b.csv", "a.csv")
    write(tmp_path, "notes.txt")
    assert recordings(tmp_path) == [first, last]


def test_experiments_have_the_names_of_their_files_without_the_number(tmp_path: Path) -> None:
    swing, plain = write(tmp_path, "01_long_swing.csv", "plain.csv")
    assert experiments(tmp_path) == {"long_swing": swing, "plain": plain}


def test_no_recording_takes_the_name_of_another(tmp_path: Path) -> None:
    paths = write(tmp_path, "01_a.csv", "02_a.csv", "05_01_a.csv", "07_b.csv", "b.csv")
    assert experiments(tmp_path) == {path.stem: path for path in paths}


@pytest.mark.parametrize(
    ("name", "missing"), [(".", "it contains no recording"), ("none", "there is no such file or folder")]
)
def test_a_source_without_recordings_is_refused(tmp_path: Path, name: str, missing: str) -> None:
    with pytest.raises(RecordingError, match=f"{missing}; give a run of cartpole-record"):
        recordings(tmp_path / name)


def test_an_identification_of_others_recordings_names_them(tmp_path: Path) -> None:
    write_config(tmp_path, "identify", {"from": "runs/import/a", "seed": 0})
    with pytest.raises(
        RecordingError, match=r"it contains no recording; it read those of from=runs/import/a$"
    ):
        recordings(tmp_path)


@pytest.mark.parametrize("result", ["identification.json", "model.json", "checkpoints/last.pt"])
def test_a_need_that_was_made_again_outdates_it(result: str, tmp_path: Path) -> None:
    run, need, moved = tmp_path / "agents/ours/10", tmp_path / "carts/stand_in/10", tmp_path / "moved"
    run.mkdir(parents=True)
    (need / result).parent.mkdir(parents=True)
    (need / result).write_text("3.1")
    assert not is_outdated(run)  # nothing is known of a run without the file
    write_inputs(run, [need])
    assert not is_outdated(run)
    (need / result).write_text("3.2")
    assert is_outdated(run)
    need.rename(moved)  # as where one study was copied without the others
    assert not is_outdated(run)
