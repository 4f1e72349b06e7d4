"""The one loop that does input and output: chunks of the compiled program, and what is kept of them."""

import contextlib
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from rich.console import Console

from vecpsmbpo import (
    checkpoint,
    config,
    crash,
    health,
    jsonl,
    loggers,
    metrics,
    placement,
    processes,
    resources,
    run_log,
    runtime,
    versions,
    words,
)
from vecpsmbpo.drivers import Driver, Interrupted, Returns, Stopped
from vecpsmbpo.envs.host.batched import SimulatorError
from vecpsmbpo.look import render, report
from vecpsmbpo.programs import evaluation_keys, initial_inputs, make_driver
from vecpsmbpo.progress import Display, Rates, Stopwatch
from vecpsmbpo.settings import SettingError, Settings
from vecpsmbpo.stopping import Stop, heeding_signals
from vecpsmbpo.training import sayings
from vecpsmbpo.training.guards import (
    TaskFailed,
    alone_in,
    check_not_emptied,
    check_place,
    disk_errors,
    has_checkpoint,
    memory_errors,
)
from vecpsmbpo.types import EpisodeEnd, TrainState

# An epoch that takes longer than this is run in chunks of about half of it, to show progress and to heed signals.
# Whoever sends SIGTERM may kill after ten seconds.
LONG_EPOCH_S = 8.0


def train(settings: Settings, stop: Stop | None = None) -> int:
    """Runs, or goes on with, the run in `settings.run_dir`.

    Args:
        stop: where whoever heeds the signals writes them down; without it, they are heeded here.

    Returns:
        0, 1 where a lane is frozen (`health`), or 128 + the number of the signal that stopped it.

    Raises:
        SettingError: it cannot be run as asked (`resources.check_memory`, `envs.make`), or not be gone on with. Nothing
            has been changed then.
        TaskFailed: the task's own code did; what was learned until then is saved.
        DiskError: the run directory cannot be written.
        OutOfMemory: the system gives no more.
        LostProcess: another process of the run is gone.
    """
    check_place(settings.run_dir)
    runtime.configure(settings)
    if said := runtime.idle_cores(settings):
        words.warn(said)
    try:
        return _train(settings, stop)
    except SimulatorError as error:
        said = f"{settings.task} failed before its first step: {error}; nothing has been changed"
        raise TaskFailed(said) from error


def _train(settings: Settings, stop: Stop | None) -> int:
    run_dir = Path(settings.run_dir)
    with processes.noticing_the_lost(), memory_errors(run_dir), contextlib.ExitStack() as around:
        processes.check_same(settings)
        with processes.together():
            driver = make_driver(settings)
            shapes = driver.shapes(*initial_inputs(settings))
            memory = resources.check_memory(driver.algorithm, shapes)
        if not has_checkpoint(run_dir):
            driver.begin()
        around.enter_context(disk_errors(run_dir))
        with processes.together():
            run_dir.mkdir(parents=True, exist_ok=True)
            if processes.is_first():
                around.enter_context(alone_in(run_dir))
            check_not_emptied(run_dir)
        stop = around.enter_context(heeding_signals()) if stop is None else stop
        crash.doing(_among("making the first state"), run_dir)
        with _leaving_together(), contextlib.ExitStack() as opened:
            return _Session(settings, driver, shapes, memory, stop, opened).go()


@contextlib.contextmanager
def _leaving_together() -> Iterator[None]:
    """Whoever left before the first process has written its last would take it along."""
    try:
        yield
    except TaskFailed:  # in every process
        processes.greatest(0)
        raise
    processes.greatest(0)


