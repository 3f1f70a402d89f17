"""A figure becomes a file of the format that its path names, or an SVG element in the colours of the page."""

import re
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

from cartpole_rl.drawing.colours import BLUE
from cartpole_rl.reporting import style
from cartpole_rl.reporting.style import DARK, LIGHT


def drawn(alt: str) -> str:
    figure = style.new_figure(height=2, width=3)
    axes = figure.subplots()
    style.dress(axes, x="time <s>", y="score")
    axes.plot([0, 1], [0, 1], color=BLUE)
    return style.svg(figure, alt)


def test_it_is_one_element_with_text_and_an_alternative() -> None:
    element = ElementTree.fromstring(drawn('5 < 6 & "so"').replace("xlink:href", "href"))
    assert element.get("role") == "img"
    assert element.get("aria-label") == '5 < 6 & "so"'
    assert "time <s>" in "".join(element.itertext())


def test_its_colours_follow_the_page() -> None:
    text = drawn("a")
    assert "stroke: var(--series-0)" in text
    assert "fill: currentColor" in text
    assert not re.search("#[0-9a-fA-F]{6}", text)
    assert LIGHT.keys() == DARK.keys()
    for name in re.findall(r"var\(--([\w-]+)\)", text):
        assert name in DARK


def test_every_colour_of_a_series_follows_the_page() -> None:
    figure = style.new_figure(height=2, width=3)
    axes = figure.subplots()
    for index in range(len(style.SERIES)):
        axes.plot(index, index, "o", color=style.series_colour(index), markeredgewidth=0)
    text = style.svg(figure, "dots")
    assert all(f"fill: var(--series-{index})" in text for index in range(len(style.SERIES)))


def test_two_figures_share_no_id_and_the_same_one_is_repeated_exactly() -> None:
    first, second = drawn("first"), drawn("second")
    assert not {*re.findall(r'id="(\S+)"', first)} & {*re.findall(r'id="(\S+)"', second)}
    assert drawn("first") == first


@pytest.mark.parametrize(("ending", "magic"), [("png", b"\x89PNG"), ("svg", b"<?xml"), ("pdf", b"%PDF")])
def test_save_writes_the_format_that_the_ending_names(tmp_path: Path, ending: str, magic: bytes) -> None:
    path = tmp_path / "new" / f"picture.{ending}"
    style.save(style.new_figure(height=1, width=1), path)
    assert path.read_bytes().startswith(magic)


def test_no_figure_needs_pyplot() -> None:
    code = (
        "import sys, numpy; from cartpole_rl.reporting import groups, style;"
        "style.png(groups.dot_rows({'a': {'': numpy.ones(2)}}, 'score', {}));"
        "sys.exit('matplotlib.pyplot' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
