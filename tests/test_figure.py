"""The paper's figures, from logs that no training wrote. (From runs: test_run.py, slow.)"""

import json
import sys
import types

import numpy as np
import pytest
from matplotlib.figure import Figure

from tests import looks
from vecpsmbpo import cli, config
from vecpsmbpo.look import experiments, figure, groups, states, style

SWEPT = {
    "fig2": ("real_ratio", (0.0, 0.5)),
    "fig11": ("temperature", (1000.0, "inf")),
    "fig12": ("temperature", (1000.0, "inf")),
    "fig16": ("forced_exploration", (0.0, 5.0)),
    "fig17": ("prior_scale", (0.0, 0.3)),
}


def _make(name, folder, *, tasks=2, seeds=2, **more):
    """Runs of an experiment: of its first tasks with all else that it compares, at most 3 of each."""
    grid = {key: values[: tasks if key == "env" else 3] for key, values in experiments._grid(name).items()}
    sweep, values = SWEPT.get(name, (None, (None,)))
    keys = list(grid)
    for index, point in enumerate(_product(grid)):
        settings = dict(zip(keys, point, strict=True)) | more | {"num_seeds": seeds}
        lines, actors = [], []
        for value in values:
            lane = {sweep: value} if sweep else {}
            for seed in range(seeds):
                lines += looks.epochs(np.arange(3) + index + seed, seed=seed, **lane)
                actors += looks.episodes(5, (2, settings.get("n_policies", 2)), seed=seed, **lane)
        if sweep:
            words = ",".join(".inf" if value == "inf" else str(value) for value in values)
            settings[f"sweep.{sweep}"] = f"[{words}]"
        looks.write(folder / name / f"run{index}", lines, actors, **settings)


def _product(grid):
    import itertools

    return itertools.product(*grid.values())


def _drawn(monkeypatch):
    """What is saved from here on."""
    saved = []
    original = Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda self, *args, **kw: (saved.append(self), original(self, *args, **kw)))
    return saved


