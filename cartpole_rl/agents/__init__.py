"""Agents: Q-networks, their loss, and the policy that leaves training."""

from cartpole_rl.agents.dqn import AgentSettings, QAgent
from cartpole_rl.agents.loss import AdvantageLearningLoss, Columns, LossGradient, columns_of

__all__ = ["AdvantageLearningLoss", "AgentSettings", "Columns", "LossGradient", "QAgent", "columns_of"]
