"""`vecpsmbpo render`: what trained policies do, drawn by the original simulator without a display."""

import functools
import importlib.util
import os
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image, ImageDraw
from rich.console import Console
from rich.progress import track

from vecpsmbpo.envs import registry
from vecpsmbpo.look import arguments, files, runs
from vecpsmbpo.look.runs import Run
from vecpsmbpo.settings import SettingError

Array = np.ndarray

OPTIONS = {
    "episodes": arguments.whole(1, at_least=1),
    "member": arguments.text("best", "best, posterior, all, or n,m"),
    "lane": arguments.whole(0),
    "seed": arguments.whole(0),
    "steps": arguments.whole(0),
    "width": arguments.whole(0, at_least=64),
    "out": arguments.out("walk.mp4", ".mp4", ".gif", ".png"),
}
FRAMES_PER_S = 30
STRIP = 4  # frames of a .png, as in figure 8
SINGLE, TILE = 480, 240  # pixels: the width of one picture, and of each of several
ENDED = 0.45  # brightness of a tile whose episode is over
PLATFORMS = ("egl", "osmesa")


class Tile(NamedTuple):
    """One member's episode so far.

    Attributes:
        name: of the member.
        picture: [H, W, 3] uint8, of now or of its end.
        earned: its return so far.
        over: whether it has ended.
    """

    name: str
    picture: Array
    earned: float
    over: bool


def run(words: Sequence[str]) -> int:
    """The command; its exit status.

    Raises:
        SettingError: a mistake in `words`, nothing to draw with, or the file cannot be written.
    """
    named, options = arguments.parse("render", words, OPTIONS)
    (path,) = arguments.run_dirs("render", named, most=1)
    out = options["out"]
    files.check_writable(out)
    found = runs.load(path)
    if "host" not in registry.TASKS[found.settings.env].backends:
        raise SettingError(f"render: env={found.settings.env} has no simulator on the host that could draw it")
    if out.suffix.lower() == ".mp4" and importlib.util.find_spec("imageio_ffmpeg") is None:
        raise SettingError(f"out={out}: .mp4 needs imageio-ffmpeg; pip install 'vecpsmbpo[video]', or take .gif")
    os.environ["MUJOCO_GL"] = platform()
    frames, frame_s = film(found, options)
    files.write(out, functools.partial(_write, frames, frame_s))
    print(f"written: {out}")
    return 0


def platform() -> str:
    """What MuJoCo can draw with here, without a display: `egl` or `osmesa`; what `MUJOCO_GL` asks for comes first.

    Each is tried in a process of its own, since MuJoCo chooses one when it is imported.

    Raises:
        SettingError: neither is there.
    """
    asked = os.environ.get("MUJOCO_GL", "")
    for name in dict.fromkeys((*([asked] if asked in PLATFORMS else []), *PLATFORMS)):
        code = "import mujoco; context = mujoco.GLContext(64, 64); context.make_current(); context.free()"
        found = subprocess.run(
            [sys.executable, "-c", code],
            env={**os.environ, "MUJOCO_GL": name, "PYOPENGL_PLATFORM": name},
            capture_output=True,
            check=False,
        )
        if found.returncode == 0:
            return name
    raise SettingError("render: there is neither EGL nor OSMesa to draw with; apt-get install libegl1 or libosmesa6")


def film(run: Run, options: dict[str, Any]) -> tuple[list[Array], float]:
    """Episodes of the members asked for, side by side: frames [H, W, 3] uint8, and seconds between them.

    Every member begins in the same state.

    Raises:
        SettingError: as `members.load` and `members.acting`; the task cannot be drawn.
    """
    from vecpsmbpo.look import members  # and JAX with it

    trained = members.load(run, options["lane"])
    policies = members.acting(trained, options["member"])
    width = options["width"] or (SINGLE if len(policies) == 1 else TILE)
    studio = Studio(run, [name for name, _ in policies], width, options["seed"])
    columns = 1 if options["out"].suffix.lower() == ".png" else int(np.ceil(np.sqrt(len(policies))))
    frames: list[Array] = []
    console = Console(stderr=True)
    episodes = track(
        range(options["episodes"]), "drawing", console=console, transient=True, disable=not console.is_terminal
    )
    for _ in episodes:
        for tiles in studio.episode([act for _, act in policies], options["steps"]):
            frames.append(mosaic(tiles, columns))
    return frames, studio.frame_s


