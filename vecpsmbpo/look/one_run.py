"""What a page says of one run: where it stands, its curves, who acted, what models and critics are worth, how to run it
again."""

import contextlib
import shlex
import time
from collections import Counter
from collections.abc import Iterator
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from vecpsmbpo import config, jsonl, logged
from vecpsmbpo.algorithms.catalogue import of_algorithm
from vecpsmbpo.jsonl import EPISODES_FILE, METRICS_FILE, SESSIONS_FILE
from vecpsmbpo.look import compare, diagnose, films, groups, statistics
from vecpsmbpo.look.curves import curve
from vecpsmbpo.look.runs import Lane, Run, known, numbers
from vecpsmbpo.settings import Settings

if TYPE_CHECKING:
    from vecpsmbpo.look.page import Page

WINDOW = 5  # evaluations that count as the last ones
AVERAGE, AVERAGE_WORDS = "iqm", "interquartile mean over seeds"  # of curves, tiles and tables alike
PICTURED = 3  # a row of them: lanes whose posterior is drawn at once; the others are there to be opened
SHOWN = 60  # rows of the table of epochs
STEPS = logged.of("env_steps").label


def add(page: "Page", run: Run, heading: str, measured: dict[str, Any] | None) -> None:
    """All of it.

    Args:
        heading: `h1` or `h2`.
        measured: its diagnosis, instead of the one that lies in its directory.

    Raises:
        SettingError: that one cannot be read.
    """
    from vecpsmbpo.look import page as html

    settings = run.settings
    algo = groups.display("algo", settings.algo)
    page.add(f"<{heading}>{escape(settings.task)}, {escape(algo)}</{heading}>", _state(run))
    page.add(*(f'<p class="warning">{escape(text)}</p>' for text in gaps(run)))
    page.add(html.tiles(_tiles(run)))
    page.add(html.panels(filter(None, (_lanes_picture(page, run, y) for y in ("eval_return", "train_return")))))
    if max(len(one.lanes) for one in groups.group([run])) > 1:
        page.add(f'<p class="soft">Thick lines: {AVERAGE_WORDS}, as in all tiles and tables; thin ones: the seeds.</p>')
    _add_posterior(page, run)
    pictures = [_lanes_picture(page, run, y) for y, quantity in logged.QUANTITIES.items() if quantity.caption]
    page.add("<h3>Inside</h3>", html.panels(filter(None, (*pictures, _chances_picture(page, run)))))
    if measured:
        _add_diagnosis(page, measured)
    elif (stored := diagnose.read(run)) is not None:
        with diagnose.reading(run):
            _add_diagnosis(page, stored)
    else:
        how = escape(f"vecpsmbpo diagnose {shlex.quote(str(run.path))}")
        page.add(f'<p class="soft">Not measured yet: how accurate models and critics are (<code>{how}</code>).</p>')
    _add_settings(page, run)


def gaps(run: Run) -> Iterator[str]:
    """What its page cannot show of a run because its files do not have it: a line each."""
    from vecpsmbpo.look import posterior

    if not values(run, "eval_return"):
        yield f"{METRICS_FILE} has no evaluation return that is a number; none is shown"
    else:
        evaluated = _evaluated(run)
        if silent := [lane.name for lane in run.lanes if lane not in evaluated]:
            yield f"{METRICS_FILE} has no evaluation return of {', '.join(silent)}"
    if lacking := posterior.lacking(run.episodes):
        yield f"{EPISODES_FILE} has no usable {', '.join(lacking)}; who acted is not shown"
    for path in films.of_run(run):
        if not films.is_film(path):
            yield f"{path.name} holds no film, and is not shown"


def _add_diagnosis(page: "Page", diagnosis: dict[str, Any]) -> None:
    from vecpsmbpo.look import diagrams
    from vecpsmbpo.look import page as html

    pictures = [page.picture(figure, caption) for figure, caption in diagrams.figures(diagnosis)]
    said = f'<p class="soft">{escape(diagrams.headline(diagnosis))}</p>'
    page.add("<h3>Models and critics put to the test</h3>", said, html.panels(pictures))
    if len(diagnosis["history"]) < diagrams.TREND:
        few = f"Not drawn: how this changed over training, which takes {diagrams.TREND} checkpoints (keep_checkpoints)."
        page.add(f'<p class="soft">{few}</p>')