@pytest.mark.parametrize("name", [name for name, draw in figure.DRAW.items() if draw is not figure.draw_states])
def test_every_figure_is_drawn_and_says_what_is_missing(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    _make(name, tmp_path / "runs")
    assert cli.main(["figure", name, "size=tiny"]) == 0
    captured = capsys.readouterr()
    if name == "table1":
        assert "| real_ratio |" in captured.out
        assert "ant, to step 120" in captured.out
    else:
        assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    said = [line for line in captured.err.splitlines() if line.startswith(f"vecpsmbpo: warning: {name}: ")]
    complete = len(list((tmp_path / "runs" / name).iterdir())) == len(list(_product(experiments._grid(name))))
    swept = name in SWEPT  # two of more values
    assert len(said) == (not complete) + swept
    assert all(line.endswith(f"; to make them: vecpsmbpo train -m experiment={name} size=tiny") for line in said)
    if not complete:
        assert said[0].startswith(f"vecpsmbpo: warning: {name}: no run of env=")
    if swept:
        assert said[-1].startswith(f"vecpsmbpo: warning: {name}: 0 of 1 seeds of env=")
        assert SWEPT[name][0] in said[-1]


def test_figure_2_accumulates_what_was_missed(tmp_path):
    settings = {"env": "cartpole_swingup_sparse", "algo": "ps_mbpo"}
    path = looks.write(tmp_path / "fig2" / "a", looks.epochs([1]), looks.episodes(4), **settings)
    (run,) = experiments.load("fig2", tmp_path, "tiny").runs
    steps, lost = figure.regret(run.lanes[0], 25.0)
    np.testing.assert_array_equal(steps, [25, 50, 75, 100])
    np.testing.assert_array_equal(lost, [25, 25 + 24, 25 + 24 + 23, 25 + 24 + 23 + 22])  # returns 0, 1, 2, 3
    assert path.exists()


def test_figure_7_averages_the_last_ten_evaluations(tmp_path, monkeypatch):
    returns = np.arange(12.0)
    for seed, shift in ((0, 0.0), (1, 4.0)):
        lines = looks.epochs(returns + shift, seed=seed)
        looks.write(tmp_path / "fig7" / str(seed), lines, env="cartpole_swingup_sparse", algo="ps_mbpo", seed=seed)
    with style.styled():
        drawn = figure.draw_bars(experiments.load("fig7", tmp_path))
    (bar,) = drawn.axes[0].containers[-1].patches
    assert bar.get_height() == pytest.approx(6.5 + 2)  # means 6.5 and 10.5 over the evaluations 2 to 11
    assert bar.get_x() + bar.get_width() / 2 == pytest.approx(2)  # N = 2


def test_the_band_of_the_paper_s_figures_is_a_standard_error():
    from vecpsmbpo.look.curves import error_band

    seeds = np.array([[1.0, 5.0], [3.0, 5.0], [8.0, 5.0]])
    low, high = error_band(seeds)
    error = np.std([1, 3, 8], ddof=1) / np.sqrt(3)
    np.testing.assert_allclose(low, [4 - error, 5])
    np.testing.assert_allclose(high, [4 + error, 5])


def test_a_group_has_one_colour_in_all_panels(tmp_path, monkeypatch):
    """Also where one of the algorithms is missing on a task; the legend names it all the same."""
    for env, algos in (("ant", ("ps_mbpo", "mbpo")), ("hopper", ("ops_mbpo", "mbpo", "sac"))):
        for algo in algos:
            looks.write(tmp_path / "fig4" / f"{env}{algo}", looks.epochs([1, 5000]), env=env, algo=algo)
    with style.styled():
        drawn = figure.draw_curves(experiments.load("fig4", tmp_path), reference="sac")
    colours = {}
    for axis in drawn.axes:
        for line in axis.get_lines():
            colours.setdefault(line.get_label(), set()).add(line.get_color())
    assert {"PS-MBPO", "OPS-MBPO", "MBPO", "SAC", "SAC at 3M steps"} <= set(colours)
    assert all(len(found) == 1 for found in colours.values())
    assert len({*map(tuple, colours.values())}) == len(colours)
    assert {text.get_text() for text in drawn.legends[0].get_texts()} == set(colours)


def test_figure_13_tells_how_lambda_is_found(tmp_path):
    _make("fig13", tmp_path)
    with style.styled():
        drawn = figure.draw_schedules(experiments.load("fig13", tmp_path))
    names = drawn.axes[-1].get_legend_handles_labels()[1]
    assert sorted(names) == ["λ chosen online", "λ constant", "λ falling from 1"]


def test_umap_figures_have_a_row_per_task_and_a_column_per_stage(tmp_path, monkeypatch):
    """UMAP itself and the checkpoints are stood in for: 300 states on a line, seen in order."""
    for algo in ("ps_mbpo", "mbpo"):
        looks.write(tmp_path / "fig8" / algo, looks.epochs([1]), env="window_open", algo=algo)
    obs = np.arange(300.0)[:, None] * np.ones(4)
    monkeypatch.setattr(states, "visited", lambda run: states.Visited(run, np.arange(300), obs))
    fake = types.SimpleNamespace(UMAP=lambda **kw: types.SimpleNamespace(fit_transform=lambda x: x[:, :2]))
    monkeypatch.setitem(sys.modules, "umap", fake)
    with style.styled():
        drawn = figure.draw_states(experiments.load("fig8", tmp_path))
    assert len(drawn.axes) == 6
    for stage, axis in enumerate(drawn.axes[:3]):
        here = axis.collections[-1].get_offsets()
        assert len(here) == 100
        units = (obs[:, 0] - obs[:, 0].mean()) / obs[:, 0].std()
        np.testing.assert_allclose(here[:, 0], units[100 * stage : 100 * (stage + 1)])


def test_umap_is_shown_while_it_is_at_work(tmp_path, monkeypatch):
    for env in ("hopper", "ant"):
        looks.write(tmp_path / "fig18" / env, looks.epochs([1]), env=env, algo="mbpo")
    events = []

    def steps(items, what):
        for item in items:
            events.append(item[0])
            yield item

    monkeypatch.setattr(figure.working, "steps", steps)
    obs = np.arange(300.0)[:, None] * np.ones(4)
    visited = lambda run: (events.append("visited"), states.Visited(run, np.arange(300), obs))[1]  # noqa: E731
    monkeypatch.setattr(states, "visited", visited)
    monkeypatch.setattr(states, "plane", states.principal_plane)
    with style.styled():
        figure.draw_states(experiments.load("fig18", tmp_path))
    assert events == ["hopper", "visited", "ant", "visited"]


def test_figure_5_has_an_asymptote_where_one_is_known(tmp_path):
    for env in ("ball_in_cup", "cartpole_swingup_sparse", "window_open"):
        looks.write(tmp_path / "fig5" / env, looks.epochs([0, 500]), env=env, algo="sac")
    with style.styled():
        drawn = figure.DRAW["fig5"](experiments.load("fig5", tmp_path))
    names = [axis.get_legend_handles_labels()[1][1:] for axis in drawn.axes]
    assert names == [["SAC at 4M steps"], ["SAC at 4M steps"], []]


@pytest.mark.parametrize(("seeds", "said"), [(1, "one seed"), (2, "mean of 2 seeds, band: standard error")])
def test_a_title_says_what_is_drawn(seeds, said, tmp_path):
    lines = [line for seed in range(seeds) for line in looks.epochs([1, 2], seed=seed)]
    looks.write(tmp_path / "fig15" / "a", lines, env="hopper", algo="mbpo", num_seeds=seeds)
    with style.styled():
        drawn = figure.draw_curves(experiments.load("fig15", tmp_path))
    assert drawn.get_suptitle() == f"experiment=fig15 size=tiny: {said}"


# ── which runs are an experiment's ──────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("name", list(figure.DRAW))
def test_runs_of_something_else_are_no_figure(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(states, "check_umap", lambda: None)
    looks.write(tmp_path / "runs" / name / "a", looks.epochs([1]), looks.episodes(3))
    assert cli.main(["figure", name]) == 2
    line = f"vecpsmbpo: {name}: none of the runs in runs/{name} is one of its; to make them: vecpsmbpo train -m"
    assert capsys.readouterr().err == f"{line} experiment={name} size=cpu\n"
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]


def test_a_run_of_something_else_is_left_out(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    saved = _drawn(monkeypatch)
    for algo in ("mbpo", "ops_mbpo"):  # the wrong one first
        looks.write(
            tmp_path / "runs" / "fig9" / algo, looks.epochs([1, 2, 3]), looks.episodes(5), env="hopper", algo=algo
        )
    assert cli.main(["figure", "fig9"]) == 0
    err = capsys.readouterr().err
    assert err == "vecpsmbpo: warning: runs/fig9/mbpo: left out, fig9 has no env=hopper algo=mbpo\n"
    assert saved[0].get_suptitle().startswith("hopper, OPS-MBPO: experiment=fig9 size=tiny, seed 0, τ = ")


def test_what_an_experiment_lacks_is_said_with_the_command_that_makes_it(tmp_path):
    lines = [line for ratio in (0.0, 0.1) for line in looks.epochs([1, 2, 3], real_ratio=ratio)]
    settings = {"env": "cartpole_swingup_sparse", "algo": "ps_mbpo", "sweep.real_ratio": "[0,0.1]"}
    looks.write(tmp_path / "fig2" / "a", lines, size="cpu", total_steps=6000, updates_per_step=7, **settings)
    lacking, foreign, unfinished = experiments.load("fig2", tmp_path).warnings()
    point = "seeds of env=cartpole_swingup_sparse algo=ps_mbpo real_ratio="
    assert lacking == (
        f"fig2: 1 of 3 {point}0.0, 1 of 3 {point}0.1, 0 of 3 {point}0.3 and 3 more; "
        "to make them: vecpsmbpo train -m experiment=fig2 size=cpu"
    )
    wanted = config.compose_point("fig2", ["size=cpu", "env=cartpole_swingup_sparse", "algo=ps_mbpo"])
    assert foreign == (
        f"{tmp_path}/fig2/a: is not as experiment=fig2 makes it: total_steps=6000 (not {wanted.total_steps}), "
        f"updates_per_step=7 (not {wanted.updates_per_step})"
    )
    assert "has come to step 120 of 6,000" in unfinished


# ── figures 9 and 10 of any run ─────────────────────────────────────────────────────────────────────────────────────


def test_figure_9_of_any_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    saved = _drawn(monkeypatch)
    looks.write(tmp_path / "a", looks.epochs([1, 2, 3]), looks.episodes(5), temperature=7, train_episode_length=20)
    assert cli.main(["figure", "fig9", "a", "out=a.png"]) == 0
    captured = capsys.readouterr()
    assert (captured.out, captured.err) == ("written: a.png\n", "")
    (drawn,) = saved
    assert drawn.get_suptitle() == "cartpole_swingup, OPS-MBPO: size=tiny, seed 0, τ = 7"
    *_, returns = (axis for axis in drawn.axes if axis.get_ylabel() == "return")
    names = returns.get_legend_handles_labels()[1]
    assert names == ["evaluation return", "return in training (episodes of 20 steps)"]


@pytest.fixture
def shelf(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for size in ("tiny", "cpu"):
        looks.write(tmp_path / "runs" / "fig9" / size, looks.epochs([1]), looks.episodes(3), env="hopper", size=size)
    looks.write(tmp_path / "runs" / "fig8" / "a", looks.epochs([1]), env="window_open")
    sparse = {"env": "cartpole_swingup_sparse"}
    looks.write(tmp_path / "runs" / "fig10" / "a", looks.epochs([1]), **sparse)
    looks.write(tmp_path / "runs" / "fig16" / "a", looks.epochs([1], eval_return=None), env="hopper", algo="ps_mbpo")
    looks.write(tmp_path / "runs" / "sac", looks.epochs([1]), looks.episodes(3, (1, 1)), algo="sac", n_policies=1)
    (tmp_path / "other" / "fig2").mkdir(parents=True)
    looks.write(tmp_path / "other" / "fig2" / "a", looks.epochs([1]), algo="ps_mbpo", **sparse)
    return tmp_path


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ([], "figure: takes the name of one; one of fig2, fig4"),
        (["fig3"], "figure: fig3 is a drawing and is left out; one of fig2"),
        (["fig99"], "figure: fig99 is no figure of the paper; one of fig2"),
        (["fig2"], "fig2: there are no runs in runs/fig2; to make them: vecpsmbpo train -m experiment=fig2 size=cpu"),
        (["fig9"], "size: the runs in runs/fig9 are of sizes cpu, tiny; say size=, one of them"),
        (
            ["fig9", "size=paper"],
            "fig9: there are no runs in runs/fig9; to make them: vecpsmbpo train -m experiment=fig9",
        ),
        (["fig9", "size=big"], "size=big: must be one of cpu, paper, tiny"),
        (["fig9", "size=cpu", "out=a.csv"], "out=a.csv: must be a file that ends in .png, .svg, .pdf"),
        (["fig10"], "run_dir=runs/fig10/a: has no whole episode in episodes.jsonl yet"),
        (["fig2", "runs=other"], "run_dir=other/fig2/a: has no whole episode in episodes.jsonl yet"),
        (["fig16"], "fig16: eval_return is null in every line of its runs"),
        (["fig9", "runs/sac"], "run_dir=runs/sac: SAC draws no member to act, so that there are no weights to show"),
        (["fig9", "runs/fig9"], "run_dir: figure takes 1 run, not 2"),
        (["fig9", "runs/sac", "size=cpu"], "size=cpu: is of the runs of experiment=fig9, and a run is named"),
        (["fig4", "runs/sac"], "figure: fig4 is of the runs of experiment=fig4; fig9 and fig10 take a run"),
        (["fig8"], "figure: this one needs umap-learn; pip install 'vecpsmbpo[umap]'"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_a_mistake_is_one_line(arguments, line, shelf, monkeypatch, capsys):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert cli.main(["figure", *arguments]) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith(f"vecpsmbpo: {line}")
    assert captured.err.count("\n") == 1
    assert sorted(path.name for path in shelf.iterdir()) == ["other", "runs"]


def test_every_experiment_has_a_figure():
    assert set(figure.DRAW) == set(config.options("experiment"))


def test_runs_of_other_ways_to_find_lambda_are_told_apart(tmp_path):
    """What `plot` of a run that chooses λ beside constants names them."""
    from vecpsmbpo.look import runs

    found = [
        looks.write(tmp_path / "a", looks.epochs([1]), real_ratio_schedule="bandit"),
        looks.write(tmp_path / "b", looks.epochs([1]), real_ratio=0.7),
        looks.write(tmp_path / "c", looks.epochs([1]), real_ratio_schedule="linear"),
    ]
    names = {group.name for group in groups.group(runs.load_all(found))}
    assert names == {"λ chosen online", "λ = 0.7", "λ falling from 1"}
    assert json.loads((found[0] / "metrics.jsonl").read_text())["env_steps"] == 40
