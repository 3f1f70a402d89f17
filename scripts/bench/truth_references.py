"""Reference scores of drawn carts: the best score found on a simulated cart with the numbers of each truth.

`reference.py --truths` writes truth_references/<seed>_<wider>.json, one file for each draw. An entry holds a
digest of the simulated cart, so that a reference of other numbers is never used.
"""

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from common import read_json, write_json
from truths import Truth, draw_truths, simulated_cart

ADDED = {
    ("backdrivability", 1.0),
    ("coasting", 0.0),
}  # which the simulator had not when references were searched
FOLDER = Path(__file__).with_name("truth_references")


class Draw(NamedTuple):
    """A seed of truths, and the share by which their ranges are wider."""

    seed: int
    wider: float

    @property
    def file(self) -> Path:
        """The file of the draw's references."""
        return FOLDER / f"{self.seed}_{self.wider:g}.json"

    def truths(self, count: int) -> list[Truth]:
        """Return the first `count` truths."""
        return draw_truths(self.seed, count, self.wider)


def digest(truth: Truth) -> str:
    """Return a short hash of the simulated cart of a truth."""
    numbers = sorted(pair for pair in simulated_cart(truth).items() if pair not in ADDED)
    return hashlib.sha256(" ".join(f"{name}={value:.6g}" for name, value in numbers).encode()).hexdigest()[
        :12
    ]


def known_references(draw: Draw, truths: Sequence[Truth]) -> list[float | None]:
    """Return the reference score of each of the first truths of a draw; None if it was not computed."""
    known = read_json(draw.file) if draw.file.exists() else {}
    entries = [known.get(str(number)) for number in range(len(truths))]
    return [
        entry["score"] if entry and entry["cart"] == digest(truth) else None
        for entry, truth in zip(entries, truths, strict=True)
    ]


def add_reference(draw: Draw, number: int, truth: Truth, found: dict[str, Any]) -> None:
    """Write the reference `found` of the truth `number`."""
    FOLDER.mkdir(exist_ok=True)
    known = read_json(draw.file) if draw.file.exists() else {}
    known[str(number)] = {**found, "cart": digest(truth)}
    write_json(draw.file, dict(sorted(known.items(), key=lambda item: int(item[0]))))


def note_missing(draw: Draw, references: Sequence[float | None]) -> None:
    """Print one line with the command that computes the missing references, if any are missing."""
    if missing := sum(reference is None for reference in references):
        print(
            f"{missing} of {len(references)} truths have no reference score: run "
            f"scripts/bench/reference.py --truths {len(references)} --seed {draw.seed} --wider {draw.wider:g}"
        )
