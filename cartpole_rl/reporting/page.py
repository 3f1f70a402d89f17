"""A simple HTML page: headings, tables, lists, paragraphs and figures."""

import html
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cartpole_rl.reporting import style

STYLE = f"""
body {{ font: 16px/1.5 system-ui, sans-serif; color: {style.INK}; max-width: 60rem; margin: 2rem auto;
       padding: 0 1rem; }}
h1 {{ font-size: 1.7rem; }} h2 {{ font-size: 1.15rem; margin-top: 2.2rem; }}
table {{ border-collapse: collapse; }} th, td {{ text-align: left; padding: .25rem 1.2rem .25rem 0; }}
th {{ color: {style.MUTED}; font-weight: normal; border-bottom: 1px solid {style.MUTED}; }}
td {{ border-bottom: 1px solid {style.FAINT}; }}
img {{ max-width: 100%; }}
code {{ background: {style.FAINT}; padding: .1rem .3rem; overflow-wrap: anywhere; }}
"""
Section = Sequence[Mapping[str, str]] | Sequence[str] | str | Path


def page(title: str, sections: Sequence[tuple[str, Any]]) -> str:
    """Return HTML: each section is a heading and its content.

    Mappings become a table headed by their keys, texts a list, one text a paragraph, and a path a figure.
    Texts are escaped; only a list's text that starts with <code> and ends with </code> keeps these tags.
    """
    parts = [f"<h1>{html.escape(title)}</h1>"]
    for heading, content in sections:
        if heading:
            parts.append(f"<h2>{html.escape(heading)}</h2>")
        parts.append(_section(content, heading))
    return (
        f'<!doctype html>\n<html lang="en"><meta charset="utf-8"><title>{html.escape(title)}</title>'
        f"<style>{STYLE}</style>\n" + "\n".join(parts) + "\n</html>\n"
    )


def _section(content: Section, heading: str) -> str:
    if isinstance(content, Path):
        return f'<img src="{html.escape(content.as_posix())}" alt="{html.escape(heading)}">'
    if isinstance(content, str):
        return f"<p>{html.escape(content)}</p>"
    rows = [row for row in content if isinstance(row, Mapping)]
    if not rows:
        items = "".join(f"<li>{_text(str(item))}</li>" for item in content)
        return f"<ul>{items}</ul>"
    head = "".join(f"<th>{html.escape(key)}</th>" for key in rows[0])
    body = "".join(
        "<tr>" + "".join(f"<td>{html.escape(str(cell))}</td>" for cell in row.values()) + "</tr>"
        for row in rows
    )
    return f"<table><tr>{head}</tr>{body}</table>"


def _text(item: str) -> str:
    if item.startswith("<code>") and item.endswith("</code>"):
        return f"<code>{html.escape(item[6:-7])}</code>"
    return html.escape(item)
