"""Identification: what a recording says about the cart that it was made on."""

from cartpole_rl.identification.fit import Fit, fit_cart
from cartpole_rl.identification.unknowns import LONGEST_LATENCY, UNKNOWNS, Unknown
from cartpole_rl.identification.windows import Windows, cut_windows

__all__ = ["LONGEST_LATENCY", "UNKNOWNS", "Fit", "Unknown", "Windows", "cut_windows", "fit_cart"]
