"""`vecpsmbpo report`: everything a run has to show on one page, which opens without a network."""

import shlex
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from html import escape
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from vecpsmbpo import arguments, config, logged
from vecpsmbpo.algorithms.catalogue import of_algorithm
from vecpsmbpo.jsonl import METRICS_FILE
from vecpsmbpo.look import compare, diagnose, files, groups, runs, statistics
from vecpsmbpo.look.curves import curve
from vecpsmbpo.look.runs import Lane, Run
from vecpsmbpo.settings import SettingError, Settings

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
WINDOW = 5  # epochs that count as the last ones
PICTURED = 3  # a row of them: lanes whose posterior is drawn at once; the others are there to be opened
SHOWN = 60  # rows of the table of epochs
STEPS = logged.of("env_steps").label


def run(words: Sequence[str]) -> int:
    """The command; its exit status.

    Raises:
        SettingError: a mistake in `words`, in the runs, or in where the page should go.
    """
    named, options = arguments.parse("report", words, OPTIONS)
    paths = arguments.run_dirs("report", named)
    files.check_writable(options["out"])
    films = [_film(name) for name in options["videos"]]
    found = runs.load_all(paths)
    diagnoses = {run.path: diagnose.measure(run) for run in found} if options["diagnostics"] == "true" else {}
    write(
        found,
        options["out"],
        group=options["group"],
        films=films,
        refresh_s=options["refresh"],
        diagnoses=diagnoses,
    )
    for text in runs.warnings(found):
        print(f"vecpsmbpo: warning: {text}", file=sys.stderr)
    print(f"written: {options['out']}")
    return 0


def _film(name: str) -> Path:
    path = Path(name)
    if path.suffix.lower() not in (".mp4", ".gif") or not path.is_file():
        raise SettingError(f"videos={name}: must be files that end in .mp4 or .gif")
    return path


def write(
    found: Sequence[Run],
    out: Path,
    *,
    group: Sequence[str] = (),
    films: Sequence[Path] = (),
    refresh_s: int = 0,
    diagnoses: Mapping[Path, dict[str, Any]] = MappingProxyType({}),
) -> None:
    """Writes the page of one run, or of several with a comparison first.

    Args:
        group: as in `groups.group`.
        films: videos to put into it, besides those that lie in run directories.
        refresh_s: as in `page.Page`.
        diagnoses: by run directory (`diagnose.measure`); of others, what lies in the directory.

    Raises:
        SettingError: as `groups.group`, a diagnosis cannot be read, or the page cannot be written.
    """
    together = groups.group(found, group)
    from vecpsmbpo.look import style
    from vecpsmbpo.look.page import Page

    one = found[0]
    what = f"{one.settings.task}, {groups.display('algo', one.settings.algo)}" if len(found) == 1 else _tasks(found)
    page = Page(f"vecpsmbpo: {what}", refresh_s=refresh_s)
    with style.styled():
        if len(found) > 1:
            _add_comparison(page, what, found, together)
        for one in found:
            _add_run(page, one, "h1" if len(found) == 1 else "h2", diagnoses.get(one.path) or diagnose.read(one))
        _add_films(page, [*films, *(path for one in found for path in _own_films(one))])
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
    options = {name: option.default for name, option in compare.OPTIONS.items()}
    options["group"] = tuple(together[0].values)
    rows = compare.table(found, options)
    for head, body in compare.cells(rows):
        page.add(html.table(head, body))
    page.add(f'<p class="soft">{escape(compare.caption(rows, options))}</p>')


def _curves_picture(page: "Page", together: Sequence[groups.Group], y: str) -> str:
    from vecpsmbpo.look import plot, style

    curves = [curve(one, "env_steps", y) for one in together]
    if not any(len(line.x) for line in curves):
        return ""
    figure, (axes,) = style.grid(1, 1)
    looks = style.looks_of([line.name for line in curves], ordered=plot.is_ordered(together))
    plot.draw_curves(axes, curves, looks)
    label = logged.of(y).label
    style.steps_axis(axes, STEPS)
    axes.set_ylabel(label)
    style.legend(figure, axes, columns=2)
    return page.picture(figure, f"{label}: mean over seeds, 95% bootstrap band")


def keep(run_dir: Path, warn: Callable[[str], None]) -> None:
    """Renews the page in a run's directory while the run goes on; what goes wrong with it is no reason to stop."""
    try:
        run = runs.load(run_dir)
        write([run], run_dir / PAGE, refresh_s=0 if run.complete else REFRESH_S)
    except Exception as error:  # whatever it is, the run is worth more
        warn(f"{run_dir / PAGE} is not up to date ({error})")


# ── one run ───────────────────────────────────────────────────────────────────────────────────────────────────────


