"""Simulators that are drawn while they run."""

import functools
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from PIL import Image

from vecpsmbpo import envs, words
from vecpsmbpo.envs import registry
from vecpsmbpo.settings import SettingError, Settings

Array = np.ndarray

FRAME_S = 1 / 30  # of a simulator that does not say how long a control step is
RENDER_MODE = "rgb_array"  # of a Gymnasium environment that draws itself


class Stage(Protocol):
    """One simulator.

    Attributes:
        dt: seconds of a control step.
        episode_length: its time limit, in control steps.
    """

    dt: float
    episode_length: int

    def reset(self) -> Array:
        """[1, O]."""

    def step(self, action: Array) -> Any:
        """action [1, A] -> obs [1, O], reward [1], terminated [1], truncated [1], by these names."""

    def picture(self) -> Array:
        """[H, W, 3] uint8."""


def make(settings: Settings, width: int, seed: int) -> Stage:
    """The run's task: its original simulator, or where there is none the JAX environment that it was trained in.

    Raises:
        SettingError: the task's package is not installed, or it cannot be drawn.
    """
    original = "host" in registry.TASKS[settings.env].backends and settings.env != "custom"
    kind = HostStage if original or settings.backend == "host" else MjxStage
    return kind(settings, width, seed)


class HostStage:
    """An original simulator."""

    def __init__(self, settings: Settings, width: int, seed: int):
        options = dict(settings.env_options)
        if settings.env == "gymnasium":  # which has to be told before; whoever makes an env=custom chooses for himself
            options["render_mode"] = RENDER_MODE
        self._env = envs.make(settings.env, "host", num_envs=1, seed=seed, **options)
        simulator = self._env.simulators[0]
        self.dt, self.picture = control_dt(simulator), camera(simulator, width)
        self.episode_length = self._env.spec.episode_length
        self._env.episode_length = settings.episode_length or self.episode_length

    def reset(self) -> Array:
        return self._env.reset()

    def step(self, action: Array) -> Any:
        return self._env.step(action)


class MjxStage:
    """A JAX environment that has a MuJoCo model: a port, Brax's or Playground's."""

    def __init__(self, settings: Settings, width: int, seed: int):
        from vecpsmbpo.look import fresh

        env = _jax_env(settings.env, settings.env_options)
        self._world = fresh.MjxWorld(env, 1, seed)
        self._scene = scene(env)
        self.dt, self.episode_length = self._scene.dt, env.spec.episode_length
        self._draw = functools.partial(_draw, self._scene, *_renderer(self._scene.model, width))

    def reset(self) -> Array:
        return self._world.reset()

    def step(self, action: Array) -> Any:
        return self._world.step(action)

    def picture(self) -> Array:
        return self._draw(self._world.state)


@functools.lru_cache(maxsize=1)
def _jax_env(name: str, options: tuple[tuple[str, Any], ...]) -> Any:
    """One for all stages of a task, and with it one compiled program."""
    return envs.make(name, "mjx", **dict(options))


class Scene:
    """Where a JAX environment keeps what its picture is a function of.

    Attributes:
        model: MuJoCo's.
        dt: seconds of a control step.
        positions: of the state of one environment, qpos [nq].
    """

    def __init__(self, model: Any, dt: float, positions: Callable[[Any], Any]):
        self.model, self.dt, self.positions = model, dt, positions


def scene(env: Any) -> Scene:
    """Of an environment of this package.

    Raises:
        SettingError: it has no MuJoCo model.
    """
    inner: Any = getattr(env, "inner", None)  # of `envs.mjx.adapter.Adapter`
    repeat = getattr(env, "_action_repeat", 1)
    if inner is None and hasattr(env, "substeps"):  # `envs.mjx.base.MjxEnv`
        return Scene(env.model, env.substeps * env.model.opt.timestep, lambda state: state.pipeline_state.qpos)
    if hasattr(inner, "mj_model"):  # Playground
        return Scene(inner.mj_model, repeat * float(inner.dt), lambda state: state.pipeline_state.data.qpos)
    if hasattr(getattr(inner, "sys", None), "mj_model"):  # Brax, on any of its backends
        return Scene(inner.sys.mj_model, repeat * float(inner.dt), lambda state: state.pipeline_state.pipeline_state.q)
    raise SettingError("render: this environment cannot be drawn: it has no MuJoCo model")


def _draw(scene: Scene, renderer: Any, view: int, states: Any) -> Array:
    import jax
    import mujoco

    data = mujoco.MjData(scene.model)
    data.qpos[:] = np.asarray(scene.positions(jax.tree.map(lambda x: x[0], states)))
    mujoco.mj_forward(scene.model, data)
    renderer.update_scene(data, camera=view)
    return renderer.render().copy()


def _renderer(model: Any, width: int) -> tuple[Any, int]:
    """MuJoCo's, of pictures four by three, and the task's first camera or, where it has none, the free one.

    Raises:
        SettingError: the driver has no room for pictures so wide.
    """
    import mujoco

    height = width * 3 // 4
    model.vis.global_.offwidth = max(model.vis.global_.offwidth, width)
    model.vis.global_.offheight = max(model.vis.global_.offheight, height)
    try:
        return mujoco.Renderer(model, height, width), 0 if model.ncam else -1
    except mujoco.FatalError as error:
        raise SettingError(f"width={width}: MuJoCo cannot draw so wide a picture here ({error})") from None


def camera(simulator: Any, width: int) -> Callable[[], Array]:
    """Draws what a simulator on the host is in: [H, W, 3] uint8.

    MuJoCo's own renderer where the simulator is one, else the environment's `render`, whose pictures are brought to the
    width.

    Raises:
        SettingError: it can do neither; the camera itself raises it where `render` fails.
    """
    model, data = _mujoco(simulator)
    if model is not None:
        renderer, view = _renderer(model, width)

        def draw() -> Array:
            renderer.update_scene(data, camera=view)
            return renderer.render().copy()

        return draw
    env = getattr(simulator, "env", None)
    if env is None or getattr(env, "render_mode", None) != RENDER_MODE:
        raise SettingError(f"render: this environment cannot be drawn: it is not made with render_mode='{RENDER_MODE}'")

    def own() -> Array:
        try:
            picture = Image.fromarray(np.asarray(env.render(), np.uint8))
        except Exception as error:  # whatever a task's own code raises, such as that pygame is missing
            raise SettingError(f"render: this environment cannot draw itself ({words.of(error)})") from None
        return np.asarray(picture.resize((width, round(width * picture.height / picture.width))))

    return own


def _mujoco(simulator: Any) -> tuple[Any, Any]:
    """Model and data of a MuJoCo simulator, or nothing."""
    env = getattr(simulator, "env", None)
    physics = getattr(env, "physics", None)
    if physics is not None:  # the control suite
        return physics.model.ptr, physics.data.ptr
    core = getattr(env, "unwrapped", None)
    model, data = getattr(core, "model", None), getattr(core, "data", None)
    return (model, data) if hasattr(data, "qpos") else (None, None)


def control_dt(simulator: Any) -> float:
    """Seconds of a control step of a simulator on the host."""
    env = simulator.env
    if hasattr(env, "control_timestep"):
        return float(env.control_timestep())
    return float(getattr(env.unwrapped, "dt", FRAME_S))
