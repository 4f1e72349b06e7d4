"""Lanes that stop being finite, and simulators that diverge: whole runs on both drivers, and by parts."""

import contextlib
import io
import json
import os
import re
import signal
import subprocess
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from tests import probes
from tests.helpers import algorithm, argv, initial, tiny, without_times
from vecpsmbpo import checkpoint, envs, evaluate, health, jsonl, placement, programs, replay, training
from vecpsmbpo.envs.host.batched import HostEnv
from vecpsmbpo.look import members, runs, states
from vecpsmbpo.settings import Settings
from vecpsmbpo.types import Counters, TrainState

MAKE = {"mjx": "tests.probes:FailingProbe", "host": "tests.probes:FailingGymnasium"}
GOOD, BAD = [1e-3, 2e-3, 3e-3, 4e-3], [1e-3, 2e-3, 1e30, 4e-3]  # the third lane's parameters overflow at once
LANE, OTHERS = 2, [0, 1, 3]
FIRST_LEARNING_STEP, FROZEN_AT = 40, 60


class Killed(BaseException):
    """The process ends here."""


def settings_for(backend: str, rates: list[float], run_dir: Path) -> Settings:
    """Four lanes of one seed, in one program whatever the rates; strides and refreshes of 20 steps."""
    return tiny(
        env="custom",
        backend=backend,
        episode_length=probes.EPISODE_LENGTH,
        run_dir=run_dir,
        **{"env.make": MAKE[backend], "sweep.policy_learning_rate": rates},
    )


def killed_at(step: int, settings: Settings, monkeypatch: pytest.MonkeyPatch) -> None:
    """Trains until everything is written but the checkpoint at `step`."""
    save = checkpoint.Checkpoints.save

    def kill(self, now, *args):
        if now == step:
            raise Killed
        save(self, now, *args)

    with monkeypatch.context() as patch:
        patch.setattr(checkpoint.Checkpoints, "save", kill)
        with pytest.raises(Killed):
            training.train(settings)


def final(settings: Settings) -> TrainState:
    driver, saved = evaluate.restore(settings)
    return placement.unpad(driver.layout, saved.state)


def _checkpoints(settings: Settings, driver) -> list[checkpoint.Saved]:
    """Those that are kept, oldest first."""
    shapes = driver.shapes(*programs.initial_inputs(settings))
    kept = checkpoint.Checkpoints(Path(settings.run_dir) / checkpoint.FOLDER, settings, read_only=True)
    with contextlib.closing(kept):
        return [kept.restore(shapes, driver.layout, warn=pytest.fail, at=step) for step in kept.steps()]


def leaves_of(tree, lanes) -> list[np.ndarray]:
    is_key = lambda x: jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key)  # noqa: E731
    return [np.asarray(jax.random.key_data(x) if is_key(x) else x)[lanes] for x in jax.tree.leaves(tree)]


def strict(path: Path) -> list[dict]:
    """The lines of a file that must be JSON: Python alone would also read NaN."""
    return [json.loads(text, parse_constant=pytest.fail) for text in path.read_text().splitlines()]


@pytest.fixture(scope="module", params=["mjx", "host"])
def backend(request):
    return request.param


@pytest.fixture(scope="module")
def healthy(backend, tmp_path_factory):
    """The run in which nothing diverges, and what it said."""
    settings = settings_for(backend, GOOD, tmp_path_factory.mktemp(backend) / "run")
    with contextlib.redirect_stdout(io.StringIO()) as screen:
        assert training.train(settings) == 0
    return settings, final(settings), screen.getvalue()


@pytest.fixture(scope="module")
def diverged(backend, tmp_path_factory):
    """The run in which one lane does, killed before any checkpoint knows of it, and once more before the last."""
    settings = settings_for(backend, BAD, tmp_path_factory.mktemp(backend) / "run")
    with pytest.MonkeyPatch.context() as monkeypatch:
        killed_at(80, settings, monkeypatch)
        good = final(settings)
        killed_at(120, settings, monkeypatch)
    assert training.train(settings) == 1
    return settings, good, final(settings)


