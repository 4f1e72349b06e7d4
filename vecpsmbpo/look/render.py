"""`vecpsmbpo render`: what trained policies do, drawn without a display by the original simulator, if there is one."""

import functools
import importlib.util
import os
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image, ImageDraw

from vecpsmbpo import arguments
from vecpsmbpo.look import exported, files, runs, stage
from vecpsmbpo.look.runs import Run
from vecpsmbpo.look.working import Working
from vecpsmbpo.settings import SettingError, Settings

Array = np.ndarray
Policies = list[tuple[str, Callable[[Any], Any]]]  # name, and obs [..., O] -> action [..., A]

WIDEST = 8192  # pixels that MuJoCo could draw with Mesa's EGL: of 16384 the framebuffer was not complete
OPTIONS = {
    "episodes": arguments.whole("one after the other", 1, at_least=1),
    "member": arguments.text(
        "who acts; posterior: one member, drawn from it for all episodes; all: a row for each model",
        "best",
        "best, posterior, all, or n,m",
    ),
    "lane": arguments.whole("of which seed and swept value, counted from 0", 0),
    "seed": arguments.whole("of the episodes", 0, at_most=2**31 - 1),
    "steps": arguments.wholes("of training, whose checkpoints act side by side; without it, the newest"),
    "length": arguments.whole("steps after which an episode is cut, at most the run's own; 0: those", 0),
    "width": arguments.whole("of each picture in pixels; without it, as many show", 0, at_least=64, at_most=WIDEST),
    "out": arguments.out(
        "the film, or a strip of its frames; without it walk.mp4, or walk.gif where the extra `video` is not installed",
        "",
        *(".mp4", ".gif", ".png"),
    ),
}
FRAMES_PER_S = 30
STRIP = 4  # frames of a .png, as in figure 8
SINGLE, TILE, SHEET = 480, 240, 1920  # pixels: the width of one picture, of each of several, and of all together
NARROW = 170  # pixels: where step and return have no room beside each other
ENDED = 0.45  # brightness of a tile whose episode is over
PLATFORMS = ("egl", "osmesa")
OWN = "episode"  # the film that a run with a page, or a logger that takes films, makes of itself at its end
OWN_S = 600.0  # that it may take


class Tile(NamedTuple):
    """One member's episode so far.

    Attributes:
        name: of the member.
        picture: [H, W, 3] uint8, of now or of its end.
        step: how many it has taken.
        earned: its return so far.
        over: whether it has ended.
    """

    name: str
    picture: Array
    step: int
    earned: float
    over: bool


def run(words: Sequence[str]) -> int:
    """The command; its exit status.

    Raises:
        SettingError: a mistake in `words`, nothing to draw with, or the file cannot be written.
    """
    named, options = arguments.parse("render", words, OPTIONS)
    policy = exported.load(named[0]) if len(named) == 1 and exported.is_one(named[0]) else None
    policies: Callable[[], Policies]
    if policy is None:
        (path,) = arguments.run_dirs("render", named, most=1)
        found = runs.load(path)
        _check(found, options)
        settings, policies = found.settings, functools.partial(_policies, found, options)
    else:
        for name in ("member", "lane", "steps"):
            if options[name] != OPTIONS[name].default:
                raise SettingError(f"{name}: {policy.path} is one policy, without a run")
        settings, policies = policy.settings, functools.partial(_alone, policy)
    out = options["out"] = options["out"] or _usual_out()
    files.check_writable(out)
    if out.suffix.lower() == ".mp4" and not _makes_mp4():
        raise SettingError(f"out={out}: .mp4 needs imageio-ffmpeg; pip install 'vecpsmbpo[video]', or take .gif")
    os.environ["MUJOCO_GL"] = platform()
    with Working() as working:
        working.on("reading what acts")
        frames, frame_s = film(settings, policies(), options, working)
        working.on(f"writing {out}")
        files.write(out, functools.partial(_write, frames, frame_s))
    print(f"written: {out}")
    return 0


