"""A page of results that needs nothing but itself: text, tables and pictures in one HTML file.

Every text is escaped. Pictures are SVG inside the page; there are no scripts, and nothing is loaded from elsewhere.
"""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

from marl_sched.files import replacing

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; color: #22303c; margin: 2rem auto; max-width: 76rem; padding: 0 1rem; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.2rem; margin-top: 2rem; border-bottom: 1px solid #c9d1d8; }
table { border-collapse: collapse; margin: .6rem 0; font-variant-numeric: tabular-nums; }
th, td { text-align: left; padding: .2rem .9rem .2rem 0; border-bottom: 1px solid #e3e8ec; vertical-align: top; }
th { font-weight: 600; } .wide { overflow-x: auto; } .wide svg { max-width: 100%; height: auto; }
tr.chosen td { background: #eaf3fa; font-weight: 600; } .note { color: #5d6d7e; font-size: .9rem; }
summary { cursor: pointer; color: #2b6a9b; }
"""


class Page:
    """Grows from top to bottom, then is saved."""

    def __init__(self, title: str) -> None:
        self._title, self._parts = title, [f"<h1>{escape(title)}</h1>"]

    def heading(self, text: str) -> None:
        """Begin a section."""
        self._parts.append(f"<h2>{escape(text)}</h2>")

    def text(self, text: str, *, note: bool = False) -> None:
        """A paragraph, a `note` in smaller letters."""
        self._parts.append(f"<p{' class=note' if note else ''}>{escape(text)}</p>")

    def items(self, texts: Sequence[str]) -> None:
        """A list."""
        self._parts.append("<ul>" + "".join(f"<li>{escape(text)}</li>" for text in texts) + "</ul>")

    def table(
        self, headings: Sequence[str], rows: Sequence[Sequence[str]], *, chosen: int | None = None, folded: str = ""
    ) -> None:
        """A table; row `chosen` stands out, and behind a `folded` title it is closed at first."""
        head = "".join(f"<th>{escape(heading)}</th>" for heading in headings)
        lines = []
        for k, row in enumerate(rows):
            cells = "".join(f"<td>{escape(cell)}</td>" for cell in row)
            lines.append(f"<tr{' class=chosen' if k == chosen else ''}>{cells}</tr>")
        body = "".join(lines)
        table = f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'
        self._parts.append(f"<details><summary>{escape(folded)}</summary>{table}</details>" if folded else table)

    def figure(self, figure: Figure) -> None:
        """A picture, the same bytes for the same figure; ids are told apart by where it stands in the page."""
        self._parts.append(f'<div class="wide">{_svg(figure, len(self._parts))}</div>')

    def save(self, path: Path) -> Path:
        """Write the page, whole or not at all; its path."""
        title = escape(self._title)
        page = (
            f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<title>{title}</title>\n'
            f'<meta name="viewport" content="width=device-width, initial-scale=1">\n<style>{_STYLE}</style>\n</head>\n'
            f"<body>\n" + "\n".join(self._parts) + "\n</body>\n</html>\n"
        )
        with replacing(path) as temporary:
            temporary.write_text(page, encoding="utf-8")
        return path


def _svg(figure: Figure, number: int) -> str:
    """A figure as an `svg` element with texts as texts; its ids begin with the number, as a page may hold several."""
    import matplotlib as mpl

    out = io.StringIO()
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": str(number)}):
        figure.savefig(out, format="svg", metadata={"Date": None, "Creator": None})
    text = out.getvalue()
    element = re.sub(r"<metadata>.*?</metadata>", "", text[text.index("<svg") :], flags=re.DOTALL)
    prefix = f"f{number}-"
    element = re.sub(r'\bid="', f'id="{prefix}', element)
    element = re.sub(r'href="#', f'href="#{prefix}', element)
    return re.sub(r"url\(#", f"url(#{prefix}", element)
