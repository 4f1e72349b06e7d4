"""The command line: mistakes are one line and exit status 2, create nothing, and never import JAX."""

import dataclasses
import itertools
import json
import math
import re
import subprocess
import sys

import hydra
import jax
import mujoco
import pytest

import vecpsmbpo
from tests.helpers import command, environment, pinned
from vecpsmbpo import cli, config
from vecpsmbpo.algorithms import TABLE
from vecpsmbpo.algorithms.catalogue import FIELDS, allowed, check, of_algorithm
from vecpsmbpo.envs.registry import TASKS
from vecpsmbpo.settings import CHANGEABLE, SettingError

MISTAKES = [
    (["train", "env=hoper"], "env=hoper: did you mean hopper"),
    (["train", "size=big"], "size=big: one of cpu, paper, tiny"),
    (["train", "algo=ops_mpo"], "algo=ops_mpo: did you mean ops_mbpo"),
    (["train", "env=gymnasium"], "env.id: must be given with env=gymnasium"),
    (["train", "env=hopper", "env.id=3"], "env.id: no such option of env=hopper; it has none"),
    (["train", "env=dm_control", "env.tsk=spin"], "env.tsk: no such option of env=dm_control; it has env.domain"),
    (["train", "n_modles=3"], "n_modles: no such setting; did you mean n_models"),
    (["train", "n_models=three"], "n_models=three: must be a whole number, at least 1"),
    (["train", "n_models=2.5"], "n_models=2.5: must be a whole number, at least 1"),
    (["train", "n_models=0"], "n_models=0: must be a whole number, at least 1"),
    (["train", "real_ratio=1.5"], "real_ratio=1.5: must be a number from 0 to 1"),
    (["train", "temperature=0"], "temperature=0: must be a number, above 0"),
    (["train", "discount=.nan"], "discount=.nan: must be a number from 0 to 1"),
    (["train", "backend=gpu"], "backend=gpu: must be one of auto, mjx, host"),
    (["train", "compile_cache=maybe"], "compile_cache=maybe: must be true or false"),
    (["train", "total_steps=1500"], "total_steps=1500: must be a multiple of epoch_steps=1000"),
    (["train", "model_update_every=300"], "model_update_every=300: must divide epoch_steps=1000"),
    (
        ["train", "algo=slbo", "posterior=average"],
        "posterior: algo=slbo has no such setting; algo=ops_mbpo or",
    ),
    (["train", "algo=sac", "real_ratio=0.5"], "real_ratio: must be 1 with algo=sac"),
    (["train", "algo=pets", "sweep.real_ratio=[0,1]"], "sweep.real_ratio: algo=pets has no such setting"),
    (["train", "plan_horizon=3"], "plan_horizon: algo=ops_mbpo has no such setting; algo=pets has"),
    (["train", "-m", "algo=pets,mbpo", "plan_horizon=3"], "plan_horizon: algo=mbpo has no such setting; algo=pets has"),
    (["train", "algo=sac", "n_models=5"], "n_models=5: must be 1 with algo=sac"),
    (
        ["train", "algo=pets", "n_policies=2"],
        "n_policies: algo=pets has no such setting; algo=ops_mbpo or",
    ),
    (["train", "real_ratio_schedule=linear", "sweep.real_ratio=[0,1]"], "sweep.real_ratio: needs real_ratio_schedule"),
    (["train", "real_ratio_arms=[0.3,0.1]"], "real_ratio_arms=[0.3, 0.1]: must rise"),
    (["train", "real_ratio_schedule=bandit", "posterior=average"], "posterior=average: no policy earns"),
    (["train", "validation_ratio=0.3"], "validation_ratio=0.3: must be 1 / k"),
    (["train", "seed=2147483647", "num_seeds=2"], "num_seeds=2: the last seed"),
    (["train", "env=hopper", "imagined_capacity=10"], "imagined_capacity=10: must hold a rollout, of up to 15 steps"),
    (["train", "n_models=1,2"], "n_models=1,2: several values need -m"),
    (["train", "hopper"], "hopper: must be name=value"),
    (["train", "-m", "n_models=1,0"], "n_models=0: must be a whole number, at least 1"),
    (["train", "sweep.n_models=[1,2]"], "sweep.n_models: cannot be swept in one program"),
    (["train", "sweep.real_ratio=0.5"], "sweep.real_ratio=0.5: must be a list of values, each a number from 0 to 1"),
    (["train", "sweep.real_ratio=[0,2]"], "real_ratio=2: must be a number from 0 to 1"),
    (["train", "real_ratio_arms=0.5"], "real_ratio_arms=0.5: must be a list of numbers, each from 0 to 1"),
    (["train", "experiment=fig2"], "experiment=fig2: is a grid of runs and needs -m"),
    (["train", "-m", "experiment=fig3"], "experiment=fig3: did you mean fig"),
    (["train", "algo=slbo", "model_patience=3"], "model_patience: algo=slbo has no such setting; algo=ops_mbpo or"),
    (["train", "algo=pets", "eval_policy=best"], "eval_policy: algo=pets has no such setting"),
    (["train", "algo=pets", "eval_actions=sampled"], "eval_actions: algo=pets has no such setting"),
    (["train", "algo=sac", "sweep.prior_scale=[0,1]"], "sweep.prior_scale: algo=sac has one policy and no"),
    (["eval"], "run_dir: eval needs one directory"),
    (["eval", "nowhere", "run_dir=elsewhere"], "run_dir: eval needs one directory"),
    (["eval", "nowhere"], "run_dir=nowhere: holds no config.yaml"),
    (["eval", "nowhere", "polcy=best"], "polcy=best: no such option of eval; did you mean policy?"),
    (["eval", "run_dir=nowhere"], "run_dir=nowhere: holds no config.yaml"),
    (["eval", "run_dir=nowhere", "n_models=2"], "n_models=2: no such option of eval"),
    (["theory", "episodes=many"], "episodes=many: must be"),
    (["envs", "x"], "x: envs takes no arguments"),
    (["trian"], "trian: no such command"),
    (["train", "-m", "hydra.nosuch=3", "seed=0,1"], "Could not override 'hydra.nosuch'"),
    (["train", "-m", "hydra/launcher=nosuch", "seed=0,1"], "In 'hydra/config': Could not find 'hydra/launcher/nosuch'"),
    (["train", "-m", "hydra/launcher=null", "seed=0,1"], "hydra/launcher=null: Hydra fails (ValueError: "),
    (["train", "-m", "hydra=null", "seed=0,1"], "hydra=null: Hydra fails (ValueError: "),
    (["train", "-m", "hydra.sweeper=null", "seed=0,1"], "hydra.sweeper=null: Hydra fails (RuntimeError: "),
]

