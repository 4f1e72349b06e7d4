"""What careless commands and surroundings do: one line each. In this process, where nothing has to start."""

import contextlib
import errno
import importlib.util
import io
import os
import re
import shlex
import signal
import subprocess
import sys
import warnings

import jax
import pytest
from rich.console import Console

from tests.helpers import command, environment, tiny
from vecpsmbpo import cli, config, runtime, stopping, words
from vecpsmbpo.envs import registry
from vecpsmbpo.settings import SettingError
from vecpsmbpo.sweeps import launch

SUITE = ["env=gymnasium", "backend=host"]
CARELESS = [
    (["temperature=1e-320"], "temperature=1e-320: must be 0 or between"),
    (["temperature=1e39"], "temperature=1e+39: must be 0 or between"),
    (["model_learning_rate=1e-50"], "model_learning_rate=1e-50: must be 0 or between"),
    (["target_entropy=-1e39"], "target_entropy=-1e+39: must be 0 or between"),
    (["sweep.temperature=[1,1e-50]"], "temperature=1e-50: must be 0 or between"),
    (["sweep.real_ratio=[0.1,0.10000000001]"], "sweep.real_ratio=[0.1, 0.10000000001]: two of its values are the same"),
    (["sweep.temperature=[.inf,.inf]"], "sweep.temperature="),
    (["episode_length=1e10"], "episode_length=10000000000.0: must be at most 2147483647"),
    (["model_hidden_size=1e10"], "model_hidden_size=10000000000.0: must be at most 2147483647"),
    (["rollout_starts=9999999999"], "rollout_starts=9999999999: must be at most 2147483647"),
    (["rollout_starts=2e9"], "rollout_starts=2000000000.0: must be a whole number from 1 to 10000000"),
    (["policy_hidden_layers=2000"], "policy_hidden_layers=2000: must be a whole number from 1 to 100"),
    (["eval_episodes=1e9"], "eval_episodes=1000000000.0: must be a whole number from 1 to 10000"),
    (["eval_episodes=6000", "num_seeds=2"], "eval_episodes=6000: at most 10000 of all seeds together, not 12000"),
    (["run_dir='a\\b'"], "run_dir=a\\b: must be a folder of this machine, without a backslash"),
    (["run_dir=gs://b"], "run_dir=gs://b: must be a folder of this machine"),
    (["seed=3000000000"], "seed=3000000000: must be at most 2147483647"),
    (["num_seeds=1000000000"], "num_seeds=1000000000: at most 10000 seeds"),
    (["num_seeds=6000", "sweep.real_ratio=[0,1]"], "num_seeds=6000: at most 10000 seeds"),
    (["~seed=0"], "~seed=0: a setting cannot be taken away"),
    (["run_dir=${nosuch}"], "Interpolation key 'nosuch' not found"),
    ([f"run_dir={'x' * 300}"], f"run_dir={'x' * 300}: File name too long"),
    (["-m", "seed=0,0"], "seed=0,0: the same value twice"),
    (["-m", "seed=0,0.0"], "seed=0,0.0: the same value twice"),
    (["-m", "real_ratio=0,0.0"], "real_ratio=0,0.0: the same value twice"),
    (["-m", "real_ratio=0.1,0.10000000001"], "real_ratio=0.1,0.10000000001: the same value twice"),
    (["-m", "total_steps=1e4,10000"], "total_steps=1e4,10000: the same value twice"),
    (["-m", "real_ratio=0,-0.0"], "real_ratio=0,-0.0: the same value twice"),
    (["-m", "seed=range(0,0)"], "seed=range(0,0): is a range of no value"),
    (["-m", "seed=range(0,1e12)"], "seed=range(0,1e12): is a range of more than 10000 values"),
    (["-m", "seed=range(0,5,0)"], "seed=range(0,5,0): range() arg 3 must not be zero"),
    (["-m", "size=glob(*)"], "size=glob(*): only a,b,… or choice() and range() can be swept"),
    (["-m", "seed=interval(0,1)"], "seed=interval(0,1): only a,b,… or choice() and range() can be swept"),
    (["env='hop\nper'"], r"env=hop\nper: did you mean hopper"),
    *(([*SUITE, f"env.id={wrong}"], "env.id=") for wrong in ("5", "null", "[1,2]", "''", "{a: 1}", "true")),
]


@pytest.mark.parametrize(("arguments", "line"), CARELESS, ids=lambda value: " ".join(value)[:40])
def test_a_careless_command_is_one_line(arguments, line, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["train", *arguments]) == 2
    said = capsys.readouterr()
    assert said.err.startswith(f"vecpsmbpo: {line}")
    assert (said.err.count("\n"), said.out) == (1, "")
    assert not list(tmp_path.iterdir())


def test_a_default_run_directory_of_many_overrides_has_a_name_that_fits():
    many = [f"{name}=0.{'1' * 15}" for name in ("real_ratio", "temperature", "discount", "target_entropy")]
    many += [f"{name}=0.{'1' * 15}" for name in ("policy_learning_rate", "model_learning_rate", "target_update_rate")]
    names = {config.compose([*many, f"model_weight_decay={value}"]).run_dir for value in (0.1, 0.2)}
    assert len(names) == 2
    assert all(len(name) < 255 for name in names)


