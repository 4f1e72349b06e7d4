"""Policies as files: they act the same without this package, and are loaded, evaluated and drawn as runs are."""

import dataclasses
import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import vecpsmbpo
from tests.drawing import draws
from tests.helpers import command
from vecpsmbpo import cli, config, envs, jsonl
from vecpsmbpo.look import export, files
from vecpsmbpo.settings import SettingError


def test_an_exported_policy_acts_the_same_without_this_package(trained, tmp_path, capsys):
    out = tmp_path / "policy"
    assert cli.main(["export", str(trained), f"out={out}"]) == 0
    obs = np.random.default_rng(0).normal(size=(7, 5)).astype(np.float32)
    expected = np.asarray(vecpsmbpo.load(trained).policy(obs))
    np.save(tmp_path / "obs.npy", obs)
    code = (
        "import sys, numpy as np; sys.path.insert(0, sys.argv[1]); from act import act; "
        "np.save('actions.npy', act(np.load('obs.npy'))); assert not {'jax', 'vecpsmbpo'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code, str(out)], cwd=tmp_path, check=True)
    np.testing.assert_allclose(np.load(tmp_path / "actions.npy"), expected, atol=1e-5)
    about = json.loads((out / "policy.json").read_text())
    assert (about["task"], about["env_steps"], about["obs_size"], about["action_size"]) == (
        "cartpole_swingup",
        80,
        5,
        1,
    )
    before = (out / "policy.npz").read_bytes()
    assert cli.main(["export", str(trained), f"out={out}", f"member={about['member']}"]) == 0
    assert (out / "policy.npz").read_bytes() == before


def test_an_export_that_fails_midway_leaves_the_policy_that_was_there(trained, tmp_path, monkeypatch, capsys):
    """Also one that was written with more files than the next."""
    out = tmp_path / "policy"
    monkeypatch.setitem(export.ADDITIONS, "onnx", ())
    monkeypatch.setattr(export, "onnx_model", lambda layers: b"a graph")
    assert cli.main(["export", str(trained), "member=0,0", "also=onnx", f"out={out}"]) == 0
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    assert set(before) == {"policy.npz", "act.py", "policy.json", "policy.onnx"}

    def full(*args):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(files.os, "fsync", full)
        assert cli.main(["export", str(trained), "member=1,0", f"out={out}"]) == 2
        assert cli.main(["export", str(trained), "member=1,0", f"out={tmp_path / 'new'}"]) == 2
    assert (
        capsys.readouterr().err.splitlines()[0] == f"vecpsmbpo: out={out}: cannot be written (No space left on device)"
    )
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before
    assert not (tmp_path / "new").exists()

    assert cli.main(["export", str(trained), "member=1,0", f"out={out}"]) == 0
    assert {path.name for path in out.iterdir()} == set(before) - {"policy.onnx"}  # it was the other member's


def test_an_exported_policy_is_loaded_as_a_run_is(trained, policy, capsys):
    loaded, run = vecpsmbpo.load(policy), vecpsmbpo.load(trained, lane=1)
    assert repr(loaded) == f"<Policy {policy}: cartpole_swingup, ops_mbpo, 80 steps>"
    assert loaded.settings == dataclasses.replace(run.settings, num_seeds=1, seed=1, run_dir="")
    obs = np.random.default_rng(0).normal(size=(2, 3, 5)).astype(np.float32)
    np.testing.assert_allclose(loaded.policy(obs), run.policy(obs), atol=1e-5)

    episodes = loaded.evaluate(seed=3, episodes=2)
    env = envs.make("cartpole_swingup", "host", num_envs=2, seed=3)
    env.episode_length = 25  # of size=tiny
    obs, earned = env.reset(), np.zeros(2)
    for _ in range(25):
        step = env.step(loaded.policy(obs))
        obs, earned = step.obs, earned + step.reward
    np.testing.assert_allclose(episodes["return"], earned, rtol=1e-5)
    assert list(episodes["length"]) == [25, 25]

    capsys.readouterr()
    assert cli.main(["eval", f"run_dir={policy}", "episodes=2"]) == 0
    assert capsys.readouterr().out.splitlines()[-2].replace("│", " ").split()[:2] == ["1", "2"]


# Somewhat less than ten episodes earn on average (docs/benchmark.md, "Trained policies").
COMMITTED = {
    "cartpole_swingup": 870,
    "cartpole_swingup_sparse": 760,
    "ball_in_cup": 900,
    "window_open": -550,
    "hopper": 2730,
    "hopper_mbpo": 3100,
    "halfcheetah": 7150,
    "walker2d": 1750,
    "ant": 850,
}


@pytest.mark.parametrize(("name", "earned"), COMMITTED.items(), ids=COMMITTED)
def test_a_committed_policy_earns_what_is_said_of_it(name, earned):
    policy = vecpsmbpo.load(Path(__file__).parents[1] / "results" / "policies" / name)
    assert policy.settings.env == name.removesuffix("_mbpo")
    assert policy.evaluate(episodes=2, backend="host")["return"].mean() > earned


def test_a_run_stays_one_when_its_policy_is_exported_into_it(trained, tmp_path):
    shutil.copytree(trained, tmp_path / "run")
    assert cli.main(["export", str(trained), f"out={tmp_path / 'run'}"]) == 0
    assert vecpsmbpo.load(tmp_path / "run", lane=1).complete
    with pytest.raises(SettingError, match="run_dir="):
        vecpsmbpo.load("x" * 300)


@draws
def test_an_exported_policy_is_drawn(policy, tmp_path):
    result = command("render", str(policy), "length=4", "width=64", "out=a.png", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert Image.open(tmp_path / "a.png").size == (4 * 64, 48)


def test_infinity_is_kept_in_an_exported_policy():
    settings = config.compose(["algo=ps_mbpo", "sweep.real_ratio=[0.1,0.7]", "num_seeds=2", "seed=4"])
    record = json.loads(json.dumps(export.settings_of(settings, 3), allow_nan=False))
    found = config.from_record(record, "policy.json")
    assert (found.temperature, found.real_ratio, found.seed, found.lanes) == (np.inf, 0.7, 5, ({"seed": 5},))


def test_the_real_data_are_exported_as_minari_reads_them(trained, tmp_path, capsys):
    minari = pytest.importorskip("minari")
    out = tmp_path / "policy"
    words = ["export", str(trained), "also=minari", "lane=1", f"out={out}"]
    assert cli.main(words) == 0
    data = minari.MinariDataset(out / "minari" / "vecpsmbpo" / "cartpole_swingup-v0" / "data")
    lines = [line for line in jsonl.read(trained / "episodes.jsonl") if line["seed"] == 1]
    assert data.total_episodes == len(lines) == 3
    for episode, line in zip(data.iterate_episodes(), lines, strict=True):
        assert episode.rewards.sum() == pytest.approx(line["return"], abs=1e-4)
        assert episode.observations.shape == (line["length"] + 1, 5)
        assert (episode.terminations.sum(), episode.truncations.sum()) == (0, 1)
        assert np.abs(episode.actions).max() <= 1
    capsys.readouterr()
    assert cli.main(words) == 2  # it is there already
    assert capsys.readouterr().err.endswith("cartpole_swingup-v0: is there already\n")


@pytest.mark.parametrize(("name", "package"), [(name, one) for name, all_ in export.ADDITIONS.items() for one in all_])
def test_an_export_without_its_extra_names_it(name, package, trained, monkeypatch, capsys):
    monkeypatch.setattr(export.importlib.util, "find_spec", lambda name: None if name == package else "there")
    assert cli.main(["export", str(trained), f"also={name}"]) == 2
    expected = f"vecpsmbpo: also={name}: needs the package {package}; pip install 'vecpsmbpo[export]'\n"
    assert capsys.readouterr().err == expected


def test_policies_for_jax_and_onnx_act_the_same(trained, tmp_path):
    pytest.importorskip("onnx")
    pytest.importorskip("flatbuffers")
    from jax import export as jax_export
    from onnx.reference import ReferenceEvaluator

    assert cli.main(["export", str(trained), "also=jax,onnx", f"out={tmp_path}"]) == 0
    obs = np.random.default_rng(0).normal(size=(7, 5)).astype(np.float32)
    expected = vecpsmbpo.load(trained).policy(obs)
    (action,) = ReferenceEvaluator(str(tmp_path / "policy.onnx")).run(None, {"obs": obs})
    np.testing.assert_allclose(action, expected, atol=1e-5)
    function = jax_export.deserialize(bytearray((tmp_path / "policy.jax").read_bytes()))
    np.testing.assert_allclose(function.call(obs), expected, atol=1e-5)
    assert function.call(obs[:3]).shape == (3, 1)  # of any number of observations
    assert function.platforms == ("cpu", "cuda", "rocm", "tpu")
