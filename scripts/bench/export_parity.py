#!/usr/bin/env python3
"""Compare the actions of exported agents with those of the host, on observations of whole episodes.

    scripts/bench/export_parity.py pretrained/medium runs/bench/medium/1[01] --processor

drives simulated carts, drawn as in the training, and emulated carts (truths.py) by each agent, as an
evaluation does, and records its observations, actions and encoder counts. Prints for each agent:

- how many actions of the C code, of the ONNX model and of PyTorch on single observations differ from those
  with which the host drove, the largest action value that such an action costs, and the time of an action;
- in how many episodes the C code chooses another motor value than the host did, from the counts alone: with
  its own perception, history and track guard;
- with `--processor`, the actions of the C code on a Cortex-M4 in QEMU, and the instructions of an action.

Needs gcc; `--processor` needs the programs of scripts/qemu/cart.py.
"""

import argparse
import ctypes
import struct
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import torch
from common import option_parser, positive_int, print_table, write_json
from tensordict import TensorDictBase
from truths import REPORTED, draw_truths

from cartpole_rl.emulator.c_firmware import firmware_folder
from cartpole_rl.envs.build import simulated_env
from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.evaluation.episodes import Policy, prepared, run_batch, warm_up
from cartpole_rl.exporting.c_code import c_files
from cartpole_rl.exporting.onnx_model import onnx_model
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.workflows.build import (
    TrainedAgent,
    evaluated_env,
    evaluated_settings,
    exported_agent,
    network_of,
    trained_agent,
)
from cartpole_rl.workflows.config import EvaluateConfig, load_settings

CARTS = 200  # simulated at once
SEED = 1
NANOSECONDS = 16  # of an instruction in QEMU, -icount shift=4
ROUNDINGS = 4  # of float32, by which equal action values may differ
TIMED = 1000  # choices that firmware/boards/qemu_policy times
MEMORY = 0x21000000  # where it finds the observations
LONGEST = 100_000  # observations that fit there
Array = np.ndarray
Choose = Callable[[Array], int]  # the action of an observation [K]