def _state(run: Run) -> str:
    """Where the run stands and what on, in a line."""
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
        *filter(None, [lengths(settings)]),
        where,
        *(f"on {machine}" for machine in dict.fromkeys(_machine(line) for line in _sessions(run)) if machine),
        f"last written {written}",
        *(f"frozen: {name}" for name in frozen),
    ]
    return f'<p class="soft"><span class="state">{state}</span> {escape(" · ".join(parts))}</p>'


def lengths(settings: Settings) -> str:
    """How long episodes are, where those that are learned from end earlier than those that are evaluated."""
    if settings.training_limit == settings.episode_length:
        return ""
    whole = f"{settings.episode_length:,}" if settings.episode_length else "as many as the task's own"
    return f"training episodes have {settings.training_limit:,} steps, evaluation episodes {whole}"


def _sessions(run: Run) -> list[jsonl.Line]:
    """What was noted whenever somebody began, or went on with, the run."""
    with contextlib.suppress(OSError):
        return jsonl.read(run.path / SESSIONS_FILE)
    return []


def _machine(session: jsonl.Line) -> str:
    """`2 × cpu, Intel Xeon, 2 cores`."""
    devices = session.get("devices")
    counts = Counter(map(str, devices)) if isinstance(devices, list) else {}
    parts = [*(f"{count} × {kind}" for kind, count in counts.items()), session.get("machine")]
    return ", ".join(str(part) for part in parts if part)


def _plural(count: int, what: str) -> str:
    return f"{count:,} {what}" if count == 1 else f"{count:,} {what}s"


def _tiles(run: Run) -> list[tuple[str, str]]:
    """The numbers to see first."""
    tiles = _return_tiles(run) if values(run, "eval_return") else [("–", "evaluation return")]
    if seconds := values(run, "seconds"):
        tiles.append((_duration(seconds[-1]), "wall time"))
    if speeds := values(run, "updates_per_s"):
        tiles.append((f"{speeds[-1]:,.0f}", "SAC updates per second"))
    return tiles


def _return_tiles(run: Run) -> list[tuple[str, str]]:
    lanes = _evaluated(run)
    last = [compare.score(lane, run.env_steps, _scoring()) for lane in lanes]
    final = statistics.bootstrap(statistics.interquartile_mean, [np.array([seed.final for seed in last])])
    best = statistics.Estimate(max(seed.best for seed in last), np.nan, np.nan)
    several, interval = len(lanes) > 1, "" if np.isnan(final.low) else ", and 95% interval"
    over = f"{AVERAGE_WORDS}{' and swept values' if run.settings.sweep else ''}" if several else "mean"
    return [
        (compare.shown(final), f"evaluation return: {over} of the last {WINDOW} evaluations{interval}"),
        (compare.shown(best), f"best evaluation{' of any seed' if several else ''}"),
    ]


def values(run: Run, name: str) -> list[float]:
    """What the log has of a column, by time; a frozen lane's last line has nothing."""
    column = numbers(run.metrics.columns, name)
    return column[known(column)].tolist()


def _evaluated(run: Run) -> list[Lane]:
    """The lanes that have an evaluation return to show."""
    return [lane for lane in run.lanes if known(lane.column("eval_return")).any()]


def _scoring() -> dict[str, Any]:
    return {"y": "eval_return", "window": WINDOW, "threshold": None}


def _duration(seconds: float) -> str:
    """1:02:03, or 2:03 below an hour."""
    minutes, second = divmod(round(seconds), 60)
    hours, minute = divmod(minutes, 60)
    return f"{hours}:{minute:02}:{second:02}" if hours else f"{minute}:{second:02}"


