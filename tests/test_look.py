"""Reading runs, grouping them, and the curves and tables made of them."""

import itertools
import json
import re
import shlex
import subprocess
import sys
import time
from html.parser import HTMLParser

import numpy as np
import pytest
from scipy import stats

from tests import looks
from tests.helpers import environment
from vecpsmbpo import cli, config
from vecpsmbpo.look import compare, curves, groups, posterior, report, runs, statistics
from vecpsmbpo.settings import SettingError

# ── reading ───────────────────────────────────────────────────────────────────────────────────────────────────────


def test_columns_of_a_log(tmp_path):
    path = looks.write(tmp_path / "a", looks.epochs([1, 2, 3], real_ratio_probs=[0.25, 0.75]), looks.episodes(5))
    run = runs.load(path)
    (lane,) = run.lanes
    assert lane.values == {"seed": 0}
    np.testing.assert_array_equal(lane.epochs["env_steps"], [40, 80, 120])
    np.testing.assert_array_equal(lane.epochs["critic_loss"], [np.nan, 1 / 2, 1 / 3])
    assert lane.epochs["real_ratio_probs"].shape == (3, 2)
    assert lane.episodes["probs"].shape == (5, 4)
    np.testing.assert_array_equal(lane.episodes["random"], [1, 0, 0, 0, 0])
    assert run.complete
    assert not lane.frozen


def test_a_line_cut_short_and_noise(tmp_path):
    path = looks.write(tmp_path / "a", looks.epochs([1, 2, 3, 4]))
    log = path / "metrics.jsonl"
    first, second, third, fourth = log.read_bytes().splitlines(keepends=True)
    log.write_bytes(first + b"\xff\x00\x9f\n" + second + b'{"env_steps": 120}\n[1]\n' + third + fourth[:-9])
    run = runs.load(path)
    np.testing.assert_array_equal(run.lanes[0].epochs["eval_return"], [1, 2, 3])
    assert run.metrics.damaged == 3  # noise, no seed, no dictionary; but not the line that is being written
    assert [f"{log}: 3 damaged line(s) left out"] == list(runs.warnings([run]))


def test_a_frozen_lane_keeps_the_others(tmp_path):
    frozen = looks.epochs([5, 6], seed=1)
    frozen.append(dict.fromkeys(frozen[0]) | {"env_steps": 120, "seed": 1, "frozen": True})
    path = looks.write(tmp_path / "a", looks.epochs([1, 2, 3]) + frozen, num_seeds=2)
    run = runs.load(path)
    assert [lane.frozen for lane in run.lanes] == [False, True]
    assert np.isnan(run.lanes[1].epochs["eval_return"][-1])
    assert list(runs.warnings([run])) == [f"{path}: seed 1 was frozen at step 120"]


def test_lanes_of_a_sweep(tmp_path):
    lines = [
        line
        for tau in ("inf", 5.0)
        for seed in (3, 4)
        for line in looks.epochs([seed, 10 * seed], seed=seed, temperature=tau)
    ]
    swept = {"num_seeds": 2, "seed": 3, "sweep.temperature": "[.inf,5]"}
    run = runs.load(looks.write(tmp_path / "a", lines, **swept))
    assert [tuple(lane.values.values()) for lane in run.lanes] == [(3, np.inf), (4, np.inf), (3, 5), (4, 5)]
    np.testing.assert_array_equal(run.lanes[3].epochs["eval_return"], [4, 40])
    assert [group.name for group in groups.group([run])] == ["τ = 5", "τ = ∞"]


def test_a_step_written_twice_counts_once(tmp_path):
    path = looks.write(tmp_path / "a", looks.epochs([1, 2, 3]) + looks.epochs([7, 8]))
    np.testing.assert_array_equal(runs.load(path).lanes[0].epochs["eval_return"], [7, 8, 3])


