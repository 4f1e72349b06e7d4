"""How pictures look: one place for colours, lines, fonts and how a figure is saved.

Colours are Okabe and Ito's, which colour-blind readers tell apart; every series also has a marker or a dash of its own,
so that a black-and-white print can be read. An algorithm looks the same in every picture. Numbers in order (a sweep of
λ) take a scale that darkens evenly instead. Names and titles are text: `$` in them begins no mathematics.
No pyplot: a figure is an object, there is no window and no global state.
"""

import contextlib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, MaxNLocator

from vecpsmbpo.look import files

Array = np.ndarray

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7a5c00", "#444444")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
ALGORITHMS = ("OPS-MBPO", "PS-MBPO", "MBPO", "SAC", "SLBO", "PETS")  # the first colours and markers are theirs
INK, FAINT, GRID, PAPER = "#1f2328", "#656d76", "#d8dee4", "#ffffff"
MARKS = 8  # markers of a line

RC: Any = {
    "figure.dpi": 100,
    "savefig.dpi": 200,
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelsize": 9,
    "axes.labelcolor": INK,
    "axes.edgecolor": FAINT,
    "axes.linewidth": 0.8,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.7,
    "lines.markersize": 4,
    "xtick.color": FAINT,
    "ytick.color": FAINT,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "text.color": INK,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "svg.hashsalt": "vecpsmbpo",  # the same picture is the same file
    "svg.fonttype": "none",
    "pdf.fonttype": 42,
}


class Look(NamedTuple):
    """A series' colour, marker and dashes."""

    colour: Any
    marker: str
    dashes: str


def looks(count: int, *, ordered: bool = False) -> list[Look]:
    """How each of `count` series is drawn; `ordered`: they are steps of one number."""
    if ordered and count > 2:
        scale = mpl.colormaps["viridis"](np.linspace(0.0, 0.88, count))  # its last eighth is too pale for paper
        colours: Sequence[Any] = [mpl.colors.to_hex(colour) for colour in scale]
    else:
        colours = [COLOURS[index % len(COLOURS)] for index in range(count)]
    dashes = ("-", "--", ":", "-.")
    return [
        Look(colours[index], MARKERS[index % len(MARKERS)], dashes[index // len(COLOURS) % len(dashes)])
        for index in range(count)
    ]


def looks_of(names: Sequence[str], *, ordered: bool = False) -> dict[str, Look]:
    """How each of the named series is drawn, in every panel.

    A series that alone is of an algorithm has that one's look, whatever is beside it; others take what is left.
    """
    if ordered:
        return dict(zip(names, looks(len(names), ordered=True), strict=True))
    algorithms = [name.partition(", ")[0] for name in names]
    own = {
        name: ALGORITHMS.index(algorithm)
        for name, algorithm in zip(names, algorithms, strict=True)
        if algorithm in ALGORITHMS and algorithms.count(algorithm) == 1
    }
    every = looks(len(ALGORITHMS) + len(names))
    left = (look for index, look in enumerate(every) if index not in own.values())
    return {name: every[own[name]] if name in own else next(left) for name in names}


@contextlib.contextmanager
def styled() -> Iterator[None]:
    """In it figures are made and saved."""
    with mpl.rc_context(RC):
        yield


def grid(count: int, columns: int, size: tuple[float, float] = (4.4, 3.1), **kwargs: Any) -> tuple[Figure, list[Axes]]:
    """A figure of `count` panels in rows of up to `columns`, as even as they can be: four are two by two, not 3 + 1."""
    rows = -(-count // columns)
    columns = -(-count // rows)
    figure = Figure(figsize=(size[0] * columns, size[1] * rows), layout="constrained")
    engine: Any = figure.get_layout_engine()
    engine.set(wspace=0.07, hspace=0.05)  # or the label of an axis touches the panel before it
    axes = list(np.ravel(figure.subplots(rows, columns, squeeze=False, **kwargs)))
    for spare in axes[count:]:
        spare.remove()
    return figure, axes[:count]


def line(
    axes: Axes,
    look: Look,
    x: Array,
    y: Array,
    *,
    low: Array | None = None,
    high: Array | None = None,
    label: str = "",
    **kwargs: Any,
) -> None:
    """A line with its band and a few markers; a legend names those that have a label."""
    every = max(1, len(x) // MARKS)
    if label.startswith("_"):  # legends leave such names out; a space of no width makes it another
        label = f"\u200b{label}"
    marks: dict[str, Any] = {"marker": look.marker, "markevery": (every // 2, every)}
    axes.plot(x, y, color=look.colour, ls=look.dashes, label=label or None, **marks, **kwargs)
    if low is not None and high is not None and np.isfinite(low).any():
        axes.fill_between(x, low, high, color=look.colour, alpha=0.16, lw=0)


def threads(axes: Axes, look: Look, x: Array, seeds: Array) -> None:
    """The seeds [S, T] that a line is the average of, thin; nothing where there is one."""
    if len(seeds) > 1:
        axes.plot(x, seeds.T, color=look.colour, lw=0.7, alpha=0.45)


def steps_axis(axes: Axes, name: str) -> None:
    """Thousands as 5k, whole steps, no more ticks than fit a phone."""
    axes.set_xlabel(name)
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.xaxis.set_major_locator(MaxNLocator(5, integer=True))


def literal(text: str) -> str:
    """A name or title as matplotlib draws it as it stands; what is between two `$` would be mathematics."""
    return text.replace("$", r"\$")  # parse_math=False does not hold where a text is wrapped


def title(figure: Figure, text: str, size: float = 10) -> None:
    """Above all panels, at the left."""
    figure.suptitle(literal(text), x=0.01, ha="left", fontsize=size, wrap=True)


def legend(figure: Figure, axes: Axes | Iterable[Axes], columns: int = 4) -> None:
    """One legend below all panels, of what is in any of `axes`."""
    handles: dict[str, Any] = {}
    for panel in [axes] if isinstance(axes, Axes) else axes:
        for handle, name in zip(*panel.get_legend_handles_labels(), strict=True):
            handles.setdefault(name, handle)
    if handles:
        fits = max(1, int(figure.get_figwidth() * 14 / (max(map(len, handles)) + 6)))
        names, columns = [literal(name) for name in handles], min(columns, fits, len(handles))
        figure.legend(list(handles.values()), names, loc="outside lower center", ncols=columns)


def save(figure: Figure, path: Path) -> None:
    """Writes the figure as the kind of file that `path` names.

    Raises:
        SettingError: it cannot be written.
    """
    # Without a date, so that the same runs give the same bytes.
    dates = {".svg": {"Date": None}, ".pdf": {"CreationDate": None}}
    metadata = dates.get(path.suffix.lower())
    files.write(path, lambda beside: figure.savefig(beside, metadata=metadata, facecolor=PAPER))
