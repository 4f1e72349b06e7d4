"""From settings to the programs of a run: the algorithm on its task, and what they are given first."""

import dataclasses
from functools import partial
from importlib import import_module

import jax
import jax.numpy as jnp

from vecpsmbpo import envs, runtime
from vecpsmbpo.algorithms import TABLE
from vecpsmbpo.algorithms.base import Algorithm
from vecpsmbpo.drivers import Driver, HostDriver, ScanDriver
from vecpsmbpo.layout import Layout
from vecpsmbpo.settings import Settings
from vecpsmbpo.types import EnvSpec, Hyper


def make_driver(settings: Settings) -> Driver:
    """The algorithm on the task, on this process's devices. `runtime.configure` comes first.

    Raises:
        SettingError: there is no such task (`envs.make`), or it has JAX compute in float64.
    """
    make_env = partial(envs.make, settings.env, settings.backend, **dict(settings.env_options))
    env = make_env(num_envs=len(settings.lanes), seed=settings.seed)
    runtime.check_float32()  # the task's module may have changed it
    if not settings.episode_length:
        settings = dataclasses.replace(settings, episode_length=env.spec.episode_length)
    algorithm = make_algorithm(settings, env.spec)
    return ScanDriver(algorithm, env) if settings.backend == "mjx" else HostDriver(algorithm, env, make_env)


def make_algorithm(settings: Settings, spec: EnvSpec) -> Algorithm:
    """The algorithm that `algo=` names, on this process's devices."""
    module, _, name = TABLE[settings.algo].learner.partition(":")
    chosen: type[Algorithm] = getattr(import_module(module), name)
    return chosen(settings, spec, Layout.of(settings))


def initial_inputs(settings: Settings) -> tuple[jax.Array, Hyper]:
    """A key [S] per seed, the same as if that seed ran alone; hyperparameters with leaves [S]."""
    lanes = settings.lanes
    keys = jax.vmap(jax.random.key)(jnp.array([lane["seed"] for lane in lanes]))
    hyper = jax.tree.map(lambda x: jnp.full(len(lanes), x), Hyper.of(settings))
    swept = {name: jnp.array([lane[name] for lane in lanes], jnp.float32) for name, _ in settings.sweep}
    return keys, hyper.replace(**swept)


def evaluation_keys(settings: Settings, env_steps: int) -> jax.Array:
    """A key [S] per seed for the evaluation at `env_steps`; evaluating never moves the run's own keys."""
    keys, _ = initial_inputs(settings)
    return jax.vmap(lambda key: jax.random.fold_in(jax.random.fold_in(key, 0xE7A1), env_steps))(keys)