def test_reading_is_linear(tmp_path):
    """Four times the lines take less than eight times as long, and are arrays: 8 bytes a number, 4 a probability."""
    seconds = []
    for count in (20_000, 80_000):
        lines = looks.episodes(100)
        text = "".join(json.dumps(line) + "\n" for line in lines) * (count // 100)
        (tmp_path / "episodes.jsonl").write_text(text)
        began = time.perf_counter()
        log = runs.read(tmp_path / "episodes.jsonl")
        seconds.append(time.perf_counter() - began)
        assert len(log) == count
        assert sum(column.nbytes for column in log.columns.values()) == count * (8 * (len(lines[0]) - 1) + 4 * 4)
    assert seconds[1] < 8 * seconds[0]


# ── grouping ──────────────────────────────────────────────────────────────────────────────────────────────────────


def _runs(tmp_path, **by_name):
    return [
        runs.load(looks.write(tmp_path / name, looks.epochs([1, 2], seed=settings.get("seed", 0)), **settings))
        for name, settings in by_name.items()
    ]


def test_groups_are_named_by_what_differs_and_no_more(tmp_path):
    found = _runs(tmp_path, a={"algo": "mbpo"}, b={"algo": "ops_mbpo"}, c={"algo": "ops_mbpo", "seed": 5})
    together = groups.group(found)
    # algo=mbpo brings rollout_models and n_policies of its own, which need not be named.
    assert [(group.name, len(group.lanes)) for group in together] == [("OPS-MBPO", 2), ("MBPO", 1)]
    (one,) = groups.group(found, ["size"])
    assert len(one.lanes) == 3


def test_groups_of_two_settings(tmp_path):
    cells = {f"{n}{m}": {"n_models": n, "n_policies": m} for n in (1, 2) for m in (1, 3)}
    names = [group.name for group in groups.group(_runs(tmp_path, **cells))]
    assert names == ["N = 1, M = 1", "N = 1, M = 3", "N = 2, M = 1", "N = 2, M = 3"]


def test_the_same_run_twice_is_told_apart_by_its_directory(tmp_path):
    assert [group.name for group in groups.group(_runs(tmp_path, before={}, after={}))] == ["after", "before"]


def test_a_setting_that_there_is_not(tmp_path):
    with pytest.raises(SettingError, match="group=alog: no such setting; did you mean algo"):
        groups.group(_runs(tmp_path, a={}), ["alog"])


# ── statistics ────────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 8, 11, 100])
def test_the_interquartile_mean_is_scipy_s_trimmed_mean(count):
    scores = np.random.default_rng(count).normal(size=(2, count))
    expected = stats.trim_mean(scores, 0.25, axis=None)
    assert statistics.interquartile_mean(list(scores)) == pytest.approx(expected)
    np.testing.assert_allclose(statistics.trimmed_mean(scores, axis=1), stats.trim_mean(scores, 0.25, axis=1))


def test_statistics_by_hand():
    one, other = [np.array([0.2, 0.8]), np.array([1.5, 0.5])], [np.array([0.2, 0.4]), np.array([2.0, 3.0])]
    assert statistics.optimality_gap(one) == pytest.approx(1 - (0.2 + 0.8 + 1.0 + 0.5) / 4)
    # Pairs: 0.2 against 0.2 is a tie, against 0.4 a loss; 0.8 wins twice; the second task is lost throughout.
    assert statistics.probability_of_improvement(one, other) == pytest.approx((2.5 / 4 + 0) / 2)
    assert statistics.probability_of_improvement(one, one) == 0.5


def test_the_probability_of_improvement_is_mann_whitney_s(tmp_path):
    random = np.random.default_rng(0)
    one, other = random.normal(0.3, 1, 9), random.normal(0, 1, 7)
    expected = stats.mannwhitneyu(one, other).statistic / (9 * 7)
    assert statistics.probability_of_improvement([one], [other]) == pytest.approx(expected)


def test_what_is_not_known_is_not_trimmed_away():
    scores = [np.array([1.0, 2.0, np.nan, 3.0])]
    assert np.isnan(statistics.interquartile_mean(scores))
    assert np.isnan(statistics.optimality_gap(scores))
    assert np.isnan(statistics.probability_of_improvement(scores, [np.zeros(2)]))


def _mean(scores):
    return float(np.mean(np.concatenate(scores)))


def test_the_bootstrap_s_interval_is_that_of_a_normal_mean():
    sample = np.random.default_rng(1).normal(5, 2, 400)
    estimate = statistics.bootstrap(_mean, [sample], resamples=4000)
    error = 1.96 * sample.std(ddof=1) / 20
    np.testing.assert_allclose([estimate.low, estimate.high], sample.mean() + np.array([-error, error]), atol=0.03)


def test_the_bootstrap_is_stratified():
    """Runs are drawn within their task: scores that differ between tasks only have an interval of no width."""
    estimate = statistics.bootstrap(_mean, [np.full(5, 0.1), np.full(5, 0.9)])
    assert estimate == pytest.approx((0.5, 0.5, 0.5))


def test_one_run_has_no_interval():
    assert np.isnan(statistics.bootstrap(statistics.interquartile_mean, [np.array([3.0])]).low)
    assert np.isnan(statistics.band(np.ones((1, 4)), np.mean)).all()


# ── curves and tables ─────────────────────────────────────────────────────────────────────────────────────────────


@pytest.fixture
def mixed(tmp_path):
    """OPS-MBPO with a frozen seed and PS-MBPO with one that is behind."""
    frozen = looks.epochs([5, 6], seed=1)
    frozen[-1]["frozen"] = True
    ops = looks.write(tmp_path / "ops", looks.epochs([1, 2, 3]) + frozen, num_seeds=2)
    behind = looks.epochs([0, 1, 2]) + looks.epochs([2, 3], seed=1)
    ps = looks.write(tmp_path / "ps", behind, num_seeds=2, algo="ps_mbpo")
    return [ops, ps]


def test_a_frozen_seed_counts_with_what_it_had_reached_and_a_slow_one_ends_the_curve(mixed):
    ops, ps = (curves.curve(group, "env_steps", "eval_return") for group in groups.group(runs.load_all(mixed)))
    np.testing.assert_array_equal(ops.x, [40, 80, 120])
    np.testing.assert_array_equal(ops.y, [3, 4, 4.5])
    np.testing.assert_array_equal(ops.seeds[1], [5, 6, 6])
    np.testing.assert_array_equal(ps.x, [40, 80])
    np.testing.assert_array_equal(ps.y, [1, 2])
    assert ops.low[0] == 1
    assert ops.high[0] == 5


def test_an_epoch_without_a_value_counts_as_the_one_before(tmp_path):
    lines = looks.epochs([1, 2, 3, 4])
    lines[2]["eval_return"] = None
    lanes = lines + looks.epochs([1, 1, 1, 1], seed=1)
    (group,) = groups.group([runs.load(looks.write(tmp_path / "a", lanes, num_seeds=2))])
    np.testing.assert_array_equal(curves.curve(group, "env_steps", "eval_return").seeds[0], [1, 2, 2, 4])
    smooth = curves.curve(group, "env_steps", "alpha", smooth=2)
    np.testing.assert_allclose(smooth.y, 0.1)


def test_smoothing_is_a_mean_of_the_last_epochs(tmp_path):
    (group,) = groups.group([runs.load(looks.write(tmp_path / "a", looks.epochs([1, 2, 6])))])
    np.testing.assert_allclose(curves.curve(group, "env_steps", "eval_return", smooth=2).y, [1, 1.5, 4])


def _options(**changes):
    return {name: option.default for name, option in compare.OPTIONS.items()} | changes


def test_scores_of_a_seed_by_hand(mixed):
    ops, _ = runs.load_all(mixed)
    seed = compare.score(ops.lanes[0], 120, _options(window=2, threshold=2.0))
    assert seed == compare.Seed(final=2.5, best=3, area=2, reached=80, seconds=6)
    frozen = compare.score(ops.lanes[1], 120, _options(window=2, threshold=7.0))
    assert (frozen.final, frozen.best, frozen.area, frozen.reached) == (6, 6, pytest.approx(17 / 3), np.inf)


def test_the_table(mixed):
    rows = compare.table(runs.load_all(mixed), _options(window=1, target=10.0))
    assert [(row.name, row.env_steps, row.frozen) for row in rows] == [("OPS-MBPO", 80, 1), ("PS-MBPO", 80, 0)]
    ops, ps = (row.cells for row in rows)
    assert ops["final"].value == 4  # of 2 and 6
    assert ops["optimality gap"].value == pytest.approx(1 - 0.4)
    assert ops["P(better)"].value == 0.75  # 2 is above 1 and below 3, 6 above both
    assert "P(better)" not in ps


def test_tasks_together_are_scaled(tmp_path):
    """Half of cartpole's 25 most possible (episodes have 25 steps) and a quarter of hopper's 3809."""
    for env, value in (("cartpole_swingup", 12.5), ("hopper", 3809 / 4)):
        for algo in ("ops_mbpo", "sac"):
            looks.write(tmp_path / f"{env}-{algo}", looks.epochs([value, value]), env=env, algo=algo)
    rows = compare.table(runs.load_all(sorted(tmp_path.iterdir())), _options())
    assert [row.task for row in rows].count("all 2 tasks, scaled") == 2
    assert rows[-1].cells["final"].value == pytest.approx((1 / 2 + 1 / 4) / 2)
    assert rows[-1].cells["optimality gap"].value == pytest.approx(5 / 8)


# ── the commands ──────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("suffix", ["png", "svg", "pdf"])
def test_plot_draws_every_kind_of_file(mixed, suffix, tmp_path, capsys):
    out = tmp_path / "made" / f"curves.{suffix}"
    assert cli.main(["plot", *map(str, mixed), "y=eval_return,train_return", f"out={out}"]) == 0
    magic = {"png": b"\x89PNG", "svg": b"<?xml", "pdf": b"%PDF"}[suffix]
    assert out.read_bytes().startswith(magic)
    assert [path.name for path in out.parent.iterdir()] == [out.name]
    captured = capsys.readouterr()
    assert captured.out == f"written: {out}\n"
    assert captured.err == f"vecpsmbpo: warning: {mixed[0]}: seed 1 was frozen at step 80\n"
    if suffix == "svg":
        text = out.read_text()
        for said in ("OPS-MBPO", "PS-MBPO", "evaluation return", "95% bootstrap band", "environment steps"):
            assert said in text


def test_plot_writes_the_numbers(mixed, tmp_path):
    out = tmp_path / "curves.csv"
    assert cli.main(["plot", str(mixed[0]), "y=eval_return,critic_loss", f"out={out}"]) == 0
    header, first, second, *_ = out.read_text().splitlines()
    assert header == "run,swept,env_steps,seed,eval_return,critic_loss"
    assert (first, second) == ("ops,,40,0,1,", "ops,,80,0,2,0.5")


def test_plot_draws_over_published_curves(tmp_path):
    path = looks.write(tmp_path / "a", looks.epochs([1, 2]), env="hopper")
    out = tmp_path / "a.svg"
    assert cli.main(["plot", str(path), "reference=mbpo,sac", f"out={out}"]) == 0
    assert "MBPO, published" in out.read_text()
    assert "SAC at 3M steps" in out.read_text()


@pytest.mark.parametrize("suffix", ["", "csv", "md", "txt"])
def test_compare_writes_every_kind_of_table(mixed, suffix, tmp_path, capsys):
    out = [f"out={tmp_path / 'table'}.{suffix}"] if suffix else []
    assert cli.main(["compare", *map(str, mixed), "threshold=2", *out]) == 0
    text = (tmp_path / f"table.{suffix}").read_text() if suffix else capsys.readouterr().out
    for said in ("OPS-MBPO", "PS-MBPO", "final", "best", "area", "steps to", "P(better)"):
        assert said in text
    assert "frozen" in text


@pytest.fixture
def shelf(tmp_path):
    """Directories of every kind; the folder that commands run in."""
    looks.write(tmp_path / "run", looks.epochs([1, 2]))
    looks.write(tmp_path / "hopper", looks.epochs([1, 2]), env="hopper")
    looks.write(tmp_path / "begun", [])
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").write_text("")
    damaged = looks.write(tmp_path / "damaged", looks.epochs([1]))
    (damaged / "config.yaml").write_text("[1, 2")
    return tmp_path


MISTAKES = [
    (["plot"], "run_dir: plot needs the directory of a run that train has written"),
    (["plot", "nowhere"], "run_dir=nowhere: holds no config.yaml, so no run"),
    (["plot", "empty"], "run_dir=empty: holds no config.yaml, so no run"),
    (["plot", "damaged"], "run_dir=damaged: its config.yaml cannot be read"),
    (["plot", "begun"], "run_dir=begun: has no whole epoch in metrics.jsonl yet"),
    (["plot", "run", "hopper"], "run_dir: must all be of one task; run is of cartpole_swingup, hopper of hopper"),
    (["plot", "run", "z=1"], "z=1: no such option of plot; one of average, group"),
    (["plot", "run", "y=eval_retrun"], "y=eval_retrun: the runs have no such column; did you mean eval_return"),
    (["plot", "run", "x=epochs"], "x=epochs: must be one of env_steps, seconds"),
    (["plot", "run", "smooth=0"], "smooth=0: must be a whole number, at least 1"),
    (["plot", "run", "group=alog"], "group=alog: no such setting; did you mean algo"),
    (["plot", "run", "reference=ppo"], "reference=ppo: must be of mbpo, sac"),
    (["plot", "run", "reference=mbpo"], "reference=mbpo: nothing is published for cartpole_swingup"),
    (["plot", "hopper", "reference=mbpo", "x=seconds"], "reference: is of y=eval_return over x=env_steps"),
    (["plot", "run", "out=a.bmp"], "out=a.bmp: must be a file that ends in .png, .svg, .pdf, .csv"),
    (["plot", "run", "out=file/a.png"], "out=file/a.png: cannot be written (Not a directory)"),
    (["compare", "run", "steps=90"], "steps=90: run has not come to it (seed 0)"),
    (["compare", "run", "target=high"], "target=high: must be a number"),
    (["compare", "run", "baseline=SAC"], "baseline=SAC: no such group; one of OPS-MBPO"),
    (["compare", "run", "out=empty/a.xls"], "out=empty/a.xls: must be a file that ends in .csv, .md, .txt"),
]


@pytest.mark.parametrize(("arguments", "line"), MISTAKES, ids=[" ".join(words) for words, _ in MISTAKES])
def test_a_mistake_is_one_line_and_leaves_nothing(arguments, line, shelf, monkeypatch, capsys):
    monkeypatch.chdir(shelf)
    before = sorted(shelf.rglob("*"))
    assert cli.main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith(f"vecpsmbpo: {line}")
    assert captured.err.count("\n") == 1
    assert sorted(shelf.rglob("*")) == before


LIGHT = """
import json, sys
from vecpsmbpo import cli
mistakes, commands = json.loads(sys.argv[1])
for words in mistakes:
    assert cli.main(words) == 2
assert "matplotlib" not in sys.modules
for words in commands:
    assert cli.main(words) == 0
heavy = {"jax", "mujoco", "brax", "orbax", "scipy"} & set(sys.modules)
assert not heavy, heavy
"""


def test_mistakes_do_not_import_matplotlib_and_looking_does_not_import_jax(shelf):
    words = [[arguments for arguments, _ in MISTAKES], [["plot", "run", "out=a.png"], ["compare", "run"]]]
    argv = [sys.executable, "-c", LIGHT, json.dumps(words)]
    result = subprocess.run(argv, cwd=shelf, env=environment(), capture_output=True, text=True, timeout=60)
    assert result.returncode == 0, result.stderr


def test_what_was_there_stays_where_a_picture_cannot_be_drawn(shelf, monkeypatch):
    from vecpsmbpo.look import style

    def full(figure, path, **kwargs):
        path.write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(style.Figure, "savefig", full)
    out = shelf / "a.png"
    out.write_text("before")
    assert cli.main(["plot", str(shelf / "run"), f"out={out}"]) == 2
    assert out.read_text() == "before"
    assert not list(shelf.glob(".a*"))


# ── the page ──────────────────────────────────────────────────────────────────────────────────────────────────────


class _Html(HTMLParser):
    """Tags that are open, texts, and everything a browser would load."""

    def __init__(self):
        super().__init__()
        self.open, self.loads, self.texts, self.styles = [], [], [], []

    def handle_starttag(self, tag, attributes):
        if tag not in {"meta", "link", "use", "img"}:
            self.open.append(tag)
        self.loads += [value for name, value in attributes if name in ("src", "href", "xlink:href")]
        self.styles += [value for name, value in attributes if name == "style"]

    def handle_startendtag(self, tag, attributes):
        self.handle_starttag(tag, attributes)
        if self.open and self.open[-1] == tag:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.texts.append(data)


def _read(path):
    page = _Html()
    page.feed(path.read_text())
    assert page.open == []
    return page


def _report(*arguments):
    assert cli.main(["report", *map(str, arguments)]) == 0


def test_a_report_stands_by_itself(tmp_path):
    path = looks.write(tmp_path / "a", looks.epochs([1, 2, 30.5]), looks.episodes(5))
    (path / "walk.gif").write_bytes(b"GIF89a")
    _report(path, f"out={tmp_path / 'a.html'}")
    page, text = _read(tmp_path / "a.html"), (tmp_path / "a.html").read_text()
    assert all(target.startswith(("#", "data:")) for target in page.loads)
    assert "data:image/gif;base64,R0lGODlh" in page.loads
    assert "http-equiv" not in text
    said = " ".join(page.texts)
    for expected in (
        "cartpole_swingup, OPS-MBPO", "step 120 of 120", "complete", "probability to act", "member n, m",
        "seed 0: 5 episodes, 1 of them by no single member", "critic loss", "30.5", "temperature", "walk",
        "vecpsmbpo train env=cartpole_swingup algo=ops_mbpo size=tiny",
    ):  # fmt: skip
        assert expected in said


def test_every_colour_of_a_report_has_one_for_dark_paper(tmp_path):
    path = looks.write(tmp_path / "a", looks.epochs([1, 2, 3]), looks.episodes(5))
    _report(path, f"out={tmp_path / 'a.html'}")
    page, text = _read(tmp_path / "a.html"), (tmp_path / "a.html").read_text()
    assert not any("#" in style.replace("url(#", "") for style in page.styles)
    light, dark = text.split("<style>")[1].split("</style>")[0].rsplit("@media (prefers-color-scheme: dark)", 1)
    used = {name for style in page.styles for name in re.findall(r"var\((--c\w+)\)", style)}
    assert len(used) > 4
    for name in used:
        assert f"{name}:#" in light
        assert f"{name}:#" in dark


def test_a_report_of_several_runs_compares_them(mixed, tmp_path):
    _report(*mixed, f"out={tmp_path / 'a.html'}")
    said = " ".join(_read(tmp_path / "a.html").texts)
    assert "2 runs of cartpole_swingup" in said
    assert "optimality gap" in said
    assert "frozen: seed 1" in said


@pytest.mark.parametrize("algo", ["mbpo", "pets", "slbo", "sac", "ps_mbpo"])
def test_every_algorithm_has_a_report(algo, tmp_path):
    path = looks.write(tmp_path / "a", looks.epochs([1, 2, 3]), looks.episodes(5, (1, 1)), algo=algo)
    _report(path, f"out={tmp_path / 'a.html'}")
    assert ("Who acted" in (tmp_path / "a.html").read_text()) is False  # one member: nothing is drawn


def test_a_frozen_lane_has_a_report(tmp_path):
    """Its last line has numbers no more."""
    frozen = looks.epochs([5, 6], seed=1)
    frozen.append(dict.fromkeys(frozen[0]) | {"env_steps": 120, "seed": 1, "frozen": True})
    path = looks.write(tmp_path / "a", looks.epochs([1, 2, 3]) + frozen, looks.episodes(5), num_seeds=2)
    _report(path, f"out={tmp_path / 'a.html'}")
    said = " ".join(_read(tmp_path / "a.html").texts)
    assert "frozen: seed 1" in said
    assert "nan" not in said.lower()
    rows = compare.table(runs.load_all([path]), _options(window=1))
    assert (rows[0].env_steps, rows[0].cells["final"].value, rows[0].cells["seconds"].value) == (120, 4.5, 5)


def test_a_run_that_goes_on_is_looked_at_again(tmp_path):
    path = looks.write(tmp_path / "a", looks.epochs([1, 2]))
    report.keep(path, warn=pytest.fail)
    assert '<meta http-equiv="refresh" content="30">' in (path / "report.html").read_text()


def test_a_page_that_cannot_be_drawn_does_not_stop_a_run(tmp_path, monkeypatch):
    path = looks.write(tmp_path / "a", looks.epochs([1, 2]))
    monkeypatch.setattr(report, "write", lambda *args, **kwargs: 1 / 0)
    said = []
    report.keep(path, said.append)
    assert said == [f"{path / 'report.html'} is not up to date (division by zero)"]


def test_the_command_of_a_report_makes_the_same_settings(tmp_path):
    given = ["env=hopper", "algo=sac", "size=cpu", "sweep.discount=[0.9,0.99]", "seed=3", "real_ratio_arms=[0,0.5]"]
    settings = config.compose([*given, "temperature=.inf", "compile_cache=false"])
    words = shlex.split(report.command(settings))[2:]
    assert config.compose([*words, f"run_dir={settings.run_dir}"]) == settings


# ── the posterior as a picture ────────────────────────────────────────────────────────────────────────────────────


def test_who_acted(tmp_path):
    lines = looks.episodes(6, (2, 3))
    lines[4] |= {"model": None, "policy": None}
    path = looks.write(tmp_path / "a", looks.epochs([1]), lines, n_policies=3)
    np.testing.assert_array_equal(posterior.acting(runs.load(path).episodes, 3), [-1, 1, 2, 3, -1, 5])


def test_bins_are_means_of_their_episodes():
    between = posterior.edges(1000)
    assert (between[0], between[-1]) == (0, 1000)
    assert len(between) == posterior.BINS + 1
    assert set(np.diff(between)) == {4, 5}
    values = np.random.default_rng(0).random((1000, 3))
    expected = [values[begin:end].mean(axis=0) for begin, end in itertools.pairwise(between)]
    np.testing.assert_allclose(posterior.binned(values, between), expected)


def test_many_episodes_are_drawn_small(tmp_path):
    """A picture of 5,000 episodes takes no more room than twice that of 200."""
    sizes = []
    for count in (200, 5000):
        path = looks.write(tmp_path / str(count), looks.epochs([1, 2]), looks.episodes(count))
        _report(path, f"out={tmp_path / 'a.html'}")
        sizes.append((tmp_path / "a.html").stat().st_size)
    assert sizes[1] < 2 * sizes[0]