class Studio:
    """One simulator for each member, each with a camera."""

    def __init__(self, run: Run, names: Sequence[str], width: int, seed: int):
        settings = run.settings
        make = functools.partial(registry.make, settings.env, "host", num_envs=1, **dict(settings.env_options))
        self._names = names
        self._envs = [make(seed=seed) for _ in names]
        self._cameras = [camera(env.simulators[0], width) for env in self._envs]
        for env in self._envs:
            env.episode_length = settings.episode_length or env.spec.episode_length
        self._dt = control_dt(self._envs[0].simulators[0])
        self._every = max(1, round(1 / (FRAMES_PER_S * self._dt)))

    @property
    def frame_s(self) -> float:
        """Seconds between two frames."""
        return self._every * self._dt

    def episode(self, policies: Sequence[Callable[[Any], Any]], steps: int = 0) -> Iterator[list[Tile]]:
        """The tiles of every frame, until all episodes are over or `steps` are done (0: no limit)."""
        observations = [env.reset() for env in self._envs]
        tiles = [Tile(name, camera(), 0.0, False) for name, camera in zip(self._names, self._cameras, strict=True)]
        yield tiles
        limit = steps or self._envs[0].episode_length
        for t in range(1, limit + 1):
            for index, (env, act, tile) in enumerate(zip(self._envs, policies, tiles, strict=True)):
                if tile.over:
                    continue
                step = env.step(np.asarray(act(observations[index])))
                observations[index] = step.obs
                over = bool(step.terminated[0] | step.truncated[0])
                # A simulator whose episode is over has been reset already: its last picture stays.
                picture = self._cameras[index]() if t % self._every == 0 and not over else tile.picture
                tiles[index] = Tile(tile.name, picture, tile.earned + float(step.reward[0]), over)
            if t % self._every == 0:
                yield tiles
            if all(tile.over for tile in tiles):
                return


def camera(simulator: Any, width: int) -> Callable[[], Array]:
    """Draws what a simulator is in: [H, W, 3] uint8.

    MuJoCo's own renderer where the simulator is one, from the task's first camera; else the environment's `render`.

    Raises:
        SettingError: it can do neither.
    """
    model, data = _mujoco(simulator)
    if model is not None:
        import mujoco

        height = width * 3 // 4
        model.vis.global_.offwidth = max(model.vis.global_.offwidth, width)
        model.vis.global_.offheight = max(model.vis.global_.offheight, height)
        renderer = mujoco.Renderer(model, height, width)
        view = 0 if model.ncam else -1

        def draw() -> Array:
            renderer.update_scene(data, camera=view)
            return renderer.render().copy()

        return draw
    env = getattr(simulator, "env", None)
    if env is None or getattr(env, "render_mode", None) != "rgb_array":
        raise SettingError("render: this environment cannot be drawn; give it render_mode='rgb_array'")
    return lambda: np.asarray(env.render(), np.uint8)


def _mujoco(simulator: Any) -> tuple[Any, Any]:
    """Model and data of a MuJoCo simulator, or nothing."""
    env = getattr(simulator, "env", None)
    physics = getattr(env, "physics", None)
    if physics is not None:  # the control suite
        return physics.model.ptr, physics.data.ptr
    core = getattr(env, "unwrapped", None)
    return getattr(core, "model", None), getattr(core, "data", None)


def control_dt(simulator: Any) -> float:
    """Seconds of a control step; 1/30 where the simulator does not say."""
    env = simulator.env
    if hasattr(env, "control_timestep"):
        return float(env.control_timestep())
    return float(getattr(env.unwrapped, "dt", 1 / FRAMES_PER_S))


def mosaic(tiles: Sequence[Tile], columns: int) -> Array:
    """The tiles in rows of `columns`, each with its member and return: [H, W, 3] uint8."""
    height, width = tiles[0].picture.shape[:2]
    rows = -(-len(tiles) // columns)
    # Even sizes: the video's colours are stored at half resolution.
    sheet = Image.new("RGB", (columns * width + columns * width % 2, rows * height + rows * height % 2))
    for index, tile in enumerate(tiles):
        picture = (tile.picture * (ENDED if tile.over and len(tiles) > 1 else 1.0)).astype(np.uint8)
        image = Image.fromarray(picture)
        ImageDraw.Draw(image).text(
            (6, 4), f"{tile.name}   {tile.earned:.0f}", fill="white", stroke_width=2, stroke_fill="black", font_size=13
        )
        sheet.paste(image, (index % columns * width, index // columns * height))
    return np.asarray(sheet)


def strip(frames: Sequence[Array]) -> Array:
    """Frames side by side, evenly from the first to the last."""
    chosen = np.linspace(0, len(frames) - 1, STRIP).round().astype(int)
    return np.concatenate([frames[index] for index in chosen], axis=1)


def _write(frames: list[Array], frame_s: float, path: Path) -> None:
    """As the kind of file that `path` names."""
    kind = path.suffix.lower()
    if kind == ".png":
        Image.fromarray(strip(frames)).save(path)
    elif kind == ".gif":
        first, *others = [Image.fromarray(frame).quantize(128) for frame in frames]
        first.save(path, save_all=True, append_images=others, duration=round(1000 * frame_s), loop=0)
    else:
        import imageio

        # It warns of what a fork in a process with JAX's threads may do; this one becomes ffmpeg at once.
        warnings.filterwarnings("ignore", message="os.fork", category=RuntimeWarning)
        with imageio.get_writer(path, fps=1 / frame_s, codec="libx264", quality=7, macro_block_size=2) as writer:
            for frame in frames:
                writer.append_data(frame)