def _add_run(page: "Page", run: Run, heading: str, diagnosis: dict[str, Any] | None) -> None:
    from vecpsmbpo.look import page as html

    settings = run.settings
    algo = groups.display("algo", settings.algo)
    page.add(f"<{heading}>{escape(settings.task)}, {escape(algo)}</{heading}>", _state(run))
    page.add(html.tiles(_tiles(run)))
    page.add(html.panels(filter(None, (_lanes_picture(page, run, y) for y in ("eval_return", "train_return")))))
    if max(len(one.lanes) for one in groups.group([run])) > 1:
        page.add('<p class="soft">Thick lines are means over seeds, thin ones the seeds.</p>')
    _add_posterior(page, run)
    pictures = [_lanes_picture(page, run, y) for y, quantity in logged.QUANTITIES.items() if quantity.caption]
    page.add("<h3>Inside</h3>", html.panels(filter(None, (*pictures, _chances_picture(page, run)))))
    if diagnosis is not None:
        _add_diagnosis(page, diagnosis)
    _add_settings(page, run)


def _add_diagnosis(page: "Page", diagnosis: dict[str, Any]) -> None:
    from vecpsmbpo.look import diagrams
    from vecpsmbpo.look import page as html

    pictures = [page.picture(figure, caption) for figure, caption in diagrams.figures(diagnosis)]
    said = f'<p class="soft">{escape(diagrams.headline(diagnosis))}</p>'
    page.add("<h3>Models and critics put to the test</h3>", said, html.panels(pictures))


def _state(run: Run) -> str:
    """Where the run stands, in a line."""
    settings, frozen = run.settings, [lane.name for lane in run.lanes if lane.frozen]
    where = f"step {run.env_steps:,} of {settings.total_steps:,}"
    state = "complete" if run.complete else "not complete"
    written = time.strftime("%Y-%m-%d %H:%M", time.localtime((run.path / METRICS_FILE).stat().st_mtime))
    parts = [
        f"N = {settings.n_models}, M = {settings.policies_per_model}",
        _plural(settings.num_seeds, "seed"),
        *(f"{len(values)} values of {groups.SYMBOLS.get(name, name)}" for name, values in settings.sweep),
        f"size {settings.size}",
        f"backend {settings.backend}",
        where,
        f"last written {written}",
        *(f"frozen: {name}" for name in frozen),
    ]
    return f'<p class="soft"><span class="state">{state}</span> {escape(" · ".join(parts))}</p>'


def _plural(count: int, what: str) -> str:
    return f"{count:,} {what}" if count == 1 else f"{count:,} {what}s"


def _tiles(run: Run) -> list[tuple[str, str]]:
    """The numbers to see first."""
    last = [compare.score(lane, run.env_steps, _scoring()) for lane in run.lanes]
    final = statistics.bootstrap(statistics.interquartile_mean, [np.array([seed.final for seed in last])])
    best = statistics.Estimate(max(seed.best for seed in last), np.nan, np.nan)
    interval = "" if np.isnan(final.low) else ", and 95% interval"
    tiles = [
        (compare.shown(final), f"evaluation return, last {WINDOW} epochs{interval}"),
        (compare.shown(best), "best evaluation"),
    ]
    if seconds := _known(run, "seconds"):
        tiles.append((_duration(seconds[-1]), "wall time"))
    if speeds := _known(run, "updates_per_s"):
        tiles.append((f"{speeds[-1]:,.0f}", "SAC updates per second"))
    return tiles


def _known(run: Run, name: str) -> list[float]:
    """What the log has of a column, by time; a frozen lane's last line has nothing."""
    column = run.metrics.columns.get(name, np.empty(0))
    return column[np.isfinite(column)].tolist()


def _scoring() -> dict[str, Any]:
    return {"y": "eval_return", "window": WINDOW, "threshold": None}


def _duration(seconds: float) -> str:
    """1:02:03, or 2:03 below an hour."""
    minutes, second = divmod(round(seconds), 60)
    hours, minute = divmod(minutes, 60)
    return f"{hours}:{minute:02}:{second:02}" if hours else f"{minute}:{second:02}"


def _lanes_picture(page: "Page", run: Run, y: str) -> str:
    """Every seed of every swept value, faint, and their mean; nothing where the column is empty."""
    from vecpsmbpo.look import plot, style

    together = groups.group([run])
    curves = [curve(one, "env_steps", y) for one in together]
    if not any(len(line.x) for line in curves):
        return ""
    figure, (axes,) = style.grid(1, 1, (4.4, 2.9))
    looks = style.looks(len(curves), ordered=plot.is_ordered(together))
    for look, line in zip(looks, curves, strict=True):
        style.threads(axes, look, line.x, line.seeds)
        style.line(axes, look, line.x, line.y, label=line.name)
    quantity = logged.of(y)
    if quantity.scale == "share":
        axes.set_ylim(-0.03, 1.03)
    elif quantity.scale == "log" and min(line.seeds.min() for line in curves if line.seeds.size) > 0:
        axes.set_yscale("log")
    style.steps_axis(axes, STEPS)
    axes.set_ylabel(quantity.label)
    if len(curves) > 1:
        style.legend(figure, axes, columns=3)
    return page.picture(figure, quantity.caption or quantity.label)