def _makes_mp4() -> bool:
    return importlib.util.find_spec("imageio_ffmpeg") is not None


def _usual_out() -> Path:
    """Where a film goes that is not told where; says so where it is not the better kind."""
    if _makes_mp4():
        return Path("walk.mp4")
    print("a .gif, since .mp4 needs imageio-ffmpeg: pip install 'vecpsmbpo[video]'")
    return Path("walk.gif")


def keep(run_dir: Path, warn: Callable[[str], None]) -> None:
    """Films an episode of a run's best member into its directory; what goes wrong with it is no reason to stop.

    In a process of its own, since MuJoCo chooses what it draws with when it is imported, and who trains has imported it
    to draw nothing; on the CPU, since the devices are full of the run.
    """
    out = run_dir / f"{OWN}{'.mp4' if _makes_mp4() else '.gif'}"
    command = [sys.executable, "-m", "vecpsmbpo.cli", "render", f"run_dir={run_dir}", f"out={out}"]
    on_cpu = {**os.environ, "JAX_PLATFORMS": "cpu"}
    try:
        subprocess.run(command, env=on_cpu, capture_output=True, text=True, timeout=OWN_S, check=True)
    except subprocess.CalledProcessError as error:
        said = error.stderr.strip().splitlines() or [f"exit status {error.returncode}"]
        warn(f"{out} is not made ({said[-1].removeprefix('vecpsmbpo: ')})")
    except (OSError, subprocess.TimeoutExpired) as error:
        warn(f"{out} is not made ({error})")


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


