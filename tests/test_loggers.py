"""Loggers beside the JSONL files: what they are told, and that nothing which happens to one stops a run."""

import dataclasses
import json
import os
import struct
import threading
import time
import types
from pathlib import Path

import pytest
from PIL import Image
from tensorboardX import record_writer

from tests.helpers import command, tiny
from vecpsmbpo import cli, config, jsonl, loggers, run_log
from vecpsmbpo.settings import SettingError
from vecpsmbpo.training import loop


class Recorder:
    """A logger that keeps what it is told; of a class that a test may bend."""

    def __init__(self, settings, run_dir, env_steps):
        self.told, self.sent, self.closed = [], [], False
        self.threads = {threading.current_thread()}
        self.id = loggers._id(run_dir, "wandb", lambda: "made")
        type(self).made.append(self)

    def scalars(self, values, env_steps):
        self.threads.add(threading.current_thread())
        self.told.append((env_steps, dict(values)))

    def flush(self):
        pass

    def files(self, paths):
        self.sent += [path.name for path in paths]

    def close(self):
        self.closed = True


@pytest.fixture
def recorder(monkeypatch):
    kind = type("Kind", (Recorder,), {"made": []})
    monkeypatch.setattr(loggers, "Wandb", kind)
    return kind


def _settings(*names):
    return dataclasses.replace(tiny(), loggers=names)


def _line(step, **more):
    return {"env_steps": step, "seed": 0, "return": step / 10, "length": 5, **more}


def test_a_logger_is_told_every_number_on_a_thread_of_its_own(tmp_path, recorder):
    (tmp_path / "walk.gif").write_bytes(b"")
    log = run_log.RunLog(tmp_path, 0, _settings("wandb"), warn=pytest.fail)
    log.episodes([_line(25)])
    log.metrics([_line(40, eval_return=7.0, model_loss=None, probs=[0.5])])
    log.close()
    (made,) = recorder.made
    assert made.told == [
        (25, {"episode/return/seed0": 2.5, "episode/length/seed0": 5}),
        (40, {"epoch/eval_return/seed0": 7.0, "epoch/return/seed0": 4.0, "epoch/length/seed0": 5}),
    ]
    assert (made.sent, made.closed) == (["walk.gif"], True)
    assert made.threads.isdisjoint({threading.main_thread()})


@pytest.mark.parametrize(
    ("given", "step", "filmed"),
    [
        ({"loggers": ("wandb",)}, 120, True),
        ({"loggers": ("tensorboard", "mlflow")}, 120, True),
        ({"loggers": ("tensorboard",)}, 120, False),  # which takes none
        ({"loggers": ()}, 120, False),
        ({"loggers": (), "report": True}, 120, True),
        ({"loggers": ("wandb",)}, 80, False),  # it goes on
        ({"loggers": ("wandb",), "algo": "pets"}, 120, False),  # it has no policy
    ],
)
def test_who_takes_films_gets_one_of_a_run_that_is_complete(given, step, filmed, tmp_path, recorder, monkeypatch):
    """Made before loggers are closed, which is when they are sent what lies there."""
    monkeypatch.setattr(loop.render, "keep", lambda run_dir, warn: (run_dir / "episode.gif").write_bytes(b"GIF89a"))
    monkeypatch.setattr(loop.report, "keep", lambda run_dir, warn: (run_dir / "report.html").write_text("a page"))
    settings = dataclasses.replace(tiny(algo=given.pop("algo", "ops_mbpo")), **given)
    said = types.SimpleNamespace(say=lambda text: None)
    session = object.__new__(loop._Session)  # without the driver that it is opened with
    vars(session).update(settings=settings, env_steps=step, to_evaluate=False, run_dir=tmp_path, display=said)
    session._film()
    assert (tmp_path / "episode.gif").exists() == filmed
    assert (tmp_path / "report.html").exists() == settings.report
    if settings.loggers == ("wandb",):
        run_log.RunLog(tmp_path, 0, settings, warn=pytest.fail).close()
        assert recorder.made[0].sent == (["episode.gif"] if filmed else [])


