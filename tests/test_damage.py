"""Runs whose files are damaged, lost or cannot be written: what the loop around the program makes of it."""

import contextlib
import dataclasses
import errno
import json
import os
import shutil
import types
from pathlib import Path

import jax
import numpy as np
import pytest

import vecpsmbpo
from tests.helpers import check_log, command, files_of, tiny
from tools.harm.runs import NotTried
from tools.harm.scarce import mounted
from vecpsmbpo import config, evaluate, jsonl, orbax_words, placement, recorded, run_log, training
from vecpsmbpo.settings import SettingError
from vecpsmbpo.training import guards
from vecpsmbpo.types import Hyper


@pytest.mark.parametrize("posterior", ["sample", "average"])
def test_a_policy_is_loaded_from_a_run(posterior, short_run, tmp_path, monkeypatch):
    """Of the best member, or of all where they act together; mean actions against a forward pass written in numpy."""
    monkeypatch.setattr(recorded, "check", lambda *args: None)  # it was trained with one of them
    shutil.copytree(short_run.run_dir, tmp_path / "run")
    config.save(dataclasses.replace(short_run, posterior=posterior, run_dir=str(tmp_path / "run")), tmp_path / "run")
    run = vecpsmbpo.load(tmp_path / "run")
    settings, act = run.settings, run.policy
    assert settings == config.load(tmp_path / "run")
    driver, saved = evaluate.restore(settings)
    seeds = placement.unpad(driver.layout, saved.state).seeds
    layers = jax.tree.map(lambda x: np.asarray(x[0], float), seeds.agents.actor)["params"]["ReluMLP_0"]
    obs = np.random.default_rng(0).normal(size=(3, 8))

    def mean_actions(member):
        dense = [
            (layer["kernel"][member], layer["bias"][member])
            for layer in (layers[f"Dense_{index}"] for index in range(settings.policy_hidden_layers + 1))
        ]
        hidden = obs
        for kernel, bias in dense[:-1]:
            hidden = np.maximum(hidden @ kernel + bias, 0)
        return np.tanh((hidden @ dense[-1][0] + dense[-1][1])[:, :2])

    earned, episodes = (np.asarray(x[0], float) for x in (seeds.posterior.returns, seeds.posterior.episodes))
    mean = np.where(episodes >= max(1, episodes.mean() / 2), earned / np.maximum(episodes, 1), -np.inf)
    members = [int(mean.argmax())] if posterior == "sample" else range(settings.n_members)
    np.testing.assert_allclose(act(obs), np.mean([mean_actions(member) for member in members], axis=0), atol=1e-5)


def _damage(run_dir: Path, step: int) -> None:
    """Cuts every file of a checkpoint's arrays in half."""
    for file in (run_dir / "checkpoints" / str(step) / "state").rglob("*"):
        if file.is_file():
            file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def test_a_damaged_newest_checkpoint_falls_back_to_the_one_before(short_run, tmp_path, capsys):
    folder = tmp_path / "run"
    shutil.copytree(short_run.run_dir, folder)
    settings = dataclasses.replace(short_run, run_dir=str(folder))
    _damage(folder, 120)
    before = files_of(folder)
    assert evaluate.restore(settings)[1].step == 80
    assert files_of(folder) == before  # looking at a run changes nothing
    assert training.train(settings) == 0
    printed = capsys.readouterr()
    assert "the checkpoint at step 120 is damaged; taking the one before it" in printed.err
    assert "resuming at step 80" in printed.out
    check_log(folder, short_run)
    assert evaluate.restore(settings)[1].step == 120


def test_a_run_whose_checkpoints_are_all_damaged_is_left_as_it_is(short_run, tmp_path):
    """As a command: the threads of orbax, which find the same, would speak until the process ends."""
    folder = tmp_path / "run"
    shutil.copytree(short_run.run_dir, folder)
    _damage(folder, 120)
    _damage(folder, 80)
    before = files_of(folder)
    result = command("train", f"run_dir={folder}", cwd=tmp_path)
    assert result.returncode == 2
    (said,) = result.stderr.splitlines()
    assert said.startswith(f"vecpsmbpo: {folder}/checkpoints: holds checkpoints, but none that can be read (")
    assert files_of(folder) == before


def _flip(path: Path, at: float = 0.5, bit: int = 4) -> None:
    """One bit, at a fraction of a file."""
    content = bytearray(path.read_bytes())
    content[int(at * len(content))] ^= 1 << bit
    path.write_bytes(content)


def _host(run_dir: Path, step: int) -> Path:
    """What the host knows beside the state, in a checkpoint."""
    return run_dir / "checkpoints" / str(step) / "host" / "metadata"


