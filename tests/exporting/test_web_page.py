"""The page's cart moves as the simulated one, in a headless browser."""

import copy
import json
import math
import re
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from browser import in_browser
from shown_pages import needs_browser

from cartpole_rl.arithmetic.writer import Scalar
from cartpole_rl.envs.build import environment
from cartpole_rl.exporting.web_page import LONGEST_LATENCY
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.plants.settings import SimulatedSettings
from cartpole_rl.plants.simulated import Carts, Inputs, commands_under_way, run_carts
from cartpole_rl.plants.specs import Numbers, OneCartPlant, PlantOutput
from cartpole_rl.rig.hardware import nominal_encoders
from cartpole_rl.workflows.build import TrainedAgent, exported_agent, network_of, new_agent
from cartpole_rl.workflows.config import TrainConfig, load_settings
from cartpole_rl.workflows.export import files_of

PERIODS = 100  # 2 s
HANGING = {"x": 0.05, "x_dot": 0.0, "theta": math.pi, "theta_dot": 0.0}
EPISODES: list[dict[str, Any]] = [  # parameters that differ from the nominal cart, and the initial true state
    {"parameters": {}, "start": HANGING},
    {"parameters": {"latency": 0.033, "cart_coulomb": 0.8, "cart_viscous": 1.5}, "start": HANGING},
    {"parameters": {}, "start": {"x": -0.1, "x_dot": 0.3, "theta": 0.05, "theta_dot": -0.4}},
    {
        "parameters": {"pole_mass": 0.42, "pole_com": 0.3, "pole_inertia": 0.0126, "latency": 0.0},
        "start": {"x": 0.2, "x_dot": 0.0, "theta": -0.1, "theta_dot": 0.0},
    },
]
DRIVE = """
const results = EPISODES.map(({ parameters, start }) => {
  const driven = new Cart(parameters), rows = [];
  driven.reset(start);
  for (let period = 0; period < PERIODS && !driven.offTrack; period++) {
    driven.step(driven.chosen());
    rows.push([...driven.motion, driven.motor]);
  }
  return rows;
});
document.body.textContent = JSON.stringify(results);
"""


class ExactPlant(OneCartPlant):
    """The nominal cart with some parameters replaced, simulated in float64 as the page is.

    `SimulatedPlant` keeps its state in float32. Near upright, two episodes that differ by such a rounding
    differ by more than 1e-4 after a second.
    """

    def __init__(self, training: TrainConfig, parameters: dict[str, float], start: dict[str, float]) -> None:
        super().__init__()
        values = {**training.nominal_with(training.pole.nominal), **parameters}
        self.track_end, self.length = values["track_half_length"], 2 * values["pole_com"]
        self.period, self.start = training.control_period, tuple(start.values())
        self.table = tuple(values[name] for name in CartParameters.names())
        self.commands = commands_under_way(LONGEST_LATENCY, self.period)
        assert isinstance(training.plant, SimulatedSettings)
        plant = training.plant
        run = partial(
            run_carts,
            models=training.models(plant),
            period=self.period,
            substeps=plant.substeps,
            encoders=training.hardware.encoders,
        )
        column = torch.zeros(4, 1)
        drive = torch.zeros(1 + self.commands, 1)
        example = Carts(torch.ones(len(self.table), 1), column, drive)
        self.run = Scalar(run, example, Inputs(torch.zeros(1, 1, dtype=torch.int64), column[:3]))

    @property
    def pole_length(self) -> torch.Tensor:
        return torch.tensor([self.length])

    @property
    def track_half_length(self) -> torch.Tensor:
        return torch.tensor([self.track_end])

    def reset_one(self) -> PlantOutput[Numbers]:
        self.motion, self.drive = self.start, (0.0,) * (1 + self.commands)
        x, _, theta, _ = self.start
        counts = round(x / nominal_encoders().metres), round(theta / nominal_encoders().radians)
        return PlantOutput(counts, (self.period,), (0,), (False,), (False,))

    def step_one(self, motor: int) -> PlantOutput[Numbers]:
        after = self.run((self.table, self.motion, self.drive), ((motor,), (0.0, 0.0, 0.0)))
        self.motion, self.drive = after.motion, after.drive
        return PlantOutput(after.counts, (self.period,), (motor,), after.off_track, (False,))


