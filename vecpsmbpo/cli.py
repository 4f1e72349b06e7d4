"""The command line. Imports JAX only once every argument has been understood."""

import contextlib
import importlib
import io
import os
import sys
import warnings
from collections.abc import Iterator, Sequence
from typing import Any, NoReturn

from vecpsmbpo import crash, interrupt, limits, stopping, words
from vecpsmbpo.settings import SettingError, Settings

HELP = """\
vecpsmbpo: posterior-sampling model-based policy optimization, vectorized in JAX and MJX

  vecpsmbpo train env=cartpole_swingup size=cpu     train; name=value as many as wanted
  vecpsmbpo train run_dir=runs/x                    go on with the run in runs/x
  vecpsmbpo train -m env=hopper real_ratio=0,0.05   one run after the other, for every value (Hydra multirun)
  vecpsmbpo train env=hopper sweep.real_ratio=[0,0.05]      every value at once, in one program
  vecpsmbpo train -m experiment=fig2 size=cpu       the runs behind a figure of the paper
  vecpsmbpo eval run_dir=runs/x episodes=10         evaluate it, or the policy that export has written there
  vecpsmbpo plot runs/x runs/y out=curves.png       learning curves, grouped by what differs
  vecpsmbpo compare runs/x runs/y                   the same as a table, with intervals
  vecpsmbpo report runs/x out=report.html           all a run has to show, on one page
  vecpsmbpo diagnose runs/x                         how good its models and critics are, into the run; or out=x.png
  vecpsmbpo render runs/x out=walk.gif              its best member at work; member=all: all of them
  vecpsmbpo export runs/x out=policy/               its best policy as files that need nothing of this
  vecpsmbpo figure fig9 size=cpu out=fig9.png       a figure of the paper, from the runs of its experiment
  vecpsmbpo figure fig9 runs/x out=weights.png      figure 9's picture, who was likely to act, of any run
  vecpsmbpo envs                                    tasks, backends, sizes
  vecpsmbpo theory                                  the paper's theory in numbers, in seconds
  vecpsmbpo --version                               of this program, jax, mujoco and Python
  vecpsmbpo plot --help                             options of one command

{groups}
settings: {settings}

What each setting does stands beside its default in {config};
of those that one algorithm alone has, in algo/settings beside it.
"""


# Commands that are a module each, with `OPTIONS` and `run`: those that read runs and show them, and the theory.
LOOKS = ("plot", "compare", "report", "figure", "render", "export", "diagnose")
MODULES = {"theory": "vecpsmbpo.theory.report", **{name: f"vecpsmbpo.look.{name}" for name in LOOKS}}


