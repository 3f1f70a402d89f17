"""Evaluation: whole episodes of a policy on any plant, their metrics and recordings."""
