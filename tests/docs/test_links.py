"""Every relative link of a Markdown page leads to a file that is there, and its anchor to a heading."""

import re
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LINK = re.compile(r"\]\(([^)\s]+)\)")
HEADING = re.compile(r"^#+ +(.*?) *$", re.M)
CODE = re.compile(r"^```.*?^```|`[^`\n]*`", re.M | re.S)


def markdown_pages() -> list[Path]:
    """The pages of the repository, without those of runs and of installed packages."""
    folders = (ROOT / "docs", ROOT / "tests", ROOT / "scripts", ROOT / "conf", ROOT / "cartpole_rl")
    nested = [page for folder in folders for page in folder.rglob("*.md")]
    return sorted([*ROOT.glob("*.md"), ROOT / "runs/README.md", *nested])


@cache
def anchors(page: Path) -> set[str]:
    """The anchors of the headings of `page`, as GitHub makes them: repeated ones get a number."""
    found: set[str] = set()
    for heading in HEADING.findall(page.read_text(encoding="utf-8")):
        text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).lower()
        anchor = re.sub(r"[^\w\- ]", "", text).replace(" ", "-")
        number, name = 0, anchor
        while name in found:
            number += 1
            name = f"{anchor}-{number}"
        found.add(name)
    return found


def broken(page: Path) -> list[str]:
    """The relative links of `page` whose file or anchor is missing."""
    wrong = []
    for link in LINK.findall(CODE.sub("", page.read_text(encoding="utf-8"))):
        if re.match(r"[a-z]+:", link):
            continue
        name, _, anchor = link.partition("#")
        target = (page.parent / name).resolve() if name else page
        if not target.exists() or (anchor and anchor not in anchors(target)):
            wrong.append(link)
    return wrong


def test_there_are_pages_with_links() -> None:
    assert len(markdown_pages()) > 10
    assert LINK.findall((ROOT / "README.md").read_text(encoding="utf-8"))


@pytest.mark.parametrize("page", markdown_pages(), ids=lambda page: str(page.relative_to(ROOT)))
def test_relative_links_exist(page: Path) -> None:
    assert broken(page) == []