def test_the_other_lanes_end_as_they_would_have(healthy, diverged):
    (plain, expected, _), (settings, _, state) = healthy, diverged
    ours, theirs = ((run.seeds.replace(health=None), run.env) for run in (state, expected))
    for a, b in zip(leaves_of(ours, OTHERS), leaves_of(theirs, OTHERS), strict=True):
        np.testing.assert_array_equal(a, b)
    for file in ("metrics.jsonl", "episodes.jsonl"):
        a, b = (without_times(strict(Path(run.run_dir) / file)) for run in (settings, plain))
        rates = [GOOD[lane] for lane in OTHERS]
        assert [line for line in a if line["policy_learning_rate"] in rates] == [
            line for line in b if line["policy_learning_rate"] in rates
        ]
        assert max(line["env_steps"] for line in a) > 100


def test_the_lane_stays_as_it_was_when_the_stride_began(diverged):
    _, good, state = diverged
    assert int(good.counters.env_steps) == FIRST_LEARNING_STEP
    looked_at = [(run.without_rings().seeds.replace(health=None), run.env) for run in (good, state)]
    for before, after in zip(*(leaves_of(tree, LANE) for tree in looked_at), strict=True):
        np.testing.assert_array_equal(before, after)
    assert all(np.isfinite(leaf).all() for leaf in leaves_of((state.seeds.real, state.seeds.imagined), LANE))
    np.testing.assert_array_equal(health.frozen(state.seeds.health), [lane == LANE for lane in range(4)])


def test_the_lane_s_last_line_says_when_and_where(diverged, capsys):
    settings, _, _ = diverged
    lines, episodes = (
        [line for line in strict(Path(settings.run_dir) / file) if line["policy_learning_rate"] == BAD[LANE]]
        for file in ("metrics.jsonl", "episodes.jsonl")
    )
    assert [line["env_steps"] for line in lines] == [40, FROZEN_AT]
    assert [line.get("frozen") for line in lines] == [None, True]
    assert lines[-1]["seed"] == 0
    assert lines[-1]["eval_return"] is None
    assert re.fullmatch(r"agents\..* of policy n = [01], m = [01]", lines[-1]["not_finite"])
    assert episodes[-1]["env_steps"] <= FIRST_LEARNING_STEP
    # A run that is complete has the same status, and says it again.
    assert training.train(settings) == 1
    said = capsys.readouterr().out
    assert (
        f"seed 0, policy_learning_rate 1e+30 is frozen as it was at step {FIRST_LEARNING_STEP}: "
        f"{lines[-1]['not_finite']} stopped being finite by step {FROZEN_AT}"
    ) in said


def test_the_simulator_of_the_frozen_lane_is_where_it_was(backend, diverged):
    """Since the checkpoint that first knows of the freezing, also through a kill."""
    settings, _, _ = diverged
    if backend == "host":
        driver, _ = evaluate.restore(settings)
        known = [saved.host["env"]["simulators"] for saved in _checkpoints(settings, driver)]
        counted = [[each["attributes"][0]["steps"] for each in simulators] for simulators in known]
        assert len(counted) == 2
        assert [before == after for before, after in zip(*counted, strict=True)] == [lane == LANE for lane in range(4)]


def test_a_run_whose_lanes_are_all_frozen_stops(backend, tmp_path, capsys):
    """Its last checkpoint can be loaded, is finite, and is not gone on from."""
    settings = settings_for(backend, [1e30, 2e30, 3e30, 4e30], tmp_path / "run")
    assert training.train(settings) == 1
    assert "every lane is frozen" in capsys.readouterr().out
    state = final(settings)
    leaves = leaves_of((state.seeds.replace(hyper=None), state.env), slice(None))
    assert all(np.isfinite(leaf).all() for leaf in leaves)
    lines = strict(tmp_path / "run" / "metrics.jsonl")
    assert [line["env_steps"] for line in lines if line.get("frozen")] == [FROZEN_AT] * 4
    assert training.train(settings) == 1
    assert strict(tmp_path / "run" / "metrics.jsonl") == lines


