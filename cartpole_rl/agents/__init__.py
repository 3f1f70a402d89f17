"""Agents: Q-networks, their loss, and the policy that leaves training."""

from cartpole_rl.agents.dqn import AgentSettings, QAgent
from cartpole_rl.agents.loss import LossGradient

__all__ = ["AgentSettings", "LossGradient", "QAgent"]
