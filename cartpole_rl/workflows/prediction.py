"""An episode on a cart, beside the one that simulation predicts from the same start."""

from pathlib import Path

from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.evaluation.episodes import Policy, run_batch
from cartpole_rl.plants.simulated import SimulatedPlant
from cartpole_rl.reporting.animation import side_by_side, write_animation
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.workflows.episodes import Evaluation


def draw_beside_simulation(evaluation: Evaluation, episode: Episode, path: Path) -> str:
    """Draw `episode` and its prediction into `path`, and return a line that compares their scores."""
    assert evaluation.simulation is not None
    predicted = predicted_episode(evaluation.simulation, evaluation.policy, episode)
    titles = f"plant={evaluation.config.plant.kind}", "predicted by simulation"
    pole, track = evaluation.settings.pole.nominal.length, evaluation.settings.task.x_max
    pictures, times = side_by_side((episode, predicted), titles, pole, track)
    write_animation(path, pictures, times, evaluation.config.animation.mp4)
    scores = f"score {episode.score.sum():.0f}, predicted by simulation {predicted.score.sum():.0f}"
    return f"first episode: {scores}; {path.name} shows both"


def predicted_episode(env: CartPoleEnv, policy: Policy, episode: Episode) -> Episode:
    """Return an episode of `policy` on the simulated cart of `env`, from the measured start of `episode`."""
    assert isinstance(env.plant, SimulatedPlant)
    names = ("x", "x_dot", "theta", "theta_dot")
    env.plant.start_from({name: float(getattr(episode, name)[0]) for name in names})
    (predicted,) = run_batch(env, policy)
    return predicted
