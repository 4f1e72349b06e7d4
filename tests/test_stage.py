"""How a picture is made: scenes of JAX environments, strips, mosaics and colours."""

import json
import subprocess
import sys
import types
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from PIL import Image

from tests import probes
from tests.drawing import draws
from tests.helpers import environment
from vecpsmbpo import cli, config
from vecpsmbpo.look import export, render, stage

DRAWN = """
import collections, types
import numpy as np
from vecpsmbpo import envs
from vecpsmbpo.look import stage

def state(*names, value):
    for name in reversed(("pipeline_state", *names)):
        value = collections.namedtuple("State", [name])(value)
    return value

port = envs.make("cartpole_swingup", "mjx")
# Playground is an extra; of its environments only these names are used.
playground = types.SimpleNamespace(inner=types.SimpleNamespace(mj_model=port.model, dt=0.01), _action_repeat=2)
cart, arm = np.array([[[0.0, 0.0]], [[0.5, 2.0]]]), np.array([[[0.0, 0.0, 0.1, 0.1]], [[1.0, 1.0, 0.1, 0.1]]])
for env, names, positions, dt in (
    (port, ["qpos"], cart, 0.01),
    (playground, ["data", "qpos"], cart, 0.02),
    (envs.make("brax", "mjx", id="reacher"), ["pipeline_state", "q"], arm, 0.02),
):
    scene = stage.scene(env)
    renderer = stage._renderer(scene.model, 80)
    first, second = (stage._draw(scene, *renderer, state(*names, value=x)).astype(float) for x in positions)
    assert first.std() > 5 and np.abs(first - second).max() > 50
    assert abs(scene.dt - dt) < 1e-6, scene.dt
"""


