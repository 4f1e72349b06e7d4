"""What `plot` and `compare` write, and what they say to mistakes."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests import looks
from tests.helpers import environment
from tools import putback
from vecpsmbpo import algorithms, cli
from vecpsmbpo.look import plot, published, runs, style, working
from vecpsmbpo.settings import SettingError


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


def test_plot_draws_the_seeds_of_a_single_group_thin(mixed, tmp_path):
    for paths, thin in ((mixed[:1], 2), (mixed, 0)):
        assert cli.main(["plot", *map(str, paths), f"out={tmp_path / 'a.svg'}"]) == 0
        assert (tmp_path / "a.svg").read_text().count("stroke-opacity: 0.45") == thin


def test_plot_writes_the_numbers(mixed, tmp_path):
    out = tmp_path / "curves.csv"
    assert cli.main(["plot", str(mixed[0]), "y=eval_return,critic_loss", f"out={out}"]) == 0
    header, first, second, *_, last = out.read_text().splitlines()
    assert header == "run,swept,env_steps,seed,eval_return,critic_loss,frozen"  # the last where a lane is
    assert (first, second, last) == ("ops,,40,0,1,,", "ops,,80,0,2,0.5,", "ops,,80,1,6,0.5,1")


def test_a_table_of_curves_is_put_back_into_run_directories(tmp_path, capsys):
    """And drawn and compared as the runs that it is of: seeds, swept values, settings and gaps."""
    swept = [line for value in (0.0, 0.5) for line in looks.epochs([1, 2.5, 3], real_ratio=value)]
    swept[-1]["frozen"] = True
    words = ["env=cartpole_swingup", "size=tiny"]
    made = [
        looks.write(tmp_path / "swept", swept, **{"sweep.real_ratio": "[0,0.5]"}),
        looks.write(tmp_path / "ps", looks.epochs([1, 2]) + looks.epochs([3], seed=1), num_seeds=2, algo="ps_mbpo"),
    ]
    tables = [tmp_path / "of runs.csv", tmp_path / "put back.csv"]
    back = [tmp_path / "back" / run.name for run in made]
    assert cli.main(["plot", *map(str, made), "y=eval_return,critic_loss", f"out={tables[0]}"]) == 0
    own = ["swept:", "sweep.real_ratio=[0,0.5]", "ps:", "num_seeds=2", "algo=ps_mbpo"]
    assert putback.main([str(tables[0]), f"out={tmp_path / 'back'}", *words, *own]) == 0
    assert cli.main(["plot", *map(str, back), "y=eval_return,critic_loss", f"out={tables[1]}"]) == 0
    assert tables[0].read_text() == tables[1].read_text()
    capsys.readouterr()
    compared = []
    for runs_ in (made, back):
        assert cli.main(["compare", *map(str, runs_), "steps=40", f"out={tmp_path / 'compared.csv'}"]) == 0
        compared.append((tmp_path / "compared.csv").read_text().splitlines())
    of_runs, of_table = compared
    assert "seconds" not in of_table[0]  # which comes last
    assert all(line.startswith(f"{part},") for line, part in zip(of_runs, of_table, strict=True))
    assert f"{back[0]}: seed 0, real_ratio 0.5 was frozen at step 120" in list(runs.warnings(runs.load_all(back)))


def test_a_table_of_episodes_is_put_back_with_the_curves(tmp_path, capsys):
    """By seed and swept value; of two runs, or of a lane that there is not, it is refused and nothing written."""
    curves, episodes = tmp_path / "curves.csv", tmp_path / "episodes.csv"
    rows = "".join(f"a,real_ratio={value},40,{seed},1\n" for value in (0, 0.1) for seed in (0, 1))
    curves.write_text("run,swept,env_steps,seed,eval_return\n" + rows)
    episodes.write_text("real_ratio,seed,env_steps,return\n0,0,25,1.5\n0.1,1,30,-2\n")
    words = [f"out={tmp_path / 'out'}", "env=cartpole_swingup", "size=tiny", "num_seeds=2", "sweep.real_ratio=[0,0.1]"]
    assert putback.main([str(curves), f"episodes={episodes}", *words]) == 0
    assert [json.loads(line) for line in (tmp_path / "out" / "a" / "episodes.jsonl").read_text().splitlines()] == [
        {"seed": 0, "real_ratio": 0.0, "env_steps": 25, "return": 1.5},
        {"seed": 1, "real_ratio": 0.1, "env_steps": 30, "return": -2.0},
    ]
    words[0] = f"out={tmp_path / 'none'}"
    for text in ("real_ratio,seed,env_steps,return\n0,2,25,1.5\n", "seed,env_steps\n0,25\n"):
        episodes.write_text(text)
        with pytest.raises(SettingError, match="is not of this run"):
            putback.main([str(curves), f"episodes={episodes}", *words])
    curves.write_text(curves.read_text() + rows.replace("a,", "b,"))
    with pytest.raises(SettingError, match="is of one run, and there are 2"):
        putback.main([str(curves), f"episodes={episodes}", *words])
    assert not (tmp_path / "none").exists()


def test_every_committed_table_of_curves_can_be_put_back(tmp_path):
    """Its rows are read; one without `swept`, which older ones lack, becomes a run directory."""
    results = Path(__file__).parents[1] / "results"
    tables = [path for path in results.glob("**/*.csv") if path.read_text().startswith("run,")]
    assert len(tables) > 30
    found = {table.name: putback._runs_of(table) for table in tables}
    assert all(found.values())
    assert found["adaptive_lambda.csv"]["short_online"][0].numbers["real_ratio_probs"] == [0.2] * 5
    words = ["env=halfcheetah", "size=cpu", "total_steps=17000"]
    assert putback.main([str(results / "halfcheetah_unnormed.csv"), f"out={tmp_path}", *words]) == 0
    (run,) = runs.load_all(list(tmp_path.iterdir()))
    assert run.lanes[0].epochs["eval_return"].max() == pytest.approx(3538, abs=1)  # as docs/benchmark.md has it


def test_mistakes_in_what_is_put_back(tmp_path):
    """A line each, and nothing is written."""
    table, words = tmp_path / "a.csv", ["env=cartpole_swingup", "size=tiny"]
    head = "run,swept,env_steps,seed,eval_return\n"
    cases = {
        "other seeds": (head + "a,,40,0,1\n", ["num_seeds=2"]),
        "no such run": (head + "a,,40,0,1\n", ["b:", "seed=0"]),
        "twice": (head + "a,,40,0,1\na,,40,0,2\n", []),
        "goes to step 160": (head + "a,,160,0,1\n", []),
        "no name of a directory": (head + "../a,,40,0,1\n", []),
        "does not write": (head + "a,,40,zero,1\n", []),
        "too short": (head + "a,,40\n", []),
        "as plot out=FILE.csv": ("a,b\n1,2\n", []),
        "holds a x": (head + "x,,40,0,1\n", []),
    }
    (tmp_path / "out" / "x").mkdir(parents=True)
    for said, (text, more) in cases.items():
        table.write_text(text)
        with pytest.raises(SettingError, match=said):
            putback.main([str(table), f"out={tmp_path / 'out'}", *words, *more])
    assert [path.name for path in (tmp_path / "out").rglob("*")] == ["x"]
    with pytest.raises(SettingError, match="needs a table"):
        putback.main([])


def test_a_column_that_older_logs_lack_is_a_gap(tmp_path):
    new = looks.write(tmp_path / "new", looks.epochs([1, 2, 3], eval_broken_off=1))
    old = looks.write(tmp_path / "old", looks.epochs([1, 2, 3]), algo="sac")
    out = tmp_path / "a.csv"
    assert cli.main(["plot", str(new), str(old), "y=eval_broken_off", f"out={out}"]) == 0
    assert [line.split(",")[-1] for line in out.read_text().splitlines()[1:]] == ["1", "1", "1", "", "", ""]
    assert cli.main(["compare", str(new), str(old), "y=eval_broken_off", f"out={out}"]) == 0


def test_plot_draws_over_published_curves(tmp_path):
    path = looks.write(tmp_path / "a", looks.epochs([1, 2]), env="hopper")
    out = tmp_path / "a.svg"
    assert cli.main(["plot", str(path), "reference=mbpo,sac", f"out={out}"]) == 0
    assert ">MBPO, published (± s.d.)<" in out.read_text()
    assert ">SAC at 3M steps<" in out.read_text()


def test_a_published_level_is_a_line_a_span_or_a_remark(tmp_path):
    with style.styled():
        _, panels = style.grid(4, 3)
        sparse = "cartpole_swingup_sparse"
        cases = (("hopper", 3500), (sparse, 700), ("hopper", 700), (sparse, 60))
        for axis, (task, highest) in zip(panels, cases, strict=True):
            axis.plot([0, 1], [0, highest])
            plot.draw_references(axis, [published.reference("sac", task)])
    line, span, remark, another = panels
    assert line.get_lines()[-1].get_ydata()[0] == 3809
    assert (span.patches[0].get_y(), span.patches[0].get_height()) == (786.7, pytest.approx(841.7 - 786.7))
    assert (len(remark.get_lines()), remark.get_ylim()[1] < 800) == (1, True)
    assert remark.get_title(loc="right") == "SAC at 3M: 3,809 ↑"
    assert another.get_title(loc="right") == "SAC at 4M: 787–842 ↑"


def test_names_and_titles_are_text_and_no_mathematics(tmp_path, monkeypatch):
    """Nor are they anything of matplotlib's own: it keeps names that begin with _ for itself."""
    monkeypatch.chdir(tmp_path)
    names = ["_a", r"$\frac$", "$b$"]
    for name in names:
        looks.write(tmp_path / name, looks.epochs([1, 2]))
    assert cli.main(["plot", *names, r"title=$\frac$ of $", "out=a.svg"]) == 0
    assert cli.main(["plot", *names, "out=a.png"]) == 0
    written = (tmp_path / "a.svg").read_text().replace("\u200b", "")
    for said in (*names, r"$\frac$ of $"):
        assert f">{said}<" in written


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("value", [1e308, float("inf"), -1e308])
def test_what_no_run_can_have_earned_counts_for_nothing(value, tmp_path, capsys):
    path = looks.write(
        tmp_path / "a", [line for seed in (0, 1) for line in looks.epochs([1, value, 3], seed=seed)], num_seeds=2
    )
    assert cli.main(["plot", str(path), f"out={tmp_path / 'a.png'}"]) == 0
    assert cli.main(["compare", str(path), f"out={tmp_path / 'a.csv'}", "window=2"]) == 0
    assert capsys.readouterr().err == ""
    head, row = (line.split(",") for line in (tmp_path / "a.csv").read_text().splitlines())
    assert row[head.index("final")] == "2"  # of 1 and 3


