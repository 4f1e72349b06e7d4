"""Compares every MJX port with its original simulator, as a table and as CSV.

    python tools/parity.py [task ...] [states=2000] [episodes=30] [run_dir=RUN ...] [output=results/parity.csv]

For each task:
    step        one control step from the same simulator state and action: errors of observation and reward, and
                agreement of `terminated`; states from random policies (fresh every step, and held for ten), from states
                placed near every termination threshold, and from the trained policy of each run directory given.
                `obs_*`: the largest error of a coordinate over the largest coordinate of the observation, or over 1
                if that is less; `coordinate_p99`: the largest error in units of its coordinate's standard deviation
    reset       two-sample Kolmogorov-Smirnov tests of every coordinate of initial states: the smallest p-value times
                their number (Bonferroni), and which coordinate has it
    episodes    return and length of each policy's whole episodes on both backends, mean and standard error, and the
                p-values of two-sample Kolmogorov-Smirnov tests
"""

import csv
import itertools
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import scipy.stats
from rich.console import Console
from rich.table import Table

import vecpsmbpo
from vecpsmbpo import arguments, envs
from vecpsmbpo.envs import registry, termination
from vecpsmbpo.envs.mjx.simulator import Physics

Policy = Callable[[jax.Array, jax.Array, jax.Array], jax.Array]  # obs [..., O], t, key -> action [..., A]
NEAR = 1e-4  # a state this close to a termination threshold may fall on either side in float32


@dataclass
class Step:
    """Original states and what one control step makes of them; T rows each."""

    qpos: np.ndarray
    qvel: np.ndarray
    warmstart: np.ndarray
    seen: np.ndarray
    contacts: np.ndarray
    action: np.ndarray
    next_obs: np.ndarray
    reward: np.ndarray
    terminated: np.ndarray


def simulator_data(host: Any) -> Any:
    """`mjData` of the first simulator of a host environment."""
    env = host.simulators[0].env
    return env.physics.data if hasattr(env, "physics") else env.unwrapped.data