@pytest.mark.parametrize("launcher", ["ray", "'ray'", "[ray]"])
def test_a_launcher_that_is_not_installed_is_one_line(launcher, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(SettingError, match=r"needs the package ray; pip install 'vecpsmbpo\[ray\]'"):
        launch.check(["seed=0,1", f"hydra/launcher={launcher}"])


def test_a_suite_that_is_not_installed_is_said_before_jax_is_imported(monkeypatch):
    monkeypatch.setattr(registry.Task, "installed", False)
    with pytest.raises(SettingError, match=r"env=brax: needs the package brax; pip install brax"):
        config.resolve(["env=brax", "env.id=reacher"])


def test_an_exception_in_one_line_says_where_it_was_raised():
    with pytest.raises(KeyError) as found:
        {}["x"]
    assert re.fullmatch(rf"KeyError: 'x' at {__file__}:\d+", words.of(found.value))


def test_an_exception_in_one_line_says_no_more_than_it_can():
    class Speechless(Exception):
        def __str__(self):
            raise ValueError

    assert words.of(Speechless()) == "Speechless"


def test_float64_is_refused():
    jax.config.update("jax_enable_x64", True)
    try:
        for check in (lambda: runtime.configure(tiny()), runtime.check_float32):
            with pytest.raises(SettingError, match=r"^jax_enable_x64 \(JAX_ENABLE_X64\): must be off"):
                check()
    finally:
        jax.config.update("jax_enable_x64", False)


@pytest.mark.parametrize("error", [RuntimeError("Unable to initialize backend"), AssertionError()])
def test_a_device_that_is_not_there_is_one_line(error, monkeypatch):
    def fail():
        raise error

    monkeypatch.setattr(jax, "devices", fail)
    monkeypatch.setenv("JAX_PLATFORMS", "foo")
    with pytest.raises(SettingError, match="JAX_PLATFORMS=foo: no such device here"):
        runtime.configure(tiny())
    monkeypatch.delenv("JAX_PLATFORMS")
    with pytest.raises(SettingError, match="JAX finds no device"):
        runtime.configure(tiny())


def test_the_command_says_so_too(tmp_path, monkeypatch):
    """Nothing on the way out asks for the device again."""
    monkeypatch.setenv("JAX_PLATFORMS", "foo")
    result = command("train", "size=tiny", cwd=tmp_path)
    assert (result.returncode, result.stderr) == (2, "vecpsmbpo: JAX_PLATFORMS=foo: no such device here\n")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("variable", "value", "said"),
    [
        ("JAX_ENABLE_X64", "foo", "invalid truth value 'foo' for environment 'JAX_ENABLE_X64'"),
        ("JAX_NUM_CPU_DEVICES", "x", 'Invalid value "x" for JAX flag jax_num_cpu_devices'),
        ("JAX_DEFAULT_DEVICE", "foo", "jax.default_device must be passed either a Device object"),
        ("MUJOCO_GL", "foo", "invalid value for environment variable MUJOCO_GL: foo"),
    ],
)
def test_a_variable_that_jax_or_mujoco_refuses_is_one_line(variable, value, said, monkeypatch, capsys):
    def fail(arguments):
        raise ValueError(f"{said}\nand more")

    monkeypatch.setattr(cli, "_dispatch", fail)
    monkeypatch.delenv(variable, raising=False)
    with pytest.raises(ValueError, match=re.escape(said)):  # nobody has set it: a fault of the program
        cli.main([])
    monkeypatch.setenv(variable, value)
    assert cli.main([]) == 2
    assert capsys.readouterr().err == f"vecpsmbpo: {variable}={value}: {said}\n"


def test_a_value_that_xla_cannot_read_is_one_line(monkeypatch):
    said = "E1129 01:50:19.87 104 flags.cc:63] Couldn't interpret value x.\nF1129 01:50:19.88 104 env.cc:9] No\nFlags:"
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: subprocess.CompletedProcess([], 1, stderr=said))
    monkeypatch.setenv("XLA_FLAGS", "--xla_foo=x")
    with pytest.raises(SettingError, match=r"^XLA_FLAGS=--xla_foo=x: Couldn't interpret value x\.$"):
        runtime.configure(tiny())


def test_a_flag_that_xla_does_not_know_is_one_line(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "")
    monkeypatch.setattr(subprocess, "run", pytest.fail)
    runtime.configure(tiny())  # costs nothing where there are none
    monkeypatch.undo()
    monkeypatch.setenv("XLA_FLAGS", "--xla_foo=1")
    with pytest.raises(SettingError, match="XLA_FLAGS=--xla_foo=1: Unknown flag in XLA_FLAGS: --xla_foo=1"):
        runtime.configure(tiny())