def test_returns_in_training_say_where_their_episodes_are_shorter(tmp_path):
    """train_episode_length: a return of 20 steps is none of 25."""
    short = looks.write(tmp_path / "a", looks.epochs([1, 2]), train_episode_length=20)
    same = looks.write(tmp_path / "b", looks.epochs([1, 2]))
    for paths, said in (
        ([same], "return in training"),
        ([short], "(episodes of 20 steps)"),
        ([short, same], "(episodes of 20 or 25 steps)"),
    ):
        assert cli.main(["plot", *map(str, paths), "y=eval_return,train_return", f"out={tmp_path / 'a.svg'}"]) == 0
        assert f">{said}<" in (tmp_path / "a.svg").read_text()
        assert ">evaluation return<" in (tmp_path / "a.svg").read_text()


def test_an_algorithm_looks_the_same_whatever_is_beside_it():
    three, five = ["OPS-MBPO", "MBPO", "SAC"], ["OPS-MBPO", "PS-MBPO", "MBPO", "PETS", "SAC"]
    few, many = style.looks_of(three), style.looks_of(five)
    assert {name: many[name] for name in three} == few
    assert style.looks_of(["SAC"]) == {"SAC": many["SAC"]}
    assert len(set(many.values())) == len({look.colour for look in many.values()}) == 5
    assert set(style.ALGORITHMS) <= {entry.title for entry in algorithms.TABLE.values()}
    mixed = style.looks_of(["OPS-MBPO, λ = 0.1", "OPS-MBPO, λ = 0.3", "SAC, λ = 0", "own"])
    assert mixed["SAC, λ = 0"] == many["SAC"]
    assert len({look.colour for look in mixed.values()}) == 4


