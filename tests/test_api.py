"""The package as a library: `vecpsmbpo.train` and `vecpsmbpo.load`."""

import json
import signal
import sys

import numpy as np
import pytest

import vecpsmbpo
from tests.helpers import tiny
from vecpsmbpo import cli, config, runtime
from vecpsmbpo.training import loop

TINY = {"env": "cartpole_swingup", "backend": "host", "size": "tiny"}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """N = M = 2, two seeds."""
    return vecpsmbpo.train(**TINY, num_seeds=2, total_steps=80, run_dir=tmp_path_factory.mktemp("api") / "a run")


def lines(run, name):
    return [json.loads(line) for line in (run.run_dir / name).read_text().splitlines()]


def test_training_gives_the_run_that_loading_gives(run):
    loaded = vecpsmbpo.load(run.run_dir)
    assert run.complete
    assert loaded.complete
    assert run.settings == loaded.settings == config.load(run.run_dir)
    assert repr(loaded).endswith("cartpole_swingup, ops_mbpo, 80 of 80 steps>")


def test_logs_are_tables(run):
    for name, table in (("metrics.jsonl", run.metrics), ("episodes.jsonl", run.episodes)):
        written = lines(run, name)
        assert len(table) == len(written) > 0
        for column in ("seed", "env_steps", "eval_return", "return", "terminated", "random"):
            if column in written[0]:
                assert table[column].tolist() == [line[column] for line in written]
    np.testing.assert_allclose(run.episodes["probs"].sum().sum(), len(run.episodes), rtol=1e-5)