@pytest.mark.parametrize("name", ["runs/x", "a=b", "5", "a b", "λ, τ", "it's", "null", "[1]", "$HOME", "a\\", "{x}"])
def test_the_command_to_continue_names_the_run_to_a_shell_and_to_hydra(name):
    command = shlex.quote(config.as_override("run_dir", name))
    (argument,) = shlex.split(command)
    assert config.parse([argument]) == {"run_dir": name}


def test_a_terminal_without_greek_letters_is_no_reason_to_fail(monkeypatch):
    shown = io.TextIOWrapper(io.BytesIO(), encoding="ascii", write_through=True)
    monkeypatch.setattr(sys, "stdout", shown)
    assert cli.main(["--version"]) == 0
    print("λ = 0.5")
    assert shown.buffer.getvalue().endswith(b"? = 0.5\n")


def test_what_the_system_refuses_is_one_line(monkeypatch, capsys):
    monkeypatch.setattr(cli, "_dispatch", lambda arguments: os.stat("/nowhere/at/all"))
    assert cli.main([]) == 2
    assert capsys.readouterr().err == "vecpsmbpo: /nowhere/at/all: No such file or directory\n"


@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGTERM, signal.SIGINT])
def test_signals_that_ask_a_run_to_stop(number, capfd):
    before = signal.signal(number, signal.SIG_DFL)  # also where the tests run under nohup
    try:
        with stopping.heeding_signals() as stop:
            os.kill(os.getpid(), number)
            assert stop.requested == number
    finally:
        signal.signal(number, before)
    assert "finishing this chunk and saving" in capfd.readouterr().err


def test_a_run_under_nohup_outlives_its_terminal():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with stopping.heeding_signals() as stop:
            os.kill(os.getpid(), signal.SIGHUP)
            assert stop.requested is None
    finally:
        signal.signal(signal.SIGHUP, before)


INTERRUPTED = """
import os, runpy, signal, sys, time
wanted = sys.argv.pop(1)
from importlib.abc import MetaPathFinder
class Interrupting(MetaPathFinder):
    def find_spec(self, name, *_):
        if name == wanted:
            try:
                os.kill(os.getpid(), signal.SIGINT)
                time.sleep(9)
            except BaseException:
                pass
signal.signal(signal.SIGINT, signal.default_int_handler)
sys.meta_path.insert(0, Interrupting())
runpy.run_module("vecpsmbpo", run_name="__main__")
"""


@pytest.mark.parametrize("module", ["vecpsmbpo.cli", "hydra", "jax"])
def test_control_c_is_not_lost_in_an_import(module, tmp_path):
    """Of the first of our own, while arguments are understood, and later."""
    arguments = [sys.executable, "-c", INTERRUPTED, module, "train", "size=tiny"]
    result = subprocess.run(arguments, env=environment(), cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert (result.returncode, result.stderr) == (130, "vecpsmbpo: interrupted\n")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("words", [["--version"], ["--help"]])
def test_a_reader_that_has_read_enough_is_no_mistake(words, monkeypatch, capsys):
    """`vecpsmbpo --help | head`, also where all fits into the buffer and is written when the program ends."""
    reading, writing = os.pipe()
    os.close(reading)
    unheard: list[str] = []
    monkeypatch.setattr(stopping, "speak_to_nobody", lambda: unheard.append("gone"))
    with contextlib.suppress(BrokenPipeError), open(writing, "w") as pipe:  # closing it fails, too
        monkeypatch.setattr("sys.stdout", pipe)
        status = cli.main(words)
    assert (status, unheard) == (141, ["gone"])
    assert capsys.readouterr().err == ""


def test_a_cache_that_memory_is_out_for_says_nothing_beside_the_run():
    """The run's own line says it. Another failure of the cache, which costs every start its compiling, is heard."""
    failed = "Error reading persistent compilation cache entry for 'jit_body': {}"
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        runtime.configure(tiny())
        warnings.warn(failed.format("MemoryError: std::bad_alloc"), stacklevel=1)
        warnings.warn(failed.format("OSError: no such disk"), stacklevel=1)
    assert [str(warning.message) for warning in heard] == [failed.format("OSError: no such disk")]


def test_another_pipe_that_breaks_is_said(monkeypatch, capsys):
    """Of a logger's service, for example, while somebody reads what is printed."""

    def breaks(arguments):
        raise BrokenPipeError(errno.EPIPE, os.strerror(errno.EPIPE))

    monkeypatch.setattr(cli, "_dispatch", breaks)
    assert cli.main(["envs"]) == 2
    assert capsys.readouterr().err == "vecpsmbpo: Broken pipe\n"


def test_a_reader_that_is_gone_does_not_stop_what_is_printed_to_it(monkeypatch):
    """`vecpsmbpo train | head`, and a terminal that was closed."""
    reading, writing = os.pipe()
    os.close(reading)
    unheard: list[str] = []
    monkeypatch.setattr(stopping, "speak_to_nobody", lambda: unheard.append("gone"))
    with open(writing, "w", buffering=1) as pipe:
        console = Console(file=stopping.Outliving(pipe))
        console.print("a line")
        console.print("another")
        assert unheard
        with contextlib.suppress(BrokenPipeError):  # what is left in its buffer
            pipe.close()
