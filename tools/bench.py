"""Measures the program against the machine, as ratios within one run.

    python tools/bench.py updates     SAC updates inside the real program, against the float32 matrix-product peak
    python tools/bench.py pieces      what XLA makes of one SAC update: products, fusions and copies inside the loop
    python tools/bench.py capacity    cost of a step at a large and at a small replay capacity
    python tools/bench.py program     cost of a step of the whole program, against its SAC updates alone
    python tools/bench.py profile     where the time of an epoch and its evaluation goes (default: the quick start)
    python tools/bench.py envs        steps per second and compile seconds of every task, on each backend and batch size
    python tools/bench.py host        host simulators stepped in a loop, by threads and by processes
    python tools/bench.py hosted      what a step around a host simulator costs besides simulating and learning
    python tools/bench.py compare     one policy of MBPO, here and in mbrl-lib (bench_peer.py says what it needs)

Further arguments are settings, as for `vecpsmbpo train` (of `envs`: tasks). One line of JSON per measurement.
"""

import json
import os
import re
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tools import bench_peer
from vecpsmbpo import config, envs, replay, runtime, sac
from vecpsmbpo.algorithms.ps_mbpo.algorithm import PsMbpo
from vecpsmbpo.drivers import ScanDriver
from vecpsmbpo.envs import registry, specs
from vecpsmbpo.layout import SEEDS
from vecpsmbpo.schedule import over_seeds
from vecpsmbpo.settings import SettingError, Settings
from vecpsmbpo.training.programs import initial_inputs, make_driver
from vecpsmbpo.types import Hyper, TrainState

PAPER = [
    "env=hopper",
    "n_models=4",
    "n_policies=6",
    "rollout_starts=4096",
    "horizon_last=1",
    "warmup_steps=250",
]
SMALL = ["env=cartpole_swingup", "size=cpu", "warmup_steps=250", "rollout_starts=2500"]
WORLD_STRIDES = 4
PROFILE_SECONDS = 150  # after which a large program's strides have been timed often enough


def best_seconds(run: Callable[[], Any], repeats: int) -> float:
    """The shortest of several runs: what the machine can do when nothing disturbs it."""
    seconds = []
    for _ in range(repeats):
        began = time.perf_counter()
        jax.block_until_ready(run())
        seconds.append(time.perf_counter() - began)
    return min(seconds)


def matmul_peak(size: int = 2048, repeats: int = 5) -> float:
    """FLOP/s of a large float32 matrix product on every device at once."""
    mesh = jax.sharding.Mesh(np.array(jax.devices()), ("devices",))
    spec = jax.sharding.PartitionSpec("devices")
    squares = jnp.ones((mesh.size, size, size), jnp.float32)
    operands = jax.device_put(squares, jax.sharding.NamedSharding(mesh, spec))
    product = jax.jit(jax.shard_map(lambda x: x @ x, mesh=mesh, in_specs=spec, out_specs=spec))
    jax.block_until_ready(product(operands))
    return mesh.size * 2 * size**3 / best_seconds(lambda: product(operands), repeats)


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


def driver_of(overrides: list[str]) -> ScanDriver:
    settings = config.compose([*overrides, *sys.argv[2:]])
    runtime.configure(settings)
    driver = make_driver(settings)
    if not isinstance(driver, ScanDriver):
        sys.exit(f"env={settings.env} backend={settings.backend}: only programs with MJX inside are measured")
    return driver


