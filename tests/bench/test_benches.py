"""One smoke test of each bench script: it runs, and its figures are what they say; how fast is not tested."""

import argparse
import json
import math
import shutil
from pathlib import Path
from types import ModuleType
from typing import Any

import adaptation
import distillation
import export_parity
import fine_tuning
import learning
import next_state
import numpy as np
import pytest
import real
import reference
import reports
import safety
import toolbox
import torch
import truth_references
import zero_shot
from bench_scripts import TINY, Run
from best_score.cart import KnownCart
from common import REFERENCES, failure, run_once
from tensordict import TensorDict
from truths import REPORTED, draw_truths, simulated_cart

from cartpole_rl.choices import choice
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.evaluation.recordings import read_recording
from cartpole_rl.identification.windows import Windows, history_periods
from cartpole_rl.plants.settings import SimulatedSettings
from cartpole_rl.randomization.ranges import Range
from cartpole_rl.run_folder import file_hash, recordings
from cartpole_rl.tasks.rewards import UPRIGHT_ANGLE
from cartpole_rl.workflows.build import simulated_env
from cartpole_rl.workflows.config import TrainConfig, load_settings

pytestmark = pytest.mark.nightly

PROCESSOR = ("qemu-system-arm", "arm-none-eabi-gcc", "make")


def figures(run: Run, script: ModuleType, folder: Path, *words: str) -> Any:
    """Run a script in a folder, and return the JSON that it writes."""
    run(script, folder, *words, "--json", "figures.json")
    return json.loads((folder / "figures.json").read_text())


def test_learning_is_judged_by_the_last_checkpoint(trained: Path, run: Run, monkeypatch: Any) -> None:
    seed = json.loads((trained / "learning.json").read_text())["medium"]["10"]
    found = seed["plants"]["medium"]
    assert found["fraction"] == pytest.approx(
        found["score"] / json.loads(REFERENCES.read_text())["medium"]["score"]
    )
    assert found["worst_start"] <= found["score"] < 1500  # hardly trained
    monkeypatch.setattr(learning, "DRAWN_CARTS", 10)
    checkpoint = trained / "runs/bench/medium/10/checkpoints/last.pt"
    before = checkpoint.stat().st_mtime_ns
    run(learning, trained, "medium", "--seeds", "1", *TINY)
    assert checkpoint.stat().st_mtime_ns == before
    with pytest.raises(SystemExit, match="10 was made with other settings than"):
        run(learning, trained, "medium", "--seeds", "1", *TINY, "agent.action_gap=0.8")


def test_an_evaluation_of_an_earlier_agent_is_refused(tmp_path: Path) -> None:
    (tmp_path / "agent.pt").write_bytes(b"trained again")
    (tmp_path / "metrics.json").touch()
    words = f"run={tmp_path / 'agent.pt'}", f"hydra.run.dir={tmp_path}"
    made = {"command": ["cartpole-evaluate", *words], "agent_sha256": file_hash(b"trained")}
    (tmp_path / "provenance.json").write_text(json.dumps(made))
    with pytest.raises(SystemExit, match="was made with an earlier agent of"):
        run_once(tmp_path, "evaluate", words[0])
    with pytest.raises(SystemExit, match="was made with an earlier agent of"):
        fine_tuning.tuned(tmp_path, {"run": str(tmp_path / "agent.pt")})
    (tmp_path / "agent.pt").write_bytes(b"trained")
    assert run_once(tmp_path, "evaluate", words[0]) == tmp_path


def test_stock_agents_are_judged_from_our_starts() -> None:
    pytest.importorskip("stable_baselines3")
    import peer

    env = peer.Judge(3, 1, 1.0).env
    env.reset()
    x, x_dot, theta, theta_dot = env.plant.true_state
    assert len(x) == 100
    assert x.abs().max() <= 0.1
    assert not torch.cat((x_dot, theta_dot, theta.cos() + 1)).any()


def test_a_distilled_agent_is_judged_as_the_others_are(monkeypatch: Any) -> None:
    monkeypatch.setattr(learning, "STARTS", 3)
    monkeypatch.setattr(learning, "DRAWN_CARTS", 3)
    found = distillation.figures(Path("pretrained/medium"), "medium")
    assert found["score"] > 4000
    assert found["multiply-adds"] > 1000


