"""Episodes end before a count that froze or jumped, and no cart that works is taken for a broken one."""

from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cartpole_rl.errors import FaultError
from cartpole_rl.evaluation.episodes import run_episodes
from cartpole_rl.evaluation.metrics import episode_metrics
from cartpole_rl.evaluation.recordings import read_recording, write_recording
from cartpole_rl.identification.experiments import recording
from cartpole_rl.plants.measured import measured_part
from cartpole_rl.plants.recorded import RecordedPlant
from cartpole_rl.rig.hardware import nominal_encoders
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.wire.messages import Fault
from cartpole_rl.workflows.build import evaluated_env, evaluated_settings, trained_agent
from cartpole_rl.workflows.config import EvaluateConfig, load_settings
from cartpole_rl.workflows.finetuning_learner import recorded_chunks

AGENT = "pretrained/medium"
PERIOD = 0.02
HANGING = 2048


def drive(**emulator: Any) -> list[Episode]:
    """An episode of an agent on an emulated cart; homing ends at 24 s."""
    pytest.importorskip("mujoco", reason='pip install "cartpole_rl[emulator]"')
    truth = {f"emulator.{name}": value for name, value in {"physics_step": 1e-3, **emulator}.items()}
    config = load_settings(EvaluateConfig, {"run": AGENT, "plant": "emulated", "task": "swingup", **truth})
    agent = trained_agent(Path(AGENT))
    with closing(evaluated_env(evaluated_settings(agent.training, config), config, prompt=print)) as env:
        return [*run_episodes(env, agent.policy, 1)]


@pytest.fixture(scope="module")
def healthy() -> Episode:
    (episode,) = drive()
    assert episode.ended_by == "time"
    assert episode.score.sum() > 4000  # a pretrained agent drives an emulated cart
    return episode


