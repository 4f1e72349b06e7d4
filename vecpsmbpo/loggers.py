"""Where a run's numbers go besides its JSONL files: TensorBoard, Weights & Biases, MLflow.

A logger is a convenience. Whatever goes wrong with one is said once, and the run goes on without it; those that may
speak to a server do so on threads of their own, so that a connection that hangs holds nothing up. How they find their
server is theirs to know: WANDB_MODE, WANDB_PROJECT, MLFLOW_TRACKING_URI, MLFLOW_EXPERIMENT_NAME and so on.
"""

import contextlib
import dataclasses
import importlib.util
import logging
import os
import queue
import secrets
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from vecpsmbpo import atomic
from vecpsmbpo.settings import SettingError, Settings

PACKAGES = {"tensorboard": "tensorboardX", "wandb": "wandb", "mlflow": "mlflow"}
PROJECT = "vecpsmbpo"  # W&B's project and MLflow's experiment, unless the environment names another
TENSORBOARD, IDS, SENT = "tensorboard", "{}.id", "{}.sent"  # in the run directory
FILES = ("report.html", "*.mp4", "*.gif")  # of the run directory, that are sent when a session ends
CLOSE_S = 60.0  # that a logger may take to say what it still has to say

Values = Mapping[str, float]


class Logger(Protocol):
    """What takes a run's numbers. Made, and called, on one thread."""

    def scalars(self, values: Values, env_steps: int) -> None:
        """Numbers by name, `group/name/lane`."""

    def flush(self) -> None:
        """An epoch is whole."""

    def files(self, paths: Sequence[Path]) -> None:
        """Pages and videos."""

    def close(self) -> None: ...


def check(names: Iterable[str]) -> None:
    """Says which package a logger lacks, before anything is created.

    Raises:
        SettingError: the first such.
    """
    for name in names:
        if importlib.util.find_spec(PACKAGES[name]) is None:
            extra = PACKAGES[name] if name == "tensorboard" else f"'vecpsmbpo[{name}]'"
            raise SettingError(
                f"loggers=[{name}]: needs the package {PACKAGES[name]}; pip install {extra}, or leave it out"
            )


class Loggers:
    """The loggers of one session of a run, each until it fails."""

    def __init__(self, settings: Settings, run_dir: Path, env_steps: int, sent: int, warn: Callable[[str], None]):
        """
        Args:
            env_steps: where the session begins.
            sent: steps up to which earlier sessions have logged everything. Work that a kill undid is done again, and
                the same; servers cannot forget, so what has reached one it is not told twice.
        """
        self._run_dir = run_dir
        self._loggers: dict[str, Logger] = {}
        self._failed: set[str] = set()
        self._warn = warn
        self._sent = {name: _reached(run_dir, name, sent) for name in settings.loggers}
        for name in settings.loggers:
            try:
                self._loggers[name] = self._make(name, settings, env_steps)
            except Exception as error:  # whatever it is, the run is worth more
                self._drop(name, error)

    def _make(self, name: str, settings: Settings, env_steps: int) -> Logger:
        if name == "tensorboard":
            return TensorBoard(self._run_dir, env_steps)
        kinds: dict[str, Callable[..., Logger]] = {"wandb": Wandb, "mlflow": Mlflow}
        path = self._run_dir / SENT.format(name)
        return Remote(
            lambda: kinds[name](settings, self._run_dir, env_steps),
            lambda error: self._drop(name, error),
            lambda env_steps: atomic.write_text(path, str(env_steps)),
        )

    def scalars(self, values: Values, env_steps: int) -> None:
        for name in self._loggers:
            if env_steps > self._sent[name]:
                self._tell(name, "scalars", values, env_steps)

    def flush(self) -> None:
        for name in self._loggers:
            self._tell(name, "flush")

    def close(self) -> None:
        """Sends the pages and videos that there are, and waits until all is said, but not for ever."""
        paths = sorted(path for pattern in FILES for path in self._run_dir.glob(pattern))
        for name in self._loggers:
            self._tell(name, "files", paths)
            self._tell(name, "close")

    def _tell(self, name: str, what: str, *args: Any) -> None:
        """Calls a method of a logger; one that has failed, perhaps on its own thread, is told nothing more."""
        if name in self._failed:
            return
        try:
            getattr(self._loggers[name], what)(*args)
        except Exception as error:  # as above
            self._drop(name, error)
            if what != "close":
                with contextlib.suppress(Exception):
                    self._loggers[name].close()

    def _drop(self, name: str, error: Exception) -> None:
        if name in self._failed:
            return
        self._failed.add(name)
        reason = (str(error).strip() or repr(error)).splitlines()[0][:200]
        self._warn(f"loggers: the run goes on without {name} ({reason})")


