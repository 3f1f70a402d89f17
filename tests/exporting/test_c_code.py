"""The exported C compiles without a warning and chooses the motor values of the host."""

import ctypes
import math
import re
import shutil
import subprocess
from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from parity import assert_same_actions

from cartpole_rl.emulator.c_firmware import CFirmware
from cartpole_rl.envs.build import simulated_env
from cartpole_rl.evaluation.episodes import Policy, choose
from cartpole_rl.exporting.agent import ExportedAgent, Floats
from cartpole_rl.exporting.c_code import c_files
from cartpole_rl.plants.specs import tensordict_of
from cartpole_rl.workflows.build import TrainedAgent, exported_agent, new_agent
from cartpole_rl.workflows.config import TrainConfig, load_settings

FLAGS = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Wconversion", "-Wpedantic", "-Wdouble-promotion", "-Werror")
SIZE = '#include "policy.h"\n#include <stddef.h>\nsize_t policy_size(void);\n'
SIZE += "size_t policy_size(void)\n{\n    return sizeof(policy_t);\n}\n"
WITHOUT_POLE = {"margin": 0.02, "delay": 0.1, "deceleration": 6.0}
TWO_GUARDS = {**WITHOUT_POLE, "pole": {"swing": 0.9, "density": 0.5, "length": 0.36}, "also": WITHOUT_POLE}
AGENTS: dict[str, dict[str, Any]] = {
    "raw": {"observation": "raw", "agent.hidden": [], "agent.mirrored": False, "guard": "none"},
    "positions": {"observation": "positions", "agent.hidden": [8], "agent.mirrored": True},
    "length": {"observation": "history_length", "pole": "range", "agent.hidden": [8, 6, 4]},
    "plain": {
        "agent.hidden": [8, 6],
        "agent.layer_norm": False,
        "actions": "two",
        "guard.numbers": TWO_GUARDS,
    },
}

pytestmark = pytest.mark.skipif(shutil.which("gcc") is None, reason="gcc is missing: install a C compiler")


def validated(files: Mapping[str, str], folder: Path) -> subprocess.CompletedProcess[str]:
    """Write the files, and let the compiler check policy.c without compiling it."""
    for name, text in files.items():
        (folder / name).write_text(text)
    words = ["gcc", *FLAGS, "-fsyntax-only", "policy.c"]
    return subprocess.run(words, cwd=folder, capture_output=True, text=True)


def untrained(**overrides: Any) -> TrainedAgent:
    """An agent with random weights, also in its layer normalization."""
    training = load_settings(TrainConfig, {**overrides, "compile": False})
    agent = new_agent(training)
    torch.manual_seed(1)
    with torch.no_grad():
        for weight in agent.parameters():
            weight.add_(0.3 * torch.randn_like(weight))
    return TrainedAgent(training, agent.greedy_policy())


