"""A page of HTML that needs nothing else: pictures are inside it, and their colours follow the reader's theme."""

import base64
import colorsys
import io
import re
from collections.abc import Iterable, Sequence
from html import escape
from typing import Any

from matplotlib.figure import Figure

from vecpsmbpo.look import style

# What pictures are drawn in, and what it becomes on dark paper; other colours are made lighter.
DARK = {style.INK: "#e6edf3", style.FAINT: "#9198a1", style.GRID: "#2d333b", style.PAPER: "#0d1117"}
LIGHTNESS = 0.62  # of series on dark paper, at least

CSS = """
:root { color-scheme: light dark; --page: #f6f8fa; --card: #ffffff; --edge: #d8dee4; --ink: #1f2328; --soft: #59636e;
  --accent: #0072b2; --shade: #1f232833; }
* { box-sizing: border-box; }
body { margin: 0; background: var(--page); color: var(--ink); font: 15px/1.5 system-ui, -apple-system, "Segoe UI",
  Roboto, sans-serif; }
main { max-width: 1240px; margin: 0 auto; padding: 20px 16px 60px; }
h1 { font-size: 1.55rem; line-height: 1.25; margin: 0 0 4px; }
h2 { font-size: 1.15rem; margin: 36px 0 4px; }
h3 { font-size: 1rem; margin: 20px 0 4px; }
p { margin: 4px 0 12px; max-width: 76ch; }
.soft { color: var(--soft); }
.above { margin: 12px 0 -8px; font-weight: 600; }
.warning { border-left: 3px solid #d55e00; padding-left: 10px; }
.state { display: inline-block; border: 1px solid var(--edge); border-radius: 99px; padding: 0 10px; font-size: .85rem;
  background: var(--card); }
.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(150px, 1fr)); gap: 10px; margin: 16px 0; }
.tile, figure { background: var(--card); border: 1px solid var(--edge); border-radius: 8px; }
.tile { padding: 10px 14px; }
.tile b { display: block; font-size: 1.35rem; font-variant-numeric: tabular-nums; line-height: 1.3; }
.tile span { color: var(--soft); font-size: .85rem; }
.panels { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(100%, 360px), 1fr)); gap: 12px; }
figure { margin: 0; padding: 10px 12px; min-width: 0; }
figure svg { width: 100%; height: auto; display: block; }
figure video, figure img { width: 100%; border-radius: 4px; display: block; }
figcaption { font-size: .85rem; color: var(--soft); margin-top: 4px; }
/* Where a table goes on to the right, its edge is shaded: the first gradient lies on the second at the end. */
.wide { overflow-x: auto; margin: 12px 0; width: fit-content; max-width: 100%; border: 1px solid var(--edge);
  border-radius: 8px; background: linear-gradient(to left, var(--card) 40%, transparent) right / 40px 100% no-repeat
  local, linear-gradient(to left, var(--shade), transparent) right / 16px 100% no-repeat scroll, var(--card); }
table { border-collapse: collapse; font-size: .87rem; font-variant-numeric: tabular-nums; }
tr:last-child td { border-bottom: 0; }
th, td { padding: 4px 12px 4px 0; text-align: right; border-bottom: 1px solid var(--edge); white-space: nowrap; }
th:first-child, td:first-child { text-align: left; padding-left: 10px; position: sticky; left: 0;
  background: var(--card); }
th { font-weight: 600; color: var(--soft); }
pre { background: var(--card); border: 1px solid var(--edge); border-radius: 8px; padding: 10px 14px; font-size: .84rem;
  white-space: pre-wrap; overflow-wrap: anywhere; }
details { margin: 12px 0; }
summary { cursor: pointer; color: var(--accent); padding: 6px 0; }
@media (prefers-color-scheme: dark) {
  :root { --page: #010409; --card: #0d1117; --edge: #30363d; --ink: #e6edf3; --soft: #9198a1; --accent: #4aa8e0;
    --shade: #e6edf34d; }
}
@media print { body { background: #fff; } figure, .tile { break-inside: avoid; } }
"""

PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<link rel="icon" href="data:,">
{refresh}<title>{title}</title>
<style>{css}{colours}</style>
</head>
<body>
<main>
{body}
</main>
</body>
</html>
"""


class Page:
    """A page that grows by pieces of HTML."""

    def __init__(self, title: str, *, refresh_s: int = 0):
        """`refresh_s`: seconds after which a browser looks for a newer one; 0: never."""
        self._title, self._refresh_s = title, refresh_s
        self._pieces: list[str] = []
        self._colours: set[str] = set()

    def add(self, *pieces: str) -> None:
        """HTML, as it is."""
        self._pieces += pieces

    def picture(self, figure: Figure, caption: str) -> str:
        """A figure as HTML; `caption` also says what it shows to those who cannot see it."""
        svg, colours = inline(figure)
        self._colours |= colours
        svg = svg.replace("<svg ", f'<svg role="img" aria-label="{escape(caption, quote=True)}" ', 1)
        return f"<figure>{svg}<figcaption>{escape(caption)}</figcaption></figure>"

    def __str__(self) -> str:
        light = "".join(f"--c{colour[1:]}:{colour};" for colour in sorted(self._colours))
        dark = "".join(f"--c{colour[1:]}:{on_dark(colour)};" for colour in sorted(self._colours))
        return PAGE.format(
            refresh=f'<meta http-equiv="refresh" content="{self._refresh_s}">\n' if self._refresh_s else "",
            title=escape(self._title),
            css=CSS,
            colours=f":root{{{light}}}\n@media (prefers-color-scheme: dark){{:root{{{dark}}}}}\n",
            body="\n".join(self._pieces),
        )


def inline(figure: Figure) -> tuple[str, set[str]]:
    """The figure as SVG to stand within HTML, its colours as CSS variables; the colours."""
    text = io.StringIO()
    figure.savefig(text, format="svg", transparent=True, metadata={"Date": None})
    svg = text.getvalue()
    svg = svg[svg.index("<svg ") :]
    svg = re.sub(
        r'<svg [^>]*?(viewBox="[^"]*")[^>]*>', r'<svg xmlns:xlink="http://www.w3.org/1999/xlink" \1>', svg, count=1
    )
    svg = re.sub(r"<metadata>.*?</metadata>\s*", "", svg, flags=re.DOTALL)
    svg = re.sub(r'<g id="[^"]*"', "<g", svg)  # would stand several times in one page; nothing refers to them
    svg = svg.replace("'DejaVu Sans'", "system-ui, sans-serif").replace("<defs/>", "")
    colours = set(re.findall(r"#[0-9a-f]{6}(?=[;\"])", svg))
    return re.sub(r"#([0-9a-f]{6})(?=[;\"])", r"var(--c\1)", svg), colours


def on_dark(colour: str) -> str:
    """The colour on dark paper."""
    if colour in DARK:
        return DARK[colour]
    hue, lightness, saturation = colorsys.rgb_to_hls(*(int(colour[at : at + 2], 16) / 255 for at in (1, 3, 5)))
    lighter = colorsys.hls_to_rgb(hue, max(lightness, LIGHTNESS), saturation)
    return "#" + "".join(f"{round(255 * part):02x}" for part in lighter)


def tiles(items: Iterable[tuple[str, str]]) -> str:
    """Numbers to see first: (number, what it is) each."""
    inside = "".join(
        f'<div class="tile"><b>{escape(value)}</b><span>{escape(what)}</span></div>' for value, what in items
    )
    return f'<div class="tiles">{inside}</div>'


def panels(pictures: Iterable[str]) -> str:
    return f'<div class="panels">{"".join(pictures)}</div>'


def table(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    first = "".join(f"<th>{escape(name)}</th>" for name in head)
    rest = "".join(f"<tr>{''.join(f'<td>{escape(str(cell))}</td>' for cell in row)}</tr>" for row in rows)
    return f'<div class="wide"><table><thead><tr>{first}</tr></thead><tbody>{rest}</tbody></table></div>'


def details(summary: str, *inside: str, opened: bool = False) -> str:
    return f"<details{' open' if opened else ''}><summary>{escape(summary)}</summary>{''.join(inside)}</details>"


def film(data: bytes, suffix: str, caption: str) -> str:
    """A video or an animated picture, inside the page."""
    encoded = base64.b64encode(data).decode()
    if suffix == ".gif":
        shown = f'<img alt="{escape(caption, quote=True)}" src="data:image/gif;base64,{encoded}">'
    else:
        shown = f'<video controls loop muted playsinline src="data:video/mp4;base64,{encoded}"></video>'
    return f"<figure>{shown}<figcaption>{escape(caption)}</figcaption></figure>"