def uniform(held: int, action_size: int) -> Policy:
    """Uniform actions, each held for `held` steps."""

    def act(obs: jax.Array, t: jax.Array, key: jax.Array) -> jax.Array:
        shape = (*obs.shape[:-1], action_size)
        return jax.random.uniform(jax.random.fold_in(key, t // held), shape, minval=-1.0, maxval=1.0)

    return act


# Indices into qpos and the values of them at which a task ends.
THRESHOLDS = {
    "ant": [(2, termination.ANT_MIN_HEIGHT), (2, termination.ANT_MAX_HEIGHT)],
    "hopper": [(1, termination.HOPPER_MIN_HEIGHT)] + [(2, sign * termination.HOPPER_MAX_ANGLE) for sign in (-1, 1)],
    "walker2d": [(1, termination.WALKER_MIN_HEIGHT), (1, termination.WALKER_MAX_HEIGHT)]
    + [(2, sign * termination.WALKER_MAX_ANGLE) for sign in (-1, 1)],
}
AROUND = 0.02  # m or rad, how near to a threshold states are placed


def place_near_threshold(host: Any, thresholds: list[tuple[int, float]], random: np.random.Generator) -> None:
    """Puts the first simulator of a host environment where its next step may terminate."""
    core = host.simulators[0].env.unwrapped
    index, value = thresholds[random.integers(len(thresholds))]
    qpos = np.array(core.data.qpos)
    qpos[index] = value + random.uniform(-AROUND, AROUND)
    core.set_state(qpos, np.array(core.data.qvel))


def collect(name: str, policy: Policy, states: int, seed: int, *, near: bool = False) -> Step:
    """Steps the original with `policy`; with `near`, every step from a state near a termination threshold."""
    host, act, random = envs.make(name, "host", seed=seed), jax.jit(policy), np.random.default_rng(seed)
    obs, rows = host.reset()[0], []
    for t in range(states):
        if near:
            if t % 10 == 0:  # joints and velocities as they are early in an episode
                obs = host.reset()[0]
            place_near_threshold(host, THRESHOLDS[name], random)
        data = simulator_data(host)
        seen = np.array(data.qpos)
        if data.model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE:
            seen[:3] = data.xpos[data.model.jnt_bodyid[0]]
        action = np.asarray(act(obs, t, jax.random.key(seed)))
        before = [np.array(x) for x in (data.qpos, data.qvel, data.qacc_warmstart)]
        step = host.step(action[None])
        contacts = simulator_data(host).ncon
        rows.append((*before, seen, contacts, action, step.next_obs[0], step.reward[0], step.terminated[0]))
        obs = step.obs[0]
    return Step(*map(np.array, zip(*rows, strict=True)))


class Port:
    """An MJX port with its functions compiled once, over a batch of any one size."""

    def __init__(self, name: str):
        self.env = envs.make(name, "mjx")

        def one(physics, action):
            state = self.env.state_at(physics.qpos, physics.qvel).replace(pipeline_state=physics)
            state = self.env.step(state, action)
            return state.obs, state.reward, state.done

        self.step = jax.jit(jax.vmap(one))
        self.reset = jax.jit(jax.vmap(self.env.reset))

    def repeat(self, steps: Step) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """obs [T, O], reward [T], terminated [T] bool of the same steps."""
        numbers = (jnp.asarray(x, jnp.float32) for x in (steps.qpos, steps.qvel, steps.warmstart, steps.seen))
        obs, reward, done = map(np.asarray, self.step(Physics(*numbers), jnp.asarray(steps.action, jnp.float32)))
        return obs, reward, done.astype(bool)


def near_threshold(env: Any, obs: np.ndarray) -> np.ndarray:
    """[T] bool: a shift of 1e-4 of any one coordinate would change `terminated`."""
    shifts = NEAR * np.concatenate([np.eye(obs.shape[1]), -np.eye(obs.shape[1])])
    shifted = jnp.asarray(obs[:, None] + shifts, jnp.float32)
    verdicts = np.asarray(env.spec.terminated(shifted, None, shifted))
    return verdicts.any(axis=1) != verdicts.all(axis=1)


def compare_steps(port: Port, steps: Step) -> dict[str, float]:
    """The errors of the port on the original's steps."""
    obs, reward, terminated = port.repeat(steps)
    scale = np.maximum(1.0, np.abs(steps.next_obs).max(axis=1))
    error = np.abs(obs - steps.next_obs).max(axis=1) / scale
    deviation = steps.next_obs.std(axis=0)
    by_coordinate = np.abs(obs - steps.next_obs) / np.where(deviation > 0, deviation, 1.0)
    reward_error = np.abs(reward - steps.reward) / np.maximum(1.0, np.abs(steps.reward))
    clear = ~near_threshold(port.env, steps.next_obs)
    return {
        "states": len(error),
        "in_contact": float(np.mean(steps.contacts > 0)),
        "terminations": int(steps.terminated.sum()),
        "near_threshold": int((~clear).sum()),
        "obs_p50": float(np.median(error)),
        "obs_p99": float(np.quantile(error, 0.99)),
        "obs_max": float(error.max()),
        "coordinate_p99": float(np.quantile(by_coordinate.max(axis=1), 0.99)),
        "reward_p99": float(np.quantile(reward_error, 0.99)),
        "reward_max": float(reward_error.max()),
        "terminated_agree": float(np.mean(terminated[clear] == steps.terminated[clear])),
    }


def _same_distribution(one: np.ndarray, other: np.ndarray) -> float:
    """p-value of a two-sample Kolmogorov-Smirnov test."""
    return float(scipy.stats.ks_2samp(one, other, method="asymp").pvalue)


def compare_resets(port: Port, name: str, count: int) -> tuple[float, int]:
    """The smallest p-value over the coordinates times their number, and the coordinate that has it. One that never
    varies must be the same on both: 0 if it is not."""
    ours = np.asarray(port.reset(jax.random.split(jax.random.key(0), count)).obs)
    host = envs.make(name, "host", seed=1)
    theirs = np.concatenate([host.reset() for _ in range(count)])
    values = []
    for one, other in zip(ours.T, theirs.T, strict=True):
        if np.ptp(other) > 0:
            values.append(_same_distribution(one, other))
        else:
            values.append(float(np.allclose(one, other, atol=1e-6)))
    worst = int(np.argmin(values))
    return min(1.0, values[worst] * len(values)), worst


def compare_episodes(port: Port, name: str, policy: Policy, count: int) -> dict[str, float]:
    """`count` whole episodes of `policy` on each backend: mean and standard error of return and length, and the
    p-values of two-sample Kolmogorov-Smirnov tests of both."""
    env, limit, act = port.env, port.env.spec.episode_length, jax.jit(policy)

    def step(carry):
        t, state, alive, total, length = carry
        state = jax.vmap(env.step)(state, policy(state.obs, t, jax.random.key(3)))
        total, length = total + jnp.where(alive, state.reward, 0.0), length + alive
        return t + 1, state, alive & (state.done == 0), total, length

    def running(carry):
        return (carry[0] < limit) & jnp.any(carry[2])

    @jax.jit
    def episodes(key):
        state = jax.vmap(env.reset)(jax.random.split(key, count))
        start = (0, state, jnp.ones(count, bool), jnp.zeros(count), jnp.zeros(count, jnp.int32))
        return jax.lax.while_loop(running, step, start)[3:]

    ours = [np.asarray(x, float) for x in episodes(jax.random.key(2))]
    host = envs.make(name, "host", num_envs=count, seed=5)
    obs = host.reset()
    total, length, alive = np.zeros(count), np.zeros(count), np.ones(count, bool)
    for t in itertools.count():
        if not alive.any():
            break
        news = host.step(np.asarray(act(obs, t, jax.random.key(4))))
        obs, total, length = news.obs, total + np.where(alive, news.reward, 0.0), length + alive
        alive &= ~(news.terminated | news.truncated)
    found = {
        f"{what}_p": _same_distribution(mine, theirs)
        for what, mine, theirs in zip(("return", "length"), ours, (total, length), strict=True)
    }
    for backend, values in (("mjx", ours), ("host", (total, length))):
        for what, value in zip(("return", "length"), values, strict=True):
            found[f"{what}_{backend}"] = float(value.mean())
            found[f"{what}_{backend}_se"] = float(value.std(ddof=1) / np.sqrt(count))
    return found


def trained_policy(run_dir: str) -> tuple[str, Policy]:
    """The task of a run, and its policy."""
    run = vecpsmbpo.load(run_dir)
    policy = run.policy
    return run.settings.env, lambda obs, t, key: policy(obs)


def rows_of(name: str, trained: dict[str, Policy], states: int, episodes: int) -> Iterator[dict[str, Any]]:
    """The lines of the table about one task."""
    port = Port(name)
    size = port.env.action_size
    policies = {"random": uniform(1, size), "held": uniform(10, size), **trained}
    reset_p, worst = compare_resets(port, name, 3000)
    shared = {"reset_p": reset_p, "reset_worst": worst}
    for seed, (label, policy) in enumerate(policies.items()):
        steps = compare_steps(port, collect(name, policy, states, seed))
        yield {"task": name, "states_from": label, **steps, **shared, **compare_episodes(port, name, policy, episodes)}
    if name in THRESHOLDS:
        steps = compare_steps(port, collect(name, policies["random"], states, seed=99, near=True))
        yield {"task": name, "states_from": "near termination", **steps}


OPTIONS = {
    "states": arguments.whole("compared, of each way to come to them", 2000, at_least=1),
    "episodes": arguments.whole("whose returns are compared", 30, at_least=1),
    "output": arguments.out("the table", "results/parity.csv", ".csv"),
}


def main(words: Sequence[str]) -> int:
    alone, options = arguments.parse("parity", words, OPTIONS)
    states, episodes = options["states"], options["episodes"]
    names = [word for word in alone if word in registry.TASKS] or registry.names("mjx")
    for name in names:
        registry.resolve_backend(name, "mjx")
    run_dirs = [word for word in alone if word not in registry.TASKS]
    runs = [(Path(run_dir).name, *trained_policy(run_dir)) for run_dir in run_dirs]
    rows: list[dict[str, Any]] = []
    with options["output"].open("w") as file:
        for name in names:
            trained = {run_dir: policy for run_dir, task, policy in runs if task == name}
            for row in rows_of(name, trained, states, episodes):
                if not rows:
                    writer = csv.DictWriter(file, row, lineterminator="\n", restval="")
                    writer.writeheader()
                rows.append(row)
                writer.writerow({k: f"{v:.3g}" if isinstance(v, float) else v for k, v in row.items()})
                file.flush()  # a long job that is cut short keeps what it has
    shown = [column for column in rows[0] if not column.endswith("_se")]
    table = Table(*shown, title="MJX float32 against the original")
    for row in rows:
        values = (row.get(column, "") for column in shown)
        table.add_row(*(f"{value:.2g}" if isinstance(value, float) else str(value) for value in values))
    Console(width=250).print(table)
    return 0


if __name__ == "__main__":
    sys.exit(arguments.as_tool("parity", main, __doc__, OPTIONS))