def test_without_pandas_they_are_columns(run, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    written = lines(run, "metrics.jsonl")
    assert run.metrics["eval_return"].tolist() == [line["eval_return"] for line in written]
    assert run.metrics["env_steps"].tolist() == [line["env_steps"] for line in written]


def test_models_predict_in_the_units_of_the_task(run):
    """A forward pass written in NumPy: whitened inputs, swish, a softly clamped log-variance (A.1, equation 20)."""
    rng = np.random.default_rng(0)
    obs, action = rng.normal(size=(3, 4, 5)), rng.uniform(-1, 1, size=(3, 4, 1))
    lane = vecpsmbpo.load(run.run_dir, lane=1)
    stored = lane._trained.state.models
    assert len(lane.models) == 2
    for n, model in enumerate(lane.models):
        params, scaling = (
            {name: {k: np.asarray(v[1, n], float) for k, v in layer.items()} for name, layer in found.items()}
            if isinstance(found, dict)
            else [np.asarray(x[1, n], float) for x in found]
            for found in (stored.params["params"], stored.scaling)
        )
        mean, std, unit = scaling
        hidden = (np.concatenate([obs, action], axis=-1) - mean) / std
        for name in sorted(params)[:-1]:
            hidden = hidden @ params[name]["kernel"] + params[name]["bias"]
            hidden = hidden * 0.5 * (1 + np.tanh(hidden / 2))
        out = hidden @ params[max(params)]["kernel"] + params[max(params)]["bias"]
        change, raw = np.split(out, 2, axis=-1)
        most = 2.0 + np.maximum(-2 * np.log(unit), 0)
        log_variance = most - np.log1p(np.exp(most - raw))
        log_variance = -10 + np.log1p(np.exp(log_variance + 10))
        expected = obs + (change * unit)[..., :-1]
        found = model(obs, action)
        np.testing.assert_allclose(found.next_obs, expected, atol=1e-4)
        np.testing.assert_allclose(found.reward, (change * unit)[..., -1], atol=1e-4)
        np.testing.assert_allclose(found.next_obs_std, (np.exp(log_variance / 2) * unit)[..., :-1], rtol=1e-3)
        np.testing.assert_allclose(found.reward_std, (np.exp(log_variance / 2) * unit)[..., -1], rtol=1e-3)
        assert not np.asarray(found.terminated).any()  # this task never ends by itself


def test_evaluation_is_what_the_command_shows(run, capsys):
    table = run.evaluate(episodes=3, policy="best")
    assert table["seed"].tolist() == [0, 0, 0, 1, 1, 1]
    assert table["episode"].tolist() == [0, 1, 2] * 2
    assert cli.main(["eval", f"run_dir={run.run_dir}", "episodes=3", "policy=best"]) == 0
    shown = capsys.readouterr().out
    for seed in (0, 1):
        assert f"{table['return'][table['seed'] == seed].mean():.1f}" in shown


def test_a_second_run_in_this_process_goes_on_with_the_first(run):
    first = vecpsmbpo.train(**TINY, total_steps=40, run_dir=run.run_dir.parent / "second")
    assert len(first.metrics) == 1
    longer = vecpsmbpo.train(run_dir=first.run_dir, total_steps=80)
    assert longer.metrics["env_steps"].tolist() == [40, 80]


def test_ctrl_c_saves_and_returns(run, monkeypatch):
    before, end_epoch = signal.getsignal(signal.SIGINT), loop._Session._end_epoch

    def interrupted(session):
        end_epoch(session)
        signal.raise_signal(signal.SIGINT)

    # A test that is started in the background is not asked: the signal is ignored there.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with monkeypatch.context() as patch:
            patch.setattr(loop._Session, "_end_epoch", interrupted)
            stopped = vecpsmbpo.train(**TINY, total_steps=80, run_dir=run.run_dir.parent / "stopped")
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)
    assert not stopped.complete
    assert stopped.env_steps == 40
    assert vecpsmbpo.train(run_dir=stopped.run_dir).complete


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        ({"env": "hoper"}, r"env=hoper: did you mean hopper"),
        ({"real_ratio": 2}, r"real_ratio=2: must be a number from 0 to 1"),
        ({"n_model": 2}, "n_model: no such setting; did you mean n_models"),
        ({"sweep": {"seed": [1]}}, "sweep.seed: cannot be swept"),
        ({"env": "gymnasium", "env_options": {"name_": 1}}, "no such option of env=gymnasium"),
        ({"env_options": 3}, "env_options=3: must be a dictionary"),
        ({"seed": object}, "seed=.*: must be a number, a string, or a list"),
    ],
)
def test_a_mistake_is_one_line_and_creates_nothing(settings, complaint, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(vecpsmbpo.SettingError, match=complaint) as raised:
        vecpsmbpo.train(**settings)
    assert "\n" not in str(raised.value)
    assert not list(tmp_path.iterdir())


def test_loading_what_is_not_there(run, tmp_path):
    with pytest.raises(vecpsmbpo.SettingError, match=r"holds no config\.yaml"):
        vecpsmbpo.load(tmp_path)
    with pytest.raises(vecpsmbpo.SettingError, match="lane=2: must be below 2"):
        vecpsmbpo.load(run.run_dir, lane=2)
    with pytest.raises(vecpsmbpo.SettingError, match="color=red: evaluation takes episodes, policy"):
        run.evaluate(color="red")


@pytest.mark.parametrize(
    "text",
    [
        "a b",
        "it's",
        "ends in \\",
        "5",
        "null",
        "true",
        "a'b\\'c",
        "λ",
        "a=b",
        "[x]",
        "1e3",
        "my_task:Make",
        "",
        "~x",
        "a,b",
    ],
)
def test_strings_come_through_as_they_are(text):
    assert config.parse(config.overrides_of({"run_dir": text})) == {"run_dir": text}


def test_values_are_written_as_a_command_line_has_them():
    found = config.overrides_of(
        {
            "env": "gymnasium",
            "env_options": {"id": "Swimmer-v5"},
            "sweep": {"real_ratio": np.array([0.0, 0.25])},
            "temperature": float("inf"),
            "report": True,
            "seed": np.int64(3),
        }
    )
    assert found == [
        "env=gymnasium",
        "env.id=Swimmer-v5",
        "sweep.real_ratio=[0.0,0.25]",
        "temperature=inf",
        "report=true",
        "seed=3",
    ]


def test_where_jax_came_first_with_fewer_devices_it_is_said(monkeypatch):
    assert runtime.idle_cores(tiny()) == ""  # the tests have said how many there are
    monkeypatch.setenv("XLA_FLAGS", "")
    monkeypatch.setattr(runtime, "_cores", lambda: 3)
    assert runtime.idle_cores(tiny()).startswith(
        "JAX was started before vecpsmbpo, with 2 device(s), where 3 cores could"
    )
    assert runtime.idle_cores(tiny(devices=2)) == ""


@pytest.mark.parametrize(("algo", "given"), [("pets", "policy"), ("pets", "actions"), ("slbo", "policy")])
def test_what_an_algorithm_has_no_choice_of_is_refused_in_evaluation(algo, given):
    settings = tiny(algo=algo, **({"plan_particles": 2} if algo == "pets" else {}))
    with pytest.raises(vecpsmbpo.SettingError, match=f"{given}=best: there is no choice with algo={algo}"):
        config.for_evaluation(settings, {given: "best"})
