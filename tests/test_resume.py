"""A run that is killed or stopped, and goes on: through the command line, to the bit."""

import re
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest

import vecpsmbpo
from tests.helpers import argv, assert_probabilities_follow, assert_same_run, command, environment
from vecpsmbpo import config, jsonl, stopping
from vecpsmbpo.settings import SettingError

TOTAL = 320  # so that five attempts which are killed do not come to its end
SMALL = ["env=cartpole_swingup", "size=tiny", "num_seeds=2", f"total_steps={TOTAL}"]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """A run of two seeds on one CPU thread."""
    folder = tmp_path_factory.mktemp("undisturbed")
    result = command("train", *SMALL, "run_dir=run", cwd=folder, one_thread=True)
    assert result.returncode == 0, result.stderr
    return folder / "run"


def _is_saving(run_dir: Path) -> bool:
    """Whether orbax is writing a checkpoint, which it renames when it is whole."""
    return any("orbax-checkpoint-tmp" in path.name for path in (run_dir / "checkpoints").iterdir())


def test_a_run_killed_again_and_again_is_the_undisturbed_run(undisturbed, tmp_path):
    """kill -9, the same command each time: at random moments, and twice in the middle of a save."""
    arguments = argv("train", *SMALL, "run_dir=run", one_thread=True)
    random = np.random.default_rng(0)
    kills = 0
    for attempt in range(5):
        process = subprocess.Popen(arguments, cwd=tmp_path, env=environment(), stdout=subprocess.PIPE, text=True)
        for line in process.stdout:  # compiling takes most of the time: wait for the work to begin
            if "compiled in" in line:
                break
        if attempt in (0, 3):
            while process.poll() is None and not _is_saving(tmp_path / "run"):
                time.sleep(1e-4)
        else:
            time.sleep(random.uniform(0.0, 1.5))
        if process.poll() is None:
            process.send_signal(signal.SIGKILL)
            kills += 1
        process.communicate()
    result = command("train", *SMALL, "run_dir=run", cwd=tmp_path, one_thread=True)
    assert result.returncode == 0, result.stderr
    assert kills >= 4
    assert_same_run(tmp_path / "run", undisturbed)


@pytest.fixture
def hanging_up():
    """SIGHUP is heeded by what is started, also where the tests run under nohup."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


def test_a_signal_saves_and_says_how_to_go_on(hanging_up, undisturbed, tmp_path):
    """Each of the signals that ask a run to stop, one after the other; then to the same end."""
    arguments, done = SMALL, 0
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        process = subprocess.Popen(
            argv("train", *arguments, "run_dir=run", one_thread=True),
            cwd=tmp_path,
            env=environment(),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        said = ""
        for line in process.stdout:
            said += line
            if "compiled in" in line:
                process.send_signal(number)
                break
        rest, errors = process.communicate(timeout=300)
        assert process.returncode == 128 + number, errors
        assert errors.strip() == stopping.FINISHING
        assert f"resuming at step {done}" in said or not done
        assert "to continue: vecpsmbpo train run_dir=run" in said + rest
        saved = int(re.search(rf"saved at step (\d+) of {TOTAL}", said + rest).group(1))
        assert done <= saved < TOTAL  # the same, where the signal comes before the first step
        arguments, done = [], saved
    result = command("train", "run_dir=run", cwd=tmp_path, one_thread=True)
    assert result.returncode == 0, result.stderr
    assert f"resuming at step {done}" in result.stdout
    assert_same_run(tmp_path / "run", undisturbed)


CHOOSING = ["real_ratio_schedule=bandit", "real_ratio_arms=[0.05,0.3]"]


@pytest.mark.parametrize(("algo", "switches"), [("ops_mbpo", CHOOSING), ("pets", []), ("slbo", [])])
def test_a_host_run_resumes_exactly(algo, switches, tmp_path):
    """The simulator's state is in the checkpoint: 120 steps at once equal 80 and then 40."""
    constant = [] if algo in ("pets", "slbo") else ["policy_learning_rate_cooldown=0"]  # which depends on total_steps
    common = ["env=hopper", "backend=host", "size=tiny", f"algo={algo}", *constant, *switches]
    for folder, budgets in (("once", [120]), ("twice", [80, 120])):
        for total in budgets:
            arguments = ["train", *common, f"run_dir={folder}", f"total_steps={total}"]
            result = command(*arguments, cwd=tmp_path, one_thread=True)
            assert result.returncode == 0, result.stderr
    assert_same_run(tmp_path / "twice", tmp_path / "once")
    if algo == "pets":
        with pytest.raises(SettingError, match="algo=pets plans its actions"):
            vecpsmbpo.load(tmp_path / "once").policy  # noqa: B018
    else:
        actions = vecpsmbpo.load(tmp_path / "once").policy(np.ones((4, 11)))
        assert actions.shape == (4, 3)
        assert np.all(np.abs(actions) <= 1)


def test_a_finished_run_says_so(undisturbed):
    result = command("train", "run_dir=run", cwd=undisturbed.parent, one_thread=True)
    assert result.returncode == 0
    assert f"already complete at {TOTAL} steps" in result.stdout


def test_evaluation_of_a_run(undisturbed):
    result = command("eval", "run_dir=run", "episodes=2", "backend=host", "devices=2", cwd=undisturbed.parent)
    assert result.returncode == 0, result.stderr
    assert f"cartpole_swingup (host) at step {TOTAL}" in result.stdout
    assert len(re.findall(r"│ +[01] │ +2 │", result.stdout)) == 2


def test_probabilities_can_be_recomputed_from_the_log(undisturbed):
    settings = config.load(undisturbed)
    for seed in (0, 1):
        lines = [line for line in jsonl.read(undisturbed / "episodes.jsonl") if line["seed"] == seed]
        assert_probabilities_follow(lines, settings.n_models, settings)