def test_panels_stand_in_even_rows_and_apart(tmp_path):
    shape = {count: style.grid(count, 3)[1][0].get_gridspec().get_geometry() for count in range(1, 8)}
    assert shape == {1: (1, 1), 2: (1, 2), 3: (1, 3), 4: (2, 2), 5: (2, 3), 6: (2, 3), 7: (3, 3)}
    with style.styled():
        figure, (left, right) = style.grid(2, 3)
        right.set_ylabel("return in training")
        figure.draw_without_rendering()
    gap = right.get_tightbbox().x0 - left.get_window_extent().x1
    assert gap > 0.15 * figure.dpi  # inches


def test_somebody_at_a_terminal_sees_how_far_it_has_come(mixed, tmp_path, monkeypatch, capsys):
    commands = (["plot", f"out={tmp_path / 'a.png'}"], ["compare"])
    for command, *rest in commands:
        assert cli.main([command, *map(str, mixed), *rest]) == 0
        assert "reading" not in capsys.readouterr().err
    monkeypatch.setenv("FORCE_COLOR", "1")  # rich's sign for a terminal
    for soon, shown in ((working.SOON, False), (0, True)):
        monkeypatch.setattr(working, "SOON", soon)
        for command, *rest in commands:
            assert cli.main([command, *map(str, mixed), *rest]) == 0
            assert ("reading" in capsys.readouterr().err) == shown
    (run,) = runs.load_all(mixed[:1])
    assert run.episodes == {}
    assert "reading" in capsys.readouterr().err
    assert runs.load(mixed[0]).episodes == {}  # nobody waits, as beside a training's own display
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("command", ["plot", "compare"])
def test_a_run_that_is_being_written_says_how_far_it_has_come(command, tmp_path, capsys):
    path = looks.write(tmp_path / "a", looks.epochs([1, 2]))
    with (path / "metrics.jsonl").open("a") as file:
        file.write('{"env_steps": 120, "se')  # half of a line
    assert cli.main([command, str(path), *([f"out={tmp_path / 'a.png'}"] if command == "plot" else [])]) == 0
    assert capsys.readouterr().err == f"vecpsmbpo: warning: {path}: has come to step 80 of 120\n"