@dataclass
class Recording:
    """Episodes, and all observations [M, K] and action values [M, A] with which they were driven."""

    policy: Policy
    episodes: list[Episode] = field(default_factory=list)
    lengths: list[tuple[float, float]] = field(default_factory=list)  # end of the track and pole length, m
    observations: list[Array] = field(default_factory=list)
    values: list[Array] = field(default_factory=list)

    def __call__(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Act as the policy does, and record."""
        chosen = self.policy(tensordict)
        self.observations.append(tensordict["observation"].numpy().copy())
        self.values.append(chosen["action_value"].numpy().copy())
        return chosen

    def drive(self, env: CartPoleEnv) -> None:
        """Add an episode of each cart."""
        self.episodes += run_batch(env, self)
        ends, lengths = env.plant.track_half_length.tolist(), env.plant.pole_length.tolist()
        self.lengths += zip(ends, lengths, strict=True)

    @property
    def count(self) -> int:
        """Observations so far."""
        return sum(map(len, self.observations))

    def arrays(self, count: int) -> tuple[Array, Array]:
        """Return the first `count` observations, and their action values."""
        observations, values = (np.concatenate(each)[:count] for each in (self.observations, self.values))
        return np.ascontiguousarray(observations), values


@torch.no_grad()
def simulated(trained: TrainedAgent, count: int) -> Recording:
    """Drive simulated carts until there are `count` observations."""
    training, recording = trained.training, Recording(trained.policy)
    while recording.count < count:
        seed = SEED + len(recording.episodes)
        start = training.task.evaluation_start
        recording.drive(simulated_env(training, training.plant, CARTS, start, seed))
    return recording


def emulated(trained: TrainedAgent, run: Path, carts: int) -> Recording:
    """Drive each of `carts` emulated carts for an episode."""
    recording = Recording(trained.policy)
    for truth in draw_truths(REPORTED, carts):
        overrides = {f"emulator.{name}": value for name, value in truth.items()}
        config = load_settings(EvaluateConfig, {"run": str(run), "plant": "emulated", **overrides})
        settings = evaluated_settings(trained.training, config)
        with closing(evaluated_env(settings, config, prompt=print)) as env:
            recording.policy = prepared(env, trained.policy)
            warm_up(env, recording.policy)
            recording.drive(env)
    return recording


class CompiledPolicy:
    """The compiled C code."""

    def __init__(self, trained: TrainedAgent, folder: Path) -> None:
        for name, text in c_files(exported_agent(trained, {}), trained.training).items():
            (folder / name).write_text(text)
        command = ["gcc", "-std=c99", "-O2", "-shared", "-fPIC", "-o", "policy.so", "policy.c", "-lm"]
        subprocess.run(command, cwd=folder, check=True)
        self._library = ctypes.CDLL(str(folder / "policy.so"))
        self._library.policy_motor.restype = ctypes.c_int16
        self._memory = ctypes.create_string_buffer(4096)  # at least the size of a policy_t

    def __call__(self, observation: Array) -> int:
        """Return the action of an observation."""
        action: int = self._library.policy_action(observation.ctypes.data_as(ctypes.c_void_p))
        return action

    def agrees(self, episode: Episode, track_end: float, pole_length: float) -> bool:
        """Return True if the code returns the motor values of an episode from its counts."""
        self._library.policy_start(self._memory, ctypes.c_float(track_end), ctypes.c_float(pole_length))
        periods = np.diff(episode.time, prepend=0.0).round(5)  # simulated times are float32
        for counts, dt, motor in zip(episode.counts, periods, episode.motor, strict=False):
            pair = map(ctypes.c_int32, map(int, counts))
            if self._library.policy_motor(self._memory, *pair, ctypes.c_float(dt)) != motor:
                return False
        return True


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
def timed_actions(choose: Choose, observations: Array) -> tuple[Array, float]:
    """Return the actions, and us per action."""
    started = time.thread_time()
    actions = np.array([choose(observation) for observation in observations])
    return actions, 1e6 * (time.thread_time() - started) / len(observations)


def on_processor(folder: Path, observations: Array) -> tuple[Array, float]:
    """Return the actions of the C code in `folder` on a Cortex-M4, and instructions per action."""
    make = ["make", "-C", str(firmware_folder()), f"BUILD={folder}", f"POLICY={folder}", "qemu_policy"]
    subprocess.run(make, check=True, stdout=subprocess.DEVNULL)
    memory = struct.pack("<I12x", len(observations)) + observations.astype("<f4").tobytes()
    (folder / "memory.bin").write_bytes(memory)
    command = ["qemu-system-arm", "-machine", "mps2-an386", "-display", "none", "-monitor", "none"]
    command += ["-icount", "shift=4,sleep=off", "-serial", "stdio", "-kernel", "qemu_policy-policy.elf"]
    command += ["-device", f"loader,file=memory.bin,addr={MEMORY:#x},force-raw=on"]
    with subprocess.Popen(command, cwd=folder, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE) as qemu:
        assert qemu.stdout is not None
        try:
            answer = qemu.stdout.read(4 + len(observations))
        finally:
            qemu.kill()
    actions = np.frombuffer(answer, np.uint8, offset=4)
    return actions, int.from_bytes(answer[:4], "little") * 1000 / NANOSECONDS / TIMED


def row(name: str, actions: Array, values: Array) -> dict[str, Any]:
    """Return how many actions differ from the best ones by `values`, and the largest cost of one.

    Another order of the sums changes a value by a few roundings, and decides between equally good actions.
    """
    cost = values.max(1) - np.take_along_axis(values, actions[:, None].astype(np.int64), 1)[:, 0]
    return {
        "of": name,
        "observations": len(values),
        "differ": int((actions != values.argmax(1)).sum()),
        "beyond rounding": int((cost > ROUNDINGS * np.spacing(values.max(1))).sum()),
        "largest cost": f"{cost.max():.1e}",
    }


def compared(
    trained: TrainedAgent, recordings: dict[str, Recording], options: argparse.Namespace
) -> Iterator[dict[str, Any]]:
    """Yield a row of figures for each plant and each program."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        in_c = CompiledPolicy(trained, folder)
        programs: dict[str, Choose] = {"C": in_c, "ONNX": in_onnx(trained, folder)}
        programs["PyTorch, one at a time"] = in_pytorch(trained)
        for plant, recording in recordings.items():
            observations, values = recording.arrays(options.observations)
            for program, choose in programs.items():
                actions, us = timed_actions(choose, observations)
                yield {"plant": plant, **row(program, actions, values), "cost of an action": f"{us:.0f} us"}
            pairs = zip(recording.episodes, recording.lengths, strict=True)
            agree = [in_c.agrees(episode, *lengths) for episode, lengths in pairs]
            yield {
                "plant": plant,
                "of": "C, from counts",
                "episodes": len(agree),
                "differ": agree.count(False),
            }
            if options.processor:
                chosen, instructions = on_processor(folder, observations[:LONGEST])
                figures = row("C on a Cortex-M4", chosen, values[:LONGEST])
                yield {"plant": plant, **figures, "cost of an action": f"{instructions:.0f} instructions"}


def main() -> None:
    """Compare, print, write."""
    parser = option_parser(__doc__)
    parser.add_argument("runs", nargs="+", type=Path, help="run folder, checkpoint, or pretrained/<name>")
    parser.add_argument("--observations", type=positive_int, default=100_000, help="of each plant, at most")
    parser.add_argument("--emulated", type=int, default=20, help="emulated carts (20)")
    parser.add_argument("--processor", action="store_true", help="also on a Cortex-M4 in QEMU")
    options = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    for run in options.runs:
        trained = trained_agent(run)
        recordings = {"simulated": simulated(trained, options.observations)}
        if options.emulated:
            recordings["emulated"] = emulated(trained, run, options.emulated)
        rows += [{"agent": str(run), **each} for each in compared(trained, recordings, options)]
        print_table([{**dict.fromkeys(rows[0]), **{"episodes": None}, **each} for each in rows])
    write_json(options.json, rows)


if __name__ == "__main__":
    main()
