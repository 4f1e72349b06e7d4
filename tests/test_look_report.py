"""The page of a run, and its picture of the posterior."""

import itertools
import json
import re
import shlex
from html.parser import HTMLParser

import numpy as np
import pytest

from tests import looks
from vecpsmbpo import cli, config
from vecpsmbpo.look import compare, curves, diagrams, groups, one_run, posterior, report, runs, style

# ── the page ────────────────────────────────────────────────────────────────────────────────────────────────────────


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
    rows = compare.table(runs.load_all([path]), looks.options(window=1))
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
    words = shlex.split(one_run.command(settings))[2:]
    assert config.compose([*words, f"run_dir={settings.run_dir}"]) == settings


# ── what a run's files lack, or have wrong ──────────────────────────────────────────────────────────────────────────

NO_RETURN = "metrics.jsonl has no evaluation return that is a number; none is shown"
MISSING = [
    ("epochs", "eval_return", ..., NO_RETURN),
    ("epochs", "eval_return", "high", NO_RETURN),
    ("epochs", "eval_return", [1.0, 2.0], NO_RETURN),
    ("epochs", "eval_return", None, NO_RETURN),
    ("epochs", "eval_return", 1e300, NO_RETURN),  # no return of float32
    ("epochs", "train_return", [1.0, 2.0], ""),
    ("epochs", "real_ratio_probs", [0.5, 0.5], ""),  # of another number of λ than there are
    *(
        ("episodes", name, ..., f"episodes.jsonl has no usable {name}; who acted is not shown")
        for name in ("model", "policy", "random", "return", "episode", "probs")
    ),
    ("episodes", "probs", 0.5, "episodes.jsonl has no usable probs; who acted is not shown"),
    ("episodes", "episode", None, "episodes.jsonl has no usable episode; who acted is not shown"),
]


@pytest.mark.parametrize(("log", "name", "value", "line"), MISSING)
def test_what_a_log_lacks_is_left_out_and_said(log, name, value, line, tmp_path, capsys):
    lines = {"epochs": looks.epochs([1, 2, 3]), "episodes": looks.episodes(5)}
    for one in lines[log]:
        one.pop(name, None)
        if value is not ...:
            one[name] = value
    path = looks.write(tmp_path / "a", lines["epochs"], lines["episodes"])
    whole = looks.write(tmp_path / "b", looks.epochs([1, 2, 3]), looks.episodes(5))
    _report(path, f"out={tmp_path / 'a.html'}")
    assert capsys.readouterr().err == (f"vecpsmbpo: warning: {path}: {line}\n" if line else "")
    said = " ".join(_read(tmp_path / "a.html").texts)
    assert line in said
    assert ("put to the test" in said) is False
    _report(path, whole, f"out={tmp_path / 'a.html'}")  # nor does it keep the other from being shown
    assert "2 runs of cartpole_swingup" in " ".join(_read(tmp_path / "a.html").texts)


def test_a_seed_without_evaluations_is_named(tmp_path, capsys):
    silent = [line | {"eval_return": None} for line in looks.epochs([1, 2, 3], seed=1)]
    path = looks.write(tmp_path / "a", looks.epochs([4, 5, 9]) + silent, looks.episodes(5), num_seeds=2)
    _report(path, f"out={tmp_path / 'a.html'}")
    assert capsys.readouterr().err.endswith("metrics.jsonl has no evaluation return of seed 1\n")
    said = " ".join(_read(tmp_path / "a.html").texts)
    assert "6.00 evaluation return: mean of the last 5 evaluations" in said


def _without(*names):
    """Of a dictionary in dictionaries, the last of `names` is gone."""

    def damage(found):
        for name in names[:-1]:
            found = found[name]
        del found[names[-1]]

    return damage


