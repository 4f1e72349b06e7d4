"""The compiled program: its updates against the peak, what capacity costs, what it does besides updating."""

import time
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from tools.benches.timing import best_seconds, matmul_peak
from vecpsmbpo import config, runtime
from vecpsmbpo.drivers import ScanDriver
from vecpsmbpo.programs import initial_inputs, make_driver
from vecpsmbpo.schedule import over_seeds
from vecpsmbpo.settings import SettingError, Settings
from vecpsmbpo.types import Counters, TrainState

PAPER = [
    "env=hopper",
    "n_models=4",
    "n_policies=6",
    "rollout_starts=4096",
    "horizon_last=1",
    "warmup_steps=250",
]
SMALL = ["env=cartpole_swingup", "size=cpu", "warmup_steps=250", "rollout_starts=2500"]


def update_flops(settings: Settings, obs: int, action: int) -> float:
    """Multiply-adds × 2 of one SAC update's matrix products, counted by hand.

    A forward pass of a network of W weights on a batch of B costs 2 B W; its backward pass as much again for the
    weights and as much again for the inputs. Critic loss: actor and two target critics forward, two critics forward
    and backward. Actor loss: actor forward and backward, two critics forward and backward to their inputs only.
    """
    width, layers = settings.policy_hidden_size, settings.policy_hidden_layers
    inner = width * width * (layers - 1)
    actor = obs * width + inner + width * 2 * action
    critic = (obs + action) * width + inner + width
    critic_loss = actor + 2 * critic + 2 * 3 * critic
    actor_loss = 3 * actor + 2 * 2 * critic
    return 2 * settings.policy_batch_size * (critic_loss + actor_loss)


def driver_of(overrides: Sequence[str]) -> ScanDriver:
    settings = config.compose(overrides)
    runtime.configure(settings)
    driver = make_driver(settings)
    if not isinstance(driver, ScanDriver):
        raise SettingError(f"env={settings.env} backend={settings.backend}: only programs with MJX inside are measured")
    return driver


def past_warmup(driver: ScanDriver, **hyper: float) -> TrainState:
    """A state whose next strides learn, with some hyperparameters replaced."""
    settings = driver.settings
    keys, given = initial_inputs(settings)
    given = given.replace(**{name: jnp.full(settings.num_seeds, value) for name, value in hyper.items()})
    state, _ = driver.run(driver.init(keys, given), settings.first_learning_step // settings.stride)
    return state


def with_full_rings(driver: ScanDriver) -> TrainState:
    """A state before the first step whose rings are full, so that minibatches are gathered from all over them."""
    state = driver.init(*initial_inputs(driver.settings))

    def fill(ring: jax.Array) -> jax.Array:
        return jax.jit(lambda: jax.random.uniform(jax.random.key(0), ring.shape), out_shardings=ring.sharding)()

    full = Counters(driver.settings.replay_capacity, driver.algorithm.ring_capacity)
    counters = jax.tree.map(lambda old, new: jax.device_put(jnp.int32(new), old.sharding), state.counters, full)
    rings = {name: fill(ring) for name, ring in state.seeds.rings().items()}
    return state.replace(counters=counters, seeds=state.seeds.replace(**rings))


def seconds_per_update(driver: ScanDriver, state: TrainState, repeats: int) -> float:
    """Of G updates of every member, by themselves: `learn` in a jitted loop over the mesh."""
    steps, specs = 5, driver.layout.specs()

    def body(state: TrainState) -> Any:
        def step(seeds, index):
            # A key of its own for every step: with one key XLA would draw all minibatches once, before the loop.
            keys = jax.vmap(lambda key: jax.random.fold_in(key, index))(seeds.key)
            return seeds.replace(agents=over_seeds(driver.algorithm.learn)(state.counters, seeds, keys)), None

        return jax.lax.scan(step, state.seeds, jnp.arange(steps))[0].agents

    run = driver.layout.jit_shard_map(body, (specs,), specs.seeds.agents)
    jax.block_until_ready(run(state))
    return best_seconds(lambda: run(state), repeats) / steps


def seconds_per_step(driver: ScanDriver, repeats: int) -> float:
    """Of a step inside the whole program, without the refresh of models and imagined data: λ = 1 has none."""
    state = past_warmup(driver, real_ratio=1.0)
    seconds = []
    for _ in range(repeats):
        began = time.perf_counter()
        state, _ = driver.run(state, driver.settings.model_update_every // driver.settings.stride)
        seconds.append(time.perf_counter() - began)
    return min(seconds) / driver.settings.model_update_every


def bench_updates(words: Sequence[str]) -> dict[str, Any]:
    driver = driver_of([*PAPER, "updates_per_step=10", "replay_capacity=20000", "imagined_capacity=20480", *words])
    settings, spec = driver.settings, driver.algorithm.spec
    state = with_full_rings(driver)
    peaks = [matmul_peak(settings.network_precision)]
    seconds = seconds_per_update(driver, state, 3) / settings.updates_per_step
    peaks.append(matmul_peak(settings.network_precision))
    rate = settings.n_members * update_flops(settings, spec.obs_size, spec.action_size) / seconds
    return {
        "members": settings.n_members,
        "width": settings.policy_hidden_size,
        "batch": settings.policy_batch_size,
        "critic_norm": settings.critic_norm,
        "precision": settings.network_precision,
        "ms_per_update_of_all_members": 1e3 * seconds,
        "member_updates_per_s": settings.n_members / seconds,
        "gflops": rate / 1e9,
        "matmul_peak_gflops": max(peaks) / 1e9,
        "share_of_peak": rate / max(peaks),
    }


def bench_capacity(words: Sequence[str]) -> dict[str, Any]:
    drivers = {
        size: driver_of([*SMALL, f"replay_capacity={size}", f"imagined_capacity={size}", *words])
        for size in (20_000, 1_000_000)
    }
    seconds: dict[int, float] = {}
    for _ in range(3):  # in turn, so that a machine whose speed drifts does not favour one
        for size, driver in drivers.items():
            seconds[size] = min(seconds.get(size, np.inf), seconds_per_step(driver, 2))
    small, large = seconds.values()
    return {"ms_per_step_at_2e4": 1e3 * small, "ms_per_step_at_1e6": 1e3 * large, "ratio": large / small}


def bench_program(words: Sequence[str]) -> dict[str, Any]:
    driver = driver_of([*SMALL, *words])
    state = past_warmup(driver)
    alone, whole = np.inf, np.inf
    for _ in range(3):
        alone = min(alone, seconds_per_update(driver, state, 10))
        whole = min(whole, seconds_per_step(driver, 2))
    return {"ms_per_step": 1e3 * whole, "ms_of_updates_alone": 1e3 * alone, "ratio": whole / alone}