@pytest.mark.parametrize("suffix", ["", "csv", "md", "txt"])
def test_compare_writes_every_kind_of_table(mixed, suffix, tmp_path, capsys):
    out = [f"out={tmp_path / 'table'}.{suffix}"] if suffix else []
    assert cli.main(["compare", *map(str, mixed), "threshold=2", *out]) == 0
    text = (tmp_path / f"table.{suffix}").read_text() if suffix else capsys.readouterr().out
    for said in ("OPS-MBPO", "PS-MBPO", "final", "best", "area", "steps to", "P(better)", "seconds"):
        assert said in text
    assert "frozen" in text
    assert suffix == "csv" or "seconds: wall time of the program that a seed was in" in " ".join(text.split())


@pytest.fixture
def shelf(tmp_path):
    """Directories of every kind; the folder that commands run in."""
    looks.write(tmp_path / "run", looks.epochs([1, 2]))
    looks.write(tmp_path / "hopper", looks.epochs([1, 2]), env="hopper")
    looks.write(tmp_path / "null", looks.epochs([1, 2], eval_return=None))
    looks.write(tmp_path / "unknown", looks.epochs([1, 2]), env="brax", **{"env.id": "Hopper"})
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
    (["plot", "run", "smooth=0"], "smooth=0: must be a whole number from 1 to 1000000"),
    (
        ["plot", "run", "smooth=99999999999999999999999"],
        "smooth=99999999999999999999999: must be a whole number from 1",
    ),
    (["plot", "run", "group=alog"], "group=alog: no such setting; did you mean algo"),
    (["plot", "run", "reference=ppo"], "reference=ppo: must be of mbpo, sac"),
    (["plot", "run", "reference=mbpo"], "reference=mbpo: nothing is published for cartpole_swingup"),
    (["plot", "hopper", "reference=mbpo", "x=seconds"], "reference: is of y=eval_return over x=env_steps"),
    (["plot", "run", "out=a.bmp"], "out=a.bmp: must be a file that ends in .png, .svg, .pdf, .csv"),
    (["plot", "run", "out=file/a.png"], "out=file/a.png: cannot be written (Not a directory)"),
    (["compare", "run", "steps=90"], "steps=90: run has not come to it (seed 0)"),
    (["compare", "run", "target=high"], "target=high: must be a number"),
    (
        ["compare", "run", "floor=30"],
        "floor=30: what counts as 0 on cartpole_swingup (30) must be below what counts as 1",
    ),
    (
        ["compare", "run", "target=0"],
        "target=0: what counts as 0 on cartpole_swingup (0) must be below what counts as 1",
    ),
    (["compare", "run", "floor=2", "target=1"], "floor=2 target=1: what counts as 0 on cartpole_swingup (2) must be"),
    (
        ["compare", "unknown", "floor=2"],
        "floor=2: needs target=, too: what is to be reached on brax Hopper is not known",
    ),
    (["compare", "null"], "y=eval_return: is null in every line of the runs up to step 80"),
    (["plot", "null"], "y=eval_return: there is no step at which all seeds of a group have a value"),
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
