"""Environments by themselves, and what a step around a simulator of the host costs."""

import os
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np

from tools.benches.timing import best_seconds
from vecpsmbpo import config, envs, runtime
from vecpsmbpo.drivers.host import _packed
from vecpsmbpo.envs import registry
from vecpsmbpo.layout import BY_SEED
from vecpsmbpo.programs import initial_inputs, make_driver
from vecpsmbpo.settings import SettingError


def bench_envs(words: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Every task (or those named) on every backend that it has; actions are uniform.

    Raises:
        SettingError: one of those named is no task.
    """
    known = {*registry.names("mjx"), *registry.names("host")}
    for name in words:
        if name not in known:
            raise SettingError(f"{name}: {config.closest(name, known)}")
    for backend in ("mjx", "host"):
        for name in registry.names(backend):
            if words and name not in words:
                continue
            for batch in (1, 10, 100):
                measure = mjx_steps if backend == "mjx" else host_steps
                yield {"env": name, "backend": backend, "batch": batch, **measure(name, batch)}


def mjx_steps(name: str, batch: int, **options: Any) -> dict[str, float]:
    env, steps = envs.make(name, "mjx", **options), 50

    def step(state, key):
        action = jax.random.uniform(key, (batch, env.action_size), minval=-1.0, maxval=1.0)
        return jax.vmap(env.step)(state, action), None

    @jax.jit
    def run(state, key):
        return jax.lax.scan(step, state, jax.random.split(key, steps))[0]

    key = jax.random.key(0)
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(key, batch))
    began = time.perf_counter()
    compiled = run.lower(state, key).compile()
    compile_seconds = time.perf_counter() - began
    state = compiled(state, key)  # past the start, where nothing touches yet
    return {
        "steps_per_s": batch * steps / best_seconds(lambda: compiled(state, key), 3),
        "compile_seconds": compile_seconds,
    }


def host_steps(name: str, batch: int) -> dict[str, float]:
    env, steps, random = envs.make(name, "host", num_envs=batch), 50, np.random.default_rng(0)
    env.reset()

    def run():
        for _ in range(steps):
            env.step(random.uniform(-1, 1, (batch, env.spec.action_size)))

    return {"steps_per_s": batch * steps / best_seconds(run, 3)}


def bench_host(words: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Steps per second of a batch of simulators: one after the other (as `HostEnv` does it), each handed to a pool of
    threads or to a process of its own (Gymnasium's `AsyncVectorEnv`, which has Gymnasium's tasks only)."""
    for name in words or ("hopper", "ball_in_cup", "window_open"):
        for batch in (2, 10, 100):
            env, steps = envs.make(name, "host", num_envs=batch), 50
            env.reset()
            actions = np.random.default_rng(0).uniform(-1, 1, (steps, batch, env.spec.action_size))
            loop = best_seconds(lambda env=env, actions=actions: [env.step(action) for action in actions], 5)
            env.reset()
            with ThreadPoolExecutor(os.cpu_count()) as pool:

                def threads(env=env, actions=actions, pool=pool):
                    for action in actions:
                        list(pool.map(lambda one, given: one.step(given), env.simulators, action))

                threaded = best_seconds(threads, 5)
            row = {"env": name, "batch": batch, "loop_steps_per_s": batch * steps / loop}
            row["threads_steps_per_s"] = batch * steps / threaded
            if name == "hopper" and batch <= 10:
                vector = gymnasium.vector.AsyncVectorEnv([lambda: gymnasium.make("Hopper-v5")] * batch)
                vector.reset()
                processes = best_seconds(lambda v=vector, a=actions: [v.step(x.astype("float32")) for x in a], 5)
                vector.close()
                row["processes_steps_per_s"] = batch * steps / processes
            yield row


def bench_hosted(words: Sequence[str]) -> dict[str, Any]:
    """What a step around a simulator of the host costs before anything is learned, and its parts."""
    settings = config.compose(["env=hopper", "size=cpu", "warmup_steps=1000", *words, "backend=host"])
    runtime.configure(settings)
    driver = make_driver(settings)
    state = driver.init(*initial_inputs(settings))
    driver.compile(state)
    strides = settings.model_update_every // settings.stride
    state, _ = driver.run(state, strides)
    began = time.perf_counter()
    state, _ = driver.run(state, strides)
    seconds = (time.perf_counter() - began) / settings.model_update_every
    strides_measured = [hosted_parts(driver, state) for _ in range(10)]
    parts = {name: min(one[name] for one in strides_measured) for name in strides_measured[0]}
    parts["rest"] = seconds - sum(parts.values())  # to begin and to end a stride, mostly
    return {
        "task": settings.env,
        "seeds": len(settings.lanes),
        "members": settings.n_members,
        "stride": settings.stride,
        "ms_per_step": 1e3 * seconds,
        **{f"ms_{name}": 1e3 * each for name, each in parts.items()},
    }


def hosted_parts(driver: Any, state: Any) -> dict[str, float]:
    """Seconds of each part of a step as `HostDriver.run` takes it, each waited for, where the run waits for the action
    only: the action fetched, the simulator, what it says sent, the program dispatched, and computed."""
    names = ("fetch", "simulator", "send", "dispatch", "compute")
    frozen, stride = np.zeros(driver.layout.num_lanes, bool), driver.settings.stride
    state = jax.tree.map(jnp.copy, state)  # the program takes its input over
    _, state, learning, acted = jax.block_until_ready(driver._begin(state))
    seconds = np.zeros(len(names))
    for _ in range(stride):
        times = [time.perf_counter()]
        action = np.asarray(acted.action)
        times.append(time.perf_counter())
        step = driver._env.step(action, still=frozen)
        times.append(time.perf_counter())
        sent = jax.block_until_ready(driver.layout.everywhere(_packed(step), BY_SEED))
        times.append(time.perf_counter())
        state, end, acted = driver._follow(state, acted, sent, learning)
        times.append(time.perf_counter())
        jax.block_until_ready((state, end, acted))
        times.append(time.perf_counter())
        seconds += np.diff(times)
    return dict(zip(names, (seconds / stride).tolist(), strict=True))
