"""Evaluation: whole episodes of a policy on any plant, and what they are worth."""