WITHOUT_JAX = """
import sys
from vecpsmbpo import cli
status = cli.main(sys.argv[1:])
heavy = {"jax", "mujoco", "brax", "dm_control", "gymnasium", "orbax"} & set(sys.modules)
assert not heavy, heavy
sys.exit(status)
"""


MANY_WITHOUT_JAX = """
import contextlib, io, json, os, sys, tempfile
from vecpsmbpo import cli
for arguments in json.load(sys.stdin):
    out, err = io.StringIO(), io.StringIO()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            status = cli.main(arguments)
        heavy = {"jax", "mujoco", "brax", "dm_control", "gymnasium", "orbax"} & set(sys.modules)
        print(json.dumps([status, out.getvalue(), err.getvalue(), os.listdir(), sorted(heavy)]))
        os.chdir("/")
"""


@pytest.fixture(scope="module")
def answers(tmp_path_factory):
    """What the program answers to each of `MISTAKES`: of one process, since starting it takes a second."""
    result = subprocess.run(
        [sys.executable, "-c", MANY_WITHOUT_JAX],
        input=json.dumps([arguments for arguments, _ in MISTAKES]),
        cwd=tmp_path_factory.mktemp("answers"),
        env=environment(),
        capture_output=True,
        text=True,
        timeout=300,
        check=True,
    )
    assert result.stderr == ""  # of native code and the watcher, too
    return [json.loads(line) for line in result.stdout.splitlines()]


@pytest.mark.parametrize("index", range(len(MISTAKES)), ids=lambda index: " ".join(MISTAKES[index][0])[:40])
def test_a_mistake_is_one_line_and_status_2(index, answers):
    status, output, errors, created, heavy = answers[index]
    assert (status, output, created, heavy) == (2, "", [], [])
    assert errors.startswith(f"vecpsmbpo: {MISTAKES[index][1]}")
    assert errors.count("\n") == 1