def test_what_a_frozen_lane_has_seen_ends_where_it_is_held(diverged):
    """What its ring receives afterwards is not drawn: its states, nor figure 8's."""
    settings, good, state = diverged
    own = health.own_rows(state.seeds.health, settings.total_steps, settings.stride)
    assert own.tolist() == [settings.total_steps] * 2 + [FIRST_LEARNING_STEP, settings.total_steps]
    run = runs.load(Path(settings.run_dir))
    found = states.visited(run)
    steps = np.split(found.steps, np.flatnonzero(np.diff(found.steps) < 0) + 1)
    assert [int(at.max()) + 1 for at in steps] == own.tolist()
    held = np.asarray(good.seeds.real[LANE, :FIRST_LEARNING_STEP, 0])
    np.testing.assert_array_equal(found.obs[len(steps[0]) + len(steps[1]) :][: len(held), 0], held)
    assert [members.load(run, lane).imagined_states(9, np.random.default_rng(0)) is None for lane in (LANE, 3)] == [
        True,
        False,
    ]
    # Where the ring has gone round since, none of its rows are the lane's own.
    of_a_longer_run = health.own_rows(state.seeds.health, 10 * settings.total_steps, settings.stride)
    assert of_a_longer_run[LANE] == FIRST_LEARNING_STEP


def test_a_real_kill_after_the_freezing(backend, tmp_path):
    """kill -9 as soon as the screen says so; the command again ends the run with status 1, and no line twice."""
    arguments = [f"env.make={MAKE[backend]}", f"sweep.policy_learning_rate={BAD}".replace(" ", "")]
    arguments = argv("train", "env=custom", f"backend={backend}", "size=tiny", "run_dir=run", *arguments)
    # On the tests' own devices: the programs are compiled already.
    where = {"cwd": tmp_path, "env": {**os.environ, "PYTHONPATH": str(Path(__file__).parent.parent)}, "text": True}
    process = subprocess.Popen([*arguments, "total_steps=240"], stdout=subprocess.PIPE, **where)
    for line in process.stdout:
        if "is frozen" in line:
            break
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    assert process.returncode == -signal.SIGKILL
    result = subprocess.run([*arguments, "total_steps=240"], capture_output=True, timeout=600, check=False, **where)
    assert result.returncode == 1, result.stderr
    for file, what in (("metrics.jsonl", "env_steps"), ("episodes.jsonl", "episode")):
        lines = [(line["policy_learning_rate"], line[what]) for line in strict(tmp_path / "run" / file)]
        assert len(set(lines)) == len(lines)
        assert len({rate for rate, _ in lines}) == 4
    lines = strict(tmp_path / "run" / "metrics.jsonl")
    assert [line.get("frozen") for line in lines if line["policy_learning_rate"] == 1e30] == [None, True]


# ── simulators ───────────────────────────────────────────────────────────────────────────────────────────────────


def test_what_a_simulator_returns_is_stored_only_if_it_has_not_diverged(healthy):
    """In its place the last good row again; the episode ends there, with the return so far."""
    settings, state, _ = healthy
    steps, unsound = settings.total_steps, 0
    lines = strict(Path(settings.run_dir) / "episodes.jsonl")
    for lane, rate in enumerate(GOOD):
        stored = np.asarray(state.seeds.real[lane, :steps])
        assert (np.abs(stored) < 1e10).all()
        again = np.concatenate([[(stored[0] == 0).all()], (stored[1:] == stored[:-1]).all(axis=1)])
        rows = jax.tree.map(np.asarray, replay.unpack(jnp.asarray(stored), 1, 1))
        np.testing.assert_allclose(rows.reward, rows.obs[:, 0] * (1 - rows.action[:, 0] ** 2), atol=1e-6)
        end = 0
        for line in (line for line in lines if line["policy_learning_rate"] == rate):
            begin, end = end, line["env_steps"]
            assert line["length"] == end - begin <= probes.EPISODE_LENGTH
            assert not again[begin : end - 1].any()  # nothing goes on after a failure
            assert again[end - 1] or line["length"] == probes.EPISODE_LENGTH
            assert line["truncated"]
            earned = rows.reward[begin:end][~again[begin:end]].sum()
            assert line["return"] == pytest.approx(float(earned), abs=1e-5)
        unsound += again.sum()
        moments = jax.tree.map(lambda x, lane=lane: x[lane], state.seeds.moments)
        inputs = np.concatenate([rows.obs, rows.action, rows.next_obs - rows.obs, rows.reward[:, None]], axis=1)
        np.testing.assert_allclose(moments.mean, inputs.mean(0), atol=1e-5)
        np.testing.assert_allclose(moments.deviation / steps, inputs.var(0), atol=1e-4)
    counted = sum(line["unsound_steps"] for line in strict(Path(settings.run_dir) / "metrics.jsonl"))
    assert counted == unsound > 20


