"""HTML pages that are read on a phone, on a desk and on paper, in light and dark.

A page needs no other file, no network and no script. `reporting.style.svg` draws in its colours.
"""

import html
import re
from collections.abc import Mapping, Sequence
from typing import Any

from cartpole_rl.drawing.colours import FAINT, INK, MUTED, PAPER
from cartpole_rl.reporting import style

LIGHTER = ("#4AA3DF", "#FF7B39", "#2FC79B", "#E39CC0", "#F2B430", "#A5DBF8", "#CF9256", "#F0F0F0")
LIGHT = {
    "ink": INK,
    "muted": MUTED,
    "faint": FAINT,
    "paper": PAPER,
    "link": "#00588A",
    "alarm": "#A8420A",
    **{f"series-{index}": colour for index, colour in enumerate(style.SERIES)},
}
DARK = {  # the same hues, lighter
    "ink": "#E6E6E6",
    "muted": "#A0A0A0",
    "faint": "#383C42",
    "paper": "#16181C",
    "link": "#7CC4F5",
    "alarm": "#FF9B66",
    **{f"series-{index}": colour for index, colour in enumerate(LIGHTER)},
}


def _variables(colours: Mapping[str, str]) -> str:
    return " ".join(f"--{name}: {colour};" for name, colour in colours.items())


STYLE = f"""
:root {{ color-scheme: light dark; {_variables(LIGHT)} }}
@media (prefers-color-scheme: dark) {{ @media screen {{ :root {{ {_variables(DARK)} }} }} }}
body {{ font: 16px/1.5 system-ui, sans-serif; color: var(--ink); background: var(--paper); max-width: 60rem;
       margin: 2rem auto; padding: 0 1rem; overflow-wrap: break-word; }}
h1 {{ font-size: 1.7rem; line-height: 1.25; }} h2 {{ font-size: 1.15rem; margin-top: 2.2rem; }}
a {{ color: var(--link); }}
table {{ border-collapse: collapse; }} th, td {{ text-align: left; padding: .25rem 1.2rem .25rem 0; }}
th {{ color: var(--muted); font-weight: normal; border-bottom: 1px solid var(--muted); }}
td {{ border-bottom: 1px solid var(--faint); vertical-align: top; }}
.number {{ white-space: nowrap; }}
img {{ max-width: 100%; background: {PAPER}; border-radius: 4px; }}
code {{ background: var(--faint); padding: .1rem .3rem; overflow-wrap: anywhere; }}
@media (max-width: 40rem) {{
  body {{ margin: 1rem auto; }}
  table {{ display: block; overflow-x: auto; }} th, td {{ padding-right: .8rem; }}
  .cards, .cards tbody, .cards tr, .cards td {{ display: block; }}
  .cards tr {{ border-bottom: 1px solid var(--muted); padding: .4rem 0; }}
  .cards tr:has(th) {{ display: none; }}
  .cards td {{ border: 0; padding: .1rem 0; }}
  .cards td::before {{ content: attr(data-label) ": "; color: var(--muted); }}
}}
@media print {{
  :root {{ color-scheme: light; }}
  body {{ font-size: 10pt; max-width: none; margin: 0; }}
  a {{ color: inherit; text-decoration: none; }}
  figure, svg, tr, pre {{ break-inside: avoid; }} h2, h3 {{ break-after: avoid; }}
}}
"""
NUMBER = re.compile(r"-?\d[\w.,%±() –-]{0,28}$")  # "4104 (4062 to 4177)", "10 of 10"


class Html(str):
    """Text that is HTML already: `escaped` leaves it as it is."""


def escaped(content: Any) -> str:
    """Return `content` as HTML."""
    return content if isinstance(content, Html) else html.escape(str(content))


def document(title: str, body: str, extra_style: str = "") -> str:
    """Return the whole page with this body."""
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title>'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<style>{STYLE}{extra_style}</style></head>\n<body>\n{body}\n</body></html>\n"
    )


def table(rows: Sequence[Mapping[str, Any]], cards: bool = False) -> Html:
    """Return a table headed by the keys of the first row; with `cards` a phone shows each row as a list."""
    head = "".join(f"<th>{html.escape(key)}</th>" for key in rows[0])
    body = "".join(f"<tr>{''.join(_cell(key, cell) for key, cell in row.items())}</tr>" for row in rows)
    opening = '<table class="cards">' if cards else "<table>"
    return Html(f"{opening}<tr>{head}</tr>{body}</table>")


def _cell(key: str, content: Any) -> str:
    """Return a cell; one that starts with a number and is short stays on one line."""
    text = escaped(content)
    kind = ' class="number"' if NUMBER.match(text) else ""
    return f'<td{kind} data-label="{html.escape(key)}">{text}</td>'
