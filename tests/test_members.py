"""What is made of a checkpoint: videos, exported policies, diagnostics. One tiny run serves all tests."""

import json
import shutil
import subprocess
import sys
import types
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import vecpsmbpo
from tests import looks
from tests.helpers import command
from vecpsmbpo import cli
from vecpsmbpo.look import members, render, runs

# What rendering needs of the machine; without it (a bare container) the tests of pictures have nothing to test.
try:
    render.platform()
    can_draw = True
except Exception:
    can_draw = False
draws = pytest.mark.skipif(not can_draw, reason="neither EGL nor OSMesa is installed")


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """N = M = 2 on the original cartpole; its first seed."""
    folder = tmp_path_factory.mktemp("trained")
    words = ["env=cartpole_swingup", "backend=host", "size=tiny", "total_steps=80", "report=true", "num_seeds=2"]
    result = command("train", *words, "run_dir=run", cwd=folder)
    assert result.returncode == 0, result.stderr
    return folder / "run"


def test_a_run_with_report_true_has_its_page(trained):
    text = (trained / "report.html").read_text()
    assert "step 80 of 80" in text
    assert "Who acted" in text
    assert "http-equiv" not in text  # it is complete: nobody needs to look again


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


def test_an_exported_policy_acts_the_same_without_this_package(trained, tmp_path, capsys):
    out = tmp_path / "policy"
    assert cli.main(["export", str(trained), f"out={out}"]) == 0
    obs = np.random.default_rng(0).normal(size=(7, 5)).astype(np.float32)
    expected = np.asarray(vecpsmbpo.load(trained).policy(obs))
    np.save(tmp_path / "obs.npy", obs)
    code = (
        "import sys, numpy as np; sys.path.insert(0, sys.argv[1]); from act import act; "
        "np.save('actions.npy', act(np.load('obs.npy'))); assert not {'jax', 'vecpsmbpo'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code, str(out)], cwd=tmp_path, check=True)
    np.testing.assert_allclose(np.load(tmp_path / "actions.npy"), expected, atol=1e-5)
    about = json.loads((out / "policy.json").read_text())
    assert (about["task"], about["env_steps"], about["obs_size"], about["action_size"]) == (
        "cartpole_swingup",
        80,
        5,
        1,
    )
    before = (out / "policy.npz").read_bytes()
    assert cli.main(["export", str(trained), f"out={out}", f"member={about['member']}"]) == 0
    assert (out / "policy.npz").read_bytes() == before


# ── videos ────────────────────────────────────────────────────────────────────────────────────────────────────────


@draws
def test_render_draws_every_member_and_the_robot_moves(trained, tmp_path):
    out = tmp_path / "walk.gif"
    result = command("render", str(trained), "member=all", "width=80", f"out={out}", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    film = Image.open(out)
    assert film.size == (160, 120)  # two rows of two, 80 by 60 each
    assert film.n_frames == 1 + 25 // 3  # 25 steps of 0.01 s, about thirty pictures a second
    frames = [np.asarray(_seek(film, index).convert("RGB"), float) for index in (0, film.n_frames - 1)]
    assert frames[0].std() > 10
    for tile in (frames[1] - frames[0]).reshape(2, 60, 2, 80, 3).swapaxes(1, 2).reshape(4, -1):
        assert np.abs(tile).max() > 50


def _seek(film, index):
    film.seek(index)
    return film


@draws
def test_render_makes_a_video(trained, tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    result = command("render", str(trained), "width=80", "member=1,0", "out=walk.mp4", cwd=tmp_path)
    assert (result.returncode, result.stderr) == (0, "")
    import imageio

    with imageio.get_reader(tmp_path / "walk.mp4") as film:
        assert film.count_frames() == 1 + 25 // 3
        assert film.get_data(0).shape == (60, 80, 3)


def test_a_strip_goes_from_the_first_frame_to_the_last():
    frames = [np.full((6, 8, 3), shade, np.uint8) for shade in range(10)]
    np.testing.assert_array_equal(render.strip(frames)[0, ::8, 0], [0, 3, 6, 9])


def test_a_mosaic_has_its_tiles_in_rows():
    shades = [20, 60, 100]
    tiles = [render.Tile("", np.full((30, 40, 3), shade, np.uint8), 0.0, shade == 100) for shade in shades]
    sheet = render.mosaic(tiles, columns=2)
    assert sheet.shape == (60, 80, 3)
    assert (sheet[25, 30, 0], sheet[25, 70, 0], sheet[55, 30, 0]) == (20, 60, 45)  # the last one is over
    assert (sheet[40:, 50:] == 0).all()


def test_an_environment_that_can_draw_itself_does():
    picture = np.arange(2 * 3 * 3, dtype=np.uint8).reshape(2, 3, 3)
    env = types.SimpleNamespace(render_mode="rgb_array", render=lambda: picture, unwrapped=types.SimpleNamespace())
    np.testing.assert_array_equal(render.camera(types.SimpleNamespace(env=env), 64)(), picture)


MISTAKES = [
    (["render"], "run_dir: render needs the directory of a run"),
    (["render", "run", "run2"], "run_dir: render takes 1 run, not 2"),
    (["render", "run", "out=walk.avi"], "out=walk.avi: must be a file that ends in .mp4, .gif, .png"),
    (["render", "run", "out=a.gif", "lane=2"], "lane=2: must be below 2"),
    (["render", "run", "out=a.gif", "member=2,0"], "member=2,0: must be best, posterior, all or one of 0,0  0,1"),
    (["export", "run", "member=2,0"], "member=2,0: must be best or one of 0,0  0,1  1,0  1,1"),
    (["export", "run", "out=file"], "out=file: must be a directory"),
    (["export", "pets"], "run_dir=pets: only policies that learn by SAC can be exported, not algo=pets"),
    (["export", "bare"], "run_dir=bare: holds no checkpoint yet"),
    (["render", "brax"], "render: env=brax has no simulator on the host that could draw it"),
]


@pytest.fixture
def shelf(trained, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("run", "run2"):
        (tmp_path / name).symlink_to(trained)
    (tmp_path / "file").write_text("")
    looks.write(tmp_path / "pets", looks.epochs([1]), algo="pets")
    looks.write(tmp_path / "bare", looks.epochs([1]), backend="host")
    looks.write(tmp_path / "brax", looks.epochs([1]), **{"env": "brax", "env.id": "reacher"})
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


def test_a_run_is_not_touched_by_being_looked_at(trained, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(trained, copy)
    before = {path: path.stat().st_mtime_ns for path in copy.rglob("*")}
    assert cli.main(["export", str(copy), f"out={tmp_path / 'policy'}"]) == 0
    assert {path: path.stat().st_mtime_ns for path in Path(copy).rglob("*")} == before
