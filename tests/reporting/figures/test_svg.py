"""A figure becomes an SVG element in the colours of the page."""

import re
from xml.etree import ElementTree

from cartpole_rl.reporting import style
from cartpole_rl.reporting.figures import svg
from cartpole_rl.reporting.page import DARK, LIGHT


def drawn(alt: str) -> str:
    figure = style.new_figure(height=2, width=3)
    axes = figure.subplots()
    style.dress(axes)
    axes.plot([0, 1], [0, 1], color=style.BLUE)
    style.label(axes, x="time <s>", y="score")
    return svg(figure, alt)


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


def test_two_figures_share_no_id_and_the_same_one_is_repeated_exactly() -> None:
    first, second = drawn("first"), drawn("second")
    assert not {*re.findall(r'id="(\S+)"', first)} & {*re.findall(r'id="(\S+)"', second)}
    assert drawn("first") == first
