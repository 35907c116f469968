"""Reports as lists of headings, paragraphs, tables and images, rendered as Markdown or as one HTML page."""

import base64
import html
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

_COLORED = ("better", "worse")
_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; margin: 0 auto; max-width: 60rem; padding: 0 1rem 3rem; color: #222;
  overflow-wrap: anywhere; }
h1, h2 { line-height: 1.2; } h2 { border-top: 1px solid #ddd; padding-top: 1rem; }
.wide { overflow-x: auto; margin: 1rem 0; }
table { border-collapse: collapse; white-space: nowrap; font-variant-numeric: tabular-nums; font-size: 0.9rem; }
th, td { padding: .3rem .7rem; border-bottom: 1px solid #ddd; text-align: right; }
th:first-child, td:first-child { text-align: left; position: sticky; left: 0; background: #fff; }
th, th:first-child { cursor: pointer; background: #f4f4f4; }
.better { color: #060; font-weight: 600; } .worse { color: #b00; } .failed { color: #b00; }
img { width: 40rem; max-width: 100%; height: auto; } figure { margin: 1rem 0; } figcaption { color: #555; }
summary { cursor: pointer; padding: .3rem 0; }
@media (max-width: 40rem) { th, td { padding: .3rem .4rem; }
  td:first-child { white-space: normal; overflow-wrap: anywhere; min-width: 6rem; } }
@media (prefers-color-scheme: dark) { body { background: #181818; color: #ddd; }
  th:first-child, td:first-child { background: #181818; } th, th:first-child { background: #2a2a2a; }
  th, td, h2 { border-color: #444; } .better { color: #7d7; } .worse, .failed { color: #f77; }
  figcaption { color: #aaa; } img { background: #fff; } }
"""
_SCRIPT = """
document.querySelectorAll("th").forEach(head => head.addEventListener("click", () => {
  const table = head.closest("table"), column = head.cellIndex, body = table.tBodies[0];
  const down = head.dataset.down = head.dataset.down === "1" ? "" : "1";
  const key = row => { const text = row.cells[column].textContent, number = parseFloat(text);
    return isNaN(number) ? text : number; };
  [...body.rows].sort((a, b) => { const x = key(a), y = key(b);
    const order = typeof x === typeof y ? (x < y ? -1 : x > y ? 1 : 0) : typeof x === "number" ? -1 : 1;
    return down ? order : -order; }).forEach(row => body.append(row));
}));
"""


@dataclass(frozen=True)
class Heading:
    """A heading."""

    text: str
    """Words of the heading."""
    level: Literal[1, 2] = 2
    """1 for the title of the report, 2 for a section."""


@dataclass(frozen=True)
class Paragraph:
    """A paragraph."""

    text: str
    """Words of the paragraph."""


@dataclass(frozen=True)
class Bullets:
    """A list of sentences; without any, nothing is rendered."""

    lines: Sequence[str]
    """Text of each bullet."""
    is_warning: bool = False
    """Whether the HTML page shows the list in red."""


@dataclass(frozen=True)
class Table:
    """A table; without lines, nothing is rendered."""

    lines: Sequence[Sequence[str]]
    """Texts of each row; the first row holds the headings of the columns."""
    name: str = ""
    """Name of the files that hold the table alone; empty for none."""


@dataclass(frozen=True)
class Image:
    """An image that is embedded in the report."""

    data: bytes
    """Content of the image file."""
    caption: str
    """Text below the image."""
    kind: Literal["png", "jpeg"] = "png"
    """Format of the image file."""
    is_folded: bool = False
    """Whether the HTML page shows the image only after a click."""


Block: TypeAlias = Heading | Paragraph | Bullets | Table | Image


def to_markdown(blocks: Iterable[Block]) -> str:
    """Render a report as Markdown; texts may hold Markdown of their own."""
    return "\n".join(filter(None, map(_markdown, blocks)))


def to_html(title: str, blocks: Iterable[Block]) -> str:
    """Render a report as an HTML page that needs no other file; all texts are escaped.

    Args:
        title: Title of the page in the browser.
        blocks: Blocks of the report, in order.
    """
    head = (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{html.escape(title)}</title><style>{_STYLE}</style></head><body>"
    )
    body = "\n".join(filter(None, map(_html, blocks)))
    return f"{head}{body}<script>{_SCRIPT}</script></body></html>\n"


def _markdown(block: Block) -> str:
    match block:
        case Heading(text, level):
            return f"{'#' * level} {text}\n"
        case Paragraph(text):
            return f"{text}\n" if text else ""
        case Bullets(lines):
            return "".join(f"- {line}\n" for line in lines)
        case Table(lines):
            rows = [*lines[:1], *(["---"] * len(line) for line in lines[:1]), *lines[1:]]
            return "".join(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in row)} |\n" for row in rows)
        case Image():
            return f"![{block.caption}]({_data(block)})\n"


def _html(block: Block) -> str:
    match block:
        case Heading(text, level):
            return f"<h{level}>{html.escape(text)}</h{level}>"
        case Paragraph(text):
            return f"<p>{html.escape(text)}</p>" if text else ""
        case Bullets(lines, is_warning):
            look = ' class="failed"' if is_warning else ""
            return f"<ul{look}>{''.join(f'<li>{html.escape(line)}</li>' for line in lines)}</ul>" if lines else ""
        case Table(lines):
            return _html_table(lines) if lines else ""
        case Image():
            return _html_image(block)


def _html_table(lines: Sequence[Sequence[str]]) -> str:
    head = "".join(f"<th>{html.escape(column)}</th>" for column in lines[0])
    body = "".join("<tr>" + "".join(map(_html_cell, line)) + "</tr>" for line in lines[1:])
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def _html_cell(text: str) -> str:
    look = f' class="{text}"' if text in _COLORED else ""
    return f"<td{look}>{html.escape(text)}</td>"


def _html_image(image: Image) -> str:
    caption = html.escape(image.caption)
    shown = f'<figure><img alt="{caption}" src="{_data(image)}"><figcaption>{caption}</figcaption></figure>'
    return f"<details><summary>{caption}</summary>{shown}</details>" if image.is_folded else shown


def _data(image: Image) -> str:
    return f"data:image/{image.kind};base64,{base64.b64encode(image.data).decode()}"