class _Session:
    """One session of a run: from a checkpoint, or from nothing, to its end or a signal."""

    def __init__(
        self,
        settings: Settings,
        driver: Driver,
        shapes: TrainState,
        memory: str,
        stop: Stop,
        opened: contextlib.ExitStack,
    ):
        """
        Args:
            opened: closes what is opened here.
        """
        self.settings, self.driver, self.stop = settings, driver, stop
        self.run_dir = Path(settings.run_dir)
        keep = settings.keep_checkpoints
        with processes.together():
            self.checkpoints = checkpoint.Checkpoints(self.run_dir / checkpoint.FOLDER, settings, keep=keep)
            opened.callback(self.checkpoints.close)
            saved = self.checkpoints.restore(shapes, driver.layout, warn=words.warn)
            if saved and saved.step > settings.total_steps:
                raise SettingError(f"total_steps={settings.total_steps}: the run has already done {saved.step}")
        if not processes.agree(saved.step if saved else -1):
            raise SettingError(f"run_dir={self.run_dir}: processes find different checkpoints in it; it must be shared")
        self.state = saved.state if saved else driver.init(*initial_inputs(settings))
        self.saved_step = saved.step if saved else None
        self.watch = Stopwatch(saved.host["seconds"] if saved else 0.0)
        if saved:
            driver.load_env(saved.host["env"])
        self.env_steps = saved.step if saved else 0
        # Whether the epoch that ends here has not been evaluated yet: a simulator failed in that, or it was stopped.
        self.to_evaluate = bool(saved and saved.host.get("to_evaluate"))
        self.health = processes.here(self.state.seeds.health)
        self.frozen = np.asarray(health.frozen(self.health))
        self.log: run_log.RunLog | run_log.NoLog = run_log.NoLog()
        with processes.together():
            if processes.is_first():
                config.save(settings, self.run_dir)  # now that it is known to be the run's own
                marks = saved.host.get("logs", {}) if saved else {}
                self.log = run_log.RunLog(
                    self.run_dir, self.env_steps, settings, words.warn, marks, unevaluated=self.to_evaluate
                )
                opened.callback(self.log.close)
        self.display = Display(driver.algorithm, self.env_steps, None if processes.is_first() else Console(quiet=True))
        self.stopped_by = 0  # the signal that any process was sent
        self.memory = memory
        self.epoch_began = time.perf_counter()
        self.epoch_steps_done = 0
        self.stride_s = float("inf")  # seconds per stride in the last chunk; infinite: not known

    @property
    def _complete(self) -> bool:
        return self.env_steps >= self.settings.total_steps and not self.to_evaluate

    def go(self) -> int:
        settings = self.settings
        try:
            with self.display:
                self._introduce()
                if self._complete:
                    self.display.say(sayings.complete(self.env_steps))
                    return self._status
                if self.frozen.all():
                    self.display.say("every lane is frozen: there is nothing to go on with")
                    return self._status
                began = {"env_steps": self.env_steps, **versions.current(), "devices": self._devices()}
                self.log.session({**began, "machine": versions.machine()})
                # At once, and not after hours.
                self._check_disk(settings.total_steps)
                if self.saved_step is None:
                    self._save()
                self._compile()
                if self.to_evaluate:
                    self._end_epoch()
                while self.env_steps < settings.total_steps and not self.frozen.all() and not self._asked_to_stop():
                    self._chunk()
                self._save()
                self._film()
                return self._farewell()
        except Interrupted as error:
            raise self._failed(f"at step {error.step}", error) from error
        except SimulatorError as error:
            raise self._failed(f"in the evaluation at step {self.env_steps}", error) from error

    def _asked_to_stop(self) -> bool:
        """Whether signals have asked any process to stop; saves first, if it is that which they asked for."""
        if processes.greatest(int(self.stop.save)):
            self.stop.save = False
            self._save()
        self.stopped_by = processes.greatest(self.stop.requested or 0)
        return self.stopped_by > 0

    def _devices(self) -> list[str]:
        """What those are that the run uses: `cpu`, `NVIDIA H100 80GB HBM3`."""
        return [device.device_kind for device in self.driver.layout.mesh.devices.flat]

    def _introduce(self) -> None:
        for line in sayings.introduction(self.settings, self._devices(), self.memory, self.env_steps):
            self.display.say(line)
        for lane in np.flatnonzero(self.frozen).tolist():
            self.display.say(self._frozen_words(lane))

    def _compile(self) -> None:
        self.display.say(sayings.compiling(self.settings))
        crash.doing(_among("compiling the training program"))
        self.driver.compile(self.state)
        crash.doing(_among("training"))
        self.display.say(f"compiled in {self.driver.compile_seconds:.1f} s")

    def _chunk(self) -> None:
        """Runs to the end of the epoch, or a part of a long one, and writes down what happened."""
        settings = self.settings
        into_epoch = self.env_steps % settings.epoch_steps
        if into_epoch == 0:
            self.epoch_began, self.epoch_steps_done = time.perf_counter(), 0
        strides = processes.of_first(self._strides(settings.epoch_steps - into_epoch))
        began = time.perf_counter()
        news: EpisodeEnd | None
        failed: Interrupted | None = None
        try:
            self.state, news = self.driver.run(self.state, strides)
        except Interrupted as error:
            self.state, news, failed = error.state, error.news, error
        seconds = time.perf_counter() - began
        self.stride_s = seconds / strides
        steps = 0 if news is None else len(news.done)
        before, self.env_steps = self.env_steps, self.env_steps + steps
        self.epoch_steps_done += steps
        if news is not None:
            episodes = metrics.episode_lines(news, before, settings)
            self.log.episodes(episodes)
            self.display.chunk(self.env_steps, steps, seconds, [line["return"] for line in episodes])
        self._note_frozen()
        if failed:
            self._save()
            raise failed
        if self.env_steps % settings.epoch_steps == 0 and not self.frozen.all():
            self._end_epoch()

    def _strides(self, left: int) -> int:
        """How many the next chunk has, `left` steps before the end of the epoch."""
        settings = self.settings
        until_learning = settings.first_learning_step - self.env_steps
        if 0 < until_learning < left:
            left = until_learning
        if until_learning == 0:
            self.stride_s = float("inf")  # learning may take a thousand times as long as the steps before it
        strides = left // settings.stride
        return strides if strides * self.stride_s <= LONG_EPOCH_S else max(1, int(LONG_EPOCH_S / 2 / self.stride_s))

    def _end_epoch(self) -> None:
        settings = self.settings
        seconds = time.perf_counter() - self.epoch_began
        keys = evaluation_keys(settings, self.env_steps)
        self.to_evaluate = True  # in what is saved until it is done
        try:
            returns = self.driver.evaluate(self.state, keys, settings.eval_episodes, self._asked_to_stop, self.frozen)
        except Stopped:
            self._save()
            return
        except SimulatorError:
            self._save()
            raise
        self.to_evaluate = False
        lines = [line for line, frozen in zip(self._lines(returns, seconds), self.frozen, strict=True) if not frozen]
        self.log.metrics(lines)
        if self.saved_step == self.env_steps:  # while it was evaluated, or before
            known = {"seconds": self.watch(), "logs": self.log.marks, "to_evaluate": False}
            self.checkpoints.amend(self.env_steps, known)
        self.display.epoch(self.env_steps, float(np.mean([line["eval_return"] for line in lines])))
        if unsound := sum(line["unsound_steps"] for line in lines):
            self.display.say(sayings.unsound(settings, unsound, len(lines) * settings.epoch_steps))
        if broken_off := sum(line["eval_broken_off"] for line in lines):
            self.display.say(sayings.broken_off(settings, broken_off, len(lines) * settings.eval_episodes))
        epoch = self.env_steps // settings.epoch_steps
        if epoch % settings.checkpoint_every == 0 and self.env_steps < settings.total_steps:
            self._save()
        shown = epoch % settings.checkpoint_every == 0 or self.env_steps >= settings.total_steps
        if settings.report and shown and processes.is_first():
            report.keep(self.run_dir, words.warn)

    def _film(self) -> None:
        """An episode of a run that is complete, where somebody will see it: on its page, or at a logger's server."""
        settings = self.settings
        seen = settings.report or not {loggers.TENSORBOARD}.issuperset(settings.loggers)
        if not seen or not self._complete or settings.plans_actions or not processes.is_first():
            return
        self.display.say("filming an episode …")
        render.keep(self.run_dir, words.warn)
        if settings.report:
            report.keep(self.run_dir, words.warn)

    def _lines(self, returns: Returns, seconds: float) -> list[jsonl.Line]:
        rates = Rates.over(self.driver.algorithm, self.env_steps, self.epoch_steps_done, seconds)
        return [
            {
                **line,
                "eval_return": float(returns.episode_return[index].mean()),
                "eval_length": float(returns.length[index].mean()),
                "eval_broken_off": int(returns.broken_off[index].sum()),
                "env_steps_per_s": rates.env_steps,
                "updates_per_s": rates.updates,
                "imagined_per_s": rates.imagined,
                "compile_seconds": self.driver.compile_seconds,
                "seconds": self.watch(),
            }
            for index, line in enumerate(self._epoch_lines())
        ]

    def _epoch_lines(self) -> list[jsonl.Line]:
        state = processes.here(self.state.without_rings())
        return metrics.epoch_lines(placement.unpad(self.driver.layout, state), self.driver.algorithm)

    def _note_frozen(self) -> None:
        """Says and writes which lanes were frozen in the chunk that ended."""
        self.health = processes.here(self.state.seeds.health)
        before, self.frozen = self.frozen, np.asarray(health.frozen(self.health))
        new = np.flatnonzero(self.frozen & ~before).tolist()
        if new:
            lines = self._epoch_lines()
            self.log.metrics(sorted((self._last_line(lines[lane], lane) for lane in new), key=lambda x: x["env_steps"]))
        for lane in new:
            self.display.say(self._frozen_words(lane))

    def _last_line(self, line: jsonl.Line, lane: int) -> jsonl.Line:
        """A lane's last, from `line` of its last good state. Its step is one that every checkpoint which knows of the
        freezing has reached, and no other: it is never written twice."""
        evaluated = ("eval_return", "eval_length", "eval_broken_off")
        speeds = ("env_steps_per_s", "updates_per_s", "imagined_per_s")
        return {
            **line,
            **dict.fromkeys(evaluated + speeds),
            "env_steps": int(self.health.env_steps[lane]),
            "compile_seconds": self.driver.compile_seconds,
            "seconds": self.watch(),
            "frozen": True,
            "not_finite": self._what_froze(lane),
        }

    def _frozen_words(self, lane: int) -> str:
        return sayings.frozen(self.settings, lane, int(self.health.env_steps[lane]), self._what_froze(lane))

    def _what_froze(self, lane: int) -> str:
        return health.describe(self.state.seeds.replace(health=self.health), lane, self.settings)

    @property
    def _status(self) -> int:
        """Exit status of a run that need not be gone on with."""
        return int(self.frozen.any())

    def _save(self) -> None:
        if self.saved_step != self.env_steps:
            self._check_disk(self.env_steps)
            host = {
                "env": self.driver.save_env(),
                "seconds": self.watch(),
                "logs": self.log.marks,
                "to_evaluate": self.to_evaluate,
            }
            self.checkpoints.save(self.env_steps, self.state, host, self.driver.layout)
            self.saved_step = self.env_steps

    def _check_disk(self, env_steps: int) -> None:
        with processes.together():
            if processes.is_first():
                resources.check_disk(self.run_dir, self.state, env_steps, self.driver.layout)

    def _farewell(self) -> int:
        ends = {"all_frozen": bool(self.frozen.all()), "complete": self._complete}
        for line in sayings.farewell(self.settings, self.env_steps, **ends):
            self.display.say(line)
        return self._status if any(ends.values()) else 128 + self.stopped_by

    def _failed(self, where: str, error: Exception) -> TaskFailed:
        return TaskFailed(sayings.failed(self.settings, where, error, self.saved_step))


def _among(doing: str) -> str:
    """With the other processes of the run, if there are any: a crash may be theirs."""
    return doing + (crash.BESIDE_OTHERS if processes.are_several() else "")
