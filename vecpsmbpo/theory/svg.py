"""Line charts as an SVG file.

Written by hand because matplotlib is no dependency of the trainer, and six panels of lines with bands need only scales,
ticks and a legend.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple
from xml.sax.saxutils import escape

import numpy as np

Array = np.ndarray

# Okabe and Ito's colours, which colour-blind readers tell apart.
COLOURS = ("#000000", "#0072b2", "#d55e00", "#009e73", "#cc79a7")
WIDTH, HEIGHT = 400, 360  # of a panel
LEFT, RIGHT, TOP, BOTTOM = 58, 14, 34, 100  # its margins; the legend stands in the lower one
HEADER = 34


class Series(NamedTuple):
    """A line: x and y, [P] each, and the half width of the band around it, [P] or none."""

    name: str
    x: Array
    y: Array
    error: Array | None = None


class Panel(NamedTuple):
    """A chart, with 0 on its y axis."""

    title: str
    x_label: str
    y_label: str
    series: Sequence[Series]


def write(path: Path, title: str, panels: Sequence[Panel], *, columns: int) -> None:
    """Writes the panels in rows of `columns`."""
    rows = -(-len(panels) // columns)
    width, height = columns * WIDTH, rows * HEIGHT + HEADER
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}" '
        'font-family="sans-serif" font-size="11" fill="#222">',
        '<rect width="100%" height="100%" fill="white"/>',
        _text(width / 2, 22, title, "middle", 'font-size="15"'),
    ]
    for index, panel in enumerate(panels):
        row, column = divmod(index, columns)
        parts += [f'<g transform="translate({column * WIDTH} {row * HEIGHT + HEADER})">', *_panel(panel), "</g>"]
    path.write_text("\n".join([*parts, "</svg>"]) + "\n", encoding="utf-8")


def ticks(low: float, high: float, about: int = 5) -> list[float]:
    """At least two multiples of 1, 2 or 5 times a power of ten, from `low` or below to `high` or above."""
    span = (high - low or 1.0) / about
    power = 10 ** math.floor(math.log10(span))
    step = next(power * factor for factor in (1, 2, 5, 10) if power * factor >= span * (1 - 1e-9))
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [round(step * count, 10) for count in range(first, max(last, first + 1) + 1)]


def _panel(panel: Panel) -> list[str]:
    x_ticks = ticks(min(line.x.min() for line in panel.series), max(line.x.max() for line in panel.series))
    lowest = min(line.y.min() for line in panel.series)
    highest = max((line.y + (0 if line.error is None else line.error)).max() for line in panel.series)
    y_ticks = ticks(min(0, lowest), max(0, highest))
    across, down = WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM

    def x_at(value):
        return LEFT + across * (value - x_ticks[0]) / (x_ticks[-1] - x_ticks[0])

    def y_at(value):
        return TOP + down * (y_ticks[-1] - value) / (y_ticks[-1] - y_ticks[0])

    parts = [_text(LEFT + across / 2, TOP - 12, panel.title, "middle", 'font-size="12" font-weight="bold"')]
    for tick in y_ticks:
        parts.append(_line(LEFT, y_at(tick), LEFT + across, y_at(tick), "#ddd"))
        parts.append(_text(LEFT - 6, y_at(tick) + 4, f"{tick:g}", "end"))
    for tick in x_ticks:
        parts.append(_line(x_at(tick), TOP + down, x_at(tick), TOP + down + 4, "#666"))
        parts.append(_text(x_at(tick), TOP + down + 16, f"{tick:g}", "middle"))
    parts.append(_line(LEFT, TOP + down, LEFT + across, TOP + down, "#666"))
    parts.append(_text(LEFT + across / 2, TOP + down + 32, panel.x_label, "middle"))
    middle = f"{LEFT - 42} {TOP + down / 2}"
    parts.append(_text(0, 0, panel.y_label, "middle", f'transform="translate({middle}) rotate(-90)"'))

    for index, line in enumerate(panel.series):
        colour = COLOURS[index % len(COLOURS)]
        if line.error is not None:
            low, high = np.maximum(line.y - line.error, y_ticks[0]), line.y + line.error
            around = _points(x_at(line.x), y_at(high)) + " " + _points(x_at(line.x[::-1]), y_at(low[::-1]))
            parts.append(f'<polygon points="{around}" fill="{colour}" fill-opacity="0.15"/>')
        points = _points(x_at(line.x), y_at(line.y))
        parts.append(f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="1.8"/>')
        # Two columns, or one where a name is too long for half the panel.
        wide = max(len(other.name) for other in panel.series) > 28
        row, column = (index, 0) if wide else divmod(index, 2)
        x, y = LEFT + column * across / 2, TOP + down + 52 + 14 * row
        parts.append(_line(x, y - 4, x + 18, y - 4, colour, width=2.5))
        parts.append(_text(x + 24, y, line.name, "start"))
    return parts


def _points(x: Array, y: Array) -> str:
    return " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))


def _line(x1: float, y1: float, x2: float, y2: float, colour: str, width: float = 1) -> str:
    ends = f'x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}"'
    return f'<line {ends} stroke="{colour}" stroke-width="{width}"/>'


def _text(x: float, y: float, text: str, anchor: str, more: str = "") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" {more}>{escape(text)}</text>'