@pytest.mark.skipif(shutil.which("gcc") is None, reason="gcc is missing: install a C compiler")
def test_exported_agents_choose_the_hosts_actions(run: Run, tmp_path: Path, monkeypatch: Any) -> None:
    pytest.importorskip("onnxscript", reason='onnxscript is missing: pip install "cartpole_rl[export]"')
    monkeypatch.setattr(export_parity, "CARTS", 2)
    processor = ["--processor"] * all(map(shutil.which, PROCESSOR))
    words = ("pretrained/medium", "--observations", "300", "--emulated", "0", *processor)
    rows = {row["of"]: row for row in figures(run, export_parity, tmp_path, *words)}
    counted = rows.pop("C, from counts")
    assert (counted["episodes"], counted["differ"]) == (2, 0)
    assert {"C", "ONNX", "PyTorch, one at a time"} <= set(rows)
    assert all((row["observations"], row["beyond rounding"]) == (300, 0) for row in rows.values())
    above = np.spacing(np.float32(3.0))
    values = np.array([[1.0, 2.0], [3.0, np.float32(3.0) + above], [5.0, 4.0]], np.float32)
    found = export_parity.row("x", np.array([0, 0, 0]), values)
    assert (found["differ"], found["beyond rounding"]) == (2, 1)


def test_a_network_alone_predicts_and_moves_carts(tmp_path: Path, monkeypatch: Any) -> None:
    words = ("run=pretrained/medium", "episodes=3", f"hydra.run.dir={tmp_path / 'run'}")
    assert failure("record", *words) is None
    *episodes, held_out = (read_recording(path).episode for path in recordings(tmp_path / "run"))
    errors = []
    for updates in (1, 500):
        monkeypatch.setattr(next_state, "UPDATES", updates)
        network = next_state.learned(episodes, 0)
        errors.append(next_state.prediction_error(network, held_out).theta)
    assert errors[1] < 0.3 * errors[0]
    monkeypatch.setattr(SimulatedSettings, "build", lambda *given: next_state.network_carts(network, *given))
    config = load_settings(TrainConfig, {"randomization": "none"})
    plant = simulated_env(config, config.plant, 3, config.task.start, 0).plant
    plant.reset()
    motors, states = torch.tensor([[9], [-90], [255]]), [torch.stack(plant.true_state, -1)]
    for _ in range(2):
        plant.step(TensorDict({"motor": motors}, [3]))
        states.append(torch.stack(plant.true_state, -1))
    expected = network(states[1], torch.cat((torch.zeros(3, 2), motors, motors), 1))
    assert torch.equal(states[2], expected)


def test_fine_tunings_are_compared_with_the_reference_of_the_cart() -> None:
    def tuned(before: list[float], after: list[float]) -> dict[str, object]:
        scores = {"before": before, "tune": [300.0, 4000.0], "after": after}
        return {"scores": scores, "left_track": 1, "left_track_first": True, "seconds": 60.0}

    better = fine_tuning.cart_figures("a", 0, {}, 5000.0, tuned([4000, 4200], [4400, 4600]))
    worse = fine_tuning.cart_figures("a", 1, {}, 4000.0, tuned([3600, 3600], [400, 3000]))
    failed = fine_tuning.cart_figures("a", 2, {}, None, {"error": "homing failed"})
    assert better["fraction"] == pytest.approx({"before": 0.82, "after": 0.9})
    row = fine_tuning.agent_row(fine_tuning.agent_figures("a", [better, worse, failed]))
    assert (row["carts"], row["not tuned"], row["ended below"]) == (2, 1, 1)
    assert (row["mean score before"], row["worst score after"]) == (3850, 1700)
    assert row["lost before, tuning, after"] == "0, 2, 1"
    assert fine_tuning.agent_row(fine_tuning.agent_figures("a", [failed]))["not tuned"] == 1
    options = argparse.Namespace(agents=["a/b"], seed=1, wider=0.0, truths=2, episodes=5, starts=5)
    folders = [
        {folder for folder, _ in fine_tuning.fine_tunings(options, words).values()}
        for words in ({}, {}, {"finetuning.iterations": 12})
    ]
    assert folders[0] == folders[1]
    assert len(folders[0] | folders[2]) == 4


def test_an_informed_agent_observes_its_own_cart() -> None:
    config = load_settings(TrainConfig, {"compile": False})
    env = adaptation.make_env(config, adaptation.Job(0.0, 0, True), 50, config.task.start, 0)
    present = env.reset()
    present["action"] = torch.zeros(50, dtype=torch.int64)
    known = env.step(present)["next", "observation"][:, config.observation.size :]
    assert known.shape == (50, len(config.ranges))
    assert known.abs().max() <= 1 + 1e-4
    tilt = env.plant.parameters.track_tilt / config.ranges["track_tilt"].limits()[1]
    torch.testing.assert_close(known[:, list(config.ranges).index("track_tilt")], tilt)


