#!/usr/bin/env python3
"""Compare the actions of an exported agent with those of PyTorch, on observations of whole episodes.

scripts/bench/export_parity.py pretrained/medium --observations 100000

drives randomized simulated carts by the agent and records its observations. For each format it prints how
many actions differ, the largest action value that such an action costs, and the processor time of an action.
The last row is PyTorch itself on single observations. Needs gcc.
"""

import ctypes
import math
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import torch
from common import option_parser, positive_int, print_table, write_json

from cartpole_rl.envs.build import simulated_env
from cartpole_rl.exporting.c_code import c_files
from cartpole_rl.exporting.onnx_model import onnx_model
from cartpole_rl.workflows.agents import TrainedAgent, trained_agent
from cartpole_rl.workflows.export import exported_agent, network_of

CARTS = 250
SEED = 1
Array = np.ndarray
Choose = Callable[[Array], int]  # the action of an observation [K]


@torch.no_grad()
def recorded(trained: TrainedAgent, count: int) -> tuple[Array, Array]:
    """Return `count` observations [M, K] of whole episodes, and their action values [M, A]."""
    training = trained.training
    env = simulated_env(training, training.plant, CARTS, training.task.evaluation_start, SEED)
    observations, values, current = [], [], env.reset()
    for _ in range(math.ceil(count / CARTS)):
        chosen = trained.policy(current.select("observation"))
        observations.append(current["observation"].numpy())
        values.append(chosen["action_value"].numpy())
        current = env.step_and_maybe_reset(current.set("action", chosen["action"]))[1]
    return np.ascontiguousarray(np.concatenate(observations)[:count]), np.concatenate(values)[:count]


def in_c(trained: TrainedAgent, folder: Path) -> Choose:
    """Return the compiled C code."""
    for name, text in c_files(exported_agent(trained, {}), trained.training).items():
        (folder / name).write_text(text)
    command = ["gcc", "-std=c99", "-O2", "-shared", "-fPIC", "-o", "policy.so", "policy.c", "-lm"]
    subprocess.run(command, cwd=folder, check=True)
    library = ctypes.CDLL(str(folder / "policy.so"))
    return lambda observation: library.policy_action(observation.ctypes.data_as(ctypes.c_void_p))


def in_onnx(trained: TrainedAgent, folder: Path) -> Choose:
    """Return the ONNX model, run by onnxruntime on one thread."""
    path = folder / "agent.onnx"
    path.write_bytes(onnx_model(exported_agent(trained, {}), network_of(trained)))
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(path, options)
    return lambda observation: int(session.run(["action"], {"observation": observation[None]})[0][0])


def in_pytorch(trained: TrainedAgent) -> Choose:
    """Return PyTorch's network on single observations: it rounds in another way than on many."""
    network = network_of(trained)
    return lambda observation: int(network(torch.from_numpy(observation[None])).argmax())


@torch.no_grad()
def compared(choose: Choose, observations: Array, values: Array) -> dict[str, Any]:
    """Return the figures of one format."""
    started = time.thread_time()
    actions = np.array([choose(observation) for observation in observations])
    seconds = time.thread_time() - started
    cost = values.max(1) - np.take_along_axis(values, actions[:, None], 1)[:, 0]
    return {
        "observations": len(values),
        "differ": int((actions != values.argmax(1)).sum()),
        "largest_cost": float(cost.max()),
        "us": 1e6 * seconds / len(values),
    }


def main() -> None:
    """Compare, print, write."""
    parser = option_parser(__doc__)
    parser.add_argument("run", type=Path, help="run folder, checkpoint, or pretrained/<name>")
    parser.add_argument("--observations", type=positive_int, default=100_000)
    options = parser.parse_args()
    torch.set_num_threads(1)
    trained = trained_agent(options.run)
    observations, values = recorded(trained, options.observations)
    with tempfile.TemporaryDirectory() as name:
        formats = {
            "c": in_c(trained, Path(name)),
            "onnx": in_onnx(trained, Path(name)),
            "PyTorch, one at a time": in_pytorch(trained),
        }
        figures = {form: compared(choose, observations, values) for form, choose in formats.items()}
    print_table(
        [
            {
                "format": form,
                "observations": str(found["observations"]),
                "actions that differ": str(found["differ"]),
                "largest cost": f"{found['largest_cost']:.1e}",
                "us per action": f"{found['us']:.0f}",
            }
            for form, found in figures.items()
        ]
    )
    write_json(options.json, figures)


if __name__ == "__main__":
    main()
