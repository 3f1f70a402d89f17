"""Agents: Q-networks, their loss, and the policy that leaves training."""
