"""What several tests need: tiny settings, and the algorithm on an environment that is in no registry."""

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import jax
import numpy as np

from tests import devices
from vecpsmbpo import config, dynamics, evaluate, jsonl, metrics, placement
from vecpsmbpo.algorithms.base import Algorithm
from vecpsmbpo.envs.host.batched import HostEnv
from vecpsmbpo.programs import initial_inputs, make_algorithm
from vecpsmbpo.settings import Settings
from vecpsmbpo.types import EnvSpec, Hyper, Model, SeedState

PROJECT = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
METRICS = {
    "env_steps", "seed", "eval_return", "eval_length", "train_return", "model_loss", "model_val_mse", "critic_loss",
    "actor_loss", "alpha", "q_mean", "real_ratio", "env_steps_per_s", "updates_per_s", "imagined_per_s",
    "seconds",
}  # fmt: skip
# Every column is in docs/logs.md.
EXPLAINED = set(re.findall(r"`(\w+)`", (Path(__file__).parents[1] / "docs" / "logs.md").read_text()))
EPISODE = {
    "seed", "episode", "env_steps", "model", "policy", "return", "length", "terminated", "truncated", "random", "probs",
}  # fmt: skip


def pinned(package: str) -> str:
    """What pyproject.toml asks for of a package that it pins: `dm-control==1.0.49`."""
    return next(text.split(";")[0] for text in PROJECT["dependencies"] if text.startswith(f"{package}=="))


def tiny(**changes: Any) -> Settings:
    """`size=tiny` with changes."""
    return config.compose(["size=tiny", *(f"{name}={value}" for name, value in changes.items())])


def new_model(key: jax.Array, settings: Settings, spec: EnvSpec, hyper: Hyper | None = None) -> Model:
    """A dynamics model before its first fit."""
    net = dynamics.network(settings, spec)
    return dynamics.init(key, hyper or Hyper.of(settings), net=net, settings=settings, spec=spec)


def constant(params: Any, outputs: jax.Array) -> Any:
    """Parameters of a network that answers `outputs` [..., K] whatever it is asked."""
    params = jax.tree.map(jax.numpy.zeros_like, params)
    last = sorted(name for name in params["params"] if name.startswith("Dense"))[-1]
    params["params"][last]["bias"] = outputs
    return params


def algorithm(settings: Settings, spec: EnvSpec) -> Any:
    return make_algorithm(settings, spec)


def initial(algorithm: Algorithm) -> SeedState:
    """The state of all seeds before the first step."""
    specs = algorithm.layout.specs().seeds
    init = algorithm.layout.jit_shard_map(jax.vmap(algorithm.init), (specs.key, specs.key), specs)
    return init(*initial_inputs(algorithm.settings))


def command(*arguments: str, cwd: Path, one_thread: bool = False, **kwargs: Any) -> subprocess.CompletedProcess:
    """Runs `vecpsmbpo` as a user would."""
    return subprocess.run(
        argv(*arguments, one_thread=one_thread),
        cwd=cwd,
        env=environment(),
        capture_output=True,
        text=True,
        timeout=600,
        **kwargs,
    )


def argv(*arguments: str, one_thread: bool = False) -> list[str]:
    """`one_thread` runs on a single core: one device, whose results are reproducible to the bit."""
    return [*(_one_core() if one_thread else []), sys.executable, "-m", "vecpsmbpo.cli", *arguments]


def _one_core() -> list[str]:
    """What a command begins with that shall have one core: of several pytest workers each another."""
    if not shutil.which("taskset"):  # on macOS
        return ["env", f"XLA_FLAGS={devices.flags(1)}"]
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    cores = sorted(os.sched_getaffinity(0))
    return ["taskset", "-c", str(cores[worker % len(cores)])]


def environment(count: int | None = None) -> dict[str, str]:
    """The program's own, or with so many devices: without those that the tests set up for themselves."""
    return {**os.environ, "XLA_FLAGS": devices.flags(count)}