def film(
    settings: Settings, policies: Policies, options: dict[str, Any], working: Working
) -> tuple[list[Array], float]:
    """Episodes of policies, side by side: frames [H, W, 3] uint8, and seconds between them.

    Every one begins in the same state.

    Args:
        settings: of the run, which has the task.
        working: is told which step is being drawn.

    Raises:
        SettingError: the task cannot be drawn.
    """
    columns = _columns(settings, len(policies), options)
    width = options["width"] or (SINGLE if len(policies) == 1 else max(64, min(TILE, SHEET // columns)))
    studio = Studio(settings, [name for name, _ in policies], width, options["seed"])
    frames: list[Array] = []
    count = options["episodes"]
    for episode in range(1, count + 1):
        each = functools.partial(working.through, what=f"drawing episode {episode} of {count}")
        for tiles in studio.episode([act for _, act in policies], options["length"], each=each):
            frames.append(mosaic(tiles, columns))
    return frames, studio.frame_s


def _columns(settings: Settings, count: int, options: dict[str, Any]) -> int:
    """Of the mosaic: one for a strip; of all members one for each policy, so that a row is a model; else as many as
    there are rows."""
    if options["out"].suffix.lower() == ".png":
        return 1
    of_models = count == settings.n_models * settings.policies_per_model  # else policies belong to none
    if options["member"] == "all" and settings.n_models > 1 and of_models:
        return settings.policies_per_model
    return int(np.ceil(np.sqrt(count)))


def _check(run: Run, options: dict[str, Any]) -> None:
    """Raises:
    SettingError: the run has no such lane, or keeps no such checkpoint.
    """
    runs.check_lane(run, options["lane"])
    kept = runs.kept_steps(run)
    if missing := [step for step in options["steps"] if step not in kept]:
        known = f"must be of {', '.join(map(str, kept))}, which checkpoints are kept of" if kept else "there is none"
        raise SettingError(f"steps={missing[0]}: {known}")


def _alone(policy: exported.Exported) -> Policies:
    """An exported policy. It needs no JAX, but its task may."""
    from vecpsmbpo import runtime

    runtime.configure(policy.settings)
    return [(policy.path.resolve().name, policy.network)]


def _policies(run: Run, options: dict[str, Any]) -> Policies:
    """The members asked for, as they are now; or at `steps` of training one of them, as in figure 8.

    Raises:
        SettingError: as `members.load` and `members.acting`; several members at several steps.
    """
    from vecpsmbpo.look import members  # and JAX with it

    who, steps = options["member"], options["steps"]
    if not steps:
        return members.acting(members.load(run, options["lane"]), who)
    if who == "all":
        raise SettingError("member=all: with steps= there is room for one member")
    found = []
    for trained in members.load_each(run, options["lane"], steps):
        found += [(f"trained {trained.step:,} steps: {name}", act) for name, act in members.acting(trained, who)]
        del trained  # as in `evaluate.restore_each`
    return found


class Studio:
    """One stage for each policy; all begin in the same state."""

    def __init__(self, settings: Settings, names: Sequence[str], width: int, seed: int):
        self._names = names
        self._stages = [stage.make(settings, width, seed) for _ in names]
        self._every = max(1, round(1 / (FRAMES_PER_S * self._stages[0].dt)))
        self._limit = settings.episode_length or self._stages[0].episode_length

    @property
    def frame_s(self) -> float:
        """Seconds between two frames."""
        return self._every * self._stages[0].dt

    def episode(
        self,
        policies: Sequence[Callable[[Any], Any]],
        length: int = 0,
        *,
        each: Callable[[Iterable[int]], Iterable[int]] = lambda steps: steps,
    ) -> Iterator[list[Tile]]:
        """The tiles of every frame, the last one included, until all episodes are over or `length` steps are done (0:
        no limit).

        Args:
            each: shows progress over the steps.
        """
        observations = [one.reset() for one in self._stages]
        tiles = [Tile(name, one.picture(), 0, 0.0, False) for name, one in zip(self._names, self._stages, strict=True)]
        yield tiles
        limit = min(length or self._limit, self._limit)
        for t in each(range(1, limit + 1)):
            shown = t % self._every == 0 or t == limit
            for index, (one, act, tile) in enumerate(zip(self._stages, policies, tiles, strict=True)):
                if tile.over:
                    continue
                step = one.step(np.asarray(act(observations[index])))
                observations[index] = step.obs
                over = bool(step.terminated[0] | step.truncated[0]) or t == self._limit
                # A simulator whose episode is over may have been reset already: its last picture stays.
                picture = one.picture() if shown and not over else tile.picture
                tiles[index] = Tile(tile.name, picture, t, tile.earned + float(step.reward[0]), over)
            ended = all(tile.over for tile in tiles)
            if shown or ended:
                yield tiles
            if ended:
                return


def mosaic(tiles: Sequence[Tile], columns: int) -> Array:
    """The tiles in rows of `columns`, each with its member, step and return: [H, W, 3] uint8."""
    height, width = tiles[0].picture.shape[:2]
    rows = -(-len(tiles) // columns)
    # Even sizes: the video's colours are stored at half resolution.
    sheet = Image.new("RGB", (columns * width + columns * width % 2, rows * height + rows * height % 2))
    apart = "   " if width > NARROW else "\n"
    look: dict[str, Any] = {"fill": "white", "stroke_width": 2, "stroke_fill": "black", "font_size": 13}
    for index, tile in enumerate(tiles):
        picture = (tile.picture * (ENDED if tile.over and len(tiles) > 1 else 1.0)).astype(np.uint8)
        image = Image.fromarray(picture)
        text = f"{tile.name}\nstep {tile.step:,}{apart}return {tile.earned:,.0f}"
        ImageDraw.Draw(image).multiline_text((6, 4), text, **look)
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
        # The usual choice of colours, by how many pixels have them, turns what is small and bright grey.
        colours = Image.Quantize.MAXCOVERAGE
        first, *others = [Image.fromarray(frame).quantize(128, method=colours) for frame in frames]
        first.save(path, save_all=True, append_images=others, duration=round(1000 * frame_s), loop=0)
    else:
        import imageio

        # It warns of what a fork in a process with JAX's threads may do; this one becomes ffmpeg at once.
        warnings.filterwarnings("ignore", message="os.fork", category=RuntimeWarning)
        with imageio.get_writer(path, fps=1 / frame_s, codec="libx264", quality=7, macro_block_size=2) as writer:
            for frame in frames:
                writer.append_data(frame)
