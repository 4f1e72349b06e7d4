"""The page of a run, and its picture of the posterior."""

import itertools
import re
import shlex
from html.parser import HTMLParser

import numpy as np
import pytest

from tests import looks
from vecpsmbpo import cli, config
from vecpsmbpo.look import compare, posterior, report, runs

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
    words = shlex.split(report.command(settings))[2:]
    assert config.compose([*words, f"run_dir={settings.run_dir}"]) == settings


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