def test_evaluation_ends_where_a_simulator_fails(healthy):
    settings, _, _ = healthy
    driver, saved = evaluate.restore(settings)
    returns = driver.evaluate(saved.state, programs.evaluation_keys(settings, 1), 20)
    assert np.isfinite(returns.episode_return).all()
    assert 0 < returns.broken_off.sum() < returns.broken_off.size
    assert (returns.length[~returns.broken_off] == probes.EPISODE_LENGTH).all()


def test_a_task_that_fails_is_named_in_every_epoch(healthy):
    settings, _, said = healthy
    lines = strict(Path(settings.run_dir) / "metrics.jsonl")
    for epoch in (40, 80, 120):
        steps = sum(line["unsound_steps"] for line in lines if line["env_steps"] == epoch)
        assert steps > 5
        diverged = f"the simulator of {settings.task} diverged (NaN, infinity, or numbers beyond 1e+10)"
        assert f"{diverged} at {steps} of 160 steps of this epoch" in said
        episodes = sum(line["eval_broken_off"] for line in lines if line["env_steps"] == epoch)
        assert (f"in {episodes} of 4 episodes of this evaluation" in said) == (episodes > 0)
    assert sum(line["eval_broken_off"] for line in lines) > 0


@pytest.mark.parametrize("name", ["halfcheetah", "window_open"])
def test_a_simulator_that_begins_anew_is_not_believed(name):
    """C MuJoCo does so by itself where it diverges, and gives a fine observation."""
    env = envs.make(name, "host", num_envs=2)
    env.reset()
    for simulator, begun_badly in zip(env.simulators, (1, 0), strict=True):  # what was before a step is not its fault
        simulator.env.unwrapped.data.warning[mujoco.mjtWarning.mjWARN_BADQVEL].number = begun_badly
    env.simulators[1].env.unwrapped.data.qvel[:] = 1e11
    step = env.step(np.zeros((2, env.spec.action_size)))
    np.testing.assert_array_equal(step.sound, [True, False])
    np.testing.assert_array_equal(step.truncated, [False, True])
    assert env.step(np.zeros((2, env.spec.action_size))).sound.all()


def test_the_simulators_of_a_frozen_lane_stand_still():
    env = HostEnv(probes.spec(False), [probes.ProbeSimulator(False) for _ in range(2)])
    env.reset()
    for _ in range(probes.EPISODE_LENGTH - 1):
        step = env.step(np.zeros((2, 1)), still=np.array([False, True]))
    saved = env.save()
    assert saved["lengths"] == [probes.EPISODE_LENGTH - 1, 0]
    assert [simulator["obs"] for simulator in saved["simulators"]] == [(probes.EPISODE_LENGTH - 1) % 2, 0]
    np.testing.assert_array_equal(step.next_obs[1], 0.0)
    assert step.sound.all()


def test_a_diverged_policy_moves_host_simulators_by_zeros():
    env = HostEnv(probes.spec(False), [probes.ProbeSimulator(False)])
    env.reset()
    env.step(np.array([[0.5]]))
    step = env.step(np.array([[np.nan]]))
    assert step.reward[0] == 1.0  # at obs 1, of the action 0
    assert step.sound[0]


def test_the_control_suite_s_own_complaint_is_an_unsound_step():
    env = envs.make("ball_in_cup", "host", num_envs=2)
    env.reset()
    env.simulators[1].env.physics.data.qvel[:] = np.nan
    step = env.step(np.zeros((2, 2)))
    np.testing.assert_array_equal(step.sound, [True, False])
    np.testing.assert_array_equal(step.truncated, [False, True])
    assert np.isfinite(step.obs).all()
    assert env.step(np.zeros((2, 2))).sound.all()