def test_what_orbax_says_of_files_that_it_has_given_up_is_not_heard():
    heard: list[types.SimpleNamespace] = []
    given_up, other = (types.SimpleNamespace(exc_value=RuntimeError(x)) for x in ("Event loop is closed", "no"))
    for unraisable in (given_up, other):
        orbax_words.unless_given_up(heard.append, unraisable)
    assert heard == [other]


def test_a_flipped_bit_is_a_damaged_checkpoint(short_run, tmp_path, capsys):
    """In the largest arrays, where it would change a number and nothing else; and in what the host knows."""
    folder = tmp_path / "run"
    shutil.copytree(short_run.run_dir, folder)
    settings = dataclasses.replace(short_run, run_dir=str(folder))
    files = (path for path in (folder / "checkpoints" / "120" / "state").rglob("*/0*") if path.is_file())
    largest = sorted(files, key=lambda path: path.stat().st_size)[-3:]
    for file, at in [*((file, at) for file in largest for at in (0.4, 0.8)), (_host(folder, 120), 0.5)]:
        whole = file.read_bytes()
        _flip(file, at)
        assert evaluate.restore(settings)[1].step == 80, file
        file.write_bytes(whole)
    assert "the checkpoint at step 120 is damaged; taking the one before it" in capsys.readouterr().err
    assert evaluate.restore(settings)[1].step == 120


def test_a_checkpoint_from_before_it_knew_its_settings_is_read(short_run, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(short_run.run_dir, folder)
    for step in (80, 120):
        host = json.loads(_host(folder, step).read_text())
        _host(folder, step).write_text(json.dumps({name: host[name] for name in ("env", "seconds", "format")}))
    assert training.train(dataclasses.replace(short_run, run_dir=str(folder), total_steps=160)) == 0


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"seed": 5}, r"its checkpoints were made with seed=0 \(not 5\); put config.yaml right, or give another"),
        ({"algo": "mbpo", "temperature": 3.0}, r"made with algo=ops_mbpo \(not mbpo\), temperature="),
        ({"model_hidden_size": 7}, r"made with model_hidden_size=\d+ \(not 7\);"),  # another shape is no damage
        ({"total_steps": 80}, r"total_steps=80: the run has already done 120"),
    ],
)
def test_settings_that_are_not_the_checkpoints_are_refused_and_nothing_changes(changes, expected, short_run, tmp_path):
    """As an edited config.yaml has them, or a command where config.yaml is gone."""
    folder = tmp_path / "run"
    shutil.copytree(short_run.run_dir, folder)
    (folder / "config.yaml").unlink()
    before = files_of(folder)
    with pytest.raises(SettingError, match=expected):
        training.train(dataclasses.replace(short_run, run_dir=str(folder), **changes))
    assert files_of(folder) == before
    if changes == {"seed": 5}:
        assert training.train(dataclasses.replace(short_run, run_dir=str(folder))) == 0  # the right ones
        assert dataclasses.replace(config.load(folder), run_dir=short_run.run_dir) == short_run


