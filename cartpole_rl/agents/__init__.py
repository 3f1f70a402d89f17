"""Agents: Q-networks, their loss, and the policy that leaves training."""

from cartpole_rl.agents.dqn import AgentSettings, QAgent

__all__ = ["AgentSettings", "QAgent"]
