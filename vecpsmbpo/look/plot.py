"""`vecpsmbpo plot`: learning curves of runs beside each other."""

import csv
import io
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from vecpsmbpo import arguments, logged
from vecpsmbpo.look import files, groups, published, runs
from vecpsmbpo.look.curves import AVERAGES, Curve, axis_label, check_columns, curve
from vecpsmbpo.settings import SettingError

OPTIONS = {
    "x": arguments.choice("the horizontal axis", "env_steps", "seconds"),
    "y": arguments.names("columns of metrics.jsonl, a panel each", "eval_return"),
    "group": arguments.names("settings whose values make a curve each; without it, those that differ between the runs"),
    "average": arguments.choice("over the seeds of a curve, with its bootstrap interval", *AVERAGES),
    "smooth": arguments.whole("epochs that a moving average spans", 1, at_least=1, at_most=1_000_000),
    "reference": arguments.names(
        "published curves to draw beside them", allowed=f"of {', '.join(published.REFERENCES)}, separated by commas"
    ),
    "title": arguments.text("of the picture"),
    "out": arguments.out("the picture, or its numbers", "curves.png", ".png", ".svg", ".pdf", ".csv"),
}
COLUMNS = 3  # panels in a row
BEYOND = 1.0  # how many heights of a panel's curves a published level may lie above them and still be drawn


def run(words: Sequence[str]) -> int:
    """The command; its exit status.

    Raises:
        SettingError: a mistake in `words`, in the runs, or in where the picture should go.
    """
    named, options = arguments.parse("plot", words, OPTIONS)
    for name in options["reference"]:
        if name not in published.REFERENCES:
            raise SettingError(f"reference={name}: must be {OPTIONS['reference'].allowed}")
    if options["reference"] and (options["x"] != "env_steps" or "eval_return" not in options["y"]):
        raise SettingError("reference: is of y=eval_return over x=env_steps")
    paths = arguments.run_dirs("plot", named)
    files.check_writable(options["out"])
    found = runs.load_all(paths)
    draw(found, options)
    for text in runs.warnings(found):
        print(f"vecpsmbpo: warning: {text}", file=sys.stderr)
    print(f"written: {options['out']}")
    return 0


def draw(found: list[runs.Run], options: dict[str, Any]) -> None:
    """Writes the picture.

    Raises:
        SettingError: the runs are of different tasks or lack what is to be drawn, or the file cannot be written.
    """
    task = groups.common_task(found)
    references = [published.reference(name, task) for name in options["reference"]]
    check_columns(found, "y", options["y"])
    check_columns(found, "x", [options["x"]])
    together = groups.group(found, options["group"])
    if options["out"].suffix.lower() == ".csv":
        return write_csv(options["out"], found, [name for name in (options["x"], *options["y"]) if name != "env_steps"])
    panels = [
        [curve(one, options["x"], y, average=options["average"], smooth=options["smooth"]) for one in together]
        for y in options["y"]
    ]
    for y, curves in zip(options["y"], panels, strict=True):
        if not any(len(line.x) for line in curves):
            raise SettingError(f"y={y}: there is no step at which all seeds of a group have a value")
    from vecpsmbpo.look import style

    with style.styled():
        figure, axes = style.grid(len(panels), COLUMNS, (5.6, 3.6) if len(panels) == 1 else (4.4, 3.1))
        looks = style.looks_of([one.name for one in together], ordered=is_ordered(together))
        for axis, y, curves in zip(axes, options["y"], panels, strict=True):
            if len(curves) == 1:  # several groups of seeds would be a thicket
                style.threads(axis, looks[curves[0].name], curves[0].x, curves[0].seeds)
            draw_curves(axis, curves, looks)
            # What is in brackets stands below, or a label is longer than its axis.
            axis.set_ylabel(style.literal(axis_label(y, found).replace(" (", "\n(")))
            style.steps_axis(axis, logged.of(options["x"]).label)
            if y == "eval_return":
                draw_references(axis, references)
        average = {"mean": "mean", "iqm": "interquartile mean"}[options["average"]]
        note = groups.averaged(together, f"{average} of", "95% bootstrap band", options["y"])
        style.title(figure, options["title"] or f"{task}: {note}")
        style.legend(figure, axes)
        style.save(figure, options["out"])


def is_ordered(together: Sequence[groups.Group]) -> bool:
    """Whether the groups are steps of one number, so that colours may be a scale."""
    values = [tuple(one.values.values()) for one in together]
    return all(len(value) == 1 and isinstance(value[0], int | float) for value in values)


def draw_curves(axis: Any, curves: Iterable[Curve], looks: Mapping[str, Any]) -> None:
    """A line with its band for each; `looks` by their names."""
    from vecpsmbpo.look import style  # here, not above: mistakes answer before matplotlib is imported

    for line in curves:
        style.line(axis, looks[line.name], line.x, line.y, low=line.low, high=line.high, label=line.name)


def draw_references(axis: Any, references: Iterable[published.Published | published.Level]) -> None:
    """What others have published, beside curves that are there already; in grey, as it is of other code."""
    from vecpsmbpo.look import style

    grey: dict[str, Any] = {"color": style.FAINT, "lw": 1.3}
    for one in references:
        if isinstance(one, published.Published):
            marks: dict[str, Any] = {"marker": "o", "mfc": "white", "ms": 4, "capsize": 2}
            axis.errorbar(one.steps, one.mean, one.deviation, ls="--", label=one.name, **marks, **grey)
            continue
        bottom, top = axis.get_ylim()
        if one.high > top + BEYOND * (top - bottom):  # drawn, it would flatten the curves
            soft: dict[str, Any] = {"color": style.FAINT, "fontsize": 8, "fontweight": "normal"}
            axis.set_title(f"{one.name}: {one.value} ↑", loc="right", **soft)
        elif one.low < one.high:
            axis.axhspan(one.low, one.high, color=style.FAINT, alpha=0.13, lw=0, label=f"{one.name} steps")
        else:
            axis.axhline(one.low, ls=(0, (1, 1.5)), label=f"{one.name} steps", **grey)


def write_csv(path: Path, found: Sequence[runs.Run], names: Sequence[str]) -> None:
    """The numbers behind a picture, small enough to commit: a line per run, lane and epoch.

    Raises:
        SettingError: it cannot be written.
    """
    names = (*names, "frozen") if any(lane.frozen for one in found for lane in one.lanes) else names
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("run", "swept", "env_steps", "seed", *names))
    for one in found:
        for lane in one.lanes:
            swept = " ".join(f"{name}={value:g}" for name, value in lane.values.items() if name != "seed")
            columns = [lane.column(name) for name in ("env_steps", "seed", *names)]
            writer.writerows((one.name, swept, *map(_number, row)) for row in zip(*columns, strict=True))
    files.write_text(path, text.getvalue())


def _number(value: float) -> str:
    """Five digits, whole numbers whole; nothing for null."""
    return "" if value != value else f"{value:.0f}" if value == int(value) else f"{value:.5g}"
