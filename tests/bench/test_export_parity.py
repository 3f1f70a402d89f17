"""The comparison of exported agents with the host counts what differs."""

import json
import shutil
from pathlib import Path

import export_parity
import numpy as np
import pytest
from bench_scripts import Run

pytest.importorskip("onnxscript", reason='onnxscript is missing: pip install "cartpole_rl[export]"')
PROCESSOR = ("qemu-system-arm", "arm-none-eabi-gcc", "make")
needs_gcc = pytest.mark.skipif(shutil.which("gcc") is None, reason="gcc is missing: install a C compiler")


@needs_gcc
def test_all_figures_are_there(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(export_parity, "CARTS", 2)
    processor = ["--processor"] if all(map(shutil.which, PROCESSOR)) else []
    words = (
        "pretrained/medium",
        "--observations",
        "300",
        "--emulated",
        "0",
        *processor,
        "--json",
        "parity.json",
    )
    run(export_parity, tmp_path, *words)
    rows = {row["of"]: row for row in json.loads((tmp_path / "parity.json").read_text())}
    assert set(rows) >= {"C", "ONNX", "PyTorch, one at a time", "C, from counts"}
    for name, row in rows.items():
        if name == "C, from counts":
            assert (row["episodes"], row["differ"]) == (2, 0)
        else:
            assert row["observations"] == 300
            assert row["beyond rounding"] == 0
    if processor:
        assert rows["C on a Cortex-M4"]["differ"] == rows["C"]["differ"]
        assert rows["C on a Cortex-M4"]["cost of an action"].endswith(" instructions")


def test_a_wrong_action_counts() -> None:
    values = np.array(
        [[1.0, 2.0], [3.0, np.float32(3.0) + np.spacing(np.float32(3.0))], [5.0, 4.0]], np.float32
    )
    found = export_parity.row("x", np.array([0, 0, 0]), values)
    assert (found["differ"], found["beyond rounding"]) == (2, 1)