# ── by parts ─────────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.fixture(scope="module")
def settled():
    """Three models and members on two devices, a fourth of each fills the mesh; and the end of a stride, compiled."""
    settings = tiny(n_models=3, n_policies=1, num_seeds=1)
    learner = algorithm(settings, probes.spec(False))
    layout = learner.layout
    assert layout.padded_members == 4
    specs = layout.specs()
    state = TrainState(Counters(jnp.int32(100), jnp.int32(0)), initial(learner), jnp.zeros((1, 1)))
    end = layout.jit_shard_map(partial(health.settle, layout), (specs.without_rings(), specs), (specs, specs.env))
    return settings, state, end


def _poisoned(state: TrainState, part: str, member: int) -> TrainState:
    """With NaN in every real number of a part, of one member where it has those."""

    def poison(x):
        if not jnp.issubdtype(x.dtype, jnp.floating):
            return x
        return x.at[0, member].set(jnp.nan) if part in (health.MODELS, health.AGENTS) else jnp.full_like(x, jnp.nan)

    part_of_it = jax.tree.map(poison, getattr(state.seeds, part))
    return state.replace(seeds=state.seeds.replace(**{part: part_of_it}))


@pytest.mark.parametrize(
    ("part", "member", "words"),
    [
        ("models", 2, r"models\.params.* of model n = 2"),
        ("agents", 1, r"agents\.actor.* of policy n = 1, m = 0"),
        ("moments", 0, r"moments\.mean$"),
        ("posterior", 0, r"posterior\.returns$"),
        ("episode", 0, r"episode\.probs$"),
        ("epoch_return", 0, r"epoch_return$"),
    ],
)
def test_wherever_it_appears_the_lane_is_put_back_and_the_place_is_named(part, member, words, settled):
    settings, state, end = settled
    after, frozen = end(state.without_rings(), _poisoned(state, part, member))
    assert frozen.tolist() == [True]
    assert re.match(words, health.describe(after.seeds, 0, settings))
    assert int(after.seeds.health.env_steps[0]) == 100
    put_back, good = ((x.seeds.replace(health=None), x.env) for x in (after, state))
    for ours, theirs in zip(leaves_of(put_back, 0), leaves_of(good, 0), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    # It stays frozen, for the reason it was, when nothing new is wrong; and when something else is.
    for later in (after, _poisoned(after, "moments", 0)):
        again, frozen = end(after.without_rings(), later.replace(counters=Counters(jnp.int32(120), jnp.int32(0))))
        assert frozen.tolist() == [True]
        assert leaves_of(again.seeds.health, 0) == leaves_of(after.seeds.health, 0)


@pytest.mark.parametrize(("part", "member"), [("models", 3), ("agents", 3), (None, 0)])
def test_what_fills_the_mesh_does_not_count(part, member, settled):
    _, state, end = settled
    _, frozen = end(state.without_rings(), _poisoned(state, part, member) if part else state)
    assert frozen.tolist() == [False]


@pytest.mark.parametrize(
    ("what", "member", "words"),
    [(health.IMAGINED, 2, "imagined data of policy n = 2, m = 0"), (health.ACTION, 0, "an action")],
)
def test_what_passes_by_within_a_stride_counts(what, member, words, settled):
    settings, state, end = settled
    noted = health.note(state.seeds.health, what, jnp.array([True]), member)
    after, frozen = end(state.without_rings(), state.replace(seeds=state.seeds.replace(health=noted)))
    assert frozen.tolist() == [True]
    assert health.describe(after.seeds, 0, settings) == words


def test_log_lines_are_json_whatever_is_in_them():
    line = {"a": float("nan"), "b": [1.0, float("inf"), [-float("inf")]], "c": "inf", "d": None, "e": 2}
    assert json.loads(jsonl.text_of(line), parse_constant=pytest.fail) == {
        "a": None, "b": [1.0, None, [None]], "c": "inf", "d": None, "e": 2,
    }  # fmt: skip
