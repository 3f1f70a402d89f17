"""Agents: Q-networks, their loss, and the policy that leaves training."""

from cartpole_rl.agents.dqn import AgentSettings, QAgent
from cartpole_rl.agents.loss import Columns, LossGradient, columns_of

__all__ = ["AgentSettings", "Columns", "LossGradient", "QAgent", "columns_of"]
