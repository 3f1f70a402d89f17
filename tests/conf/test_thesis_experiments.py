"""experiment=thesis_balance and thesis_swingup match the thesis; each number has its source.

If the thesis gives no value, ours is listed as "silent", so that no setting is overlooked.
"""

import math
from typing import Any

import pytest
from every_command import leaves

from cartpole_rl.choices import conf_folder
from cartpole_rl.rig.hardware import HARDWARE
from cartpole_rl.workflows.config import TrainConfig, load_settings

SILENT = "silent"
UNREAD = "not read with these settings"
Table = dict[str, tuple[Any, str]]  # setting: value, source in the thesis

BOTH: Table = {
    "control_period": (0.02, "5.2.2: 50 Hz"),
    "plant.kind": ("simulated", "5.2"),
    "plant.integrator": ("semi_implicit", "3.1, equation (3.8)"),
    "plant.substeps": (4, SILENT),
    "plant.pole_presses": (False, "5.2.3: friction of a constant normal force"),
    "pole.choices.medium.pole_mass": (0.127, "table 6.3"),
    "pole.choices.medium.pole_com": (pytest.approx(0.355 / 2, abs=5e-4), "table 6.3: length 0.355 m"),
    "pole.choices.medium.pole_inertia": (1.199e-3, SILENT),
    "pole.lengths": (None, "6.4: all but one experiment use one pole"),
    "pole.in_turn": (False, UNREAD),
    "actions.actuator": ("force_curve", "6.3; at the nominal cart also the forces of 6.1"),
    "task.duration": (10.0, "6: ten seconds at 50 Hz"),
    "task.time_limit": (None, "the same in control periods"),
    "task.x_max": (0.38, SILENT),
    "task.start.angle_spread": (0.05, SILENT),
    "task.start.position_spread": (0.05, "5.2: Gymnasium's environment"),
    "task.start.speed_spread": (0.05, "5.2: Gymnasium's environment"),
    "task.start.angular_speed_spread": (0.05, "5.2: Gymnasium's environment"),
    "task.start.resting_share": (0.0, "6.2: any random position"),
    "task.start.centred_share": (0.0, UNREAD),
    "task.evaluation_start.resting_share": (0.0, UNREAD),
    "task.evaluation_start.centred_share": (0.0, UNREAD),
    "reward.scale": (1.0, "equations (5.1) and (6.2)"),
    "reward.track_penalty": (0.0, "equations (5.1) and (6.2)"),
    "reward.period": (0.02, "5.2.2: 50 Hz"),
    "reward.position_cost": (0.0, "equations (5.1) and (6.2)"),
    "guard.enabled": (False, "ours: the thesis has no guard"),
    "guard.quantile": (0.95, UNREAD),
    "guard.numbers": (None, UNREAD),
    "observation.kind": ("raw", "5.1.1"),
    "observation.past_motors": (0, "5.1.1"),
    "observation.past_velocities": (0, "5.1.1"),
    "observation.past_positions": (0, "5.1.1"),
    "observation.pole_length": (False, "5.1.1"),
    "agent.hidden": ([64, 64], "tables 6.1 and 6.2"),
    "agent.kind": ("dqn", "4.1.2"),
    "agent.network": ("mlp", "5.1.1"),
    "agent.recurrent": (None, "5.1.1"),
    "agent.layer_norm": (False, "not named"),
    "agent.mirrored": (False, "not named"),
    "agent.horizon": (None, "given by gamma"),
    "agent.gamma": (0.99, "table 6.2"),
    "agent.double": (False, "4.1.2"),
    "agent.action_time": (None, "given by action_gap"),
    "agent.action_gap": (0.0, "equation (4.1)"),
    "agent.loss": ("l2", SILENT),
    "agent.target_tau": (None, "4.1.2: the network is copied"),
    "agent.average_decay": (None, "not named"),
    "learning.carry": (True, UNREAD),
    "buffer.kind": ("uniform", "5: typically equally distributed"),
    "buffer.alpha": (0.0, UNREAD),
    "buffer.beta": ([1.0, 1.0], UNREAD),
    "buffer.priority_eps": (1e-3, UNREAD),
    "optimizer.learning_rate": (0.001, "table 6.2"),
    "optimizer.learning_rate_end": (1.0, "no schedule is named"),
    "optimizer.max_grad_norm": (10.0, SILENT),
    "learning.carts": (1, "5, figure 5.1"),
    "learning.chunk": (1, SILENT),
    "learning.retry_probability": (0.0, "5.2.1"),
    "learning.updates": (1, SILENT),
    "learning.return_time": (0.1, UNREAD),
    "learning.staggered": (None, UNREAD),
    "learning.n_step": (1, "equation (4.1)"),
    "learning.warmup_transitions": (1000, SILENT),
    "learning.epsilon": ([0.1, 0.1], "table 6.2"),
    "learning.epsilon_transitions": (500_000, UNREAD),
    "learning.evaluations": (10, SILENT),
    "learning.evaluation_episodes": (100, SILENT),
    "learning.checkpoint_interval": (2, SILENT),
    "cart_friction.parameters": ({}, "6.3"),
    "pole_friction.parameters": ({}, "6.3"),
    "randomization": ({}, "6.4: only there"),
}
CART: Table = {
    "latency": (0.0, "5.2.2"),
    "latency_jitter": (0.0, "5.2.2"),
    "motor_time_constant": (0.0, "5.2.2"),
    "track_tilt": (0.0, "5.2"),
    "angle_offset": (0.0, "5.2"),
    "position_noise": (0.0, "5.2"),
    "angle_noise": (0.0, "5.2"),
    "force_quadratic": (0.0, "figure 5.5 without numbers; 6.2: 1, 2, 3, 4 N"),
    "force_linear": (0.02, "figure 5.5 without numbers; 6.2: 1, 2, 3, 4 N at 100, 150, 200, 250"),
    "force_offset": (-1.0, "figure 5.5 without numbers; 6.2: 1, 2, 3, 4 N"),
    "force_asymmetry": (0.0, "6.3"),
    "deadband_left": (0.0, "6.3"),
    "deadband_right": (0.0, "6.3"),
    "sigmoid_slope": (100.0, "6.3: rho"),
    "backdrivability": (1.0, "equations (3.5) and (3.6): the pole pushes the cart"),
    "coasting": (0.0, SILENT),
    "cart_coulomb": (0.5, SILENT),
    "cart_coulomb_asymmetry": (0.0, "equation (5.8)"),
    "pole_viscous": (2.1e-4, SILENT),
    "cart_mass": (0.703, SILENT),
    "track_half_length": (0.38, SILENT),
    **{
        name: (value, UNREAD)
        for name, value in {"cart_stiction_ratio": 1.2, "stribeck_velocity": 0.01}.items()
    },
    **{name: (value, UNREAD) for name, value in {"pole_drag": 2.5e-5, "pole_coulomb": 0.0}.items()},
}
OF: dict[str, Table] = {
    "thesis_balance": {
        "task.name": ("balance", "6.1"),
        "task.angle_limit": (pytest.approx(math.radians(12)), "6.1"),
        "task.start.angle": ("upright", "3.3"),
        "task.evaluation_start.angle": ("upright", "3.3"),
        "task.evaluation_start.position_spread": (0.05, "5.2: Gymnasium's environment"),
        "task.evaluation_start.angle_spread": (0.05, "5.2: Gymnasium's environment"),
        "task.evaluation_start.speed_spread": (0.05, "5.2: Gymnasium's environment"),
        "task.evaluation_start.angular_speed_spread": (0.05, "5.2: Gymnasium's environment"),
        "actions.motors": ([-200, 0, 200], "table 6.1: -1, 0, 1"),
        "reward.kind": ("constant", "table 6.1"),
        "cart_friction.model": ("none", "5.2.2, 6.1"),
        "pole_friction.model": ("none", "5.2.2, 6.1"),
        "cart.cart_viscous": (0.0, UNREAD),
        "agent.target_period": (200, "table 6.1"),
        "buffer.size": (15_000, "table 6.1"),
        "optimizer.kind": ("adam", "5.1.2, 6.2"),
        "optimizer.weight_decay": (0.0, "5.1.2: plain Adam"),
        "learning.transitions": (200_000, "figure 6.1 counts 30000 episodes, of unknown length"),
        "learning.batch_size": (128, "table 6.1"),
    },
    "thesis_swingup": {
        "task.name": ("swingup", "6.3"),
        "task.angle_limit": (None, "6.2"),
        "task.start.angle": ("any", "6.2"),
        "task.start.angle_spread": (0.0, UNREAD),
        "task.evaluation_start.angle": ("hanging", "5.2.1"),
        "task.evaluation_start.position_spread": (0.1, SILENT),
        "task.evaluation_start.angle_spread": (0.0, SILENT),
        "task.evaluation_start.speed_spread": (0.0, SILENT),
        "task.evaluation_start.angular_speed_spread": (0.0, SILENT),
        "actions.motors": ([-250, -200, -150, -100, 0, 100, 150, 200, 250], "6.3"),
        "reward.kind": ("score", "6.2: equation (6.2)"),
        "cart_friction.model": ("sigmoid", "6.3: one of three"),
        "pole_friction.model": ("exponential", "6.3"),
        "cart.cart_viscous": (0.0, "equation (5.8)"),
        "agent.target_period": (2000, "table 6.2"),
        "buffer.size": (200_000, "table 6.2"),
        "optimizer.kind": ("adamw", "6.3"),
        "optimizer.weight_decay": (0.01, SILENT),
        "learning.transitions": (500_000, SILENT),
        "learning.batch_size": (256, "table 6.2"),
    },
}
# not of the experiment
OF_THE_RUN = {"seed", "label", "device", "threads", "compile", "resume", "logger", "preview", "view"}
EXPECTED = {
    name: {**BOTH, **{f"cart.{key}": row for key, row in CART.items()}, **own} for name, own in OF.items()
}


def settings(experiment: str) -> dict[str, Any]:
    """Each setting of an experiment by its whole name."""
    config = load_settings(TrainConfig, {"experiment": experiment})
    of_the_rig = {f"cart.{name}" for name in HARDWARE}  # no agent reads it
    found = leaves(config.model_dump(mode="json", exclude=OF_THE_RUN))
    return {name: value for name, value in found if name not in of_the_rig}


@pytest.mark.parametrize("experiment", EXPECTED)
def test_every_setting_is_that_of_the_thesis(experiment: str) -> None:
    found = settings(experiment)
    assert set(found) == set(EXPECTED[experiment])
    wrong = {name: row for name, row in EXPECTED[experiment].items() if found[name] != row[0]}
    assert wrong == {}


@pytest.mark.parametrize("experiment", EXPECTED)
def test_each_number_in_the_file_has_a_source(experiment: str) -> None:
    lines = (conf_folder() / f"experiment/{experiment}.yaml").read_text().splitlines()
    for line in lines[lines.index("defaults:") + 1 :]:
        if not line.rstrip().endswith(":"):
            assert "#" in line, line