@pytest.mark.parametrize("arguments", [["--help"], ["train", "--help"], ["envs"]], ids=" ".join)
def test_help_and_envs_answer_without_jax(arguments, tmp_path):
    result = subprocess.run(
        [sys.executable, "-c", WITHOUT_JAX, *arguments],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert result.returncode == 0, result.stderr
    assert "hopper" in result.stdout


@pytest.mark.parametrize("command", cli.MODULES)
def test_a_command_s_help_names_its_options(command, capsys):
    assert cli.main([command, "--help"]) == 0
    shown = capsys.readouterr().out
    assert shown.startswith(f"`vecpsmbpo {command}`")
    assert "\n  out=" in shown
    assert max(map(len, shown.splitlines())) <= 120


def test_the_help_of_eval_names_what_it_may_be_told(capsys):
    assert cli.main(["eval", "--help"]) == 0
    shown = capsys.readouterr().out
    assert shown.startswith("`vecpsmbpo eval`")
    assert re.findall(r"^  (\w+)=", shown, re.MULTILINE) == ["episodes", "policy", "actions", "backend", "devices"]


def test_version_says_what_a_report_needs_without_jax(tmp_path):
    program = [sys.executable, "-c", WITHOUT_JAX, "--version"]
    result = subprocess.run(program, cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert (result.returncode, result.stderr) == (0, "")
    python = ".".join(map(str, sys.version_info[:3]))
    expected = f"vecpsmbpo {vecpsmbpo.__version__}, jax {jax.__version__}, mujoco {mujoco.__version__}, python {python}"
    assert result.stdout == f"{expected}\n"


def test_envs_names_every_task_and_how_to_install_what_is_missing(monkeypatch, capsys):
    monkeypatch.setattr("vecpsmbpo.envs.registry.Task.installed", property(lambda task: False))
    assert cli.main(["envs"]) == 0
    lines = capsys.readouterr().out.splitlines()[1:]
    assert [line.split()[0] for line in lines] == list(TASKS)
    said = {line.split()[0]: line.partition("no: pip install ")[2].rstrip() for line in lines}
    assert said["playground"] == "'vecpsmbpo[playground]'"
    assert said["dm_control"] == said["ball_in_cup"] == f"--no-deps {pinned('dm-control')}"
    assert said["hopper"] == "gymnasium"


def test_too_little_memory_is_said_before_anything_is_allocated(tmp_path):
    result = command("train", "env=hopper", "n_models=1000", "imagined_capacity=100000000", cwd=tmp_path)
    assert result.returncode == 2
    assert result.stderr.splitlines()[-1].startswith("vecpsmbpo: not enough memory: ")
    assert "lower imagined_capacity" in result.stderr
    assert not list(tmp_path.iterdir())


def test_a_run_directory_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("")
    result = command("train", "size=tiny", "run_dir=file/run", cwd=tmp_path)
    assert result.returncode == 2
    assert result.stderr.splitlines()[-1] == "vecpsmbpo: run_dir=file/run: cannot be written (Not a directory)"


def test_every_setting_has_a_default_and_says_what_it_may_be():
    for algo in TABLE:
        settings = config.compose([f"algo={algo}"])
        for name, field in of_algorithm(algo).items():
            assert allowed(name)
            assert check(name, getattr(settings, name)) == getattr(settings, name)
            assert (field.type, field.metadata) == (FIELDS[name].type, FIELDS[name].metadata)  # one name, one meaning
    assert set(FIELDS) >= CHANGEABLE


@pytest.mark.parametrize("env", config.options("env"))
@pytest.mark.parametrize("size", config.options("size"))
def test_every_task_composes_at_every_size(env, size):
    needed = [f"env.{name}=x" for name, value in config.env_options(env).items() if value == "???"]
    settings = config.compose([f"env={env}", f"size={size}", *needed])
    assert (settings.env, settings.size) == (env, size)
    assert dict(settings.env_options) == {
        name: "x" if value == "???" else value for name, value in config.env_options(env).items()
    }


# The paper's columns, read from the paper: episode length, total steps, weight decay, start states, horizon, target
# entropy, λ, τ.
TABLE_1 = {
    "ant": (1000, 300 * 1000, 1e-4, 10**5, (1, 25), -4, 0.05, 50_000),
    "ball_in_cup": (1000, 150 * 1000, 5e-5, 10**5, (1, 1), -0.05, 0.5, 1000),
    "cartpole_swingup_sparse": (1000, 400 * 1000, 5e-5, 10**5, (1, 1), -0.05, 0.5, 5000),
    "halfcheetah": (1000, 300 * 1000, 1e-4, 10**5, (1, 1), -3, 0.05, 15_000),
    "hopper": (1000, 125 * 1000, 1e-4, 10**5, (1, 15), -1, 0.05, 15_000),
    "walker2d": (1000, 300 * 1000, 1e-4, 10**5, (1, 1), -3, 0.05, 50_000),
    "window_open": (250, 600 * 250, 1e-4, 5 * 10**4, (1, 1), -1, 0.5, 5000),
}


@pytest.mark.parametrize("env", TABLE_1)
def test_table_1(env):
    settings = config.compose([f"env={env}"])
    assert TABLE_1[env] == (
        settings.episode_length,
        settings.total_steps,
        settings.model_weight_decay,
        settings.rollout_starts,
        (settings.horizon_first, settings.horizon_last),
        settings.target_entropy,
        settings.real_ratio,
        settings.temperature,
    )
    assert (settings.horizon_ramp_start, settings.horizon_ramp_end) == (20, 100)
    assert (settings.n_models, settings.n_policies) == (5, 5)
    assert (settings.model_hidden_size, settings.model_hidden_layers) == (200, 4)
    assert (settings.replay_capacity, settings.imagined_capacity) == (10**6, 10**6)
    assert (settings.model_batch_size, settings.policy_batch_size) == (256, 256)
    assert (settings.discount, settings.policy_learning_rate) == (0.99, 3e-4)


def test_uniform_sampling_is_an_infinite_temperature():
    assert config.compose(["algo=ps_mbpo", "env=hopper"]).temperature == float("inf")


def test_the_command_line_wins():
    settings = config.compose(["env=hopper", "size=cpu", "n_models=4", "real_ratio=0.3"])
    assert (settings.n_models, settings.real_ratio) == (4, 0.3)


def test_the_default_run_directory_tells_runs_apart():
    names = {config.compose(chosen).run_dir for chosen in ([], ["seed=1"], ["real_ratio=0.5"], ["real_ratio=0"])}
    assert len(names) == 4
    assert config.compose(["total_steps=9000"]).run_dir == config.compose([]).run_dir


def test_saved_settings_are_loaded_as_they_were(tmp_path):
    settings = config.compose(["algo=ps_mbpo", f"run_dir={tmp_path}"])
    config.save(settings, tmp_path)
    assert config.load(tmp_path) == settings


@pytest.mark.parametrize(
    ("override", "line"),
    [
        ("n_models=3", "n_models=3: contradicts the run in"),
        ("env=hopper", "env=hopper: contradicts the run in"),
        ("real_ratio_schedule=bandit", "real_ratio_schedule=bandit: contradicts the run in"),
        ("real_ratio=0.25", "real_ratio=0.25: contradicts the run in"),
    ],
)
def test_a_resumed_run_keeps_its_settings(tmp_path, override, line):
    config.save(config.compose(["size=tiny", f"run_dir={tmp_path}"]), tmp_path)
    with pytest.raises(SettingError, match=line):
        config.resolve([f"run_dir={tmp_path}", override])


@pytest.mark.parametrize("switches", [[], ["real_ratio_schedule=bandit", "real_ratio_arms=[0,0.5]"]])
def test_a_resumed_run_may_be_prolonged(tmp_path, switches):
    config.save(config.compose(["size=tiny", f"run_dir={tmp_path}", *switches]), tmp_path)
    again = config.resolve([f"run_dir={tmp_path}", "total_steps=400", "n_models=2", "backend=auto"])
    assert again.total_steps == 400


def test_a_run_from_before_a_setting_existed_is_read_with_its_default(tmp_path):
    settings = config.compose(["size=tiny", f"run_dir={tmp_path}"])
    config.save(settings, tmp_path)
    text = (tmp_path / "config.yaml").read_text()
    assert text.count("eval_actions: mean\n") == 1
    (tmp_path / "config.yaml").write_text(text.replace("eval_actions: mean\n", ""))
    assert config.load(tmp_path) == settings


@pytest.mark.parametrize(
    "text",
    [
        *(json.dumps({"env": "hopper"}), "", "[1, 2]", "{", "5", "\xff\x00", "[" * 5000, "{[1]: 2}", "- a\n b: c"),
        *("env: [1]", "sweep: 5", "env_options: 5", "env_options: [[1], 2]", "algo: foo", "env: {}", "seed: -1"),
    ],
)
def test_a_damaged_config_is_named(tmp_path, text):
    config.save(config.compose(["size=tiny"]), tmp_path)
    good = (tmp_path / "config.yaml").read_text()
    named = text.partition(":")[0]
    damaged = re.sub(rf"^{named}:.*\n", f"{text}\n", good, flags=re.M) if f"\n{named}:" in f"\n{good}" else text
    (tmp_path / "config.yaml").write_bytes(damaged.encode("latin-1"))
    with pytest.raises(SettingError, match=r"its config\.yaml (cannot be read|has )") as error:
        config.load(tmp_path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("experiment", config.options("experiment"))
@pytest.mark.parametrize("size", ["cpu", "paper"])
def test_every_run_of_every_experiment_composes(experiment, size):
    with hydra.initialize_config_module("vecpsmbpo.configs", version_base="1.3"):
        chosen = [f"experiment={experiment}", f"size={size}"]
        params = hydra.compose("config", chosen, return_hydra_config=True).hydra.sweeper.params
        names, values = list(params), [str(value).split(",") for value in params.values()]
        runs = []
        for point in itertools.product(*values):
            overrides = [*chosen, *(f"{name}={value}" for name, value in zip(names, point, strict=True))]
            settings = config.from_tree(hydra.compose("config", overrides), overrides)
            assert settings.size == size
            for name, value in zip(names, point, strict=True):
                assert str(getattr(settings, name)) == value
            runs.append(settings.run_dir)
    assert len(set(runs)) == len(runs)
    assert all(run.startswith(f"runs/{experiment}/") for run in runs)


def test_an_experiment_runs_from_the_command_line(tmp_path):
    """Two runs of figure 6, made cheap: one samples policies and one averages them."""
    small = ["size=tiny", "env=ball_in_cup", "backend=host", "n_policies=1", "num_seeds=1"]
    for total in (40, 80):  # the second time it goes on with each
        result = command("train", "-m", "experiment=fig6", *small, f"total_steps={total}", cwd=tmp_path)
        assert result.returncode == 0, result.stderr
    assert result.stdout.count("resuming at step 40") == 2
    runs = sorted((tmp_path / "runs" / "fig6").iterdir())
    assert ["average" in run.name for run in runs] == [True, False]
    for run in runs:
        assert config.load(run).posterior == ("average" if "average" in run.name else "sample")
        assert (run / "metrics.jsonl").read_text().count("\n") == 2
    assert {path.name for path in tmp_path.iterdir()} == {"runs"}


def test_a_run_of_a_grid_that_cannot_be_is_one_line_and_the_others_go_on(tmp_path):
    small = ["env=ball_in_cup", "backend=host", "size=tiny", "total_steps=40"]
    result = command("train", "-m", *small, "algo=slbo", "n_models=2,1", cwd=tmp_path)
    assert result.returncode == 2
    assert result.stderr.splitlines() == ["vecpsmbpo: n_models=2: must be 1 with algo=slbo"]
    assert [run.name[-9:] for run in (tmp_path / "runs").iterdir() if run.is_dir()] == ["n_models1"]


def test_a_run_of_a_grid_that_cannot_be_written_does_not_take_the_others_with_it(tmp_path):
    (tmp_path / "file").touch()
    small = ["env=ball_in_cup", "backend=host", "size=tiny", "total_steps=40", "loggers=[]"]
    result = command("train", "-m", *small, "run_dir=file/run,whole", cwd=tmp_path)
    assert result.returncode == 2
    assert result.stderr.splitlines() == ["vecpsmbpo: run_dir=file/run: cannot be written (Not a directory)"]
    assert (tmp_path / "whole" / "metrics.jsonl").read_text().count("\n") == 1


def test_swept_values_are_kept_with_the_run(tmp_path):
    settings = config.compose(["size=tiny", "num_seeds=2", "seed=5", "sweep.temperature=[1,.inf]"])
    assert [tuple(lane.values()) for lane in settings.lanes] == [(5, 1.0), (6, 1.0), (5, math.inf), (6, math.inf)]
    config.save(settings, tmp_path)
    assert dataclasses.replace(config.load(tmp_path), run_dir=settings.run_dir) == settings
    with pytest.raises(SettingError, match="contradicts the run"):
        config.resolve([f"run_dir={tmp_path}", "sweep.temperature=[1,2]"])