def test_the_environment_counts_what_the_search_for_a_reference_counted() -> None:
    config = reference.composed(["task.time_limit=110"])
    cart = KnownCart(config)
    found = reference.search(cart, 0.05, 120, 8)
    played = reference.replay(config, 0.05, found)
    assert sum(played.points) == pytest.approx(float(cart.run(cart.hanging(0.05), found).points), abs=0.01)
    assert all(abs(theta) < UPRIGHT_ANGLE for theta in played.theta[-10:])
    (truth,) = draw_truths(REPORTED, 1)
    config, actions = reference.truth_config(truth), [8] * 6 + [0] * 12 + [8] * 4
    points = KnownCart(config).run(KnownCart(config).hanging(0.0), actions).points
    assert sum(reference.replay(config, 0.0, actions).points) == pytest.approx(float(points), abs=1e-4)


@pytest.mark.parametrize("file", sorted(truth_references.FOLDER.glob("*.json")), ids=lambda file: file.stem)
def test_the_stored_references_are_those_of_the_carts_of_today(file: Path) -> None:
    seed, wider = file.stem.split("_")
    draw = truth_references.Draw(int(seed), float(wider))
    assert all(truth_references.known_references(draw, draw.truths(len(json.loads(file.read_text())))))


def test_zero_shot_fractions_are_relative_to_the_reference_of_the_cart(
    trained: Path, run: Run, tmp_path: Path, monkeypatch: Any
) -> None:
    monkeypatch.setattr(truth_references, "FOLDER", tmp_path / "references")
    draw = truth_references.Draw(REPORTED, 0.0)
    (truth,) = draw.truths(1)
    truth_references.add_reference(draw, 0, truth, {"score": 100.0})
    assert truth_references.known_references(draw, [{**truth, "cart_mass": 1.0}]) == [None]
    words = ("runs/bench/medium/10", "--truths", "1", "--starts", "2")
    found = figures(run, zero_shot, trained, *words)
    assert (found["seed"], found["wider"], found["starts"]) == (2026, 0, 2)
    (agent,) = found["agents"]
    (scores,) = agent["scores"].values()
    assert agent["worst_fraction"] == agent["mean_fraction"] == pytest.approx(sum(scores) / 2 / 100)
    assert agent["lost"] == sum(score < 500 for score in scores)
    assert agent["beaten"] == [0] * (max(scores) > 100)
    with pytest.raises(SystemExit, match="was made with --seed 2026: use that, or another --json file"):
        figures(run, zero_shot, trained, *words, "--seed", "0")
    found["agents"][0]["scores"]["9"] = scores
    (trained / "figures.json").write_text(json.dumps(found))
    with pytest.raises(SystemExit, match="holds 10 carts: use --truths 10"):
        figures(run, zero_shot, trained, *words)


def within(value: float, low: float, high: float) -> bool:
    return low - 1e-9 <= value <= high + 1e-9


def test_drawn_carts_are_possible_and_inside_the_ranges_of_training_unless_wider() -> None:
    nominal = {**choice("cart/ip02"), **choice("pole/medium")["choices"]["medium"]}
    bounds = {}
    for name, line in choice("randomization/wide").items():
        each = Range(**line)
        bounds[name] = [limit * (nominal[name] if each.scales_nominal else 1) for limit in each.limits()]
    for wider in (0.0, 1 / 3, 1.0):
        for truth in draw_truths(REPORTED, 50, wider):
            EmulatorSettings(**truth)  # has bounds of its own
            cart = simulated_cart(truth)
            drawn = {
                name.removesuffix("_left").replace("coulomb_right", "coulomb_asymmetry") for name in truth
            }
            outside = {name for name in drawn & set(bounds) if not within(cart[name], *bounds[name])}
            assert not outside or wider
    assert draw_truths(REPORTED, 20)[:5] == draw_truths(REPORTED, 5)


def test_a_motor_value_that_never_ends_is_not_left_out() -> None:
    taken = {"us": 0, "took": "SET_MOTOR", "motor": 50, "tick": 7}
    refused = {"us": 30_000, "took": "SET_MOTOR", "motor": 60, "tick": 8}
    events = [taken, {"us": 1000, "in_force": 50}]
    assert [*safety.values_of_the_host([*events, {"us": 9000, "in_force": 0}, refused])] == [(0, 9000, 7)]
    assert [*safety.values_of_the_host(events)] == [(0, math.inf, 7)]