def test_a_film_that_cannot_be_made_is_said(tmp_path):
    """A run directory without a run: the line of the command is the reason."""
    said = []
    loop.render.keep(tmp_path, said.append)
    (line,) = said
    assert line.startswith(f"{tmp_path}/episode.")
    assert line.endswith(f"is not made (run_dir={tmp_path}: holds no config.yaml, so no run)")


def test_a_resumed_session_is_the_same_run_and_says_nothing_twice(tmp_path, recorder):
    for begins, steps in ((0, (10, 20, 30)), (20, (30, 40))):  # a kill after step 30 undid what came after 20
        log = run_log.RunLog(tmp_path, begins, _settings("wandb", "tensorboard"), warn=pytest.fail)
        log.metrics([_line(step) for step in steps])
        log.close()
    first, second = recorder.made
    assert [step for step, _ in first.told] == [10, 20, 30]
    assert [step for step, _ in second.told] == [40]
    assert first.id == second.id == "made"
    assert [line["env_steps"] for line in jsonl.read(tmp_path / "metrics.jsonl")] == [10, 20, 30, 40]


def test_a_logger_that_joins_later_is_told_what_is_done_again(tmp_path, recorder):
    for names, begins, steps in ((["tensorboard"], 0, (10, 20, 30)), (["wandb"], 20, (30, 40))):
        log = run_log.RunLog(tmp_path, begins, _settings(*names), warn=pytest.fail)
        log.metrics([_line(step) for step in steps])
        log.close()
    (made,) = recorder.made
    assert [step for step, _ in made.told] == [30, 40]


@pytest.mark.parametrize("where", ["__init__", "scalars", "flush", "files", "close"])
def test_what_goes_wrong_with_a_logger_is_said_once(where, tmp_path, recorder, monkeypatch):
    def fail(self, *args):
        raise ConnectionError("the server is gone\nand more")

    monkeypatch.setattr(recorder, where, fail)
    said = []
    log = run_log.RunLog(tmp_path, 0, _settings("wandb", "tensorboard"), said.append)
    for step in range(1, 6):
        log.metrics([_line(step)])
    log.close()
    assert said == ["loggers: the run goes on without wandb (the server is gone)"]
    assert len(jsonl.read(tmp_path / "metrics.jsonl")) == 5
    assert list((tmp_path / "tensorboard").iterdir())


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs a disk that is always full")
def test_a_tensorboard_that_cannot_be_written_holds_nothing_up(tmp_path, monkeypatch, capfd):
    monkeypatch.setattr(record_writer, "open_file", lambda path: Path("/dev/full").open("wb"))  # noqa: SIM115
    said = []
    log = run_log.RunLog(tmp_path, 0, _settings("tensorboard"), said.append)
    for step in range(1, 300):
        log.metrics([_line(step)])
    log.close()
    assert said == ["loggers: the run goes on without tensorboard ([Errno 28] No space left on device)"]
    assert len(jsonl.read(tmp_path / "metrics.jsonl")) == 299
    assert capfd.readouterr().err == ""


def test_a_logger_that_fails_is_closed_and_told_what_it_missed_where_that_is_done_again(
    tmp_path, recorder, monkeypatch
):
    def scalars(self, values, env_steps):
        if env_steps > 20:
            raise ConnectionError("the server is gone")
        Recorder.scalars(self, values, env_steps)

    with monkeypatch.context() as patch:
        patch.setattr(recorder, "scalars", scalars)
        log = run_log.RunLog(tmp_path, 0, _settings("wandb"), warn=lambda text: None)
        for step in (10, 20, 30):
            log.metrics([_line(step)])
        log.close()
        (first,) = recorder.made
        for thread in first.threads:
            thread.join(10)
    log = run_log.RunLog(tmp_path, 10, _settings("wandb"), warn=pytest.fail)  # a kill undid what came after step 10
    for step in (20, 30, 40):
        log.metrics([_line(step)])
    log.close()
    assert first.closed
    assert [step for made in recorder.made for step, _ in made.told] == [10, 20, 30, 40]