def check_log(run_dir: Path, settings) -> None:
    """Every epoch and episode of every lane exactly once, with every field."""
    lanes = [tuple(metrics.lane_of(settings, index).items()) for index in range(len(settings.lanes))]
    names = [name for name, _ in lanes[0]]

    def of(lane, lines):
        return [line for line in lines if tuple((name, line[name]) for name in names) == lane]

    epochs, episodes = (jsonl.read(run_dir / name) for name in ("metrics.jsonl", "episodes.jsonl"))
    steps = list(range(settings.epoch_steps, settings.total_steps + 1, settings.epoch_steps))
    assert len(epochs) == len(lanes) * len(steps)
    for lane in lanes:
        assert [line["env_steps"] for line in of(lane, epochs)] == steps
        own = of(lane, episodes)
        assert [line["episode"] for line in own] == list(range(1, len(own) + 1))
        assert all(set(line) == EPISODE | set(names) for line in own)
        assert sum(line["length"] for line in own) > settings.total_steps - settings.episode_length
        assert np.allclose([np.sum(line["probs"]) for line in own], 1.0, atol=1e-5)
    assert all(set(line) >= METRICS | set(names) for line in epochs)
    assert {name for line in [*epochs, *episodes] for name in line} <= EXPLAINED | set(names)
    assert list((run_dir / "tensorboard").iterdir())


def without_times(lines: list[dict]) -> list[dict]:
    """Lines without what depends on the clock."""
    clock = {"env_steps_per_s", "updates_per_s", "imagined_per_s", "seconds", "compile_seconds"}
    return [{name: value for name, value in line.items() if name not in clock} for line in lines]


def final_parameters(run_dir: Path) -> list[np.ndarray]:
    """Every array of the newest checkpoint's state."""
    settings = config.load(run_dir)
    driver, saved = evaluate.restore(settings)
    assert saved.step == settings.total_steps
    leaves = jax.tree.leaves(placement.unpad(driver.layout, saved.state))
    is_key = lambda x: jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key)  # noqa: E731
    return [np.asarray(jax.random.key_data(leaf) if is_key(leaf) else leaf) for leaf in leaves]


def files_of(folder: Path) -> dict[str, bytes]:
    """What each file below a folder holds."""
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def assert_same_run(run_dir: Path, other: Path) -> None:
    for ours, theirs in zip(final_parameters(run_dir), final_parameters(other), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    for file in ("metrics.jsonl", "episodes.jsonl"):
        assert without_times(jsonl.read(run_dir / file)) == without_times(jsonl.read(other / file))
    check_log(run_dir, config.load(run_dir))


def assert_probabilities_follow(lines: list[dict], n_models: int, settings: Settings) -> np.ndarray:
    """Equation 19 from the episodes of one lane alone; what each member has earned [N, M] at their end."""
    earned = np.zeros((n_models, settings.n_policies))
    for line in lines:
        logits = (earned - earned.max()) / settings.temperature
        np.testing.assert_allclose(line["probs"], np.exp(logits) / np.exp(logits).sum(), atol=1e-5)
        if not line["random"]:
            earned[line["model"], line["policy"]] += line["return"]
    return earned


def assert_resumes_exactly(env: HostEnv, other: HostEnv, episode_length: int) -> None:
    """What `env` saves, `other` loads and goes on from, bit for bit.

    Saved in the middle of an episode, one step before a reset, at it, and after it.
    """
    env.episode_length = other.episode_length = episode_length
    random = np.random.default_rng(0)
    env.reset()
    other.reset()
    for moment in (episode_length // 2, episode_length - 1, episode_length, 7):
        for _ in range(moment):
            env.step(random.uniform(-1, 1, (2, env.spec.action_size)))
        np.testing.assert_array_equal(other.load(json.loads(json.dumps(env.save()))), env._obs)
        for _ in range(episode_length + 10):
            actions = random.uniform(-1, 1, (2, env.spec.action_size))
            for ours, theirs in zip(env.step(actions), other.step(actions), strict=True):
                np.testing.assert_array_equal(ours, theirs)
