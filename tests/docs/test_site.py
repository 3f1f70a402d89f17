"""The site builds without a warning from the pages as they are, and needs no network to be read."""

import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LOADED = re.compile(r"<(?:script|link|img|iframe|source)\b[^>]*?\b(?:src|href)=\"([^\"]+)\"")


def public_modules() -> set[str]:
    """The modules that docs/api.md lists."""
    return set(re.findall(r"^- \[`(cartpole_rl[\w.]+)`\]", (ROOT / "docs/api.md").read_text(), re.M))


def test_the_reference_has_every_module_that_the_page_on_the_api_uses() -> None:
    used = set(re.findall(r"^from (cartpole_rl\S+) import", (ROOT / "docs/python-api.md").read_text(), re.M))
    assert len(used) > 10
    assert used - public_modules() == set()


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built by the command of `make docs`."""
    if find_spec("sphinx") is None:
        pytest.skip('Sphinx is missing: pip install "cartpole_rl[docs]"')
    folder = tmp_path_factory.mktemp("site")
    command = re.search(r"sphinx-build (.*) build/site", (ROOT / "Makefile").read_text())
    assert command is not None
    words = [*command[1].split(), "-d", folder / "trees", folder / "site"]
    done = subprocess.run([sys.executable, "-m", "sphinx", *words], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder / "site"


@pytest.mark.nightly
def test_it_builds_and_shows_the_docstrings_of_public_modules(site: Path) -> None:
    page = (site / "docs/api.html").read_text(encoding="utf-8")
    assert [module for module in public_modules() if module not in page] == []
    named = re.findall(r": (`\w+`.*)$", (ROOT / "docs/api.md").read_text(), re.M)
    names = ["TrainConfig", "CartPoleError", *re.findall(r"`(\w+)`", " ".join(named))]
    assert len(names) > 20
    assert [name for name in names if f"<h3>{name}<" not in page] == []


@pytest.mark.nightly
def test_every_page_of_the_table_is_in_the_contents(site: Path) -> None:
    table = (ROOT / "README.md").read_text().partition("\n## Read on")[2]
    pages = re.findall(r"\(([\w./-]+)\.md\)", table)
    contents = (site / "README.html").read_text(encoding="utf-8").partition('class="sidebar-tree"')[2]
    assert len(pages) > 20
    assert [page for page in pages if f'href="{page}.html"' not in contents] == []


@pytest.mark.nightly
def test_no_page_loads_anything_from_the_network(site: Path) -> None:
    pages = list(site.rglob("*.html"))
    assert len(pages) > 20
    for page in pages:
        loaded = LOADED.findall(page.read_text(encoding="utf-8"))
        assert loaded or page.name == "index.html"
        assert [url for url in loaded if re.match(r"(?:[a-z]+:)?//", url)] == [], page
    for sheet in site.rglob("*.css"):
        assert not re.search(r"@import|url\(['\"]?(?:https?:)?//", sheet.read_text(encoding="utf-8")), sheet
