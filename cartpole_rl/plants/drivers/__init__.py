"""Carts with firmware of their own: a driver reads and commands one, this computer keeps our rules."""
