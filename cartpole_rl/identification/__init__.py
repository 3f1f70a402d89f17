"""Identification: the parameters of a cart, estimated from recordings."""
