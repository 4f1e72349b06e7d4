"""Panels of lines that come from no run: what `vecpsmbpo theory` draws."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from vecpsmbpo.look import style

Array = np.ndarray


class Series(NamedTuple):
    """A line: x and y, [P] each, and the half width of the band around it, [P] or none."""

    name: str
    x: Array
    y: Array
    error: Array | None = None


class Panel(NamedTuple):
    """A chart with 0 on its y axis."""

    title: str
    x_label: str
    y_label: str
    series: Sequence[Series]


def write(path: Path, title: str, panels: Sequence[Panel], *, columns: int) -> None:
    """Writes the panels in rows of `columns`, each with its own legend below it.

    Raises:
        SettingError: it cannot be written.
    """
    with style.styled():
        figure, axes = style.grid(len(panels), columns, (4.4, 3.9))
        figure.suptitle(title, fontsize=12)
        for axis, panel in zip(axes, panels, strict=True):
            for look, one in zip(style.looks(len(panel.series)), panel.series, strict=True):
                low, high = (None, None) if one.error is None else (np.maximum(one.y - one.error, 0), one.y + one.error)
                style.line(axis, look, one.x, one.y, low=low, high=high, label=one.name)
            axis.set_title(panel.title)
            axis.set_xlabel(panel.x_label)
            axis.set_ylabel(panel.y_label)
            axis.set_ylim(bottom=min(0.0, axis.get_ylim()[0]) if min(one.y.min() for one in panel.series) < 0 else 0.0)
            wide = max(len(one.name) for one in panel.series) > 24
            axis.legend(loc="upper center", bbox_to_anchor=(0.5, -0.17), ncols=1 if wide else 2, fontsize=7.5)
        style.save(figure, path)
