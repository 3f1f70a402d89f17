"""JavaScript and C compute what PyTorch computes, also for NaN, infinities, zeros and halves."""

import ctypes
import json
import math
import shutil
import subprocess
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch
from browser import BROWSER, BROWSERS, in_browser
from operations import OPERATIONS, PAIRS
from torch import Tensor

from cartpole_rl.arithmetic.languages import C99, JAVASCRIPT
from cartpole_rl.arithmetic.writer import Writer
from cartpole_rl.exporting.code import Graph, filled
from cartpole_rl.exporting.web_page import function

NOT_IN_C = {5, 14, 25, 26}  # remainders, and conversions of infinite numbers to integers


class Pair(NamedTuple):
    a: Tensor
    b: Tensor


class Result(NamedTuple):
    value: Tensor


def operation(number: int, dtype: torch.dtype) -> Graph:
    """Return the graph of an operation."""
    operand = torch.zeros(1, dtype=dtype)
    return Graph.of(lambda pair: Result(OPERATIONS[number](*pair)), Pair(operand, operand.clone()))


def expected(number: int, dtype: torch.dtype) -> np.ndarray:
    """Return the results of PyTorch for all pairs."""
    a, b = torch.tensor(PAIRS, dtype=dtype).unbind(1)
    return OPERATIONS[number](a, b).double().numpy()


@pytest.mark.skipif(BROWSER is None, reason=f"none of {', '.join(BROWSERS)} is installed")
def test_javascript_behaves_as_pytorch(tmp_path: Path) -> None:
    functions = [
        function(f"operation{number}", operation(number, torch.float64)) for number in range(len(OPERATIONS))
    ]
    pairs = ", ".join(f"[{JAVASCRIPT.literal(a)}, {JAVASCRIPT.literal(b)}]" for a, b in PAIRS)
    names = ", ".join(f"operation{number}" for number in range(len(OPERATIONS)))
    script = f"""{filled("arithmetic.js", {})}{"".join(functions)}
    const text = (operation, [a, b]) => String(Number(operation([a], [b]).value[0]));
    const results = [{names}].map((operation) => [{pairs}].map((pair) => text(operation, pair)));
    document.body.textContent = JSON.stringify(results);"""
    found = in_browser("<!DOCTYPE html><html><body></body></html>", script, tmp_path)
    for number, results in enumerate(found):
        numbers = [float(result.replace("Infinity", "inf")) for result in results]
        right = expected(number, torch.float64)
        assert numbers == pytest.approx(right, rel=1e-9, abs=1e-9, nan_ok=True), number


@pytest.mark.skipif(shutil.which("gcc") is None, reason="gcc is missing: install a C compiler")
def test_c_behaves_as_pytorch(tmp_path: Path) -> None:
    supported = [number for number in range(len(OPERATIONS)) if number not in NOT_IN_C]
    text = "#include <math.h>\n#include <stdbool.h>\n#include <stdint.h>\n" + "".join(
        filled(f"{name}.c", {}) for name in ("clamped", "sign")
    )
    text += "".join(map(in_c, supported))
    (tmp_path / "operations.c").write_text(text)
    words = ["-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror", "-shared", "-fPIC"]
    command = ["gcc", *words, "-o", "operations.so", "operations.c", "-lm"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    library = ctypes.CDLL(str(tmp_path / "operations.so"))
    for number in supported:
        compute = getattr(library, f"operation{number}")
        compute.restype = ctypes.c_float
        found = [compute(ctypes.c_float(a), ctypes.c_float(b)) for a, b in PAIRS]
        right = expected(number, torch.float32)
        assert found == pytest.approx(right, rel=1e-5, abs=1e-6, nan_ok=True), number


def in_c(number: int) -> str:
    """Return an operation as a C function."""
    graph, writer = operation(number, torch.float32), Writer(C99)
    inputs = [writer.variables(name, example) for name, example in graph.inputs.items()]
    results = writer.write(graph.trace, inputs)
    lines = "".join(f"    {line}\n" for line in writer.statements(results))
    (result,) = results[0].reshape(-1)
    unused = "    (void)a;\n    (void)b;\n"
    head = f"float operation{number}(float a, float b)"
    return f"{head};\n{head}\n{{\n{unused}{lines}    return (float){result};\n}}\n"


def test_what_c_cannot_write_is_named() -> None:
    for number in NOT_IN_C:
        with pytest.raises(NotImplementedError, match="cannot be written as plain arithmetic"):
            in_c(number)


def test_literals_are_exact() -> None:
    for value in (0.1, -3.0, 1e-30, 5):
        assert float(C99.literal(value).strip("()f")) == value
        assert json.loads(JAVASCRIPT.literal(value).strip("()")) == value
    assert [C99.literal(value) for value in (math.inf, -math.inf)] == ["INFINITY", "(-INFINITY)"]
    assert C99.literal(math.nan) == "NAN"