def test_tensorboard_that_fails_does_not_stop_a_run_either(tmp_path, monkeypatch):
    monkeypatch.setattr(loggers.TensorBoard, "scalars", lambda *args: 1 / 0)
    said = []
    log = run_log.RunLog(tmp_path, 0, _settings("tensorboard"), said.append)
    log.metrics([_line(1)])
    log.metrics([_line(2)])
    log.close()
    assert said == ["loggers: the run goes on without tensorboard (division by zero)"]


def test_a_connection_that_hangs_holds_nothing_up(tmp_path, recorder, monkeypatch):
    release = threading.Event()
    monkeypatch.setattr(recorder, "scalars", lambda *args: release.wait(60))
    monkeypatch.setattr(loggers, "CLOSE_S", 0.1)
    said = []
    log = run_log.RunLog(tmp_path, 0, _settings("wandb"), said.append)
    log.metrics([_line(1)])
    log.close()
    release.set()
    assert said == ["loggers: the run goes on without wandb (it did not answer for 0.1 s)"]


@pytest.mark.parametrize("text", ["", "\x00\x00", "forty"])
def test_a_damaged_note_of_what_was_sent_counts_as_all_that_was_logged(text, tmp_path):
    assert loggers._reached(tmp_path, "wandb", 80) == 0  # a new one
    (tmp_path / loggers.IDS.format("wandb")).write_text("abc")
    (tmp_path / loggers.SENT.format("wandb")).write_text("40")
    assert loggers._reached(tmp_path, "wandb", 80) == 40
    (tmp_path / loggers.SENT.format("wandb")).write_text(text)
    assert loggers._reached(tmp_path, "wandb", 80) == 80


def test_hyperparameters_have_the_names_of_the_command_line():
    settings = config.compose(["size=tiny", "env=gymnasium", "env.id=Hopper-v5", "sweep.real_ratio=[0,1]"])
    found = loggers.hyperparameters(settings)
    assert (found["env.id"], found["sweep.real_ratio"], found["n_models"]) == ("Hopper-v5", [0.0, 1.0], 2)
    assert found["loggers"] == ["tensorboard"]


MISTAKES = [
    ("loggers=[tensorbord]", "loggers=['tensorbord']: must be a list of tensorboard, wandb, mlflow"),
    ("loggers=wandb", "loggers=wandb: must be a list of tensorboard, wandb, mlflow"),
]


@pytest.mark.parametrize(("word", "line"), MISTAKES)
def test_a_logger_that_there_is_not(word, line, capsys):
    assert cli.main(["train", "env=hopper", word]) == 2
    assert capsys.readouterr().err == f"vecpsmbpo: {line}\n"