def test_nothing_after_a_frozen_count_is_kept(
    healthy: Episode, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Neither scored nor recorded. No firmware sees that the cart's count froze: the agent drives gently."""
    (episode,) = drive(stuck_encoder="cart", stuck_at=30.0)
    steps = episode.steps
    assert 250 < steps < 280
    assert (episode.counts == healthy.counts[: steps + 1]).all()
    assert episode.counts[-1, 0] != episode.counts[-2, 0]
    assert episode.score.sum() == healthy.score[:steps].sum()
    assert episode.ended_by == "fault"
    assert "the cart's count froze: the last " in caplog.text
    assert episode_metrics(episode, 0.4)["steps"] == steps
    write_recording(tmp_path / "episode.csv", episode)
    assert read_recording(tmp_path / "episode.csv").episode.steps == steps
    assert f"\n# left_out: {episode.left_out}\n" in (tmp_path / "episode.csv").read_text()


def test_an_episode_that_is_frozen_from_the_start_is_left_out(caplog: pytest.LogCaptureFixture) -> None:
    with pytest.raises(FaultError, match="no control period was measured"):
        drive(stuck_encoder="pole", stuck_at=24.5)
    assert "the last 11 of 11 control periods do not count" in caplog.text


def test_a_fault_is_a_truncation_without_the_tracks_penalty(
    healthy: Episode, make_environment: Callable
) -> None:
    """In the transitions that an agent learns from; `plants/serial/test_plant.py` asks the same of a cart."""
    motors = sorted({*healthy.motor.tolist()})
    chunks = {}
    for ending in ("time", "fault", "track"):
        episode = replace(healthy.part(0, 100), ended_by=ending)

        def over(plant: RecordedPlant) -> Any:
            return make_environment(plant, motors)

        chunks[ending] = recorded_chunks(episode, over, motors, None)[-1][0, -1]["next"]
    assert (chunks["fault"]["done"].item(), chunks["fault"]["terminated"].item()) == (True, False)
    assert chunks["fault"]["reward"] == chunks["time"]["reward"] > chunks["track"]["reward"]
    assert chunks["track"]["terminated"].item()


def hanging(motor: Any, cart: Any, pole: Any) -> Episode:
    """A recording whose counts are given, the cart's in m."""
    counts = np.stack(np.broadcast_arrays(np.rint(np.array(cart) / nominal_encoders().metres), pole), 1)
    motors = np.broadcast_to(motor, len(counts) - 1)
    gaps = np.full(len(motors), PERIOD)
    return recording(counts.astype(np.int64), gaps, motors, "time", nominal_encoders())


COUNT = nominal_encoders().metres
TIME = PERIOD * np.arange(100)
FORTH_AND_BACK = 0.1 * (1 - np.cos(4 * TIME))  # m, up to 0.4 m/s
FREE_FALL = np.rint(np.degrees(0.02 * np.cosh(6 * TIME[:26])) / 360 * 4096)


@pytest.mark.parametrize(
    ("episode", "fault"),
    [
        (hanging(0, np.zeros(100), HANGING), 0),
        (hanging([*[150] * 40, *[-150] * 59], np.zeros(100), HANGING), 0),  # friction holds the cart
        (hanging(255, np.zeros(100), HANGING), 0),  # an obstacle
        (hanging(0, 0.3 * TIME, HANGING), 0),  # at constant speed
        (hanging(0, 0.1 * TIME**2, HANGING - 40), 0),  # constant acceleration
        (hanging(0, np.zeros(51), [*FREE_FALL[:0:-1], *FREE_FALL]), 0),  # nearly over the top, and down again
        (hanging(0, [*0.1 * TIME[:10], *[0.02] * 40], HANGING), 0),  # at 0.1 m/s, until friction stops it
        (hanging(0, np.zeros(50), [*range(2030, 2050, 2), *[HANGING] * 40]), 0),
        (hanging(0, np.zeros(100), HANGING), Fault.HARD_LIMIT),
        (hanging(0, np.zeros(100), 10), 0),  # upright, with an error of the encoder's zero of 0.88 degrees
        (hanging(0, np.zeros(100), 9 + np.arange(100) % 4), 0),
    ],
)
def test_what_a_whole_cart_can_do_is_kept(episode: Episode, fault: int) -> None:
    assert measured_part(episode, Fault(fault)) is episode


@pytest.mark.parametrize(
    ("episode", "fault", "steps"),
    [
        (hanging(0, FORTH_AND_BACK, HANGING), 0, 0),
        (hanging(0, FORTH_AND_BACK, [HANGING - 1] * 9 + [HANGING] * 91), 0, 9),
        (hanging(0, FORTH_AND_BACK, [*range(2043, 2048), *[HANGING, 2047] * 47, 2047]), 0, 4),  # an open wire
        (hanging(([220] * 10 + [-220] * 10) * 4, COUNT * (np.arange(81) % 2), np.arange(81)), 0, 0),
        (hanging(([220] * 10 + [-220] * 10) * 4, [0.001] * 5 + [0.0] * 76, np.arange(81)), 0, 5),
        (hanging(100, np.zeros(100), 24 + np.arange(100) % 4), 0, 0),  # balanced by a cart that stands
        (hanging(0, np.zeros(50), [*range(2000, 2050, 5), *[2045] * 40]), 0, 9),  # in the middle of a swing
        (hanging(0, [*0.4 * TIME[:10], *[0.072] * 40], np.arange(50)), 0, 9),
        (hanging(0, [0.0] * 30 + [0.2] * 3, HANGING), 0, 29),  # 10 m/s
        (hanging(0, np.zeros(20), np.arange(20) * 2000), 0, 0),  # 24 turns a second
        (hanging(255, [0.001] * 5 + [0.0] * 30, np.arange(35)), Fault.STALL, 5),
        (hanging(50, 0.001 * np.arange(35), [0] * 8 + [1] * 27), Fault.POLE_ENCODER, 8),
        (hanging(50, 0.001 * np.arange(35), np.arange(35)), Fault.CART_ENCODER, 33),  # an unseen jump
    ],
)
def test_what_follows_is_left_out(episode: Episode, fault: int, steps: int) -> None:
    left = measured_part(episode, Fault(fault))
    assert (left.steps, len(left.time), left.ended_by) == (steps, steps + 1, "fault")
    assert (left.counts == episode.counts[: steps + 1]).all()
    assert f"{episode.steps - steps} of {episode.steps}" in left.left_out


def test_an_unmeasured_step_is_no_frozen_count() -> None:
    """A lost link repeats the last counts: as if the cart had stopped at once."""
    cart = np.append(FORTH_AND_BACK[:50], FORTH_AND_BACK[49])
    pole = [HANGING - 1] * 20 + [HANGING] * 31
    episode = hanging(0, cart, pole)
    lost = replace(episode, ended_by="link")
    assert measured_part(lost) is lost
    assert measured_part(episode).steps == 20
