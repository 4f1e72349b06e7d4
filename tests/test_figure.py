"""The paper's figures, from runs that no training made."""

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
    complete = len(list((tmp_path / "runs" / name).iterdir())) == len(list(_product(experiments._grid(name))))
    assert complete == (captured.err == "")
    if not complete:
        assert captured.err.startswith(f"vecpsmbpo: warning: {name}: no run of env=")
        assert f"to make them: vecpsmbpo train -m experiment={name} size=tiny" in captured.err


def test_figure_2_accumulates_what_was_missed(tmp_path):
    path = looks.write(tmp_path / "fig2" / "a", looks.epochs([1]), looks.episodes(4), env="cartpole_swingup_sparse")
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
    """Also where one of the algorithms is missing on a task."""
    for env, algos in (("ant", ("ps_mbpo", "mbpo")), ("hopper", ("ops_mbpo", "mbpo", "sac"))):
        for algo in algos:
            looks.write(tmp_path / "fig4" / f"{env}{algo}", looks.epochs([1, 2]), env=env, algo=algo)
    with style.styled():
        drawn = figure.draw_curves(experiments.load("fig4", tmp_path), reference="sac")
    colours = {}
    for axis in drawn.axes:
        for line in axis.get_lines():
            colours.setdefault(line.get_label(), set()).add(line.get_color())
    assert {"PS-MBPO", "OPS-MBPO", "MBPO", "SAC", "SAC at 3M steps"} <= set(colours)
    assert all(len(found) == 1 for found in colours.values())
    assert len({*map(tuple, colours.values())}) == len(colours)


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


@pytest.fixture
def shelf(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for size in ("tiny", "cpu"):
        looks.write(tmp_path / "runs" / "fig9" / size, looks.epochs([1]), looks.episodes(3), env="hopper", size=size)
    looks.write(tmp_path / "runs" / "fig8" / "a", looks.epochs([1]), env="window_open")
    return tmp_path


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ([], "figure: takes the name of one; one of fig2, fig4"),
        (["fig3"], "figure: fig3 is a drawing and is left out; one of fig2"),
        (["fig99"], "figure: takes the name of one"),
        (["fig2"], "fig2: there are no runs in runs/fig2; to make them: vecpsmbpo train -m experiment=fig2 size=cpu"),
        (["fig9"], "size: the runs in runs/fig9 are of sizes cpu, tiny; say size=, one of them"),
        (
            ["fig9", "size=paper"],
            "fig9: there are no runs in runs/fig9; to make them: vecpsmbpo train -m experiment=fig9",
        ),
        (["fig9", "size=big"], "size=big: must be one of cpu, paper, tiny"),
        (["fig9", "size=cpu", "out=a.csv"], "out=a.csv: must be a file that ends in .png, .svg, .pdf"),
        (["fig8"], "figure: this one needs umap-learn; pip install 'vecpsmbpo[umap]'"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_a_mistake_is_one_line(arguments, line, shelf, monkeypatch, capsys):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert cli.main(["figure", *arguments]) == 2
    captured = capsys.readouterr()
    errors = [text for text in captured.err.splitlines() if "warning" not in text]
    assert len(errors) == 1
    assert errors[0].startswith(f"vecpsmbpo: {line}")
    assert [path.name for path in shelf.iterdir()] == ["runs"]


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
