#!/usr/bin/env python
"""How good is a network that predicts a cart's next state without any equation, and an agent trained in it?

    scripts/bench/next_state.py --seeds 10 --jobs 2 --json next_state.json

The emulated cart `stand_in` is recorded for each seed: the motions of cartpole-identify, then ten episodes of
the pretrained agent, since the former hardly come near upright. From them a network learns the next state (x,
x_dot, theta, theta_dot), given the present one and the last motor values. The states are those of polynomials
through the encoders' counts. Errors are RMS over 1 s, in the median stretch away from upright of the
recording that the identification holds out, as its own are.

An agent of experiment=medium is then trained in each network, and its last checkpoint drives ten episodes on
`stand_in`. The runs are in runs/bench/next_state; what exists is not made again.
"""

from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from common import (
    RUNS,
    add_seed_options,
    chosen_seeds,
    mean_score,
    option_parser,
    positive_int,
    print_table,
    processes,
    read_json,
    run_once,
    write_json,
)
from torch import Tensor, nn

from cartpole_rl.evaluation.recordings import read_recording
from cartpole_rl.identification.experiments import HELD_OUT
from cartpole_rl.identification.identify import HORIZON, PredictionError, median_error
from cartpole_rl.identification.windows import cut_stretches
from cartpole_rl.physics.dynamics import State
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.plants.settings import SimulatedSettings
from cartpole_rl.plants.simulated import Carts, Inputs, Period, SimulatedPlant, encoder_counts
from cartpole_rl.plants.specs import Numbers, Plant, PlantOutput
from cartpole_rl.run_folder import recordings
from cartpole_rl.tasks.episode import Episode, wrap
from cartpole_rl.workflows.config import TrainConfig, load_settings
from cartpole_rl.workflows.train import train

PERIOD = 0.02  # s
MEMORY = 4  # motor values that the network reads
ROWS, DEGREE = 9, 3  # of the polynomials; one less where a prediction starts, from the past alone
UPDATES, BATCH, RATE = 10_000, 256, 2e-3
FAST = "windows=80", "substeps=4", "carts=500"  # settings of the identification


class NextState(nn.Module):
    """Returns the next state, [N, 4], from the present one and the last motor values, [N, MEMORY]."""

    def __init__(self, change: Tensor) -> None:
        super().__init__()
        self.change = change  # [4]: typical, in a period
        self.layers = nn.Sequential(
            nn.Linear(5 + MEMORY, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, 4)
        )

    def forward(self, state: Tensor, motors: Tensor) -> Tensor:
        """Return the next state, the angle not wrapped."""
        x, x_dot, theta, theta_dot = state.unbind(-1)
        seen = torch.stack((x / 0.4, x_dot, theta.cos(), theta.sin(), theta_dot / 10), -1)
        return state + self.change * self.layers(torch.cat((seen, motors / 255), -1))


def learned(episodes: list[Episode], seed: int) -> NextState:
    """Return a network that has learned the steps of the episodes."""
    from scipy.signal import savgol_filter  # slow to import

    torch.manual_seed(seed)
    before, after, motors = [], [], []
    for episode in episodes:
        positions = episode.positions[: episode.measured_steps + 1]
        found = [savgol_filter(positions, ROWS, DEGREE, deriv, PERIOD, axis=0) for deriv in (0, 1)]
        path = np.stack(found, -1).reshape(-1, 4)
        regular = episode.regular_frames(PERIOD)
        for row in range(MEMORY - 1, episode.measured_steps):
            if regular[row - MEMORY + 1 : row + 1].all():
                before.append(path[row])
                after.append(path[row + 1])
                motors.append(episode.motor[row - MEMORY + 1 : row + 1])
    state, following, motor = (torch.from_numpy(np.array(each)).float() for each in (before, after, motors))
    network = NextState((following - state).std(0))
    optimizer = torch.optim.Adam(network.parameters(), RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, UPDATES)
    for _ in range(UPDATES):
        chosen = torch.randint(len(state), (BATCH,))
        predicted = network(state[chosen], motor[chosen])
        loss = nn.functional.huber_loss(predicted / network.change, following[chosen] / network.change)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return network.requires_grad_(False)


def prediction_error(network: NextState, held_out: Episode) -> PredictionError:
    """Return the error as the identification has it."""
    windows = cut_stretches(held_out, PERIOD, HORIZON, ROWS - 1)
    times = PERIOD * np.arange(1 - ROWS, 1)
    fits = [np.polyfit(times, windows.positions[:ROWS, k], DEGREE - 1)[:-3:-1] for k in range(2)]
    states = [torch.from_numpy(np.concatenate(fits).T).float()]  # [W, 4]
    for end in range(len(windows.motors) - windows.periods + ROWS, len(windows.motors) + 1):
        motors = torch.from_numpy(windows.motors[end - MEMORY : end].T).float()
        states.append(network(states[-1], motors))
    predicted = torch.stack(states)[:, :, ::2].double().numpy().transpose(2, 1, 0)  # [2, W, H + 1]
    x_error, theta_error = predicted - windows.positions[ROWS - 1 :].transpose(1, 2, 0)
    return median_error(x_error, wrap(theta_error), predicted[1], np.isfinite(x_error).all(1))