def test_a_missing_extra_is_one_line_before_anything_is_created(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(loggers.importlib.util, "find_spec", lambda name: None)
    assert cli.main(["train", "env=hopper", "size=tiny", "loggers=[wandb]"]) == 2
    assert capsys.readouterr().err == (
        "vecpsmbpo: loggers=[wandb]: needs the package wandb; pip install 'vecpsmbpo[wandb]', or leave it out\n"
    )
    assert not list(tmp_path.iterdir())


def test_loggers_may_change_when_a_run_is_resumed(tmp_path):
    config.save(dataclasses.replace(tiny(), run_dir=str(tmp_path)), tmp_path)
    assert config.load(tmp_path).loggers == ("tensorboard",)
    assert config.resolve([f"run_dir={tmp_path}", "loggers=[]"]).loggers == ()
    with pytest.raises(SettingError, match="must be a list of"):
        config.resolve([f"run_dir={tmp_path}", "loggers=[1]"])


# ── the real ones ─────────────────────────────────────────────────────────────────────────────────────────────────


def _two_sessions(name, folder, monkeypatch):
    """A run that a kill took back from step 30 to 20, and that goes on; nothing goes wrong."""
    run_dir = folder / "run"
    run_dir.mkdir()
    (run_dir / "report.html").write_text("<p>a page</p>")
    Image.new("RGB", (8, 8)).save(run_dir / "episode.gif")
    for begins, steps in ((0, (10, 20, 30)), (20, (30, 40))):
        log = run_log.RunLog(run_dir, begins, _settings(name), warn=pytest.fail)
        log.metrics([_line(step) for step in steps])
        log.close()
    return run_dir


def _records(path):
    """What W&B keeps in a file: LevelDB's log format, blocks of 32 KiB whose records may be in parts, after 7 bytes."""
    data, place, parts = path.read_bytes(), 7, b""
    while place + 7 <= len(data):
        left = 32768 - place % 32768
        if left < 7:
            place += left
            continue
        size, kind = struct.unpack("<HB", data[place + 4 : place + 7])
        parts += data[place + 7 : place + 7 + size]
        place += 7 + size
        if kind in (1, 4):  # whole, or the last part
            yield parts
            parts = b""


def _whole(path, kind):
    """The records of a session that has ended: its last one may come a moment after the end."""
    for _ in range(100):
        records = [kind.FromString(data) for data in _records(path)]
        if records and records[-1].WhichOneof("record_type") == "exit":
            return records
        time.sleep(0.1)
    raise AssertionError(f"{path} has no end")


def test_weights_and_biases_offline(tmp_path, monkeypatch):
    pytest.importorskip("wandb")
    from wandb.proto import wandb_internal_pb2

    monkeypatch.setenv("WANDB_MODE", "offline")
    run_dir = _two_sessions("wandb", tmp_path, monkeypatch)
    (name,) = {path.name for path in run_dir.glob("wandb/*/run-*.wandb")}
    assert name == f"run-{(run_dir / 'wandb.id').read_text()}.wandb"
    history, hyperparameters, files = {}, {}, set()
    for path in sorted(run_dir.glob(f"wandb/offline-run-*/{name}")):
        for record in _whole(path, wandb_internal_pb2.Record):
            items = {item.key or ".".join(item.nested_key): item.value_json for item in record.history.item}
            if "epoch/return/seed0" in items:
                step = json.loads(items["_step"])
                assert step not in history
                history[step] = json.loads(items["epoch/return/seed0"])
            hyperparameters |= {item.key: item.value_json for item in record.run.config.update}
            files |= {item.path for item in record.files.files}
    assert history == {10: 1, 20: 2, 30: 3, 40: 4}
    assert json.loads(hyperparameters["n_models"]) == 2
    for name, suffix in (("report", ".html"), ("episode", ".gif")):
        assert any(Path(path).name.startswith(name) and path.endswith(suffix) for path in files)


def test_mlflow_in_a_file(tmp_path, monkeypatch):
    pytest.importorskip("mlflow")
    from mlflow import MlflowClient

    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{tmp_path / 'mlflow.db'}")
    run_dir = _two_sessions("mlflow", tmp_path, monkeypatch)
    client = MlflowClient()
    experiment = client.get_experiment_by_name("vecpsmbpo")
    (run,) = client.search_runs([experiment.experiment_id])
    assert run.info.run_id == (run_dir / "mlflow.id").read_text()
    assert (run.info.status, run.info.run_name) == ("FINISHED", "run")
    assert run.data.params["n_models"] == "2"
    history = client.get_metric_history(run.info.run_id, "epoch/return/seed0")
    assert [(point.step, point.value) for point in history] == [(10, 1), (20, 2), (30, 3), (40, 4)]
    assert {item.path for item in client.list_artifacts(run.info.run_id)} == {"episode.gif", "report.html"}


def test_a_server_that_is_not_there_does_not_stop_a_run(tmp_path):
    """The whole program, with MLflow pointed at a port where nobody listens."""
    pytest.importorskip("mlflow")
    environment = {"MLFLOW_TRACKING_URI": "http://127.0.0.1:9", "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "0"}
    os.environ.update(environment)
    try:
        words = ["env=cartpole_swingup", "backend=host", "size=tiny", "total_steps=40", "loggers=[mlflow]"]
        result = command("train", *words, "run_dir=run", cwd=tmp_path)
    finally:
        for name in environment:
            del os.environ[name]
    assert result.returncode == 0, result.stderr
    (line,) = [line for line in result.stderr.splitlines() if "mlflow" in line]
    assert line.startswith("vecpsmbpo: warning: loggers: the run goes on without mlflow (")
    assert len(jsonl.read(tmp_path / "run" / "metrics.jsonl")) == 1
