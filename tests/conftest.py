"""Two CPU devices, as on the smallest machine the project is for, and one compilation cache for the whole session.

The cache also serves the programs that tests start as subprocesses: what one compiled, the next one loads.
"""

import os
import tempfile

from tests import devices

os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", os.path.join(tempfile.gettempdir(), "vecpsmbpo-tests-jax"))
os.environ["XLA_FLAGS"] = devices.flags(2)

import jax
import pytest

from tests import looks, shapes

shapes.check_core()  # before anything imports it: fixtures import what they need
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


@pytest.fixture
def key() -> jax.Array:
    return jax.random.key(0)


@pytest.fixture
def mixed(tmp_path):
    """OPS-MBPO with a frozen seed and PS-MBPO with one that is behind."""
    frozen = looks.epochs([5, 6], seed=1)
    frozen[-1]["frozen"] = True
    ops = looks.write(tmp_path / "ops", looks.epochs([1, 2, 3]) + frozen, num_seeds=2)
    behind = looks.epochs([0, 1, 2]) + looks.epochs([2, 3], seed=1)
    ps = looks.write(tmp_path / "ps", behind, num_seeds=2, algo="ps_mbpo")
    return [ops, ps]


@pytest.fixture(scope="session")
def trained(tmp_path_factory):
    """N = M = 2 on the original cartpole, two seeds; a session's only run that is looked at."""
    from tests.helpers import command

    folder = tmp_path_factory.mktemp("trained")
    words = ["env=cartpole_swingup", "backend=host", "size=tiny", "total_steps=80", "report=true", "num_seeds=2"]
    words += ["keep_checkpoints=3"]
    result = command("train", *words, "run_dir=run", cwd=folder)
    assert result.returncode == 0, result.stderr
    return folder / "run"


@pytest.fixture(scope="session")
def short_run(tmp_path_factory):
    """A finished run by the host's driver of this process: its settings."""
    from tests.helpers import tiny
    from vecpsmbpo import training

    settings = tiny(env="ball_in_cup", backend="host", run_dir=tmp_path_factory.mktemp("short") / "run")
    assert training.train(settings) == 0
    return settings


@pytest.fixture(scope="session")
def policy(trained):
    """The best policy of its second seed, exported."""
    from vecpsmbpo import cli

    out = trained.parent / "policy"
    assert cli.main(["export", str(trained), "lane=1", f"out={out}"]) == 0
    return out


LONGEST = (
    "test_resume",
    "test_drivers",
    "test_envs",
    "test_run",
    "test_processes",
    "test_switches",
    "test_cli",
    "test_health",
    "test_damage",
    "test_interrupted",
    "test_adapters",
    "test_members",
    "test_export",
    "test_layout",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest files first, so that two workers end at about the same time."""
    rank = {name: index for index, name in enumerate(LONGEST)}
    items.sort(key=lambda item: rank.get(item.path.stem, len(rank)))