WRONG = {
    "models": lambda found: found.update(models=5),
    "discount": _without("critics", "discount"),
    "bias": _without("critics", "bias"),
    "expected": _without("models", "expected"),
    "ragged": lambda found: found["models"]["error"][0].pop(),
    "distance": lambda found: found["states"].update(distance=None),
    "lane": lambda found: found.update(lane="seed 0"),
    "step": lambda found: found.update(env_steps="all"),
    "history": lambda found: found.update(history=[1, 2, 3]),
    "words": lambda found: found["critics"]["shown"].update(q=["a", "b"]),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_a_diagnosis_with_wrong_parts_is_one_line(wrong, tmp_path, capsys):
    path, found = looks.write(tmp_path / "a", looks.epochs([1, 2, 3])), looks.diagnosis(3)
    WRONG[wrong](found)
    (path / "diagnostics.json").write_text(json.dumps(found))
    assert cli.main(["report", str(path), f"out={tmp_path / 'a.html'}"]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith(f"vecpsmbpo: {path}/diagnostics.json: cannot be read (")
    assert printed.err.endswith(f"; vecpsmbpo diagnose {path} writes it again\n")
    assert printed.err.count("\n") == 1
    assert not (tmp_path / "a.html").exists()


@pytest.mark.parametrize("checkpoints", [1, 2, 3])
def test_a_trend_takes_three_checkpoints(checkpoints, tmp_path):
    path = looks.write(tmp_path / "a", looks.epochs([1, 2, 3]))
    (path / "diagnostics.json").write_text(json.dumps(looks.diagnosis(checkpoints)))
    _report(path, f"out={tmp_path / 'a.html'}")
    said = " ".join(_read(tmp_path / "a.html").texts)
    assert ("at every checkpoint that is kept" in said) == (checkpoints == 3)
    assert ("takes 3 checkpoints" in said) == (checkpoints < 3)


def test_expected_errors_stand_beside_those_of_every_dimension():
    """In the same colours: a half of the error is another colour, and the same value the same one."""
    panels = {panel.title: panel for panel in diagrams.panels(looks.diagnosis())}
    colours = []
    for title in ("error by dimension", "error by dimension, as expected"):
        _, (axes,) = style.grid(1, 1)
        panels[title].draw(axes)
        (mesh,) = axes.collections
        np.testing.assert_allclose(mesh.get_array(), 0.2 if title == "error by dimension" else 0.1)
        colours.append((mesh.norm.vmin, mesh.norm.vmax))
    assert colours[0] == colours[1]


@pytest.mark.parametrize(("name", "content"), [("empty.gif", b""), ("a.mp4", b"GIF89a"), ("b.gif", b"<html>")])
def test_a_film_that_is_none_is_refused_and_one_in_the_run_left_out(name, content, tmp_path, capsys):
    path = looks.write(tmp_path / "a", looks.epochs([1, 2, 3]))
    (tmp_path / name).write_bytes(content)
    assert cli.main(["report", str(path), f"videos={tmp_path / name}", f"out={tmp_path / 'a.html'}"]) == 2
    assert capsys.readouterr().err == f"vecpsmbpo: videos={tmp_path / name}: holds no film\n"
    (tmp_path / name).rename(path / name)
    _report(path, f"out={tmp_path / 'a.html'}")
    assert capsys.readouterr().err == f"vecpsmbpo: warning: {path}: {name} holds no film, and is not shown\n"
    assert "Videos" not in (tmp_path / "a.html").read_text()


# ── what a page says of a run ───────────────────────────────────────────────────────────────────────────────────────


def test_a_report_says_what_a_run_was_run_on(tmp_path):
    path = looks.write(tmp_path / "a", looks.epochs([1, 2, 3]))
    first = {"env_steps": 0, "vecpsmbpo": "0.1.0", "jax": "0.10.2", "mujoco": "3.16.0", "python": "3.11.7"}
    second = {"env_steps": 80, "devices": ["NVIDIA H200"], "machine": "Xeon, 16 cores"}
    lines = [first | {"devices": ["cpu", "cpu"]}, {"env_steps": 40, "devices": "cpu"}, second]
    text = "".join(json.dumps(line) + "\n" for line in lines)
    (path / "sessions.jsonl").write_text(text + "no line\n")
    _report(path, f"out={tmp_path / 'a.html'}")
    said = " ".join(_read(tmp_path / "a.html").texts)
    assert "on 2 × cpu · on 1 × NVIDIA H200, Xeon, 16 cores" in said
    assert "0 2 × cpu 0.1.0 0.10.2 3.16.0 3.11.7 40 – – – – – 80 1 × NVIDIA H200, Xeon, 16 cores" in said


def test_a_report_says_where_training_episodes_are_shorter(tmp_path):
    expected = "training episodes have 10 steps, evaluation episodes 25"
    for name, given, count in (("a", {"train_episode_length": 10}, 3), ("b", {}, 0)):
        path = looks.write(tmp_path / name, looks.epochs([1, 2, 3]), looks.episodes(5), **given)
        _report(path, f"out={tmp_path / 'a.html'}")
        assert " ".join(_read(tmp_path / "a.html").texts).count(expected) == count  # the head, the curve, the posterior


def test_curves_and_tiles_of_a_report_are_the_same_average(tmp_path):
    """Interquartile means: of 0, 4, 8 and 1,000 the middle two count."""
    lines = [line for seed, value in enumerate((0, 4, 8, 1000)) for line in looks.epochs([value] * 6, seed=seed)]
    path = looks.write(tmp_path / "a", lines, num_seeds=4, total_steps=240)
    _report(path, f"out={tmp_path / 'a.html'}")
    said = " ".join(_read(tmp_path / "a.html").texts)
    assert re.search(r"6\.00 \[.*\] evaluation return: interquartile mean over seeds of the last 5 evaluations", said)
    assert "1,000 best evaluation of any seed" in said
    assert "Thick lines: interquartile mean over seeds" in said
    (together,) = groups.group(runs.load_all([path]))
    np.testing.assert_array_equal(curves.curve(together, "env_steps", "eval_return", average=one_run.AVERAGE).y, 6)


def test_a_terminal_sees_what_a_report_is_at(mixed, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm")
    _report(mixed[0], f"out={tmp_path / 'a.html'}")
    shown = capsys.readouterr().err
    for what in (f"drawing {mixed[0]}"[:40], f"writing {tmp_path}"[:40]):
        assert what in shown
    monkeypatch.delenv("FORCE_COLOR")
    _report(mixed[0], f"out={tmp_path / 'a.html'}")
    assert "drawing" not in capsys.readouterr().err


# ── the posterior as a picture ──────────────────────────────────────────────────────────────────────────────────────


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
