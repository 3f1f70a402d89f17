"""Follows one path of docs/extending.md in the copy of the package that PYTHONPATH names.

    python extended_package.py <number of the path> <folder of the copy>

Runs the page's commands with a tiny budget, then its checks, then looks for the effect of the new thing in
the runs, in an environment or in the emulated cart.
"""

import contextlib
import io
import json
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))
from command_line import ONCE, TINY, in_process
from extending_page import paths, printed

import cartpole_rl
from cartpole_rl.emulator.settings import EmulatorSettings

Runs = list[Path]  # a folder for each command


def run_command(line: str, folder: Path, number: int, runs: Runs) -> Path:
    """Run one command of the page in this process; return its run folder."""
    program, *words = line.split()
    command = program.removeprefix("cartpole-")
    trained = next((str(run) for run in reversed(runs) if "train" in run.name), "no training yet")
    run = folder / f"{number}_{command}"
    place = [] if command == "preflight" else [f"hydra.run.dir={run}"]
    budget = (*TINY, ONCE) if command == "train" else ()
    words = [word.replace("<run>", trained) for word in words]
    done = in_process(command, *words, *budget, *place, folder=folder)
    assert done.code == 0, f"{line}\n{done.out}{done.err}"
    return run


def run_check(code: str) -> None:
    """Run a check of the page, which prints what the page says."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        exec(compile(code, "docs/extending.md", "exec"), {"__name__": "check"})
    shown, expected = out.getvalue().splitlines(), printed(code)
    assert shown == expected != [], f"{shown}, not {expected}"


def metrics(run: Path) -> dict[str, Any]:
    return json.loads((run / "metrics.json").read_text())


def course(**chosen: str) -> Any:
    """Twenty steps of 16 simulated carts under random actions, [16, 20], and the environment."""
    import torch

    from cartpole_rl.envs.build import simulated_env
    from cartpole_rl.workflows.config import TrainConfig, load_settings

    torch.manual_seed(0)
    config = load_settings(TrainConfig, chosen)
    env = simulated_env(config, config.plant, 16, config.task.start, seed=0)
    return env.rollout(20, break_when_any_done=False)["next"], env


def friction_changes_the_motion(runs: Runs) -> None:
    trained, step, smooth, exported = runs
    assert metrics(step)["episodes"] != metrics(smooth)["episodes"]
    assert "model: my_laws:smooth_stribeck" in (trained / "config.yaml").read_text()
    assert any(exported.rglob("*.c"))
    chosen = ("stribeck", "smooth_stribeck.yaml")
    rollouts = [course(cart_friction=name)[0] for name in chosen]
    assert (rollouts[0]["state"] - rollouts[1]["state"]).abs().max() > 0.001


def reward_is_the_formula(runs: Runs) -> None:
    rollout, _ = course(reward="gaussian", task="balance")
    x, theta = rollout["state"][..., 0], rollout["state"][..., 2]
    expected = 0.5 * (-0.5 * (theta / math.radians(10)) ** 2).exp() - 0.1 * (x / 0.38) ** 2
    assert not rollout["terminated"].all()
    driven = ~rollout["terminated"].squeeze(-1)
    assert (rollout["reward"].squeeze(-1) - expected)[driven].abs().max() < 1e-5
    assert expected[driven].max() - expected[driven].min() > 0.1


def pole_swings_as_long_as_it_is(runs: Runs) -> None:
    from cartpole_rl.choices import choice
    from cartpole_rl.emulator.physics import CartPhysics

    _, env = course(pole="carbon")
    assert env.plant.pole_length.tolist() == [0.5] * 16
    assert metrics(runs[1])["plant"] == "emulated"
    truth = {key: value for key, value in choice("emulator/carbon").items() if key != "defaults"}
    free = dict.fromkeys(("pole_viscous", "pole_coulomb", "pole_drag", "track_tilt"), 0.0)
    physics = CartPhysics(EmulatorSettings(**truth, **free, cart_mass=1000.0))
    physics.place(0.0, math.pi + 0.05)
    seconds = 0.0
    while physics.angle > math.pi:  # a quarter of a swing
        physics.advance(0, 0.001)
        seconds += 0.001
    assert abs(4 * seconds - 1.158) < 0.01


def counts_are_metres(runs: Runs) -> None:
    _, env = course(cart="lab", randomization="none")
    counts, true = env.plant.rollout(1)["next", "counts"][:, 0], env.plant.true_state
    x_count, theta_count = 2 * math.pi * 0.01 / 4096, 2 * math.pi / 2000
    assert (counts[:, 0] * x_count - true.x).abs().max() < x_count  # 15.340 um is rounded
    assert (counts[:, 1] * theta_count - true.theta).abs().max() < theta_count


def agent_sees_the_energy(runs: Runs) -> None:
    from cartpole_rl.agents.baseline import decode
    from cartpole_rl.tasks.features import ObservationKind

    usual, _ = course(observation="history")
    rollout, _ = course(observation="energy")
    seen, state = rollout["observation"], rollout["state"]
    assert seen.shape[-1] == usual["observation"].shape[-1] + 1
    energy = 0.5 * (0.1534 * state[..., 3]) ** 2 + state[..., 2].cos() - 1
    assert (seen[..., 5] - energy).abs().max() < 1e-5
    assert energy.max() - energy.min() > 0.1
    (theta_dot,), (motor,) = decode(seen[:1, 5], ObservationKind("energy"))[0][3], seen[:1, 5, 6] * 255
    assert abs(theta_dot - state[0, 5, 3]) < 1e-5
    assert decode(seen[:1, 5], ObservationKind("energy"))[1] == motor


def message_survives_the_wire(runs: Runs) -> None:
    from cartpole_rl.emulator.firmware import Firmware
    from cartpole_rl.wire.frames import decode_frame, encode_frame
    from cartpole_rl.wire.messages import Battery, GetBattery, Nack, Reason

    for message in (GetBattery(), Battery(11_900), Battery(65_535)):
        assert decode_frame(encode_frame(message, 7)[:-1]).message == message
    firmware = Firmware(lambda: 0)
    (answer,) = firmware.receive(encode_frame(GetBattery(), 1)[:-1], 0)
    assert decode_frame(answer[:-1]).message == Battery(11_900)
    (answer,) = firmware.receive(encode_frame(Battery(1), 2)[:-1], 0)
    assert decode_frame(answer[:-1]).message == Nack(2, Battery.TYPE, Reason.UNKNOWN_TYPE)


EFFECTS: dict[int, Callable[[Runs], None]] = {
    1: friction_changes_the_motion,
    2: reward_is_the_formula,
    3: pole_swings_as_long_as_it_is,
    4: counts_are_metres,
    5: agent_sees_the_energy,
    6: message_survives_the_wire,
}


def main(number: int, folder: Path) -> None:
    assert Path(cartpole_rl.__file__).is_relative_to(folder), cartpole_rl.__file__
    path, runs = paths()[number], []
    for line in path.commands:
        runs.append(run_command(line, folder, len(runs), runs))
    for code in path.checks:
        run_check(code)
    EFFECTS[number](runs)


if __name__ == "__main__":
    main(int(sys.argv[1]), Path(sys.argv[2]))
