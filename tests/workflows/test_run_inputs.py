"""A run knows what the runs that it needs had found when it started."""

from pathlib import Path

import pytest

from cartpole_rl.run_folder import is_outdated, write_inputs


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
