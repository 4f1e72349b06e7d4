"""What is made of a checkpoint: videos and diagnostics. (Exported policies: test_export.py.)"""

import json
import shutil
import types
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
import pytest
from PIL import Image

import vecpsmbpo
from tests import looks
from tests.drawing import draws
from tests.helpers import command
from vecpsmbpo import cli, config, training
from vecpsmbpo.look import diagnose, members, render, runs, states


def test_a_run_with_report_true_has_its_page(trained):
    text = (trained / "report.html").read_text()
    assert "step 80 of 80" in text
    assert "Who acted" in text
    assert "http-equiv" not in text  # it is complete: nobody needs to look again


@draws
def test_a_run_with_report_true_films_an_episode_at_its_end(trained):
    film = next(trained.glob("episode.*"))
    assert film.suffix == (".mp4" if render._makes_mp4() else ".gif")
    assert film.stat().st_size > 1000
    assert "<figcaption>episode</figcaption>" in (trained / "report.html").read_text()


# ── policies ──────────────────────────────────────────────────────────────────────────────────────────────────────


def test_members_act_as_the_policy_that_is_loaded(trained):
    run = runs.load(trained)
    lane = members.load(run)
    ((_, best),) = members.acting(lane, "best")
    named = dict(members.acting(lane, "all"))
    assert list(named) == ["0,0", "0,1", "1,0", "1,1"]
    obs = np.random.default_rng(0).normal(size=(7, 5)).astype(np.float32)
    expected = vecpsmbpo.load(trained).policy(obs)
    np.testing.assert_allclose(best(obs), expected, atol=1e-6)
    np.testing.assert_allclose(named[members.member_names(run)[lane.best()]](obs), expected, atol=1e-6)
    actions = [np.asarray(act(obs)) for act in named.values()]
    assert all(not np.allclose(one, other) for index, one in enumerate(actions) for other in actions[:index])


# ── diagnostics ───────────────────────────────────────────────────────────────────────────────────────────────────


def test_a_run_is_diagnosed_and_its_report_says_so(trained, tmp_path, monkeypatch):
    monkeypatch.setattr(states, "has_umap", lambda: False)  # its compilation takes half a minute
    run = tmp_path / "run"
    shutil.copytree(trained, run)
    assert cli.main(["diagnose", str(run), "horizon=4", "lane=1"]) == 0
    found = json.loads((run / "diagnostics.json").read_text())
    assert (found["env_steps"], found["lane"]) == (80, {"seed": 1})
    assert [point["env_steps"] for point in found["history"]] == [0, 40, 80]  # keep_checkpoints=3
    assert [point["errors"] is None for point in found["history"]] == [True, True, False]  # fitted after the warm-up
    models = found["models"]
    assert np.shape(models["error"]) == np.shape(models["expected"]) == (2, 4, 6)
    assert np.shape(models["coverage"]) == (2, 3, 6)
    assert np.shape(models["reliability"]["made"]) == (2, 14)
    assert found["critics"]["members"] == ["0,0", "0,1", "1,0", "1,1"]
    assert found["critics"]["states"] == 4 * 25  # what lies beyond the time limit is seen, too
    difference = found["critics"]["q"] - found["critics"]["earned"]
    assert found["critics"]["bias"] == pytest.approx(difference, abs=1e-3)
    assert found["states"]["method"] == "principal components"
    assert cli.main(["report", str(run), f"out={tmp_path / 'r.html'}"]) == 0
    page = (tmp_path / "r.html").read_text()
    assert "put to the test" in page
    assert "error of the reward" in page


def test_plans_are_diagnosed_as_far_as_they_can_be(tmp_path):
    """PETS has models, and neither critics nor imagined data."""
    words = ["env=cartpole_swingup", "backend=host", "size=tiny", "total_steps=80", "algo=pets"]
    assert training.train(config.compose([*words, f"run_dir={tmp_path / 'run'}"])) == 0
    out = tmp_path / "a.png"
    assert cli.main(["diagnose", str(tmp_path / "run"), "horizon=4", f"out={out}"]) == 0
    assert Image.open(out).size[0] > 800
    found = diagnose.measure(runs.load(tmp_path / "run"), horizon=4)
    assert np.shape(found["models"]["error"]) == (2, 4, 6)
    assert (found["critics"], found["states"]) == (None, None)


