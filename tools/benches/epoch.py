"""Where the time of an epoch goes."""

import contextlib
import dataclasses
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from tools.benches.program import driver_of
from tools.benches.simulators import mjx_steps
from tools.benches.timing import best_seconds
from vecpsmbpo import jsonl, training
from vecpsmbpo.drivers import ScanDriver
from vecpsmbpo.layout import BY_SEED, SEEDS
from vecpsmbpo.programs import initial_inputs
from vecpsmbpo.schedule import over_seeds
from vecpsmbpo.settings import SettingError
from vecpsmbpo.types import TrainState

WORLD_STRIDES = 4
ACTS = 200
PROFILE_SECONDS = 150  # after which, with two refreshes, a large program's strides have been timed often enough


def bench_profile(words: Sequence[str]) -> dict[str, Any]:
    """Strides of the real program are timed one by one: before the warm-up is over they are the world alone, then
    updates come on top, and at the start of every period a refresh. What cannot be told apart so is timed by itself.
    A stride by itself pays for being started and for its news, which a run pays once for an epoch: it counts as
    observing.
    """
    driver = driver_of(words or ["env=cartpole_swingup", "size=cpu"])
    settings, layout = driver.settings, driver.layout
    strides, warm = settings.epoch_steps // settings.stride, settings.first_learning_step // settings.stride
    if not settings.learns_by_sac or settings.model_update_every == settings.stride or warm < WORLD_STRIDES + 1:
        raise SettingError("profile: needs SAC, periods of more than a stride, and a warm-up of more than 100 steps")
    keys, given = initial_inputs(settings)
    state = driver.init(keys, given)
    driver.compile(state)
    state = run_strides(driver, state, warm - WORLD_STRIDES)
    world, learning, refreshing = [], [], []
    for _ in range(WORLD_STRIDES):
        state, seconds = timed_stride(driver, state)
        world.append(seconds)
    began = time.perf_counter()
    for index in range(strides):
        state, seconds = timed_stride(driver, state)
        (learning if index % (strides // settings.refreshes_per_epoch) else refreshing).append(seconds)
        if len(refreshing) > 1 and time.perf_counter() - began > PROFILE_SECONDS:
            refreshing = refreshing[1:]  # the first, which begins with new models, is not like the rest of an epoch
            break
    evaluate = lambda: driver.evaluate(state, keys, settings.eval_episodes)  # noqa: E731
    evaluate()
    evaluating = best_seconds(evaluate, 2)
    lanes = len(settings.lanes) // layout.mesh.shape[SEEDS]  # of a device
    stepping = (
        lanes * settings.epoch_steps / mjx_steps(settings.env, lanes, **dict(settings.env_options))["steps_per_s"]
    )
    acting = settings.epoch_steps * seconds_per_act(driver, state)
    # The last that uses the state, which it consumes.
    imagining = seconds_per_imagining(driver, state) * settings.refreshes_per_epoch if settings.imagines else 0.0
    refresh = settings.refreshes_per_epoch * max(np.mean(refreshing) - np.median(learning), 0.0)
    seconds_of = {
        "updating": strides * (np.median(learning) - np.median(world)),
        "fitting": max(refresh - imagining, 0.0),
        "imagining": imagining,
        "stepping": stepping,
        "acting": acting,
        "observing": max(strides * np.median(world) - stepping - acting, 0.0),
        "evaluating": evaluating,
        "host": seconds_of_host(driver),
    }
    whole = sum(seconds_of.values())
    return {
        "task": settings.env,
        "members": settings.n_members,
        "width": settings.policy_hidden_size,
        "from_step": settings.first_learning_step,
        "strides_timed": len(learning),
        "refreshes_timed": len(refreshing),
        "seconds_of_an_epoch": whole,
        **{name: seconds / whole for name, seconds in seconds_of.items()},
    }


def run_strides(driver: ScanDriver, state: TrainState, strides: int) -> TrainState:
    """An epoch at a time, which is what the program has room to report."""
    most = driver.settings.epoch_steps // driver.settings.stride
    while strides > 0:
        state, _ = driver.run(state, min(strides, most))
        strides -= most
    return state


def timed_stride(driver: ScanDriver, state: TrainState) -> tuple[TrainState, float]:
    began = time.perf_counter()
    state, _ = driver.run(state, 1)
    jax.block_until_ready(state)
    return state, time.perf_counter() - began


def seconds_per_imagining(driver: ScanDriver, state: TrainState) -> float:
    """Of one refresh, for every member, by itself; the state is consumed, so that rings are written in place."""
    places = driver.layout.specs()

    def body(state: TrainState) -> TrainState:
        def imagine(counters: Any, seed: Any, key: Any) -> Any:
            return driver.algorithm.imagine(counters, seed, jnp.bool_(True), key)[1]

        return state.replace(seeds=over_seeds(imagine)(state.counters, state.seeds, state.seeds.key))

    run = driver.layout.jit_shard_map(body, (places,), places, donate_argnums=0)
    seconds = []
    for _ in range(3):  # the first compiles
        began = time.perf_counter()
        state = jax.block_until_ready(run(state))
        seconds.append(time.perf_counter() - began)
    return min(seconds)


def seconds_per_act(driver: ScanDriver, state: TrainState) -> float:
    """Of drawing an action in every seed's environment."""

    def body(state: TrainState) -> Any:
        def act(carry, index):
            keys = jax.vmap(lambda key: jax.random.fold_in(key, index))(state.seeds.key)
            obs = state.env.obs + 1e-6 * carry[:, None]  # so that no two are the same
            action, _ = over_seeds(driver.algorithm.act)(state.counters, state.seeds, obs, keys)
            return carry + jnp.sum(action, axis=1), None

        return jax.lax.scan(act, jnp.zeros(state.env.obs.shape[0]), jnp.arange(ACTS))[0]

    run = driver.layout.jit_shard_map(body, (driver.layout.specs(),), BY_SEED)
    jax.block_until_ready(run(state))
    return best_seconds(lambda: run(state), 3) / ACTS


def seconds_of_host(driver: ScanDriver) -> float:
    """Of an epoch outside of the programs: logs, the display, a share of a checkpoint. Of a whole run that does not
    learn, whose host does the same, with the programs' own time taken off."""
    settings = driver.settings
    epochs, steps = settings.checkpoint_every, settings.epoch_steps
    with tempfile.TemporaryDirectory() as folder:
        total = (1 + epochs) * steps
        random = dataclasses.replace(settings, total_steps=total, warmup_steps=total, run_dir=str(Path(folder) / "run"))
        with contextlib.redirect_stdout(sys.stderr):
            training.train(random)
        lines = jsonl.read(Path(random.run_dir) / jsonl.METRICS_FILE)
    seconds = {line["env_steps"]: line["seconds"] for line in lines}
    keys, given = initial_inputs(settings)
    state = driver.init(keys, given)
    programs = []
    for _ in range(2):  # the first may have something to compile
        began = time.perf_counter()
        state, _ = driver.run(state, steps // settings.stride)
        driver.evaluate(state, keys, settings.eval_episodes)
        programs.append(time.perf_counter() - began)
    return max((seconds[total] - seconds[steps]) / epochs - min(programs), 0.0)