def _chances_picture(page: "Page", run: Run) -> str:
    """How likely each λ is the best, where it is chosen online; mean over seeds."""
    from vecpsmbpo.look import style

    columns = [lane.epochs["real_ratio_probs"] for lane in run.lanes if "real_ratio_probs" in lane.epochs]
    if not columns:
        return ""
    shortest = min(map(len, columns))
    chances = np.mean([column[:shortest] for column in columns], axis=0)
    figure, (axes,) = style.grid(1, 1, (4.4, 2.9))
    arms = run.lanes[0].setting("real_ratio_arms")
    for look, arm, chance in zip(style.looks(len(arms), ordered=True), arms, chances.T, strict=True):
        style.line(axes, look, run.lanes[0].epochs["env_steps"][:shortest], chance, label=f"λ = {arm:g}")
    style.steps_axis(axes, STEPS)
    axes.set_ylabel("probability")
    style.legend(figure, axes, columns=3)
    return page.picture(figure, "how likely each λ is the best (mean over seeds)")


def _add_posterior(page: "Page", run: Run) -> None:
    from vecpsmbpo.look import page as html
    from vecpsmbpo.look import posterior

    lanes = [lane for lane in run.lanes if "probs" in lane.episodes and len(lane.episodes["probs"])]
    if not lanes or lanes[0].episodes["probs"].shape[1] < 2:
        return
    page.add("<h3>Who acted, and what it earned</h3>")
    page.add(
        '<p class="soft">Before every episode a member (n, m) is drawn: policy m that learns in model n. The stronger '
        "its row, the more likely it was to be drawn (equation 19); dots are the draws.</p>"
    )

    def picture(lane: Lane) -> str:
        acts = posterior.acting(lane.episodes, run.settings.policies_per_model)
        caption = f"{lane.name}: {_plural(len(acts), 'episode')}, {np.sum(acts < 0)} of them by no single member"
        return page.picture(posterior.draw(lane), caption)

    page.add(html.panels(picture(lane) for lane in lanes[:PICTURED]))
    if len(lanes) > PICTURED:
        rest = html.panels(picture(lane) for lane in lanes[PICTURED:])
        page.add(html.details(f"{len(lanes) - PICTURED} more", rest))


def _add_settings(page: "Page", run: Run) -> None:
    """The command that makes the run again, every setting, and the numbers behind the first picture."""
    from vecpsmbpo.look import page as html

    settings = run.settings
    page.add("<h3>Again</h3>", f"<pre>{escape(command(settings))}</pre>")
    plain = [(name, groups.display(name, getattr(settings, name))) for name in of_algorithm(settings.algo)]
    options = [(f"env.{name}", value) for name, value in settings.env_options]
    swept = [(f"sweep.{name}", groups.display(name, values)) for name, values in settings.sweep]
    page.add(html.details("every setting", html.table(("setting", "value"), [*plain, *options, *swept])))
    steps = np.unique(np.concatenate([lane.epochs["env_steps"] for lane in run.lanes]))
    steps = steps[np.unique(np.linspace(0, len(steps) - 1, SHOWN).astype(int))]
    rows = [[f"{step:,.0f}", *(_at(lane, step) for lane in run.lanes)] for step in steps]
    head = ("step", *(lane.name for lane in run.lanes))
    page.add(html.details("evaluation returns as numbers", html.table(head, rows)))


def _at(lane: Lane, step: float) -> str:
    found = lane.epochs["eval_return"][lane.epochs["env_steps"] == step]
    return f"{found[0]:,.1f}" if len(found) and np.isfinite(found[0]) else "–"


def command(settings: Settings) -> str:
    """The shortest command that makes a run with these settings; its directory is left to it."""
    words = [f"env={settings.env}", *(f"env.{name}={value}" for name, value in settings.env_options)]
    words += [f"algo={settings.algo}", f"size={settings.size}"]
    usual = config.compose(words)
    for name in of_algorithm(settings.algo):
        value = getattr(settings, name)
        if name != "run_dir" and value != getattr(usual, name):
            words.append(f"{name}={_word(value)}")
    words += [f"sweep.{name}={_word(values)}" for name, values in settings.sweep]
    return " ".join(["vecpsmbpo train", *map(shlex.quote, words)])


def _word(value: Any) -> str:
    """A value as the command line reads it."""
    if isinstance(value, tuple):
        return "[" + ",".join(map(_word, value)) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    return ".inf" if value == float("inf") else str(value)


# ── videos ────────────────────────────────────────────────────────────────────────────────────────────────────────


def _own_films(run: Run) -> list[Path]:
    """Videos that lie in the run's directory."""
    return sorted([*run.path.glob("*.mp4"), *run.path.glob("*.gif")])


def _add_films(page: "Page", paths: Sequence[Path]) -> None:
    from vecpsmbpo.look import page as html

    if paths:
        films = [html.film(path.read_bytes(), path.suffix.lower(), path.stem) for path in dict.fromkeys(paths)]
        page.add("<h2>Videos</h2>", html.panels(films))
