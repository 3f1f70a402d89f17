"""Agents: Q-networks, their loss, the greedy policy, and a baseline."""
