"""Figures of a run: each function takes arrays and returns a matplotlib Figure; `save` writes one.

No function touches pyplot or a global setting, so that they may be called from any thread.
"""

from cartpole_rl.reporting.figures.behaviours import behaviour
from cartpole_rl.reporting.figures.comparisons import comparison
from cartpole_rl.reporting.figures.files import png, save, svg
from cartpole_rl.reporting.figures.learning_curves import learning_curve

__all__ = [
    "behaviour",
    "comparison",
    "learning_curve",
    "png",
    "save",
    "svg",
]
