"""The page's cart moves as the simulated one, in a headless browser."""

import html
import json
import math
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from cartpole_rl.envs.build import simulated_env
from cartpole_rl.evaluation.episodes import choose
from cartpole_rl.exporting.agent import ExportedAgent
from cartpole_rl.exporting.web_page import web_page
from cartpole_rl.physics.dynamics import State
from cartpole_rl.plants.specs import tensordict_of
from cartpole_rl.workflows.agents import TrainedAgent
from cartpole_rl.workflows.build import with_parameters

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
BROWSER = next(filter(None, map(shutil.which, BROWSERS)), None)
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


@pytest.fixture(scope="module")
def page(exported: ExportedAgent, medium_agent: TrainedAgent) -> str:
    training = medium_agent.training
    return web_page(exported, training, training.plant)


@torch.no_grad()
def simulated(trained: TrainedAgent, episode: dict[str, Any]) -> np.ndarray:
    """True states and motor values of an episode in the simulation, [PERIODS, 5]."""
    training = trained.training
    settings = with_parameters(training.model_copy(update={"randomization": {}}), episode["parameters"])
    settings = settings.model_copy(update={"guard": training.guard})
    env = simulated_env(settings, training.plant, 1, training.task.evaluation_start, seed=0)
    env.plant.start_from(episode["start"])
    cart, rows = env.one_cart, []
    step: Any = cart.reset()
    for _ in range(PERIODS):
        observed = torch.from_numpy(np.array([step.observation], np.float32))
        action = int(choose(trained.policy, tensordict_of({"observation": observed})))
        motor = cart.sent_motor(action)
        step = cart.step(action)
        rows.append([*(each.item() for each in State(*env.plant.true_state)), motor])
        if cart.frame.terminated:
            break
    return np.array(rows)


def in_browser(page: str, script: str, folder: Path) -> Any:
    """Return the JSON that `script`, at the end of the page, writes into its body."""
    assert BROWSER is not None
    file = folder / "page.html"
    file.write_text(page.replace("</body>", f"<script>{script}</script></body>"))
    words = ["--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={folder / 'profile'}"]
    done = subprocess.run(
        [BROWSER, *words, "--dump-dom", file.as_uri()], capture_output=True, text=True, timeout=300
    )
    (body,) = re.findall(r"<body>(.*)</body>", done.stdout, re.S)
    return json.loads(html.unescape(body))


def test_the_page_needs_no_other_file(page: str) -> None:
    assert not re.search(r"(src|href)\s*=|url\(|import\s|fetch\(|https?:", page)
    assert "@@" not in page
    assert len(page) < 150_000


@pytest.mark.skipif(BROWSER is None, reason=f"none of {', '.join(BROWSERS)} is installed")
def test_it_drives_as_the_simulation(page: str, medium_agent: TrainedAgent, tmp_path: Path) -> None:
    script = f"const EPISODES = {json.dumps(EPISODES)}, PERIODS = {PERIODS};{DRIVE}"
    for episode, rows in zip(EPISODES, in_browser(page, script, tmp_path), strict=True):
        expected, found = simulated(medium_agent, episode), np.array(rows)
        assert found.shape == expected.shape
        assert (found[:, 4] == expected[:, 4]).all()
        assert np.abs(found - expected).max() < 1e-4