def test_a_run_whose_checkpoints_are_gone_does_not_begin_anew(short_run, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(short_run.run_dir, folder)
    shutil.rmtree(folder / "checkpoints")
    before = files_of(folder)
    with pytest.raises(SettingError, match="its logs reach step 120, but its checkpoints are gone"):
        training.train(dataclasses.replace(short_run, run_dir=str(folder)))
    assert files_of(folder) == before
    assert not (folder / "checkpoints").exists()


def test_what_is_wrong_with_the_logs_is_said_when_a_run_goes_on(short_run, tmp_path, capsys):
    folder = tmp_path / "run"
    shutil.copytree(short_run.run_dir, folder)
    metrics_file, episodes_file = folder / "metrics.jsonl", folder / "episodes.jsonl"
    first, second, third = metrics_file.read_bytes().splitlines(keepends=True)
    metrics_file.write_bytes(first + b"[1, 2]\n" + second[:20] + b"\n" + third)
    episodes_file.write_bytes(episodes_file.read_bytes()[: episodes_file.stat().st_size // 2])
    assert training.train(dataclasses.replace(short_run, run_dir=str(folder))) == 0
    assert metrics_file.read_bytes() == first + third
    said = capsys.readouterr().err
    assert f"{metrics_file}: 2 line(s) that cannot be read, set aside in metrics.jsonl.strange" in said
    assert f"{episodes_file}: 1 line(s) that cannot be read, set aside in episodes.jsonl.strange" in said  # cut in half
    assert "of its lines up to step 120 are lost" in said
    assert said.count("\n") == 3


def test_a_run_is_trained_by_one_process_at_a_time(short_run):
    with guards.alone_in(Path(short_run.run_dir)), pytest.raises(SettingError, match="another process is training"):
        training.train(short_run)


def test_a_run_goes_on_where_the_system_has_no_locks(tmp_path, monkeypatch):
    monkeypatch.setattr(guards, "fcntl", None)
    with guards.alone_in(tmp_path), guards.alone_in(tmp_path / "not even looked at"):
        pass


def test_a_disk_that_fills_up_stops_the_run_in_one_line(short_run, tmp_path, monkeypatch):
    """Not at the check before a save, but while a line is written; the checkpoint before it is whole."""
    append = jsonl.Growing.append

    def full(file, lines):
        if any(line["env_steps"] > 60 for line in lines):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        append(file, lines)

    monkeypatch.setattr(jsonl.Growing, "append", full)
    settings = dataclasses.replace(short_run, run_dir=str(tmp_path / "run"))
    with pytest.raises(training.DiskError, match=r"cannot be written \(No space left on device\)"):
        training.train(settings)
    monkeypatch.undo()
    assert evaluate.restore(settings)[1].step == 40
    assert training.train(settings) == 0
    check_log(tmp_path / "run", settings)


@pytest.fixture
def mount(tmp_path):
    """Mounts a disk of a kind; its folder."""
    with contextlib.ExitStack() as mounts:

        def at(how):
            (folder := tmp_path / "disk").mkdir()
            try:
                mounts.enter_context(mounted(folder, how))
            except NotTried as why:
                pytest.skip(str(why))
            return folder

        yield at


@pytest.mark.parametrize("how", ["size=64k", "size=64m,nr_inodes=60"])
def test_a_full_disk_is_one_line(how, mount, tmp_path):
    """No room, and no more files."""
    run_dir = mount(how) / "run"
    result = command("train", "env=ball_in_cup", "backend=host", "size=tiny", f"run_dir={run_dir}", cwd=tmp_path)
    line = f"vecpsmbpo: run_dir={run_dir}: cannot be written (No space left on device)\n"
    assert (result.returncode, result.stderr) == (2, line)


def test_a_grid_in_a_folder_that_cannot_be_written_is_one_line(mount, tmp_path):
    if os.geteuid() == 0:  # who may write wherever a disk can be
        folder, why = mount("ro"), "Read-only file system"
    else:
        folder, why = tmp_path, "Permission denied"
        folder.chmod(0o555)
    result = command("train", "-m", "env=ball_in_cup", "backend=host", "size=tiny", "seed=0,1", cwd=folder)
    assert (result.returncode, result.stderr) == (2, f"vecpsmbpo: runs: {why}\n")


def test_log_files_drop_what_will_be_done_again(tmp_path):
    lines = [{"env_steps": step, "seed": 0, "return": 1.0, "length": 5} for step in (10, 20, 30)]
    path = tmp_path / "episodes.jsonl"
    path.write_text("".join(json.dumps(line) + "\n" for line in lines) + '{"env_steps": 40, "se')
    log = run_log.RunLog(tmp_path, 20, tiny(), warn=pytest.fail)
    log.episodes([{"env_steps": 25, "seed": 0, "return": 2.0, "length": 5}])
    log.close()
    assert [line["env_steps"] for line in jsonl.read(path)] == [10, 20, 25]


@pytest.mark.parametrize(
    ("algo", "own"),
    [
        ("ops_mbpo", "policy_learning_rate discount target_entropy target_update_rate real_ratio temperature"),
        ("pets", ""),
        ("slbo", "discount"),
    ],
)
def test_what_may_be_swept_keeps_its_order_in_checkpoints(algo, own):
    """And what one algorithm has is not in another's: an algorithm that is added makes no checkpoint unreadable."""
    names = f"model_learning_rate model_weight_decay prior_scale forced_exploration {own}".split()
    leaves = jax.tree_util.tree_leaves_with_path(Hyper.of(tiny(algo=algo)))
    assert [jax.tree_util.keystr(path) for path, _ in leaves] == [f".{name}" for name in names]


def test_a_run_trained_with_what_is_no_setting_any_more_is_not_gone_on_with():
    settings = tiny(run_dir="x")
    record = recorded.plain(settings)
    recorded.check_retired(settings, record)
    recorded.check_retired(settings, {**record, "clip_targets": False})
    with pytest.raises(SettingError, match="clip_targets=True, which is no setting any more; it can be looked at"):
        recorded.check_retired(settings, {**record, "clip_targets": True})