@draws
def test_jax_environments_are_drawn(tmp_path):
    """What moves in the simulator moves in the picture. MuJoCo chooses what it draws with when it is imported."""
    drawn = {**environment(), "MUJOCO_GL": render.platform()}
    result = subprocess.run([sys.executable, "-c", DRAWN], env=drawn, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr


def test_a_strip_goes_from_the_first_frame_to_the_last():
    frames = [np.full((6, 8, 3), shade, np.uint8) for shade in range(10)]
    np.testing.assert_array_equal(render.strip(frames)[0, ::8, 0], [0, 3, 6, 9])


def test_what_is_small_keeps_its_colour_in_a_gif(tmp_path):
    frame = np.random.default_rng(0).integers(0, 90, (60, 80, 3)).astype(np.uint8)
    frame[..., 2] += 90  # a restless blue
    frame[30:34, 40:44] = 230, 165, 95
    render._write([frame, frame], 0.04, tmp_path / "a.gif")
    shown = np.asarray(Image.open(tmp_path / "a.gif").convert("RGB"), int)
    assert np.abs(shown[30:34, 40:44] - (230, 165, 95)).max() < 20


def test_a_mosaic_has_its_tiles_in_rows():
    shades = [20, 60, 100]
    tiles = [render.Tile("", np.full((50, 40, 3), shade, np.uint8), 0, 0.0, shade == 100) for shade in shades]
    sheet = render.mosaic(tiles, columns=2)
    assert sheet.shape == (100, 80, 3)
    assert (sheet[45, 30, 0], sheet[45, 70, 0], sheet[95, 30, 0]) == (20, 60, 45)  # the last one is over
    assert (sheet[60:, 50:] == 0).all()


# ── environments that draw themselves ─────────────────────────────────────────────────────────────────────────────


def _policy_of(folder, *words, sizes=(1, 1)):
    """An exported policy whose action is 1, for a task that nobody has trained."""
    settings = config.compose(["size=tiny", "backend=host", *words])
    about = {"settings": export.settings_of(settings, 0)}
    np.savez(folder / "policy.npz", kernel_0=np.zeros(sizes, np.float32), bias_0=np.full(sizes[1], 9, np.float32))
    (folder / "policy.json").write_text(json.dumps(about))
    return folder


def _render(monkeypatch, *words):
    """The command, in this process: what is drawn here needs no MuJoCo, which chooses only once what it draws with."""
    monkeypatch.setattr(render, "platform", lambda: "disabled")
    monkeypatch.setenv("MUJOCO_GL", "disabled")
    return cli.main(["render", *map(str, words)])


TASKS = {
    "gymnasium": ("env=gymnasium", "env.id='tests.probes:Lamp-v0'"),
    "custom": ("env=custom", "env.make=tests.probes:drawn_lamp"),
}


@pytest.mark.parametrize("kind", TASKS)
def test_a_task_that_draws_itself_is_filmed(kind, tmp_path, monkeypatch):
    folder = _policy_of(tmp_path, *TASKS[kind])
    assert _render(monkeypatch, folder, "length=5", "width=160", f"out={tmp_path / 'a.gif'}") == 0
    film = Image.open(tmp_path / "a.gif")
    assert (film.size, film.n_frames) == ((160, 120), 6)
    lights = []
    for index in range(film.n_frames):
        film.seek(index)
        lights.append(np.asarray(film.convert("L"), float)[60:].mean())
    np.testing.assert_allclose(lights, 255 * np.arange(6) / 10, atol=8)


def test_a_suite_s_task_without_mujoco_is_filmed(tmp_path, monkeypatch):
    pytest.importorskip("pygame")
    folder = _policy_of(tmp_path, "env=gymnasium", "env.id=Pendulum-v1", sizes=(3, 1))
    assert _render(monkeypatch, folder, "length=5", "width=64", f"out={tmp_path / 'a.png'}") == 0
    first, *_, last = np.split(np.asarray(Image.open(tmp_path / "a.png").convert("L"), float), 4, axis=1)
    assert np.abs(first - last)[30:].max() > 50  # it swings


UNDRAWN = [
    (("env=gymnasium", "env.id='tests.probes:Blind-v0'"), "env.id=tests.probes:Blind-v0: cannot be drawn: it takes no"),
    (
        ("env=custom", "env.make=tests.probes:Blind"),
        "render: this environment cannot be drawn: it is not made with render_mode='rgb_array'",
    ),
]


@pytest.mark.parametrize(("words", "line"), UNDRAWN)
def test_a_task_that_cannot_be_drawn_is_one_line(words, line, tmp_path, monkeypatch, capsys):
    assert _render(monkeypatch, _policy_of(tmp_path, *words), f"out={tmp_path / 'a.gif'}") == 2
    printed = capsys.readouterr().err
    assert printed.startswith(f"vecpsmbpo: {line}")
    assert printed.count("\n") == 1
    assert not (tmp_path / "a.gif").exists()


def test_a_task_that_fails_to_draw_itself_is_one_line(tmp_path, monkeypatch, capsys):
    def fail(self):
        raise gymnasium.error.DependencyNotInstalled("pygame is not installed, run `pip install gymnasium[box2d]`")

    monkeypatch.setattr(probes.Lamp, "render", fail)
    assert _render(monkeypatch, _policy_of(tmp_path, *TASKS["custom"]), f"out={tmp_path / 'a.gif'}") == 2
    printed = capsys.readouterr().err
    assert printed.startswith("vecpsmbpo: render: this environment cannot draw itself (DependencyNotInstalled: pygame")
    assert printed.count("\n") == 1


def test_a_terminal_sees_the_steps_of_an_episode(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm")
    folder = _policy_of(tmp_path, *TASKS["custom"])
    assert _render(monkeypatch, folder, "length=5", "episodes=2", f"out={tmp_path / 'a.gif'}") == 0
    shown = capsys.readouterr().err
    assert "drawing episode 1 of 2" in shown
    assert "drawing episode 2 of 2" in shown


# ── episodes and their tiles ──────────────────────────────────────────────────────────────────────────────────────


class _Clock:
    """A stage whose episode ends at step 4, and whose picture is its step."""

    dt, episode_length = 0.01, 25

    def __init__(self, settings, width, seed):
        self.t = 0

    def reset(self):
        self.t = 0
        return np.zeros((1, 1))

    def step(self, action):
        self.t += 1
        ends = np.array([self.t == 4])
        return types.SimpleNamespace(obs=np.zeros((1, 1)), reward=[2.0], terminated=ends, truncated=~ends & False)

    def picture(self):
        return np.full((6, 8, 3), self.t, np.uint8)


@pytest.mark.parametrize(("length", "steps"), [(0, [0, 3, 4]), (2, [0, 2]), (3, [0, 3])])
def test_the_last_step_of_an_episode_is_a_frame(length, steps, monkeypatch):
    """Thirty frames a second are every third step of 0.01 s; the end, with the whole return, is one all the same."""
    monkeypatch.setattr(stage, "make", _Clock)
    studio = render.Studio(config.compose(["size=tiny"]), ["0,0"], 64, seed=0)
    tiles = [tile for (tile,) in studio.episode([lambda obs: np.zeros((1, 1))], length)]
    assert [(tile.step, tile.earned) for tile in tiles] == [(step, 2.0 * step) for step in steps]
    assert [tile.over for tile in tiles] == [step == 4 for step in steps]


@pytest.mark.parametrize(
    ("given", "count", "out", "columns"),
    [
        (["n_models=3", "n_policies=2", "member=all"], 6, "a.gif", 2),
        (["n_models=3", "n_policies=1", "member=all"], 3, "a.gif", 1),
        (["n_models=1", "n_policies=5", "member=all"], 5, "a.gif", 3),
        (["algo=mbpo", "n_models=3", "n_policies=2", "member=all"], 2, "a.gif", 2),  # which belong to no model
        (["n_models=2", "n_policies=3", "member=best"], 6, "a.gif", 3),
        (["n_models=3", "n_policies=2", "member=all"], 6, "a.png", 1),
    ],
)
def test_a_row_of_members_is_a_model(given, count, out, columns):
    *words, member = given
    options = {"out": Path(out), "member": member.partition("=")[2]}
    assert render._columns(config.compose(["size=tiny", *words]), count, options) == columns
