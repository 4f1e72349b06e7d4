"""`vecpsmbpo report`: everything a run has to show on one page, which opens without a network."""

import sys
from collections.abc import Callable, Mapping, Sequence
from html import escape
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from vecpsmbpo import arguments, logged
from vecpsmbpo.look import compare, diagnose, files, films, groups, one_run, runs
from vecpsmbpo.look.curves import curve
from vecpsmbpo.look.runs import Run
from vecpsmbpo.look.working import Working
from vecpsmbpo.settings import SettingError

if TYPE_CHECKING:
    from vecpsmbpo.look.page import Page

OPTIONS = {
    "out": arguments.out("the page", "report.html", ".html"),
    "group": arguments.names("settings whose values make a curve each; without it, those that differ between the runs"),
    "videos": arguments.names("films to embed", allowed="files that end in .mp4 or .gif, separated by commas"),
    "refresh": arguments.whole("seconds after which an open page looks for a newer one; 0: never", 0),
    "diagnostics": arguments.choice("measure models and critics on fresh episodes", "false", "true"),
}
PAGE = "report.html"  # in the directory of a run with report=true
REFRESH_S = 30  # after which a browser looks for a newer one, while the run goes on


def run(words: Sequence[str]) -> int:
    """The command; its exit status.

    Raises:
        SettingError: a mistake in `words`, in the runs, or in where the page should go.
    """
    named, options = arguments.parse("report", words, OPTIONS)
    paths = arguments.run_dirs("report", named)
    files.check_writable(options["out"])
    named_films = [_film(name) for name in options["videos"]]
    found = runs.load_all(paths)
    for run in found:
        _ = run.episodes  # read now, since that shows its own progress
    with Working() as working:
        measured = found if options["diagnostics"] == "true" else []
        diagnoses = {run.path: diagnose.measure(run, working=working) for run in measured}
        write(
            found,
            options["out"],
            group=options["group"],
            videos=named_films,
            refresh_s=options["refresh"],
            diagnoses=diagnoses,
            working=working,
        )
    for text in [*runs.warnings(found), *(f"{run.path}: {text}" for run in found for text in one_run.gaps(run))]:
        print(f"vecpsmbpo: warning: {text}", file=sys.stderr)
    print(f"written: {options['out']}")
    return 0


def _film(name: str) -> Path:
    path = Path(name)
    if path.suffix.lower() not in films.MAGIC or not path.is_file():
        raise SettingError(f"videos={name}: must be files that end in .mp4 or .gif")
    if not films.is_film(path):
        raise SettingError(f"videos={name}: holds no film")
    return path


def write(
    found: Sequence[Run],
    out: Path,
    *,
    group: Sequence[str] = (),
    videos: Sequence[Path] = (),
    refresh_s: int = 0,
    diagnoses: Mapping[Path, dict[str, Any]] = MappingProxyType({}),
    working: Working | None = None,
) -> None:
    """Writes the page of one run, or of several with a comparison first.

    Args:
        group: as in `groups.group`.
        videos: to put into it, besides those that lie in run directories.
        refresh_s: as in `page.Page`.
        diagnoses: by run directory (`diagnose.measure`); of others, what lies in the directory.
        working: is told what is being drawn.

    Raises:
        SettingError: as `groups.group`, a diagnosis cannot be read, or the page cannot be written.
    """
    together = groups.group(found, group)
    from vecpsmbpo.look import style
    from vecpsmbpo.look.page import Page

    working = working or Working()  # which nobody has entered: it says nothing
    one = found[0]
    what = f"{one.settings.task}, {groups.display('algo', one.settings.algo)}" if len(found) == 1 else _tasks(found)
    page = Page(f"vecpsmbpo: {what}", refresh_s=refresh_s)
    with style.styled():
        if len(found) > 1:
            working.on("comparing")
            _add_comparison(page, what, found, together)
        for one in found:
            working.on(f"drawing {one.path}")
            one_run.add(page, one, "h1" if len(found) == 1 else "h2", diagnoses.get(one.path))
        working.on(f"writing {out}")
        films.add(page, [*videos, *(path for one in found for path in films.of_run(one))])
    files.write_text(out, str(page))


def _tasks(found: Sequence[Run]) -> str:
    tasks = dict.fromkeys(run.settings.task for run in found)
    return f"{len(found)} runs of {', '.join(tasks)}"


def _add_comparison(page: "Page", what: str, found: Sequence[Run], together: Sequence[groups.Group]) -> None:
    from vecpsmbpo.look import page as html

    page.add(f"<h1>{escape(what)}</h1>", f'<p class="soft">{escape(", ".join(str(run.path) for run in found))}</p>')
    for task in dict.fromkeys(run.settings.task for run in found):
        here = [groups.Group(one.values, [x for x in one.lanes if x.run.settings.task == task]) for one in together]
        here = [one for one in here if one.lanes]
        pictures = [_curves_picture(page, here, y) for y in ("eval_return", "train_return")]
        page.add(f"<h2>{escape(task)}</h2>", html.panels(filter(None, pictures)))
    if silent := [str(run.path) for run in found if not one_run.values(run, "eval_return")]:
        page.add(f'<p class="soft">No table: without evaluation returns: {escape(", ".join(silent))}.</p>')
        return
    options = {name: option.default for name, option in compare.OPTIONS.items()}
    options["group"] = tuple(together[0].values)
    rows = compare.table(found, options)
    for (title, *names), body in compare.cells(rows):
        page.add(f'<p class="above">{escape(title)}</p>', html.table(("", *names), body))
    page.add(f'<p class="soft">{escape(compare.caption(rows, options))}</p>')


def _curves_picture(page: "Page", together: Sequence[groups.Group], y: str) -> str:
    from vecpsmbpo.look import plot, style

    curves = [curve(one, "env_steps", y, average=one_run.AVERAGE) for one in together]
    if not any(len(line.x) for line in curves):
        return ""
    figure, (axes,) = style.grid(1, 1)
    looks = style.looks_of([line.name for line in curves], ordered=plot.is_ordered(together))
    plot.draw_curves(axes, curves, looks)
    label = logged.of(y).label
    style.steps_axis(axes, one_run.STEPS)
    axes.set_ylabel(label)
    style.legend(figure, axes, columns=2)
    said = [f"{label}: {one_run.AVERAGE_WORDS}, 95% bootstrap band"]
    if y == "train_return":
        said += filter(
            None, dict.fromkeys(one_run.lengths(lane.run.settings) for one in together for lane in one.lanes)
        )
    return page.picture(figure, "; ".join(said))


def keep(run_dir: Path, warn: Callable[[str], None]) -> None:
    """Renews the page in a run's directory while the run goes on; what goes wrong with it is no reason to stop."""
    try:
        run = runs.load(run_dir)
        write([run], run_dir / PAGE, refresh_s=0 if run.complete else REFRESH_S)
    except Exception as error:  # whatever it is, the run is worth more
        warn(f"{run_dir / PAGE} is not up to date ({error})")
