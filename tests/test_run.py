"""Whole runs through the command line: every task and driver, and several at once."""

import importlib.util
import math
from importlib import resources

import jax
import numpy as np
import pytest
import yaml

from tests.helpers import METRICS, check_log, command
from vecpsmbpo import config, jsonl, versions
from vecpsmbpo.envs import registry


def _usual(name: str, backend: str):
    """All tasks on all backends take ten minutes (`pytest -m slow`): the usual tests run one of each driver."""
    usual = (name, backend) in (("hopper", "mjx"), ("window_open", "host"))
    return pytest.param(name, backend, marks=[] if usual else pytest.mark.slow)


@pytest.mark.parametrize(
    ("name", "backend"), [_usual(name, backend) for backend in ("mjx", "host") for name in registry.names(backend)]
)
def test_every_task_runs_end_to_end_and_resumes_on_every_backend(name, backend, tmp_path):
    begun = command(
        "train", f"env={name}", f"backend={backend}", "size=tiny", "run_dir=run", "total_steps=80", cwd=tmp_path
    )
    assert begun.returncode == 0, begun.stderr
    for said in ("memory: ", "compil", "steps/s", "updates/s", "imagined/s", "left ", "saved at step 80 of 80"):
        assert said in begun.stdout
    assert begun.stdout.startswith(f"{versions.line()}; devices: ")
    result = command("train", "run_dir=run", "total_steps=120", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "resuming at step 80" in result.stdout
    sessions = jsonl.read(tmp_path / "run" / "sessions.jsonl")
    assert [line.pop("env_steps") for line in sessions] == [0, 80]
    assert set(sessions[0].pop("devices")) == {jax.devices()[0].device_kind}
    assert sessions[0].pop("machine") == versions.machine()
    assert sessions[0] == versions.current()
    settings = config.load(tmp_path / "run")
    assert settings.backend == backend
    check_log(tmp_path / "run", settings)
    last = jsonl.read(tmp_path / "run" / "metrics.jsonl")[-1]
    assert all(np.isfinite(last[field]) for field in METRICS - {"train_return"})
    assert last["compile_seconds"] > 0.5


@pytest.mark.slow
@pytest.mark.parametrize("experiment", config.options("experiment"))
def test_every_experiment_runs(experiment, tmp_path):
    """And is drawn: all that it compares, on the task of it that compiles fastest and with few models and policies."""
    tasks, quick = _swept(experiment, "env"), ("ball_in_cup", "cartpole_swingup_sparse", "window_open", "hopper")
    narrowed = [f"env={next(task for task in quick if task in tasks)}"]
    fewer = [f"{name}=1,2" for name in ("n_models", "n_policies") if len(_swept(experiment, name)) > 2]
    chosen = [f"experiment={experiment}", "size=tiny", "total_steps=80", *narrowed, *fewer]
    result = command("train", "-m", *chosen, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    runs = list((tmp_path / "runs" / experiment).iterdir())
    expected = math.prod(len(_swept(experiment, name)) for name in ("algo", "posterior", "real_ratio_schedule"))
    assert len(runs) == expected * 2 ** len(fewer)
    for run in runs:
        check_log(run, config.load(run))
    if experiment not in ("fig8", "fig18", "fig19") or importlib.util.find_spec("umap"):
        drawn = command("figure", experiment, "size=tiny", cwd=tmp_path)
        assert drawn.returncode == 0, drawn.stderr
        assert experiment == "table1" or (tmp_path / f"{experiment}.png").read_bytes().startswith(b"\x89PNG")


def _swept(experiment: str, name: str) -> list[str]:
    """The values of a setting in an experiment's grid; [""] where it is not in it."""
    text = (resources.files("vecpsmbpo.configs") / "experiment" / f"{experiment}.yaml").read_text()
    return str(yaml.safe_load(text)["hydra"]["sweeper"]["params"].get(name, "")).split(",")


def test_multirun_runs_every_value(tmp_path):
    common = ["env=ball_in_cup", "backend=host", "size=tiny", "total_steps=80", "n_models=1", "n_policies=1"]
    result = command("train", "-m", *common, "real_ratio=0.0,1.0", cwd=tmp_path)
    assert result.returncode == 0, result.stderr + result.stdout
    ratios = [config.load(folder).real_ratio for folder in (tmp_path / "runs").iterdir() if folder.is_dir()]
    assert sorted(ratios) == [0.0, 1.0]
