"""The site's generator: Sphinx with MyST reads README.md, and the pages that its "Read on" tables list.

`make docs` builds it strictly into build/site. The pages are plain Markdown, and no other file is for
Sphinx. The table of contents comes from README.md; the API reference comes from docs/api.md and docstrings,
read without an import of the package.
"""

import ast
import re
from collections.abc import Sequence
from pathlib import Path
from textwrap import dedent
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
LISTED = re.compile(r"^- \[`(?P<module>[\w.]+)`\]\(\.\./(?P<file>[\w./]+)\)(?:: (?P<names>.*))?$", re.M)

project = "cartpole_rl"
extensions = ["myst_parser"]
root_doc = "README"
include_patterns = ["*.md", "docs/**.md", "runs/README.md", "scripts/README.md", "tests/README.md"]
exclude_patterns = [".*", "build", "runs/*/**"]
nitpicky = True
myst_heading_anchors = 4
highlight_language = "text"
html_theme = "furo"
html_title = project
html_copy_source = False
html_show_sphinx = False
html_show_copyright = False
pygments_style = "friendly"
pygments_dark_style = "github-dark"


def contents(readme: str) -> str:
    """Return a toctree for each row of the table below "Read on", and a first one of the other pages."""
    first, _, table = readme.partition("\n## Read on")
    rows = [("Start", first), *re.findall(r"^\| (\w+) \| (.*) \|$", table, re.M)]
    trees = []
    for caption, links in rows:
        pages = dict.fromkeys(re.findall(r"\(([\w./-]+)\.md\)", links))
        if links is first:
            pages = {page: None for page in pages if f"({page}.md)" not in table}
        trees.append("\n".join(["```{toctree}", ":hidden:", f":caption: {caption}", "", *pages, "```"]))
    return "\n\n".join(trees)


def reference(module: str, path: Path, names: Sequence[str]) -> str:
    """Return the docstrings of a module and of its classes and functions `names`, or all, as Markdown."""
    source = path.read_text(encoding="utf-8")
    tree = ast.parse(source)
    parts = [f"## {module.removeprefix('cartpole_rl.')}", f"`{module}`", prose(tree)]
    for node in tree.body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef) and is_public(node, names):
            parts += [f"### {node.name}", *described(node, source)]
    return "\n\n".join(parts)


def expanded(line: re.Match[str]) -> str:
    """Return the reference of the module in a line of docs/api.md."""
    return reference(line["module"], ROOT / line["file"], re.findall(r"`(\w+)`", line["names"] or ""))


def is_public(node: ast.ClassDef | ast.FunctionDef, names: Sequence[str] = ()) -> bool:
    """Return True if `node` is one of `names`, where there are any, and not private."""
    return node.name in names if names else not node.name.startswith("_")


def described(node: ast.ClassDef | ast.FunctionDef, source: str) -> list[str]:
    """Return the signature and the docstring of a function or class, then those of its public methods."""
    parts = [f"```python\n{signature(node, source)}\n```", prose(node)]
    for method in node.body if isinstance(node, ast.ClassDef) else ():
        if isinstance(method, ast.FunctionDef) and is_public(method):
            parts += described(method, source)
    return parts


def prose(node: ast.Module | ast.ClassDef | ast.FunctionDef) -> str:
    """Return the docstring of `node`, in which <, * and _ outside code are no markup."""
    lines = (ast.get_docstring(node) or "").splitlines()
    code = re.compile(r"(`[^`]+`)|([<*_])")
    return "\n".join(
        line if line.startswith("    ") else code.sub(lambda part: part[1] or f"\\{part[2]}", line)
        for line in lines
    )


def signature(node: ast.ClassDef | ast.FunctionDef, source: str) -> str:
    """Return the lines that introduce a function or class, and the fields of a class with their comments."""
    lines = source.splitlines()
    shown = lines[node.lineno - 1 : node.body[0].lineno - 1]
    for field in node.body if isinstance(node, ast.ClassDef) else ():
        if isinstance(field, ast.AnnAssign):
            shown += lines[field.lineno - 1 : field.end_lineno]
    return dedent("\n".join(shown)).rstrip(":")


def add_generated_parts(app: Any, name: str, text: list[str]) -> None:
    """Add the table of contents to README.md, and the docstrings to docs/api.md."""
    if name == root_doc:
        text[0] += f"\n\n{contents(text[0])}\n"
    if name == "docs/api":
        text[0] = LISTED.sub(expanded, text[0])


def add_index(app: Any, error: Exception | None) -> None:
    """Write index.html, which leads to the page of README.md."""
    page = f'<!doctype html><meta http-equiv="refresh" content="0; url={root_doc}.html">\n'
    (Path(app.outdir) / "index.html").write_text(page, encoding="utf-8")


def setup(app: Any) -> None:
    """Connect the generated parts."""
    app.connect("source-read", add_generated_parts)
    app.connect("build-finished", add_index)
