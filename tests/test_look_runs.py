"""Reading the logs of runs, and which of their lanes belong together."""

import json

import numpy as np
import pytest

from tests import looks
from vecpsmbpo.look import groups, runs
from vecpsmbpo.settings import SettingError

# ── reading ─────────────────────────────────────────────────────────────────────────────────────────────────────────


def test_columns_of_a_log(tmp_path):
    path = looks.write(tmp_path / "a", looks.epochs([1, 2, 3], real_ratio_probs=[0.25, 0.75]), looks.episodes(5))
    run = runs.load(path)
    (lane,) = run.lanes
    assert lane.values == {"seed": 0}
    np.testing.assert_array_equal(lane.epochs["env_steps"], [40, 80, 120])
    np.testing.assert_array_equal(lane.epochs["critic_loss"], [np.nan, 1 / 2, 1 / 3])
    assert lane.epochs["real_ratio_probs"].shape == (3, 2)
    assert lane.episodes["probs"].shape == (5, 4)
    np.testing.assert_array_equal(lane.episodes["random"], [1, 0, 0, 0, 0])
    assert run.complete
    assert not lane.frozen


def test_a_line_cut_short_and_noise(tmp_path):
    path = looks.write(tmp_path / "a", looks.epochs([1, 2, 3, 4]))
    log = path / "metrics.jsonl"
    first, second, third, fourth = log.read_bytes().splitlines(keepends=True)
    log.write_bytes(first + b"\xff\x00\x9f\n" + second + b'{"env_steps": 120}\n[1]\n' + third + fourth[:-9])
    run = runs.load(path)
    np.testing.assert_array_equal(run.lanes[0].epochs["eval_return"], [1, 2, 3])
    assert run.metrics.damaged == 3  # noise, no seed, no dictionary; but not the line that is being written
    assert [f"{log}: 3 damaged line(s) left out"] == list(runs.warnings([run]))


def test_a_word_among_numbers_is_a_gap(tmp_path):
    path = looks.write(tmp_path / "a", looks.epochs([1, 2, 3, 4], real_ratio_probs=[0.25, 0.75]))
    first, second, *others = map(json.loads, (path / "metrics.jsonl").read_text().splitlines())
    second |= {"eval_return": "oops", "critic_loss": [1, 2], "real_ratio_probs": "oops", "only_a_word": "oops"}
    (path / "metrics.jsonl").write_text("".join(f"{json.dumps(line)}\n" for line in (first, second, *others)))
    epochs = runs.load(path).lanes[0].epochs
    np.testing.assert_array_equal(epochs["eval_return"], [1, np.nan, 3, 4])
    np.testing.assert_array_equal(epochs["critic_loss"], [np.nan, np.nan, 1 / 3, 1 / 4])
    assert np.isnan(epochs["real_ratio_probs"]).tolist() == [[False] * 2, [True] * 2, [False] * 2, [False] * 2]
    assert "only_a_word" not in epochs


def test_a_frozen_lane_keeps_the_others(tmp_path):
    frozen = looks.epochs([5, 6], seed=1)
    frozen.append(dict.fromkeys(frozen[0]) | {"env_steps": 120, "seed": 1, "frozen": True})
    path = looks.write(tmp_path / "a", looks.epochs([1, 2, 3]) + frozen, num_seeds=2)
    run = runs.load(path)
    assert [lane.frozen for lane in run.lanes] == [False, True]
    assert np.isnan(run.lanes[1].epochs["eval_return"][-1])
    assert list(runs.warnings([run])) == [f"{path}: seed 1 was frozen at step 120"]


def test_lanes_of_a_sweep(tmp_path):
    lines = [
        line
        for tau in ("inf", 5.0)
        for seed in (3, 4)
        for line in looks.epochs([seed, 10 * seed], seed=seed, temperature=tau)
    ]
    swept = {"num_seeds": 2, "seed": 3, "sweep.temperature": "[.inf,5]"}
    run = runs.load(looks.write(tmp_path / "a", lines, **swept))
    assert [tuple(lane.values.values()) for lane in run.lanes] == [(3, np.inf), (4, np.inf), (3, 5), (4, 5)]
    np.testing.assert_array_equal(run.lanes[3].epochs["eval_return"], [4, 40])
    assert [group.name for group in groups.group([run])] == ["τ = 5", "τ = ∞"]


def test_a_step_written_twice_counts_once(tmp_path):
    path = looks.write(tmp_path / "a", looks.epochs([1, 2, 3]) + looks.epochs([7, 8]))
    np.testing.assert_array_equal(runs.load(path).lanes[0].epochs["eval_return"], [7, 8, 3])


def test_logs_are_kept_as_arrays(tmp_path):
    """8 bytes a number and 4 a probability. (How long reading takes: tools/bench_look.py.)"""
    lines = looks.episodes(100)
    (tmp_path / "episodes.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines) * 50)
    log = runs.read(tmp_path / "episodes.jsonl")
    assert len(log) == 5000
    assert sum(column.nbytes for column in log.columns.values()) == 5000 * (8 * (len(lines[0]) - 1) + 4 * 4)


# ── grouping ────────────────────────────────────────────────────────────────────────────────────────────────────────


def _runs(tmp_path, **by_name):
    return [
        runs.load(looks.write(tmp_path / name, looks.epochs([1, 2], seed=settings.get("seed", 0)), **settings))
        for name, settings in by_name.items()
    ]


def test_groups_are_named_by_what_differs_and_no_more(tmp_path):
    found = _runs(tmp_path, a={"algo": "mbpo"}, b={"algo": "ops_mbpo"}, c={"algo": "ops_mbpo", "seed": 5})
    together = groups.group(found)
    # algo=mbpo brings rollout_models and n_policies of its own, which need not be named.
    assert [(group.name, len(group.lanes)) for group in together] == [("OPS-MBPO", 2), ("MBPO", 1)]
    (one,) = groups.group(found, ["size"])
    assert len(one.lanes) == 3


def test_groups_of_two_settings(tmp_path):
    cells = {f"{n}{m}": {"n_models": n, "n_policies": m} for n in (1, 2) for m in (1, 3)}
    names = [group.name for group in groups.group(_runs(tmp_path, **cells))]
    assert names == ["N = 1, M = 1", "N = 1, M = 3", "N = 2, M = 1", "N = 2, M = 3"]


def test_the_same_run_twice_is_told_apart_by_its_directory(tmp_path):
    assert [group.name for group in groups.group(_runs(tmp_path, before={}, after={}))] == ["after", "before"]


def test_a_setting_that_there_is_not(tmp_path):
    with pytest.raises(SettingError, match="group=alog: no such setting; did you mean algo"):
        groups.group(_runs(tmp_path, a={}), ["alog"])
