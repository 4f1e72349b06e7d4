"""How a picture is made: scenes of JAX environments, strips, mosaics and colours."""

import subprocess
import sys
import types

import numpy as np
from PIL import Image

from tests.drawing import draws
from tests.helpers import environment
from vecpsmbpo.look import render, stage

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
    tiles = [render.Tile("", np.full((30, 40, 3), shade, np.uint8), 0.0, shade == 100) for shade in shades]
    sheet = render.mosaic(tiles, columns=2)
    assert sheet.shape == (60, 80, 3)
    assert (sheet[25, 30, 0], sheet[25, 70, 0], sheet[55, 30, 0]) == (20, 60, 45)  # the last one is over
    assert (sheet[40:, 50:] == 0).all()


def test_an_environment_that_can_draw_itself_does():
    picture = np.arange(2 * 3 * 3, dtype=np.uint8).reshape(2, 3, 3)
    env = types.SimpleNamespace(render_mode="rgb_array", render=lambda: picture, unwrapped=types.SimpleNamespace())
    np.testing.assert_array_equal(stage.camera(types.SimpleNamespace(env=env), 64)(), picture)