def main(argv: Sequence[str] | None = None) -> int:
    """Runs a command line; the exit status. A user's mistake is one line on stderr and status 2, and so is what the
    system does not let it do."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal without Greek letters shows ? for one
    try:
        status = _dispatch(arguments)
        print(end="", flush=True)
        return status
    except SettingError as error:
        words.complain(error)
        return 2
    except OSError as error:
        if isinstance(error, BrokenPipeError) and stopping.is_unheard():
            return stopping.UNHEARD
        words.complain(words.of_system(error))
        return 2
    except MemoryError:
        words.complain("out of memory")
        return 2
    except (ValueError, RuntimeError) as error:
        if not (line := words.of_environment(error)):
            raise
        words.complain(line)
        return 2
    except KeyboardInterrupt:  # where no run heeds signals
        words.complain("interrupted")
        return 130


def _dispatch(arguments: list[str]) -> int:
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print(_help())
        return 0 if arguments else 2
    if arguments[0] in ("--version", "version"):
        from vecpsmbpo import versions

        print(versions.line())
        return 0
    command, rest = arguments[0], arguments[1:]
    if {"-h", "--help"} & set(rest):
        print(_help(command))
        return 0
    if command == "envs":
        return _envs(rest)
    if command == "eval":
        with crash.watched():
            return _eval(rest)
    if command in MODULES:
        return importlib.import_module(MODULES[command]).run(rest)
    if command == "train":
        multirun = {"-m", "--multirun"} & set(rest)
        overrides = [text for text in rest if text not in ("-m", "--multirun")]
        with crash.watched():
            return _multirun(overrides) if multirun else _train(overrides)
    raise SettingError(f"{command}: no such command; one of train, eval, envs, {', '.join(MODULES)}")


def _train(overrides: list[str]) -> int:
    with interrupt.leaving(crash.end):
        from vecpsmbpo import config

        settings = config.resolve(overrides)
    status, in_order = _run(settings)
    return status if in_order else _leave(status)


@contextlib.contextmanager
def _importing_jax() -> Iterator[None]:
    """While JAX is imported, for which there is room."""
    if "jax" in sys.modules:
        yield
        return
    limits.check_start()
    with interrupt.leaving(crash.end):
        yield


def _run(settings: Settings) -> tuple[int, bool]:
    """Trains; the exit status, and whether the process may end as processes do."""
    with _importing_jax():
        from vecpsmbpo import processes
        from vecpsmbpo.training import DiskError, OutOfMemory, TaskFailed, train
    try:
        return train(settings), True
    except TaskFailed as error:
        words.complain(error)
        return 1, True
    except (DiskError, OutOfMemory, processes.LostProcess, SettingError) as error:
        alone = not isinstance(error, processes.NotTogether) and not processes.are_several()
        if isinstance(error, SettingError) and alone:
            raise
        words.complain(error)
        return (1 if isinstance(error, processes.LostProcess) else 2), False
    except KeyboardInterrupt:  # before a run heeds signals itself, or a second one
        words.complain("interrupted")
        return 130, False


def _leave(status: int) -> NoReturn:
    """Ends the process at once: the writer threads of orbax would each report the same disk again, in tracebacks of
    their own, while the interpreter ends; there may be no memory for that; and JAX would wait for the processes that
    have left, or have not come."""
    crash.end()
    os._exit(status)


class _Task:
    """What Hydra calls for each run of a grid that is run in this process.

    Attributes:
        worst: the exit status of all runs so far, those of a launcher (`hydra_plugins.vecpsmbpo`) included.
        in_order: whether the process may end as processes do.
        begun: whether Hydra has come as far as the runs.
    """

    def __init__(self) -> None:
        self.worst, self.in_order, self.begun = 0, True, False

    def __call__(self, tree: Any) -> None:
        from hydra.core.hydra_config import HydraConfig

        from vecpsmbpo import config

        self.begun = True
        try:
            status, in_order = _run(config.resolve(list(HydraConfig.get().overrides.task), tree))
            self.in_order &= in_order
        except SettingError as error:
            words.complain(error)
            status = 2
        if status > 2:
            sys.exit(status)
        self.worst = max(self.worst, status)


def _multirun(overrides: list[str]) -> int:
    """Hydra's own multirun, so that its sweepers and launchers work.

    A run that cannot be made, or has frozen lanes, does not take the others with it; the exit status is the worst of
    all. A signal stops them all.
    """
    with interrupt.leaving(crash.end):
        import hydra
        from hydra.core.plugins import Plugins

        from hydra_plugins.vecpsmbpo import Jobs
        from vecpsmbpo import config
        from vecpsmbpo.sweeps import launch
        from vecpsmbpo.sweeps.job import Elsewhere

        if "distributed" in config.parse(overrides, sweep=True):
            raise SettingError("distributed: is of a single run, and not of a grid (-m)")
        launch.check(overrides)
    Plugins.instance().register(Jobs)  # by hand, since Hydra finds none in an editable installation
    task = _Task()
    sys.argv = ["vecpsmbpo", "--multirun", *config.for_hydra(overrides)]
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra then leaves its errors to us
    try:
        with config.hydra_errors(), warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=r"\s*Running Hydra app with --multirun")
            hydra.main(version_base="1.3", config_path="pkg://vecpsmbpo.configs", config_name="config")(task)()
    except (AttributeError, LookupError, RuntimeError, TypeError, ValueError) as error:
        if task.begun:
            raise
        given = " ".join(text for text in overrides if "hydra" in text.partition("=")[0])
        raise SettingError(f"{given or '-m'}: Hydra fails ({words.of(error)})") from None
    except Elsewhere as error:
        words.complain(error)
        return 130
    return task.worst if task.in_order else _leave(task.worst)


def _evaluation_options() -> dict[str, Any]:
    """What `eval` may be told, as `arguments` has it; what is not said is as the run has it."""
    from vecpsmbpo import arguments, config
    from vecpsmbpo.algorithms.catalogue import allowed

    return {
        name: arguments.Option(word.what, None, str, allowed(word.setting)) for name, word in config.EVALUATION.items()
    }


def _eval(rest: list[str]) -> int:
    from vecpsmbpo import arguments, config
    from vecpsmbpo.look import exported

    run_dirs, values = arguments.parse("eval", rest, _evaluation_options())
    if len(run_dirs) != 1:
        raise SettingError("run_dir: eval needs one directory that train or export has written")
    [run_dir], given = run_dirs, {name: value for name, value in values.items() if value is not None}
    if policy := exported.load(run_dir) if exported.is_one(run_dir) else None:
        stored, settings = policy.settings, exported.for_evaluation(policy, given)
    else:
        stored = config.load(run_dir)
        settings = config.for_evaluation(stored, given)
    with _importing_jax():
        from vecpsmbpo.evaluate import show
    return exported.show(policy, settings) if policy else show(stored, settings)


def _envs(rest: list[str]) -> int:
    if rest:
        raise SettingError(f"{rest[0]}: envs takes no arguments")
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from vecpsmbpo import config
    from vecpsmbpo.envs.registry import TASKS

    table = Table("task", "backends", "obs", "action", "episode", "options", "suite", "installed", box=None)
    for name, task in TASKS.items():
        sizes = map(str, task.sizes) if task.sizes else ("any", "any", "its own")
        options = " ".join(f"env.{option}" for option in config.env_options(name))
        installed = "yes" if task.installed else f"no: pip install {task.needs or task.suite}"
        installed = escape(installed)  # rich would read [playground] as markup
        table.add_row(name, ", ".join(task.backends), *sizes, options, task.suite, installed)
    Console(width=150).print(table)
    return 0


def _help(command: str = "") -> str:
    """Of the whole program, or of a command that has options of its own."""
    import textwrap
    from importlib import resources

    from vecpsmbpo import arguments, config
    from vecpsmbpo.algorithms.catalogue import FIELDS

    if command in MODULES:
        module = importlib.import_module(MODULES[command])
        return arguments.explain(command, module.__doc__ or "", module.OPTIONS)
    if command == "eval":
        return arguments.explain(command, config.evaluation.__doc__ or "", _evaluation_options())
    plain = [name for name in FIELDS if name not in config.GROUPS]
    return HELP.format(
        groups="\n".join(
            f"{group + '=':12}{', '.join(config.options(group))}" for group in (*config.GROUPS, "experiment")
        ),
        settings=textwrap.fill(", ".join(plain), 110, subsequent_indent="          "),
        config=resources.files("vecpsmbpo.configs") / "config.yaml",
    )


if __name__ == "__main__":
    sys.exit(main())
