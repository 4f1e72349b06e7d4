"""What several tests need: tiny settings, and the algorithm on an environment that is in no registry."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax

from vecpsmbpo import config
from vecpsmbpo.algorithms.ps_mbpo import PsMbpo
from vecpsmbpo.layout import Layout
from vecpsmbpo.settings import Settings
from vecpsmbpo.train import initial_inputs
from vecpsmbpo.types import EnvSpec, SeedState


def tiny(**changes: Any) -> Settings:
    """`size=tiny` with changes."""
    return config.compose(["size=tiny", *(f"{name}={value}" for name, value in changes.items())])


def algorithm(settings: Settings, spec: EnvSpec) -> PsMbpo:
    return PsMbpo(settings, spec, Layout.of(settings))


def initial(algorithm: PsMbpo) -> SeedState:
    """The state of all seeds before the first step."""
    specs = algorithm.layout.specs().seeds
    init = algorithm.layout.spread(jax.vmap(algorithm.init), (specs.key, specs.key), specs)
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
    prefix = ["taskset", "-c", "0"] if one_thread else []
    return [*prefix, sys.executable, "-m", "vecpsmbpo.cli", *arguments]


def environment() -> dict[str, str]:
    """The program's own: without the devices that the tests set up for themselves."""
    return {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
