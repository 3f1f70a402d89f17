"""Nominal parameters and a generator in, a batch of drawn parameters out."""