class NetworkPlant(SimulatedPlant):
    """N carts that a network moves. Of the parameters only the track and the encoders' errors count."""

    def __init__(self, network: NextState, *settings: Any) -> None:
        super().__init__(*settings)
        self._network = network
        missing = max(0, 1 + MEMORY - len(self._carts.drive))
        drive = torch.cat((self._carts.drive, self._carts.drive.new_zeros(missing, self.carts)))
        self._carts = self._carts._replace(drive=drive)
        self._run = self._predict

    def _predict(self, carts: Carts, inputs: Inputs) -> Period:
        motor = inputs.motor.to(carts.drive.dtype)
        drive = torch.cat((carts.drive[:1], motor, carts.drive[1:-1]))
        motion = self._network(carts.motion.T, drive[1 : 1 + MEMORY].flip(0).T).T
        parameters = CartParameters(carts.table)
        counts = encoder_counts(State(*motion), parameters, inputs.noise, self.hardware.encoders)
        off_track = ~(motion[:1].abs() <= parameters.track_half_length)
        return Period(motion, drive, counts, inputs.motor, off_track)

    def step_one(self, motor: int) -> PlantOutput[Numbers]:
        """Drive the only cart for a period."""
        return Plant.step_one(self, motor)


def network_carts(network: NextState, settings: SimulatedSettings, *given: Any) -> NetworkPlant:
    """Return the carts of a network, for plant=simulated; `given` is that of `simulated_carts`."""
    config, draws, carts, start, seed, compiled, device = given
    models, period = config.models(settings), config.control_period
    physics = models, period, settings.substeps
    return NetworkPlant(network, carts, draws, start, *physics, seed, device, compiled, config.hardware)


def judged(seed: int) -> dict[str, Any]:
    """Return the figures of a seed's network and of its agent."""
    folder = RUNS / "next_state" / str(seed)
    cart = ("plant=emulated", "emulator=stand_in", f"seed={seed}")
    moved = run_once(folder / "identify", "identify", *cart, *FAST, result="identification.json")
    own = ("run=pretrained/medium", "episodes=10")
    driven = run_once(folder / "record", "record", *cart, *own, result="recordings/episode_009.csv")
    episodes = {file: read_recording(file).episode for file in [*recordings(moved), *recordings(driven)]}
    (held_out,) = [episodes.pop(file) for file in [*episodes] if file.stem.endswith(HELD_OUT)]
    network = learned([*episodes.values()], seed)
    found, physics = prediction_error(network, held_out), read_json(moved / "identification.json")
    agent = folder / "agent"
    if not (agent / "metrics.json").exists():
        with patch.object(SimulatedSettings, "build", lambda *given: network_carts(network, *given)):
            train(load_settings(TrainConfig, {"randomization": "none", "seed": seed}), agent)
    judge = run_once(folder / "emulated", "evaluate", f"run={agent}", *cart, "episodes=10")
    return {
        "seed": seed,
        "network": in_units(found.x, found.theta),
        "physics": in_units(physics["held_out_1_s"]["x_m"], physics["held_out_1_s"]["theta_rad"]),
        "simulated": mean_score(agent / "metrics.json"),
        "emulated": mean_score(judge / "metrics.json"),
    }


def in_units(x: float, theta: float) -> dict[str, float]:
    """Return errors in m and rad as those of the results."""
    return {"x_mm": 1e3 * x, "theta_deg": float(np.degrees(theta))}


def row(figures: dict[str, Any]) -> dict[str, str]:
    """Return the table row of a seed."""
    errors = {
        each: "{x_mm:.1f} mm, {theta_deg:.2f} deg".format(**figures[each]) for each in ("network", "physics")
    }
    return {**errors, **{each: f"{figures[each]:.0f}" for each in ("seed", "simulated", "emulated")}}


def main() -> None:
    """Learn, train, drive, print and write the figures."""
    parser = option_parser(__doc__)
    add_seed_options(parser, 10)
    parser.add_argument("--jobs", type=positive_int, default=1, help="seeds at the same time (1)")
    options = parser.parse_args()
    with processes(options.jobs) as pool:
        agents = [*pool.map(judged, chosen_seeds(options))]
    print_table([row(each) for each in agents])
    write_json(options.json, {"agents": agents})


if __name__ == "__main__":
    main()
