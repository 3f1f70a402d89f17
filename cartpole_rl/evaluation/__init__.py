"""Evaluation: whole episodes of a policy on any plant, and what they are worth."""

from cartpole_rl.evaluation.episodes import run_episodes
from cartpole_rl.evaluation.metrics import episode_metrics, summarize

__all__ = ["episode_metrics", "run_episodes", "summarize"]
