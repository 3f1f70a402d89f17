"""Operations of PyTorch that can be written as plain arithmetic, and numbers that are awkward for them."""

import itertools
import math
from collections.abc import Callable

import torch
from torch import Tensor

AWKWARD = (0.0, -0.0, 0.5, -0.5, 1.5, 2.5, 1.0, -1.0, math.nan, math.inf, -math.inf, 1e300, -1e300, 710.0)
PAIRS = list(itertools.product((*AWKWARD, 0.3, -7.4, 3.0), repeat=2))

OPERATIONS: tuple[Callable[[Tensor, Tensor], Tensor], ...] = (
    lambda a, b: a + 2 * b - 1,
    lambda a, b: 1 - a * b,
    lambda a, b: a / b,
    lambda a, b: 1 / a,
    lambda a, b: a / 3,
    lambda a, b: a % b,
    lambda a, b: -a.abs(),
    lambda a, b: a.sign(),
    lambda a, b: torch.copysign(a, b),
    lambda a, b: a.round(),
    lambda a, b: a.clamp(0, 1),
    lambda a, b: a.clamp(min=0.0),
    lambda a, b: a.clamp(max=2),
    lambda a, b: a.clamp(-b, b),
    lambda a, b: a.nan_to_num(0.0).clamp(-(2**30), 2**30).long(),
    lambda a, b: a.sin() + b.cos(),
    lambda a, b: a.exp(),
    lambda a, b: a.sigmoid() - b.tanh(),
    lambda a, b: a.clamp(-1e9, 1e9) ** 2,
    lambda a, b: torch.where((a > b) | (a == 0), a, b),
    lambda a, b: ~(a <= b) & (b != 0),
    lambda a, b: (a < 1.5) * b,
    lambda a, b: ((a > 0) + (b > 0)) * (a < b),
    lambda a, b: 1 * (a >= b) - 1 * (a < b),
    lambda a, b: (a > 0).to(a.dtype) + b.bool(),
    lambda a, b: (a.nan_to_num(0.0).clamp(-5000, 5000).long() + 2048) & 4095,
    lambda a, b: (a.nan_to_num(0.0).clamp(-5000, 5000).long() + 100) % 7,
    lambda a, b: (5 * (a > b).long() - 9 * (a < 1).long()) % 7,
    lambda a, b: torch.ops.aten.alias(a),  # traced where another thread, as a profiler's, holds a frame
)