def past_warmup(driver: ScanDriver, **hyper: float) -> TrainState:
    """A state whose next strides learn, with some hyperparameters replaced."""
    settings = driver.settings
    keys, given = initial_inputs(settings)
    given = given.replace(**{name: jnp.full(settings.num_seeds, value) for name, value in hyper.items()})
    state, _ = driver.run(driver.init(keys, given), settings.first_learning_step // settings.stride)
    return state


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


def bench_updates() -> dict[str, Any]:
    driver = driver_of([*PAPER, "updates_per_step=10", "replay_capacity=20000", "imagined_capacity=20480"])
    settings, spec = driver.settings, driver.algorithm.spec
    state = driver.init(*initial_inputs(settings))
    peaks = [matmul_peak()]
    seconds = seconds_per_update(driver, state, 3) / settings.updates_per_step
    peaks.append(matmul_peak())
    rate = settings.n_members * update_flops(settings, spec.obs_size, spec.action_size) / seconds
    return {
        "members": settings.n_members,
        "width": settings.policy_hidden_size,
        "batch": settings.policy_batch_size,
        "ms_per_update_of_all_members": 1e3 * seconds,
        "member_updates_per_s": settings.n_members / seconds,
        "gflops": rate / 1e9,
        "matmul_peak_gflops": max(peaks) / 1e9,
        "share_of_peak": rate / max(peaks),
    }


def bench_pieces() -> dict[str, Any]:
    settings = config.compose([*PAPER, *sys.argv[2:]])
    runtime.configure(settings)
    return {"task": settings.env, "width": settings.policy_hidden_size, **pieces_of_update(settings)}


def pieces_of_update(settings: Settings) -> dict[str, int]:
    """How many instructions of each kind the compiled loop over G updates of one member has in its body."""
    spec = specs.get(settings.env)
    nets, key = sac.make_networks(settings, spec), jax.random.key(0)

    def inputs() -> tuple:
        shape = (settings.updates_per_step, settings.policy_batch_size)
        rows = jnp.zeros((*shape, replay.row_size(spec.obs_size, spec.action_size)))
        batches = replay.unpack(rows, spec.obs_size, spec.action_size)
        noise = sac.Noise.draw(key, (*shape, spec.action_size))
        return sac.init(key, nets, spec), batches, noise, Hyper.of(settings), sac.Limits(jnp.zeros(()), jnp.zeros(()))

    def run(agent: Any, batches: Any, noise: Any, hyper: Hyper, limits: sac.Limits) -> Any:
        known = limits if settings.clip_targets else None
        every = settings.target_update_every
        return sac.updates(agent, batches, noise, hyper, nets=nets, limits=known, target_every=every)

    return loop_pieces(jax.jit(run).lower(*jax.eval_shape(inputs)).compile().as_text())


def loop_pieces(program: str) -> dict[str, int]:
    """Of an XLA program in its text form: what is in the bodies of its loops, and in all that these call.

    Raises:
        ValueError: there is no loop.
    """
    computations = dict(re.findall(r"^(?:ENTRY )?%?([\w.\-]+) \([^\n]*\{\n(.*?)^\}", program, re.M | re.S))
    called = r"(?:calls|to_apply|body|condition|\w+_computations?)=\{?([^,}\s]+(?:, %[^,}\s]+)*)"
    seen: set[str] = set()
    waiting = re.findall(r" while\(.*body=%?([\w.\-]+)", program)
    if not waiting:
        raise ValueError("the program has no loop: XLA unrolls one of a single update")
    while waiting:
        name = waiting.pop()
        if name not in seen:
            seen.add(name)
            for parts in re.findall(called, computations[name]):
                waiting += [part.lstrip("%") for part in parts.split(", ")]
    body = "".join(computations[name] for name in seen)
    products = len(re.findall(r" dot\(|custom_call_target=\"[^\"]*(?:gemm|matmul)", body))
    return {"products": products, "fusions": body.count(" fusion("), "copies": body.count(" copy(")}


def bench_capacity() -> dict[str, Any]:
    drivers = {
        size: driver_of([*SMALL, f"replay_capacity={size}", f"imagined_capacity={size}"])
        for size in (20_000, 1_000_000)
    }
    seconds: dict[int, float] = {}
    for _ in range(3):  # in turn, so that a machine whose speed drifts does not favour one
        for size, driver in drivers.items():
            seconds[size] = min(seconds.get(size, np.inf), seconds_per_step(driver, 2))
    small, large = seconds.values()
    return {"ms_per_step_at_2e4": 1e3 * small, "ms_per_step_at_1e6": 1e3 * large, "ratio": large / small}


def bench_program() -> dict[str, Any]:
    driver = driver_of(SMALL)
    state = past_warmup(driver)
    alone, whole = np.inf, np.inf
    for _ in range(3):
        alone = min(alone, seconds_per_update(driver, state, 10))
        whole = min(whole, seconds_per_step(driver, 2))
    return {"ms_per_step": 1e3 * whole, "ms_of_updates_alone": 1e3 * alone, "ratio": whole / alone}


def bench_profile() -> dict[str, Any]:
    """Strides of the real program are timed one by one: before the warm-up is over they are the world alone, then
    updates come on top, and at the start of every period a refresh. What cannot be told apart so is timed by itself.
    A stride by itself pays for being started and for its news, which a run pays once for an epoch: it counts as acting.
    """
    driver = driver_of([] if sys.argv[2:] else ["env=cartpole_swingup", "size=cpu"])
    settings, algorithm, layout = driver.settings, driver.algorithm, driver.layout
    strides, warm = settings.epoch_steps // settings.stride, settings.first_learning_step // settings.stride
    if not isinstance(algorithm, PsMbpo) or settings.model_update_every == settings.stride or warm < WORLD_STRIDES + 1:
        sys.exit("profile: needs SAC, periods of more than a stride, and a warm-up of more than 100 steps")
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
        if learning and time.perf_counter() - began > PROFILE_SECONDS:
            break
    evaluate = lambda: driver.evaluate(state, keys, settings.eval_episodes)  # noqa: E731
    evaluate()
    evaluating = best_seconds(evaluate, 2)
    lanes = len(settings.lanes) // layout.mesh.shape[SEEDS]  # of a device
    stepping = (
        lanes * settings.epoch_steps / mjx_steps(settings.env, lanes, **dict(settings.env_options))["steps_per_s"]
    )
    imagining = seconds_per_imagining(driver, state) * settings.refreshes_per_epoch if settings.imagines else 0.0
    refresh = settings.refreshes_per_epoch * max(np.mean(refreshing) - np.median(learning), 0.0)
    seconds_of = {
        "updating": strides * (np.median(learning) - np.median(world)),
        "fitting": max(refresh - imagining, 0.0),
        "imagining": imagining,
        "stepping": stepping,
        "acting_and_observing": strides * np.median(world) - stepping,
        "evaluating": evaluating,
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


def bench_envs() -> list[dict[str, Any]]:
    """Every task (or those named) on every backend that it has; actions are uniform."""
    found = []
    for backend in ("mjx", "host"):
        for name in registry.names(backend):
            if sys.argv[2:] and name not in sys.argv[2:]:
                continue
            for batch in (1, 10, 100):
                measure = mjx_steps if backend == "mjx" else host_steps
                found.append({"env": name, "backend": backend, "batch": batch, **measure(name, batch)})
                print(found[-1], file=sys.stderr, flush=True)
    return found


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


def bench_host() -> list[dict[str, Any]]:
    """Steps per second of a batch of simulators: one after the other (as `HostEnv` does it), each handed to a pool of
    threads or to a process of its own (Gymnasium's `AsyncVectorEnv`, which has Gymnasium's tasks only)."""
    found = []
    for name in sys.argv[2:] or ("hopper", "ball_in_cup", "window_open"):
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
            found.append(row)
    return found


def bench_compare() -> dict[str, Any]:
    try:
        return bench_peer.compare(sys.argv[2:])
    except SettingError as error:
        print(f"bench: {error}", file=sys.stderr)
        sys.exit(2)


def bench_hosted() -> dict[str, Any]:
    """Of a step around a simulator of the host what is neither the simulator nor learning: acting, observing, and the
    way to the device and back."""
    settings = config.compose(["env=hopper", "size=cpu", "warmup_steps=1000", *sys.argv[2:], "backend=host"])
    runtime.configure(settings)
    driver = make_driver(settings)
    state = driver.init(*initial_inputs(settings))
    driver.compile(state)
    strides = settings.model_update_every // settings.stride
    state, _ = driver.run(state, strides)
    seconds = []
    for _ in range(2):
        began = time.perf_counter()
        state, _ = driver.run(state, strides)
        seconds.append((time.perf_counter() - began) / settings.model_update_every)
    lanes = len(settings.lanes)
    simulator = lanes / host_steps(settings.env, lanes)["steps_per_s"]
    return {
        "task": settings.env,
        "seeds": lanes,
        "members": settings.n_members,
        "ms_per_step": 1e3 * min(seconds),
        "ms_of_simulator": 1e3 * simulator,
        "ms_around_it": 1e3 * (min(seconds) - simulator),
    }


BENCHES = {
    "hosted": bench_hosted,
    "compare": bench_compare,
    "envs": bench_envs,
    "host": bench_host,
    "updates": bench_updates,
    "pieces": bench_pieces,
    "capacity": bench_capacity,
    "program": bench_program,
    "profile": bench_profile,
}

if __name__ == "__main__":
    if {"-h", "--help"} & set(sys.argv):
        sys.exit(print(__doc__))
    if len(sys.argv) < 2 or sys.argv[1] not in BENCHES:
        print(f"bench: takes one of {', '.join(BENCHES)}, then settings", file=sys.stderr)
        sys.exit(2)
    results = BENCHES[sys.argv[1]]()
    machine = {"bench": sys.argv[1]}
    if sys.argv[1] != "compare":  # which leaves the devices to the programs that it starts
        machine |= {"devices": jax.device_count(), "platform": jax.default_backend()}
    for result in results if isinstance(results, list) else [results]:
        print(json.dumps({**machine, **result}))
