"""Templates of exported files: @@name@@ stands for a value."""

import re
from collections.abc import Mapping
from pathlib import Path

TEMPLATES = Path(__file__).parent / "templates"


def filled(template: str, values: Mapping[str, object]) -> str:
    """Return the content of a template with `values` in place."""
    text = (TEMPLATES / template).read_text(encoding="utf-8")
    return re.sub(r"@@(\w+)@@", lambda match: str(values[match[1]]), text)
