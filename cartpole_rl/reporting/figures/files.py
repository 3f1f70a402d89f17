"""Figures as files or as bytes."""

import io
from pathlib import Path

from matplotlib.figure import Figure

from cartpole_rl.files import replacing
from cartpole_rl.reporting import style


def save(figure: Figure, path: Path | str) -> Path:
    """Write `figure` to `path` in the format of its suffix (.png, .pdf, .svg), and create its folder."""
    path = Path(path)
    with replacing(path) as beside:
        figure.savefig(beside, format=path.suffix.removeprefix("."), dpi=style.DPI)
    return path


def png(figure: Figure, dpi: float = style.DPI) -> bytes:
    """Return `figure` as the bytes of a PNG file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi)
    return buffer.getvalue()
