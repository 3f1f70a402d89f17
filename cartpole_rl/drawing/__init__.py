"""Pictures of a cart, its pole and its track, and the colours that they share with the figures.

Pages with a moving cart share their style, and the pictures on a canvas, in `parts/`.
"""

import re
from collections.abc import Mapping
from pathlib import Path

PARTS = Path(__file__).parent / "parts"


def filled(template: Path, values: Mapping[str, object]) -> str:
    """Return the content of a template with `values` in place of @@name@@."""
    text = template.read_text(encoding="utf-8")
    return re.sub(r"@@(\w+)@@", lambda match: str(values[match[1]]), text)


def shared_parts() -> dict[str, str]:
    """Return the style of a page, `style`, and the functions that draw on it, `scene`."""
    names = {"style": "page.css", "scene": "scene.js"}
    return {key: (PARTS / name).read_text(encoding="utf-8") for key, name in names.items()}