class TensorBoard:
    """TensorBoard's files, by tensorboardX. Not by its `SummaryWriter`, whose thread ends where it cannot write: a run
    would then wait for ever for room in its queue."""

    def __init__(self, run_dir: Path, env_steps: int):
        from tensorboardX import event_file_writer, summary
        from tensorboardX.proto import event_pb2

        self._event, self._scalar = event_pb2.Event, summary.scalar
        folder = run_dir / TENSORBOARD
        folder.mkdir(parents=True, exist_ok=True)
        self._writer = event_file_writer.EventsWriter(str(folder / "events"))
        # TensorBoard forgets what earlier sessions have written from here on.
        begins = event_pb2.SessionLog(status=event_pb2.SessionLog.START)
        self._write(env_steps + 1, session_log=begins)

    def _write(self, env_steps: int, **what: Any) -> None:
        self._writer.write_event(self._event(step=env_steps, wall_time=time.time(), **what))

    def scalars(self, values: Values, env_steps: int) -> None:
        for name, value in values.items():
            self._write(env_steps, summary=self._scalar(name, value))

    def flush(self) -> None:
        self._writer.flush()

    def files(self, paths: Sequence[Path]) -> None:
        """They lie beside its own."""

    def close(self) -> None:
        self._writer.close()


class Remote:
    """A logger on a thread of its own."""

    def __init__(self, make: Callable[[], Logger], failed: Callable[[Exception], None], reached: Callable[[int], None]):
        """Both are called on that thread.

        Args:
            failed: is told what went wrong; nothing is sent any more then.
            reached: is told the steps up to which the logger has taken everything.
        """
        self._make, self._failed, self._reached = make, failed, reached
        self._env_steps = 0
        self._calls: queue.SimpleQueue[Callable[[Logger], None] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def scalars(self, values: Values, env_steps: int) -> None:
        self._env_steps = env_steps
        self._calls.put(lambda logger: logger.scalars(values, env_steps))

    def flush(self) -> None:
        env_steps = self._env_steps
        self._calls.put(lambda logger: logger.flush())
        if env_steps:  # 0: all of this session so far had been said before
            self._calls.put(lambda logger: self._reached(env_steps))

    def files(self, paths: Sequence[Path]) -> None:
        self._calls.put(lambda logger: logger.files(paths))

    def close(self) -> None:
        self._calls.put(lambda logger: logger.close())
        self._calls.put(None)
        self._thread.join(CLOSE_S)
        if self._thread.is_alive():
            raise TimeoutError(f"it did not answer for {CLOSE_S:g} s")

    def _work(self) -> None:
        logger = None
        try:
            logger = self._make()
            while (call := self._calls.get()) is not None:
                call(logger)
        except Exception as error:  # as in `Loggers`
            self._failed(error)  # first: closing may take long
            if logger is not None:
                with contextlib.suppress(Exception):
                    logger.close()


class Wandb:
    """Weights & Biases: one run for the run directory. Without a key it writes what `wandb sync` sends later."""

    def __init__(self, settings: Settings, run_dir: Path, env_steps: int):
        import wandb

        self._wandb = wandb
        mode: Any = os.environ.get("WANDB_MODE") or ("online" if wandb.login(prompt=False) else "offline")
        self._run = wandb.init(
            project=os.environ.get("WANDB_PROJECT", PROJECT),
            name=run_dir.resolve().name,
            id=_id(run_dir, "wandb", lambda: secrets.token_hex(4)),
            resume="allow",
            reinit="create_new",  # the jobs of a multirun share a process
            dir=str(run_dir),
            mode=mode,
            config=hyperparameters(settings),
            settings=wandb.Settings(silent=True, console="off", disable_git=True),
        )
        self._env_steps = env_steps

    def scalars(self, values: Values, env_steps: int) -> None:
        # W&B's steps only rise, over all sessions of a run; what belongs to one step is one row.
        self._env_steps = max(self._env_steps, env_steps)
        self._run.log(dict(values), step=self._env_steps)

    def flush(self) -> None:
        """It does so by itself."""

    def files(self, paths: Sequence[Path]) -> None:
        for path in paths:
            kind: Any = path.suffix[1:]
            shown = self._wandb.Html(str(path)) if kind == "html" else self._wandb.Video(str(path), format=kind)
            self._run.log({path.stem: shown}, step=self._env_steps)

    def close(self) -> None:
        self._run.finish()


class Mlflow:
    """MLflow: one run for the run directory, at the tracking server that MLFLOW_TRACKING_URI names."""

    def __init__(self, settings: Settings, run_dir: Path, env_steps: int):
        from mlflow import MlflowClient
        from mlflow.entities import Metric

        for name in ("mlflow", "alembic"):  # which tell of every step of making a data base
            logging.getLogger(name).setLevel(logging.ERROR)
        self._client, self._metric = MlflowClient(), Metric
        self._id = _id(run_dir, "mlflow", lambda: self._create(settings, run_dir))
        self._client.update_run(self._id, status="RUNNING")

    def _create(self, settings: Settings, run_dir: Path) -> str:
        name = os.environ.get("MLFLOW_EXPERIMENT_NAME", PROJECT)
        experiment = self._client.get_experiment_by_name(name)
        where = experiment.experiment_id if experiment else self._client.create_experiment(name)
        run_id: str = self._client.create_run(where, run_name=run_dir.resolve().name).info.run_id
        for key, value in hyperparameters(settings).items():
            self._client.log_param(run_id, key, value)
        return run_id

    def scalars(self, values: Values, env_steps: int) -> None:
        now = int(1000 * time.time())
        self._client.log_batch(self._id, [self._metric(name, value, now, env_steps) for name, value in values.items()])

    def flush(self) -> None:
        """Every call is one to the server."""

    def files(self, paths: Sequence[Path]) -> None:
        for path in paths:
            self._client.log_artifact(self._id, str(path))

    def close(self) -> None:
        self._client.set_terminated(self._id)


def hyperparameters(settings: Settings) -> dict[str, Any]:
    """Every setting by the name that a command line gives it."""
    values = dataclasses.asdict(settings)
    options, sweep = dict(values.pop("env_options")), dict(values.pop("sweep"))
    values |= {f"env.{name}": value for name, value in options.items()}
    values |= {f"sweep.{name}": list(swept) for name, swept in sweep.items()}
    return {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}


def _id(run_dir: Path, name: str, make: Callable[[], str]) -> str:
    """What the run is called at a logger's server: the same in every session."""
    path = run_dir / IDS.format(name)
    if not path.exists() or not path.stat().st_size:
        atomic.write_text(path, make())
    return path.read_text(errors="replace").strip()


def _reached(run_dir: Path, name: str, logged: int) -> int:
    """Steps up to which a logger has been told everything, of those that were `logged`; 0 for one that is new."""
    if not (run_dir / IDS.format(name)).exists():
        return 0
    try:
        return min(logged, int((run_dir / SENT.format(name)).read_text()))
    except (OSError, ValueError):  # not there, or damaged: only what a kill kept from reaching it is missing then
        return logged