def test_members_and_checkpoints_share_a_compiled_policy(trained):
    run, obs = runs.load(trained), np.zeros((1, 5), np.float32)
    before = [program._cache_size() for program in (members._mean_action, members._evaluation_action)]
    actions = []
    for one in members.load_each(run):
        for who in ("all", "best"):
            actions += [np.asarray(act(obs)) for _, act in members.acting(one, who)]
    after = [program._cache_size() for program in (members._mean_action, members._evaluation_action)]
    assert len({action.tobytes() for action in actions}) > 4  # each acts for itself
    assert np.subtract(after, before).max() <= 1


# ── videos ────────────────────────────────────────────────────────────────────────────────────────────────────────


@draws
def test_render_draws_every_member_and_the_robot_moves(trained, tmp_path):
    out = tmp_path / "walk.gif"
    result = command("render", str(trained), "member=all", "width=80", f"out={out}", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    film = Image.open(out)
    assert film.size == (160, 120)  # two rows of two, 80 by 60 each
    assert film.n_frames == 1 + 25 // 3 + 1  # 25 steps of 0.01 s, about thirty pictures a second, and the end
    frames = [np.asarray(_seek(film, index).convert("RGB"), float) for index in (0, film.n_frames - 1)]
    assert frames[0].std() > 10
    for tile in (frames[1] - frames[0]).reshape(2, 60, 2, 80, 3).swapaxes(1, 2).reshape(4, -1):
        assert np.abs(tile).max() > 10  # an untrained policy may hardly move it; without moving it is 0


def _seek(film, index):
    film.seek(index)
    return film


@draws
def test_render_draws_a_member_at_steps_of_training(trained, tmp_path):
    words = ["steps=[0,80]", "member=1,0", "length=12", "width=80", f"out={tmp_path / 'a.png'}"]
    result = command("render", str(trained), *words, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    picture = np.asarray(Image.open(tmp_path / "a.png").convert("RGB"), float)
    assert picture.shape == (2 * 60, 4 * 80, 3)  # a row for each step, four frames in it
    first, last = np.split(picture, 2)
    assert np.abs(first[20:] - last[20:]).max() > 50  # another policy moves it elsewhere


def test_a_policy_s_name_says_who_acts(trained):
    """The posterior draws by equation 19 with the state's own key, as an evaluation with it does."""
    lane = members.load(runs.load(trained), 1)
    names = members.member_names(lane.run)
    seed = lane.of_lane(lane.state)
    logits = np.asarray(seed.posterior.returns, float) / lane.run.settings.temperature
    drawn = names[int(jax.random.categorical(seed.key, logits - logits.max()))]
    obs = np.random.default_rng(0).normal(size=(7, 5)).astype(np.float32)
    for who, member in (("posterior", drawn), ("best", names[lane.best()])):
        ((name, act),), ((_, own),) = members.acting(lane, who), members.acting(lane, member)
        assert name == f"{who} {member}"
        np.testing.assert_array_equal(act(obs), own(obs))


@draws
def test_render_makes_a_video(trained, tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    result = command("render", str(trained), "width=80", "member=1,0", "out=walk.mp4", cwd=tmp_path)
    assert (result.returncode, result.stderr) == (0, "")
    import imageio

    with imageio.get_reader(tmp_path / "walk.mp4") as film:
        assert film.count_frames() == 1 + 25 // 3 + 1
        assert film.get_data(0).shape == (60, 80, 3)


DAMAGED: dict[str, Callable[[Path], object]] = {
    "cut": lambda path: (path / "policy.json").write_text('{"algo"'),
    "old": lambda path: (path / "policy.json").write_text('{"algo": "ops_mbpo"}'),
    "list": lambda path: (path / "policy.json").write_text("[]"),
    "deep": lambda path: (path / "policy.json").write_text("[" * 100_000),
    "short": lambda path: (path / "policy.npz").write_bytes((path / "policy.npz").read_bytes()[:-9]),
    "empty": lambda path: (path / "policy.npz").write_bytes(b""),
    "words": lambda path: np.savez(path / "policy.npz", kernel_0=np.full((5, 1), "x"), bias_0=np.zeros(1)),
    "rule": lambda path: (path / "policy.json").write_text(
        (path / "policy.json").read_text().replace('"relu"', '"gelu"')
    ),
    "other": lambda path: np.savez(path / "policy.npz", kernel_0=np.zeros((7, 1)), bias_0=np.zeros(1)),
    "broken": lambda path: np.savez(
        path / "policy.npz", kernel_0=np.zeros((5, 3)), bias_0=np.zeros(3), kernel_1=np.zeros((4, 1)), bias_1=np.ones(1)
    ),
}

MISTAKES = [
    (["render"], "run_dir: render needs the directory of a run"),
    (["render", "run", "run2"], "run_dir: render takes 1 run, not 2"),
    (["render", "run", "out=walk.avi"], "out=walk.avi: must be a file that ends in .mp4, .gif, .png"),
    (["render", "run", "out=a.gif", "lane=2"], "lane=2: must be below 2"),
    (["render", "run", "out=a.gif", "width=20000"], "width=20000: must be a whole number from 64 to 8192"),
    (["render", "run", "out=a.gif", "seed=5000000000"], "seed=5000000000: must be a whole number from 0 to 2147483647"),
    (["diagnose", "run", "seed=2147483648"], "seed=2147483648: must be a whole number from 0 to 2147483647"),
    (["render", "run", "out=a.gif", "member=2,0"], "member=2,0: must be best, posterior, all or one of 0,0  0,1"),
    (["export", "run", "member=2,0"], "member=2,0: must be best or one of 0,0  0,1  1,0  1,1"),
    (["export", "run", "out=file"], "out=file: must be a directory"),
    (["export", "pets"], "run_dir=pets: algo=pets plans its actions; there is no policy to export"),
    (["export", "together"], "member=best: with posterior=average all members act together, which is no single policy"),
    (["export", "broken_run"], "broken_run/checkpoints: holds checkpoints, but none that can be read ("),
    (["export", "bare"], "run_dir=bare: holds no checkpoint yet"),
    (["diagnose", "run", "run2"], "run_dir: diagnose takes 1 run, not 2"),
    (["diagnose", "run", "out=a.gif"], "out=a.gif: must be a file that ends in .json, .png, .svg, .pdf"),
    (["diagnose", "run", "out=a.json", "lane=2"], "lane=2: must be below 2"),
    (["diagnose", "run", "out=file/a.json"], "out=file/a.json: cannot be written (Not a directory)"),
    (["diagnose", "bare"], "run_dir=bare: holds no checkpoint yet"),
    (["report", "bare", "diagnostics=true", "out=a.html"], "run_dir=bare: holds no checkpoint yet"),
    (["report", "bare", "diagnostics=yes"], "diagnostics=yes: must be one of false, true"),
    (["render", "bare", "out=a.gif", "steps=7"], "steps=7: there is none"),
    (
        ["report", "half", "out=a.html"],
        "half/diagnostics.json: cannot be read (JSONDecodeError: Expecting value: line 1 column 14 (char 13)",
    ),
    (["render", "run", "out=a.gif", "steps=41"], "steps=41: must be of 0, 40, 80, which checkpoints are kept of"),
    (["render", "run", "out=a.gif", "steps=[0,x]"], "steps=[0,x]: must be whole numbers, separated by commas"),
    (["render", "run", "out=a.gif", "steps=0,40", "member=all"], "member=all: with steps= there is room for one"),
    (["render", "policy", "out=a.gif", "member=0,0"], "member: policy is one policy, without a run"),
    (["eval", "run_dir=policy", "actions=sampled"], "actions=sampled: policy is one policy and its mean actions"),
    (["eval", "run_dir=policy", "episodes=0"], "episodes=0: must be"),
    *((["eval", f"run_dir={name}"], f"{name}: holds no policy that can be read") for name in DAMAGED),
    (["render", "short", "out=a.gif"], "short: holds no policy that can be read (BadZipFile: "),
    (["export", "run", "also=rlds"], "also=rlds: must be of jax, onnx, minari, separated by commas"),
]


@pytest.fixture(scope="module")
def damaged_run(trained):
    """None of its checkpoints can be read."""
    path = trained.parent / "damaged_run"
    shutil.copytree(trained, path)
    for host in (path / "checkpoints").glob("*/host/metadata"):
        host.write_text("{")
    return path


@pytest.fixture
def shelf(trained, policy, damaged_run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, damage in {"policy": lambda path: None, **DAMAGED}.items():
        shutil.copytree(policy, tmp_path / name)
        damage(tmp_path / name)
    for name in ("run", "run2"):
        (tmp_path / name).symlink_to(trained)
    (tmp_path / "file").write_text("")
    looks.write(tmp_path / "pets", looks.epochs([1]), algo="pets")
    looks.write(tmp_path / "together", looks.epochs([1]), posterior="average")
    (tmp_path / "broken_run").symlink_to(damaged_run)
    looks.write(tmp_path / "bare", looks.epochs([1]), backend="host")
    looks.write(tmp_path / "half", looks.epochs([1]))
    (tmp_path / "half" / "diagnostics.json").write_text('{"history": [')
    return tmp_path


@pytest.mark.parametrize(("arguments", "line"), MISTAKES, ids=[" ".join(words) for words, _ in MISTAKES])
def test_a_mistake_is_one_line_and_leaves_nothing(arguments, line, shelf, monkeypatch, capsys):
    monkeypatch.setattr(render, "platform", lambda: "egl")
    before = sorted(path.name for path in shelf.iterdir())
    assert cli.main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith(f"vecpsmbpo: {line}")
    assert captured.err.count("\n") == 1
    assert sorted(path.name for path in shelf.iterdir()) == before


def test_nothing_to_draw_with_names_the_packages(shelf, monkeypatch, capsys):
    monkeypatch.setattr(render.subprocess, "run", lambda *a, **kw: types.SimpleNamespace(returncode=1))
    assert cli.main(["render", "run", "out=a.gif"]) == 2
    assert capsys.readouterr().err == (
        "vecpsmbpo: render: there is neither EGL nor OSMesa to draw with; apt-get install libegl1 or libosmesa6\n"
    )


def test_a_video_without_its_extra_names_it(shelf, monkeypatch, capsys):
    monkeypatch.setattr(render.importlib.util, "find_spec", lambda name: None)
    assert cli.main(["render", "run", "out=a.mp4"]) == 2
    assert capsys.readouterr().err == (
        "vecpsmbpo: out=a.mp4: .mp4 needs imageio-ffmpeg; pip install 'vecpsmbpo[video]', or take .gif\n"
    )


@pytest.mark.parametrize("installed", [True, False])
def test_a_film_that_is_not_told_where_goes_where_it_can_be_made(installed, shelf, monkeypatch, capsys):
    monkeypatch.setattr(render, "_makes_mp4", lambda: installed)
    monkeypatch.setattr(render, "platform", lambda: "egl")
    monkeypatch.setenv("MUJOCO_GL", "egl")
    monkeypatch.setattr(render, "film", lambda *args: ([np.zeros((4, 4, 3), np.uint8)] * 2, 0.1))
    monkeypatch.setattr(render, "_write", lambda frames, frame_s, path: path.write_bytes(b"film"))
    assert cli.main(["render", "run"]) == 0
    said = capsys.readouterr().out.splitlines()
    name = "walk.mp4" if installed else "walk.gif"
    assert said[-1] == f"written: {name}"
    assert said[:-1] == (
        [] if installed else ["a .gif, since .mp4 needs imageio-ffmpeg: pip install 'vecpsmbpo[video]'"]
    )
    assert (shelf / name).read_bytes() == b"film"


def test_a_terminal_sees_what_is_diagnosed(trained, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(states, "has_umap", lambda: False)
    assert cli.main(["diagnose", str(trained), "horizon=4", f"out={tmp_path / 'a.json'}"]) == 0
    shown = capsys.readouterr().err
    for what in ("reading checkpoints", *(f"step 80: {part}" for part in ("fresh", "models", "critics", "imagined"))):
        assert what in shown


def test_a_run_is_not_touched_by_being_looked_at(trained, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(trained, copy)
    before = {path: path.stat().st_mtime_ns for path in copy.rglob("*")}
    assert cli.main(["export", str(copy), f"out={tmp_path / 'policy'}"]) == 0
    assert {path: path.stat().st_mtime_ns for path in Path(copy).rglob("*")} == before