@torch.no_grad()
def simulated(trained: TrainedAgent, episode: dict[str, Any]) -> np.ndarray:
    """True states and motor values of an episode in the simulation, [PERIODS, 5]."""
    plant = ExactPlant(trained.training, episode["parameters"], episode["start"])
    network = copy.deepcopy(network_of(trained)).double()
    cart, rows = environment(trained.training, plant).one_cart, []
    step: Any = cart.reset()
    for _ in range(PERIODS):
        action = int(network(torch.tensor(step.observation, dtype=torch.float64)).argmax())
        motor = cart.sent_motor(action)
        step = cart.step(action)
        rows.append([*plant.motion, motor])
    return np.array(rows)


def test_the_page_needs_no_other_file(page: str) -> None:
    assert not re.search(r"(src|href)\s*=|url\(|import\s|fetch\(|https?:", page)
    assert "@@" not in page
    assert len(page) < 150_000


@needs_browser
def test_a_balancing_agent_starts_upright_and_fails_when_the_pole_falls(
    balancing: TrainedAgent, balancing_page: str, tmp_path: Path
) -> None:
    script = """
    const driven = new Cart(), start = driven.motion[2], angles = [];
    driven.reset({ ...REST, theta: 0.1 });
    while (!driven.fallen && angles.length < 200) {
      driven.step(0);
      angles.push(Math.abs(driven.percept.state[2]));
    }
    const text = document.querySelector("p").textContent + verdict()[0];
    document.body.textContent = JSON.stringify([text, start, ...angles.slice(-2)]);
    """
    text, start, before, last = in_browser(balancing_page, script, tmp_path)
    assert "balances the pole." in text
    assert "wing" not in text  # it does not swing up
    assert start == 0
    assert before <= balancing.training.task.angle_limit < last


@needs_browser
def test_a_long_nominal_latency_is_simulated_as_it_is(tmp_path: Path) -> None:
    given = {"cart.latency": 0.0625, "agent.hidden": [8], "compile": False}
    training = load_settings(TrainConfig, given)
    slow = TrainedAgent(training, new_agent(training).greedy_policy())
    script = """
    const shown = element("latency-value").textContent;
    document.body.textContent = JSON.stringify([simulated.parameters.latency, shown, DATA.commands]);
    """
    page = files_of("web", exported_agent(slow, {}), slow)["cart.html"].decode()
    found = in_browser(page, script, tmp_path)
    assert found == [0.0625, "62.5 ms", commands_under_way(0.0625, 0.02)]


@needs_browser
def test_a_key_that_is_released_in_another_window_pushes_no_longer(page: str, tmp_path: Path) -> None:
    script = """
    window.dispatchEvent(new KeyboardEvent("keydown", { key: "ArrowRight" }));
    const held = keys;
    window.dispatchEvent(new Event("blur"));
    document.body.textContent = JSON.stringify([held, keys]);
    """
    held, left = in_browser(page, script, tmp_path)
    assert held > left == 0


@needs_browser
def test_it_drives_as_the_simulation(page: str, medium_agent: TrainedAgent, tmp_path: Path) -> None:
    script = f"const EPISODES = {json.dumps(EPISODES)}, PERIODS = {PERIODS};{DRIVE}"
    for episode, rows in zip(EPISODES, in_browser(page, script, tmp_path), strict=True):
        expected, found = simulated(medium_agent, episode), np.array(rows)
        assert found.shape == expected.shape
        assert (found[:, 4] == expected[:, 4]).all()
        assert np.abs(found - expected).max() < 1e-4