class Compiled:
    """The library of an exported agent, with one cart."""

    def __init__(self, files: Mapping[str, str], folder: Path) -> None:
        self.folder, self.header = folder, files["policy.h"]
        for name, text in {**files, "size.c": SIZE}.items():
            (folder / name).write_text(text)
        words = ["gcc", *FLAGS, "-shared", "-fPIC", "-o", "policy.so", "policy.c", "size.c", "-lm"]
        done = subprocess.run(words, cwd=folder, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        self.library = ctypes.CDLL(str(folder / "policy.so"))
        self.library.policy_size.restype = ctypes.c_size_t
        self.library.policy_motor.restype = ctypes.c_int16
        self.memory = ctypes.create_string_buffer(self.library.policy_size())

    def action(self, observation: Floats) -> int:
        return self.library.policy_action(observation.ctypes.data_as(ctypes.c_void_p))

    def start(self, track_end: float, pole_length: float) -> None:
        self.library.policy_start(self.memory, ctypes.c_float(track_end), ctypes.c_float(pole_length))

    def resume(self) -> None:
        self.library.policy_resume(self.memory)

    def drove(self, motor: int) -> None:
        self.library.policy_drove(self.memory, ctypes.c_int16(motor))

    def motor(self, counts: tuple[int, int], dt: float) -> int:
        return self.library.policy_motor(self.memory, *map(ctypes.c_int32, counts), ctypes.c_float(dt))


@pytest.fixture(scope="module")
def compiled(
    exported: ExportedAgent, medium_agent: TrainedAgent, tmp_path_factory: pytest.TempPathFactory
) -> Compiled:
    return Compiled(c_files(exported, medium_agent.training), tmp_path_factory.mktemp("c"))


def test_actions_are_those_of_the_host(compiled: Compiled, observed: tuple[Floats, Floats]) -> None:
    observations, values = observed
    assert_same_actions(np.array([compiled.action(each) for each in observations]), values)


def check_motors(training: TrainConfig, policy: Policy, compiled: Compiled, periods: int) -> None:
    """Drive a random cart by the host; check that the C code returns the motor values that are sent."""
    env = simulated_env(training, training.plant, 1, training.task.start, seed=3)
    cart, sent = env.one_cart, set()
    for _ in range(3):
        observation = cart.reset().observation
        compiled.start(float(env.plant.track_half_length), float(env.plant.pole_length))
        for period in range(periods):
            present = tensordict_of({"observation": torch.from_numpy(np.array([observation], np.float32))})
            action = int(choose(policy, present))
            motor, found = cart.sent_motor(action), compiled.motor(cart.frame.counts, cart.frame.dt[0])
            if found != motor:  # either is right, and the two remember different motor values
                values = policy(present)["action_value"].numpy()
                assert_same_actions(np.array([training.actions.motors.index(found)]), values)
                break
            sent.add(motor)
            if period % 7 == 6:  # a limit of the track replaces the value
                compiled.drove(-motor)
                step = cart.advance(-motor, env.plant.step_one(-motor))
            else:
                step = cart.step(action)
            observation = step.observation
            if step.done[0]:
                break
    assert len(sent) > 1


@torch.no_grad()
def test_motor_values_are_those_of_the_host(compiled: Compiled, medium_agent: TrainedAgent) -> None:
    check_motors(medium_agent.training, medium_agent.policy, compiled, 300)


@torch.no_grad()
@pytest.mark.parametrize("name", AGENTS)
def test_so_they_are_for_every_observation_and_network(name: str, tmp_path: Path) -> None:
    trained = untrained(**AGENTS[name])
    exported = exported_agent(trained, {})
    compiled = Compiled(c_files(exported, trained.training), tmp_path)
    check_motors(trained.training, trained.policy, compiled, 200)
    observes = int(trained.training.observation.pole_length)
    assert f"#define POLICY_OBSERVES_LENGTH {observes}" in compiled.header
    assert_figures(exported, compiled)
    if observes:
        assert_lengths(compiled, trained.training)
        assert_identity_with_length(exported, tmp_path)
    if name == "plain":
        assert_overflow_is_no_action(exported, trained.training, tmp_path / "overflow")


def assert_identity_with_length(exported: ExportedAgent, folder: Path) -> None:
    """A board that was compiled for another length is told apart."""
    boards = [CFirmware(lambda: 0, policy=folder, pole_length=length) for length in (0.3556, 0.66)]
    reported = [board._head.policy_identity for board in boards]
    assert reported == [exported.identity_with(0.3556), exported.identity_with(0.66)]
    assert len({*reported, exported.identity}) == 3


def assert_lengths(compiled: Compiled, training: TrainConfig) -> None:
    """A length that no pole has keeps the motor at 0."""
    for length in (0.0, -1.0, 355.6, math.nan, math.inf):
        compiled.start(0.38, length)
        assert [compiled.motor((0, 2048), 0.02) for _ in range(3)] == [0, 0, 0]
        compiled.resume()
        assert compiled.motor((0, 2048), 0.02) == 0
    compiled.start(0.38, 0.3556)
    assert compiled.motor((0, 2048), 0.02) in training.actions.motors
    assert "above 0 and at most 3" in compiled.header


def assert_overflow_is_no_action(exported: ExportedAgent, training: TrainConfig, folder: Path) -> None:
    """A unit that is not finite reaches the action values."""
    first = exported.layers[0]
    layer = first._replace(weight=np.full_like(first.weight, 3e38))
    folder.mkdir()
    compiled = Compiled(c_files(replace(exported, layers=(layer, *exported.layers[1:])), training), folder)
    assert compiled.action(np.array([2, -2] * 5, np.float32)) == -1  # infinity minus infinity


def assert_figures(exported: ExportedAgent, compiled: Compiled) -> None:
    comment = compiled.header.split("*/")[0]
    tables = re.findall(r"static const float \w+\[(\d+)\]", (compiled.folder / "policy.c").read_text())
    motors = 2 * (len(exported.description.motors) + 2)
    products = sum(inputs * outputs for inputs, outputs in pairwise(exported.description.sizes))
    assert f"{len(compiled.memory)} bytes for each cart" in comment
    assert f"{4 * sum(map(int, tables)) + motors} bytes of tables" in comment
    assert f"{products} multiply-adds" in comment
    assert exported.checksum in comment


@pytest.fixture(scope="module")
def small() -> Callable[..., dict[str, str]]:
    """The C files of a small agent, which is exported and compiled at once, with another description."""
    trained = untrained(**AGENTS["plain"])
    exported = exported_agent(trained, {})

    def build(command: str, **changes: Any) -> dict[str, str]:
        changes = {"provenance": {"command": [command]}, **changes}
        about = exported.description.model_copy(update=changes)
        return c_files(replace(exported, description=about), trained.training)

    return build


@pytest.mark.parametrize("origin", ["*/ int x; /*", "a ??/\nb\\"])
def test_no_origin_leaves_the_comment(origin: str, small: Callable, tmp_path: Path) -> None:
    files = small(origin)
    done = validated(files, tmp_path)
    assert done.returncode == 0, done.stderr
    first, second = files["policy.h"].split("*/")[0].splitlines()[-3:-1]
    assert first.startswith(' * Training: "')
    assert second.startswith(" * SHA-256: ")


def test_files_of_two_exports_compile_only_if_the_agent_is_the_same(small: Callable, tmp_path: Path) -> None:
    files = small("first")
    for other, fits in ((small("first", angle_limit=1.0), False), (small("second"), True)):
        assert other["policy.h"] != files["policy.h"]
        done = validated({**files, "policy.h": other["policy.h"]}, tmp_path)
        assert (done.returncode == 0) == fits
        assert ("policy.h is of another export than policy.c" in done.stderr) != fits


def test_after_a_bad_number_the_motor_stays_at_0(compiled: Compiled) -> None:
    for dt in (0.0, -0.02, math.nan, math.inf):
        compiled.start(0.38, 0.36)
        assert compiled.motor((0, 2048), 0.0) != 0  # the first period reads no dt
        assert compiled.motor((2000, 2048), dt) == 0
        assert compiled.motor((2000, 2048), 0.02) == 0
        compiled.resume()
        assert compiled.motor((2000, 2048), 0.02) == 0
    for end in (math.nan, 0.0, math.inf):
        compiled.start(end, 0.36)
        assert compiled.motor((0, 2048), 0.0) == 0
    assert compiled.action(np.array([math.inf] * 10, np.float32)) == -1
    assert compiled.action(np.array([math.nan] * 10, np.float32)) == -1
    compiled.start(0.38, 0.36)
    assert compiled.motor((0, 2048), 0.0) != 0


def test_the_motor_stays_at_0_once_the_pole_fell(tmp_path: Path) -> None:
    trained = untrained(**AGENTS["plain"], task="balance")
    compiled = Compiled(c_files(exported_agent(trained, {}), trained.training), tmp_path)
    for sign in (1, -1):  # 100 counts are 8.8 degrees, 140 are 12.3
        compiled.start(0.38, 0.36)
        assert compiled.motor((0, sign * 100), 0.0) != 0
        assert compiled.motor((0, sign * 140), 0.02) == 0
        assert compiled.motor((0, 0), 0.02) == 0
        compiled.resume()
        assert compiled.motor((0, 0), 0.02) == 0
    compiled.start(0.38, 0.36)
    assert compiled.motor((0, 2048), 0.0) == 0
    assert "#define POLICY_STARTS_UPRIGHT 1" in compiled.header


def test_a_resumed_policy_forgets_what_it_observed(compiled: Compiled) -> None:
    """After a gap the next counts are the first: no velocity is computed over it."""
    memories = []
    for resumed in (False, True):
        compiled.start(0.38, 0.36)
        if resumed:
            for cart in (0, 500, 900):
                compiled.motor((cart, 2048), 0.02)
            compiled.resume()
        compiled.motor((5000, 1000), 0.02)
        memories.append(bytes(compiled.memory))
    assert memories[0] == memories[1]


def test_without_a_start_the_motor_stays_at_0(compiled: Compiled) -> None:
    ctypes.memset(compiled.memory, 0, len(compiled.memory))
    assert [compiled.motor((0, 2048), 0.02) for _ in range(3)] == [0, 0, 0]


def test_options_that_remove_the_checks_are_refused(compiled: Compiled) -> None:
    for option in ("-Ofast", "-ffast-math", "-ffinite-math-only"):
        words = ["gcc", option, "-fsyntax-only", str(compiled.folder / "policy.c")]
        done = subprocess.run(words, capture_output=True, text=True)
        assert done.returncode != 0
        assert "they remove the checks for finite numbers" in done.stderr


def test_the_guard_brakes_a_fast_cart(compiled: Compiled) -> None:
    for side in (1, -1):
        compiled.start(0.38, 0.36)
        compiled.motor((side * 13_000, 2048), 0.0)
        assert compiled.motor((side * 14_000, 2048), 0.02) == -side * 250  # 1.1 m/s outward at 0.32 m
