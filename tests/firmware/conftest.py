"""Makes scripts/qemu/cart.py importable as `qemu_cart`."""

import importlib.util
import sys
from pathlib import Path

PATH = Path(__file__).parents[2] / "scripts" / "qemu" / "cart.py"
SPECIFICATION = importlib.util.spec_from_file_location("qemu_cart", PATH)
assert SPECIFICATION is not None
assert SPECIFICATION.loader is not None
sys.modules["qemu_cart"] = importlib.util.module_from_spec(SPECIFICATION)
SPECIFICATION.loader.exec_module(sys.modules["qemu_cart"])