def test_reports_of_more_and_more_runs_are_measured(trained: Path, run: Run) -> None:
    words = ("runs/bench/medium/10", "animations=false", "--runs", "2", "5")
    rows = figures(run, reports, trained, *words)
    assert [row["runs"] for row in rows] == [2, 5]
    assert all(row["seconds"] > 0 and row["peak_mb"] > 50 and row["page_mb"] > 0.01 for row in rows)


WINDOWS, PERIODS = 12, 25


def known_cart(**values: float) -> dict[str, float]:
    return {name: toolbox.nominal()[name] for name in toolbox.BOUNDS} | values


def drawn_windows(cart: toolbox.MujocoCart) -> tuple[torch.Tensor, Windows]:
    dice = np.random.default_rng(0)
    motion = dice.normal(size=(4, 1, WINDOWS)) * np.array([0.1, 0.3, 0.8, 3.0]).reshape(4, 1, 1)
    motion[2] += np.pi
    levels = dice.integers(-2, 3, ((history_periods(real.PERIOD) + PERIODS) // 3 + 1, WINDOWS))
    motors = 100.0 * np.repeat(levels, 3, axis=0)[: history_periods(real.PERIOD) + PERIODS]
    positions = cart.positions(torch.from_numpy(motion), torch.from_numpy(motors))[:, :, 0].numpy()
    numbers = np.arange(WINDOWS)
    return torch.from_numpy(motion), Windows(positions, motors, numbers, 0 * numbers, np.full(2, 1e-4))


def test_the_cart_in_mujoco_moves_as_the_packages_own_one() -> None:
    late = real.nominal()["latency"] + real.PERIOD / toolbox.SUBSTEPS / 2  # its steps move a cart early
    motion, windows = drawn_windows(
        toolbox.MujocoCart.of(known_cart(cart_coulomb=0.0, latency=late, angle_offset=0.02), real.PERIOD)
    )
    own = real.dynamics({**real.nominal(), "angle_offset": 0.02}, "linear", "exponential")
    motion[2] -= 0.02  # states in MuJoCo are as measured
    error = own.positions(motion, torch.from_numpy(windows.motors))[:, :, 0].numpy() - windows.positions
    assert np.abs(error[:, 0]).max() < 2e-3
    assert np.abs(error[:, 1]).max() < 0.05


@pytest.mark.skipif(not toolbox.INSTALLED, reason='mujoco.sysid is missing: pip install "mujoco[sysid]"')
def test_mujocos_toolbox_finds_the_cart_that_moved() -> None:
    true = known_cart(force_linear=0.025, latency=0.022, cart_coulomb=0.3, angle_offset=0.01)
    _, windows = drawn_windows(toolbox.MujocoCart.of(true, real.PERIOD))
    found = toolbox.values_of(toolbox.search(toolbox.starting(1.0), windows, real.PERIOD, 4)[0])
    assert found["latency"] == pytest.approx(0.022, abs=1e-3)
    assert found["angle_offset"] == pytest.approx(0.01, abs=1e-3)
    for ratio in ("force_linear", "cart_viscous"):  # motion shows them over the mass
        assert found[ratio] / found["cart_mass"] == pytest.approx(true[ratio] / true["cart_mass"], rel=0.05)
    assert toolbox.at_bounds(found | {"latency": 0.0}) == ["latency"]


def test_a_motor_whose_logs_are_too_short_is_refused(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(real, "MOTORS_2020", {"short": ("*.csv", ("layout.angle.upright=3000",))})
    time = np.arange(0, 8, 0.005)
    late = time - 0.01  # s, of the acceleration behind the motor value
    angle, motor = 3000 + 300 * np.sin(9 * time), 2000 * (np.cos(5 * time) + np.cos(11 * time))
    position = -20_000 * (np.cos(5 * late) / 5**2 + np.cos(11 * late) / 11**2)
    rows = np.stack((time, angle.round(), position.round(), motor.round()), 1)
    for name in ("a_short.csv", "b_short.csv"):
        head = "time,angle,position,actualMotorCmd"
        np.savetxt(tmp_path / name, rows, fmt="%.6g", delimiter=",", header=head, comments="")
    found = real.of_2020(tmp_path, tmp_path / "runs")["short"]
    assert "too short" in found["refused"]
    assert found["import"]["sensors"]["delay"] is not None
    assert "identified" not in found
    assert real.at_times(np.full((201, 3), -2.0), 0.005) == [[2.0, 2.0]] * 4