def _lanes_picture(page: "Page", run: Run, y: str) -> str:
    """Every seed of every swept value, faint, and their average; nothing where the column is empty."""
    from vecpsmbpo.look import plot, style

    together = groups.group([run])
    curves = [curve(one, "env_steps", y, average=AVERAGE) for one in together]
    if not any(len(line.x) for line in curves):
        return ""
    figure, (axes,) = style.grid(1, 1, (4.4, 2.9))
    looks = style.looks(len(curves), ordered=plot.is_ordered(together))
    for look, line in zip(looks, curves, strict=True):
        style.threads(axes, look, line.x, line.seeds)
        style.line(axes, look, line.x, line.y, label=line.name)
    quantity = logged.of(y)
    if quantity.scale == "unit":
        axes.set_ylim(-0.03, 1.03)
    elif quantity.scale == "log" and min(line.seeds.min() for line in curves if line.seeds.size) > 0:
        axes.set_yscale("log")
    style.steps_axis(axes, STEPS)
    axes.set_ylabel(quantity.label)
    if len(curves) > 1:
        style.legend(figure, axes, columns=3)
    said = [quantity.caption or quantity.label, *filter(None, [lengths(run.settings)] if y == "train_return" else [])]
    return page.picture(figure, "; ".join(said))


def _chances_picture(page: "Page", run: Run) -> str:
    """How likely each λ is the best, where it is chosen online; mean over seeds."""
    from vecpsmbpo.look import style

    columns = [lane.epochs["real_ratio_probs"] for lane in run.lanes if "real_ratio_probs" in lane.epochs]
    arms = run.lanes[0].setting("real_ratio_arms")
    if not columns or any(column.shape[1:] != (len(arms),) for column in columns):
        return ""
    shortest = min(map(len, columns))
    chances = np.mean([column[:shortest] for column in columns], axis=0)
    figure, (axes,) = style.grid(1, 1, (4.4, 2.9))
    for look, arm, chance in zip(style.looks(len(arms), ordered=True), arms, chances.T, strict=True):
        style.line(axes, look, run.lanes[0].epochs["env_steps"][:shortest], chance, label=f"λ = {arm:g}")
    style.steps_axis(axes, STEPS)
    axes.set_ylabel("probability")
    style.legend(figure, axes, columns=3)
    return page.picture(figure, "how likely each λ is the best (mean over seeds)")


def _add_posterior(page: "Page", run: Run) -> None:
    from vecpsmbpo.look import page as html
    from vecpsmbpo.look import posterior

    if not run.episodes or posterior.lacking(run.episodes):
        return
    lanes = [lane for lane in run.lanes if len(lane.episodes["probs"])]
    if not lanes or lanes[0].episodes["probs"].shape[1] < 2:
        return
    page.add("<h3>Who acted, and what it earned</h3>")
    differ = lengths(run.settings)
    said = f" Returns are those of training: {differ}." if differ else ""
    page.add(
        '<p class="soft">Before every episode a member (n, m) is drawn: policy m that learns in model n. The stronger '
        f"its row, the more likely it was to be drawn (equation 19); dots are the draws.{said}</p>"
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
    versions = ("vecpsmbpo", "jax", "mujoco", "python")
    sessions = [
        [f"{line[jsonl.STEP]:,}", _machine(line) or "–", *(line.get(name, "–") for name in versions)]
        for line in _sessions(run)
    ]
    if sessions:
        page.add(html.details("what it ran on", html.table(("from step", "devices", *versions), sessions)))
    page.add(html.details("every setting", html.table(("setting", "value"), [*plain, *options, *swept])))
    steps = np.unique(np.concatenate([lane.epochs["env_steps"] for lane in run.lanes]))
    steps = steps[np.unique(np.linspace(0, len(steps) - 1, SHOWN).astype(int))]
    rows = [[f"{step:,.0f}", *(_at(lane, step) for lane in run.lanes)] for step in steps]
    head = ("step", *(lane.name for lane in run.lanes))
    page.add(html.details("evaluation returns as numbers", html.table(head, rows)))


def _at(lane: Lane, step: float) -> str:
    found = lane.column("eval_return")[lane.epochs["env_steps"] == step]
    return f"{found[0]:,.1f}" if len(found) and known(found[0]) else "–"


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
