"""Sets JAX up for a run. Must come before the first array: a backend cannot be changed once it is there."""

import functools
import logging
import os
import re
import subprocess
import sys
import warnings
from pathlib import Path

import jax

from vecpsmbpo import processes, words
from vecpsmbpo.settings import SettingError, Settings

SINGLE_THREADED = "--xla_cpu_multi_thread_eigen=false"
COUNT_FLAG = "xla_force_host_platform_device_count"  # who gives it has said how many CPU devices there are


def configure(settings: Settings) -> None:
    """One CPU device per core, the other processes of the run, and the compilation cache.

    Each CPU device computes on one thread: members spread over devices use the cores better than threads inside small
    matrix products do, and results do not depend on the scheduling of threads. How many of them a run uses is decided
    by `layout`: the jobs of a multirun share a process, and differ in that. JAX ignores the CPU settings where there is
    a GPU.

    Raises:
        SettingError: XLA does not know a flag in XLA_FLAGS, JAX is told to compute in float64, it finds no device, or
            not the one that JAX_PLATFORMS asks for, or the other processes are not there.
    """
    check_float32()
    flags = os.environ.get("XLA_FLAGS", "")
    if others := flags.replace(SINGLE_THREADED, "").strip():
        _check_flags(others)
    if "xla_cpu_multi_thread_eigen" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {SINGLE_THREADED}".strip()
    if COUNT_FLAG not in flags:
        try:
            jax.config.update("jax_num_cpu_devices", _cores())
        except RuntimeError:  # a backend is there already: an earlier run's, or of a program that imports this package
            logging.getLogger(__name__).debug("JAX is already initialised; its devices are used as they are")
    processes.join(settings.distributed)
    jax.config.update("jax_enable_compilation_cache", settings.compile_cache)
    if settings.compile_cache:
        jax.config.update("jax_compilation_cache_dir", str(cache_dir()))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 1.0)
        jax.config.update("jax_raise_persistent_cache_errors", False)
        # Where memory is out the run itself says so; what the cache could not read then is compiled, or fails, too.
        out_of_memory = r"Error (reading|writing) persistent compilation cache entry .*MemoryError"
        warnings.filterwarnings("ignore", message=out_of_memory)
    try:
        jax.devices()
    except (RuntimeError, AssertionError) as error:  # the latter where a plug-in is there and its hardware is not
        asked = os.environ.get("JAX_PLATFORMS")
        what = f"JAX_PLATFORMS={asked}: no such device here" if asked else f"JAX finds no device ({words.of(error)})"
        raise SettingError(what) from None


def idle_cores(settings: Settings) -> str:
    """In words, where JAX was started before this package with fewer CPU devices than a run could use; else nothing."""
    devices = jax.devices()
    wanted = min(settings.devices or _cores(), _cores())
    if devices[0].platform != "cpu" or len(devices) >= wanted or COUNT_FLAG in os.environ.get("XLA_FLAGS", ""):
        return ""
    return (
        f"JAX was started before vecpsmbpo, with {len(devices)} device(s), where {wanted} cores could work; train "
        "before anything else makes a JAX array"
    )


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def check_float32() -> None:
    """Raises:
    SettingError: JAX is told to compute in float64, by the environment or by a task's own code.
    """
    if jax.config.values["jax_enable_x64"]:
        raise SettingError("jax_enable_x64 (JAX_ENABLE_X64): must be off, since this program computes in float32")


@functools.cache
def _check_flags(flags: str) -> None:
    """That XLA knows the `flags` in XLA_FLAGS: it ends the process over one that it does not know."""
    tried = subprocess.run(
        [sys.executable, "-c", "import jax; jax.devices('cpu')"],
        env={**os.environ, "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        check=False,
    )
    if tried.returncode:
        lines = (tried.stderr.strip() or "XLA does not take them").splitlines()
        of_xla = [line.rpartition("] ")[2] for line in lines if re.match(r"[EF]\d{4} ", line)]  # before pages of advice
        raise SettingError(f"XLA_FLAGS={flags}: {[*of_xla, lines[-1]][0]}")


def cache_dir() -> Path:
    """Where compiled programs are kept: `JAX_COMPILATION_CACHE_DIR`, or below the user's cache directory."""
    if chosen := os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        return Path(chosen)
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "vecpsmbpo" / "jax"
