"""From a command line to `Settings`: Hydra composes, and every mistake becomes one line."""

import contextlib
import dataclasses
import difflib
import hashlib
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import hydra
import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from vecpsmbpo import loggers, recorded, whole
from vecpsmbpo.algorithms.catalogue import FIELDS, allowed, build, check, check_sweep, require
from vecpsmbpo.envs import registry
from vecpsmbpo.settings import CHANGEABLE, SettingError, Settings

CONFIG_FILE = "config.yaml"
LONGEST_NAME = 200  # of a default run directory, in bytes; file systems take 255
GROUPS = ("env", "algo", "size", "recipe")
_DOTTED = {"env": "env_options", "sweep": "sweep"}  # where the settings `env.*` and `sweep.*` are kept
# What the name of a default run directory already says, or need not say.
_UNNAMED = frozenset({*GROUPS, "seed", "run_dir", *CHANGEABLE})


def options(group: str) -> list[str]:
    """The names that `group=` may take."""
    folder = resources.files("vecpsmbpo.configs") / group
    return sorted(Path(item.name).stem for item in folder.iterdir() if item.name.endswith(".yaml"))


def env_options(env: str) -> dict[str, Any]:
    """The options `env.*` of a task and their defaults; `???` where one must be given."""
    text = (resources.files("vecpsmbpo.configs") / "env" / f"{env}.yaml").read_text()
    return {name: value for name, value in yaml.safe_load(text)["env"].items() if name != "name"}


def closest(name: str, known: Iterable[str]) -> str:
    """What may have been meant by `name`, for the end of an error line."""
    known = sorted(known)
    near = difflib.get_close_matches(name, known, n=3, cutoff=0.4)
    return f"did you mean {' or '.join(near)}?" if near else f"one of {', '.join(known)}"


def parse(overrides: Sequence[str], *, sweep: bool = False) -> dict[str, Any]:
    """Checks each override on its own: its name, and what its value may be.

    Args:
        overrides: `name=value` each.
        sweep: values may be several, as Hydra's multirun has them.

    Returns:
        Value by name.

    Raises:
        SettingError: what is wrong with the first wrong one.
    """
    found: dict[str, Any] = {}
    algorithms: list[str] = []
    for text in overrides:
        if "=" not in text:
            raise SettingError(f"{text}: must be name=value")
        try:
            override = OverridesParser.create().parse_override(text)
        except HydraException as error:
            raise SettingError(f"{text}: is not a value that can be read ({_first_line(error)})") from None
        name = override.key_or_group
        if override.is_delete():
            raise SettingError(f"{text}: a setting cannot be taken away; give it another value")
        if sweep and name.startswith("hydra"):
            continue
        if override.is_sweep_override() and not sweep:
            raise SettingError(f"{text}: several values need -m")
        values = _sweep_values(override) if override.is_sweep_override() else [override.value()]
        if len(set(map(str, values))) < len(values):
            raise SettingError(f"{text}: the same value twice")
        for value in values:
            found[name] = _check_override(name, value)
            algorithms += [str(value)] if name == "algo" else []
    if "experiment" in found and not sweep:
        raise SettingError(f"experiment={found['experiment']}: is a grid of runs and needs -m")
    _check_env_options(found)
    if sweep and "experiment" not in found:
        for algo in algorithms or [_default("algo")]:
            _check_algorithm(algo, found)
    return found


def _check_env_options(found: dict[str, Any]) -> None:
    """That the task has the options given; a run that is resumed knows its task by itself."""
    given = [name for name in found if name.startswith("env.")]
    if "env" not in found and "run_dir" in found:
        return
    for name in given:
        env = found.get("env", _default("env"))
        if name.removeprefix("env.") not in env_options(env):
            has = ", ".join(f"env.{option}" for option in env_options(env)) or "none"
            raise SettingError(f"{name}: no such option of env={env}; it has {has}")


def _check_values(env: str, options: Mapping[str, Any]) -> None:
    """That the options of a task have the types of their defaults; one that must be given is a name."""
    for name, default in env_options(env).items():
        value = options.get(name, default)
        if isinstance(default, str):
            wrong, what = not isinstance(value, str) or not value, "a name"
        else:
            wrong, what = isinstance(value, bool) or not isinstance(value, int | float), "a number"
        if wrong:
            raise SettingError(f"env.{name}={value}: must be {what}")


def _check_algorithm(algo: str, names: Iterable[str]) -> None:
    """That the algorithm has the settings given."""
    for name in names:
        require(algo, name)


def _defaults(algo: str = "") -> dict[str, Any]:
    """What `configs/config.yaml` says, and for the settings that only this algorithm has, `configs/algo/settings`."""
    folder = resources.files("vecpsmbpo.configs")
    found = yaml.safe_load((folder / "config.yaml").read_text())
    own = folder / "algo" / "settings" / f"{algo}.yaml"
    return {**found, **(yaml.safe_load(own.read_text()) if own.is_file() else {})}


def _default(group: str) -> str:
    return next(entry[group] for entry in _defaults()["defaults"] if group in entry)


def _sweep_values(override: Override) -> list[Any]:
    values = list(override.sweep_iterator())
    return [yaml.safe_load(value) if isinstance(value, str) else value for value in values]


def _check_override(name: str, value: Any) -> Any:
    if name in (*GROUPS, "experiment"):
        if value not in options(name):
            raise SettingError(f"{name}={value}: {closest(str(value), options(name))}")
        return value
    if name.startswith("env."):
        return value
    if name.startswith("sweep."):
        return check_sweep(name.removeprefix("sweep."), value)
    if name not in FIELDS:
        raise SettingError(f"{name}: no such setting; {closest(name, FIELDS)}")
    return check(name, "" if value is None and FIELDS[name].type is str else value)


def _first_line(error: Exception) -> str:
    return (str(error).strip() or repr(error)).splitlines()[0]


def compose(overrides: Sequence[str]) -> Settings:
    """The settings of a new run.

    Raises:
        SettingError: a mistake in `overrides`.
    """
    given = parse(overrides)
    _check_algorithm(given.get("algo", _default("algo")), given)
    with hydra_errors(), hydra.initialize_config_module("vecpsmbpo.configs", version_base="1.3"):
        tree = hydra.compose("config", for_hydra(overrides))
    return from_tree(tree, overrides)


@contextlib.contextmanager
def hydra_errors() -> Iterator[None]:
    """Turns what Hydra complains of into one line."""
    try:
        yield
    except (HydraException, OmegaConfBaseException) as error:
        raise SettingError(_first_line(error)) from None


def for_hydra(overrides: Iterable[str]) -> list[str]:
    """The same for Hydra, which adds a name to a group, as `sweep.*` needs, only where it is told to."""
    return [f"++{text}" if text.startswith("sweep.") else text for text in overrides]


def from_tree(tree: DictConfig, overrides: Sequence[str]) -> Settings:
    """Settings from what Hydra composed, with the backend and the run directory resolved."""
    with hydra_errors():
        values: Any = OmegaConf.to_container(tree, resolve=True)
    values["sweep"] = values["sweep"] or {}
    values["env_options"] = {name: value for name, value in values["env"].items() if name != "name"}
    for group in GROUPS:
        values[group] = values[group]["name"]
    _check_algorithm(values["algo"], (text.split("=")[0].lstrip("+") for text in overrides))
    for name, value in values["env_options"].items():
        if value == "???":
            raise SettingError(f"env.{name}: must be given with env={values['env']}")
    _check_values(values["env"], values["env_options"])
    values["backend"] = registry.resolve_backend(values["env"], check("backend", values["backend"]))
    settings = build(values)
    if not settings.run_dir:
        settings = dataclasses.replace(settings, run_dir=_default_run_dir(settings, overrides))
    return settings


def _default_run_dir(settings: Settings, overrides: Sequence[str]) -> str:
    """The same command gives the same directory, so that running it again goes on with the run."""
    extra = sorted(text for text in overrides if text.split("=")[0].lstrip("+") not in _UNNAMED)
    task = [str(value) for _, value in settings.env_options if any(text.startswith("env.") for text in extra)]
    others = [text for text in extra if not text.startswith(("hydra", "env.", "experiment="))]
    experiment = [text.removeprefix("experiment=") for text in extra if text.startswith("experiment=")]
    parts = [settings.env, *task, settings.algo, settings.size, f"seed{settings.seed}", *others]
    # Only what the command line reads back without quotes.
    name = "-".join(re.sub(r"[^\w.+-]", "_", part.replace("=", "")) for part in parts)
    if len(name.encode()) > LONGEST_NAME:
        name = f"{name[: LONGEST_NAME // 4]}-{hashlib.sha256(name.encode()).hexdigest()[:16]}"
    return str(Path("runs", *experiment) / name)


def save(settings: Settings, run_dir: Path) -> None:
    """Writes `config.yaml`: not with whom it was run, which is over when it ends."""
    plain = recorded.plain(dataclasses.replace(settings, distributed=""))
    # At once: a run whose config is cut short could not be resumed.
    whole.write_text(run_dir / CONFIG_FILE, yaml.safe_dump(plain, sort_keys=False))


def load(run_dir: str | Path) -> Settings:
    """The settings that a run directory was started with.

    Raises:
        SettingError: there are none, or they cannot be read.
    """
    where = f"run_dir={run_dir}: its {CONFIG_FILE}"
    try:
        record = yaml.safe_load((Path(run_dir) / CONFIG_FILE).read_text())
    except OSError:
        raise SettingError(f"run_dir={run_dir}: holds no {CONFIG_FILE}, so no run") from None
    except (ValueError, RecursionError, yaml.YAMLError) as error:
        raise SettingError(f"{where} cannot be read ({_first_line(error)})") from None
    return dataclasses.replace(from_record(record, where), run_dir=str(run_dir))


def from_record(record: Any, where: str) -> Settings:
    """The settings that `recorded.plain` wrote down.

    Args:
        record: what is found there, which may be anything.
        where: for the error.

    Raises:
        SettingError: it is none.
    """
    try:
        # What the run does not know came to this program after it, and is off by default.
        values = {**_defaults(record["algo"]), "recipe": "paper", **record}
        for group in ("env", "algo"):
            _check_override(group, values[group])
        _check_values(values["env"], dict(values.get("env_options", ())))
        return build(values)
    except SettingError as error:
        raise SettingError(f"{where} has {error}") from None
    except (LookupError, TypeError, AttributeError, ValueError, OverflowError, RecursionError) as error:
        raise SettingError(f"{where} cannot be read ({_first_line(error)})") from None


def resolve(overrides: Sequence[str], tree: DictConfig | None = None) -> Settings:
    """The settings of a run, new or resumed: a `run_dir` that holds one resumes with its own.

    Args:
        overrides: `name=value` each.
        tree: what Hydra composed of them, where it already has (a job of a multirun).

    Raises:
        SettingError: a mistake in `overrides`, one contradicts the stored run, or a logger is not installed.
    """
    settings = _resolved(overrides, tree)
    loggers.check(settings.loggers)
    return settings


def _resolved(overrides: Sequence[str], tree: DictConfig | None) -> Settings:
    given = parse(overrides, sweep=tree is not None)

    def new() -> Settings:
        return compose(overrides) if tree is None else from_tree(tree, overrides)

    run_dir = given.get("run_dir") or ""
    if not run_dir or "${" in run_dir:
        run_dir = new().run_dir
    try:
        if not (Path(run_dir) / CONFIG_FILE).exists():
            return new()
    except (OSError, ValueError) as error:  # a name too long, or with a null byte
        raise SettingError(f"run_dir={run_dir}: {getattr(error, 'strerror', None) or error}") from None
    stored = load(run_dir)
    _check_algorithm(stored.algo, given)
    changed: dict[str, Any] = {}
    for name, value in given.items():
        if name == "experiment":  # a name for a grid; what it sets has been given beside it
            continue
        group, _, option = name.rpartition(".")
        had = dict(getattr(stored, _DOTTED[group])).get(option) if group else getattr(stored, name)
        if name == "run_dir" or value == had or (name, value) == ("backend", "auto"):
            continue
        if not stored.may_change(name):
            raise SettingError(
                f"{name}={value}: contradicts the run in {run_dir}, which has {name}={had}; "
                "leave it out to resume, or give another run_dir"
            )
        changed[name] = value
    return build({**dataclasses.asdict(stored), **changed})


# What `vecpsmbpo eval` may be told, and the settings that it stands for.
EVALUATION = {
    "episodes": "eval_episodes",
    "policy": "eval_policy",
    "actions": "eval_actions",
    "backend": "backend",
    "devices": "devices",
}


def parse_evaluation(overrides: Sequence[str]) -> tuple[str, dict[str, str]]:
    """The `run_dir=` that is to be evaluated, and what else is said, by the names in `EVALUATION`.

    Raises:
        SettingError: there is no such name, or no `run_dir=`.
    """
    given: dict[str, str] = {}
    for text in overrides:
        name, equals, value = text.partition("=")
        if not equals or name not in ("run_dir", *EVALUATION):
            raise SettingError(f"{text}: eval takes run_dir=…, {'=…, '.join(EVALUATION)}=…")
        given[name] = value
    if "run_dir" not in given:
        raise SettingError("run_dir: eval needs run_dir=…, a directory that train or export has written")
    return given.pop("run_dir"), given


def for_evaluation(stored: Settings, given: Mapping[str, Any]) -> Settings:
    """The settings of a run as it is to be evaluated.

    Args:
        given: values by the names in `EVALUATION`.

    Raises:
        SettingError: a name that there is not, or a value that it cannot have.
    """
    changes = {}
    for name, value in given.items():
        if name not in EVALUATION:
            raise SettingError(f"{name}={value}: evaluation takes {', '.join(EVALUATION)}")
        setting = EVALUATION[name]
        try:
            changes[setting] = check(setting, value)
        except SettingError:
            raise SettingError(f"{name}={value}: must be {allowed(setting)}") from None
    changes["backend"] = registry.resolve_backend(stored.env, changes.get("backend", stored.backend))
    return dataclasses.replace(stored, **changes)


# ── the same from Python ─────────────────────────────────────────────────────────────────────────────────────────


def overrides_of(settings: Mapping[str, Any]) -> list[str]:
    """`name=value` as a command line would have it, of settings by name; `env_options` and `sweep` hold the settings
    `env.*` and `sweep.*`.

    Raises:
        SettingError: a value is of a type that no setting has.
    """
    dots = {kept: f"{group}." for group, kept in _DOTTED.items()}
    found = []
    for name, value in settings.items():
        if name not in dots:
            found.append(as_override(name, value))
        elif not isinstance(value, Mapping):
            raise SettingError(f"{name}={value}: must be a dictionary")
        else:
            found += [f"{dots[name]}{inner}={_written(inner, item)}" for inner, item in value.items()]
    return found


def as_override(name: str, value: Any) -> str:
    """`name=value` as Hydra reads it back."""
    return f"{name}={_written(name, value)}"


def _written(name: str, value: Any) -> str:
    """A value as Hydra reads it back."""
    if hasattr(value, "tolist"):  # of NumPy or JAX
        value = value.tolist()
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, list | tuple):
        return "[" + ",".join(_written(name, item) for item in value) + "]"
    if not isinstance(value, str | Path):
        raise SettingError(f"{name}={value!r}: must be a number, a string, or a list of them")
    text = str(value)
    if re.fullmatch(r"[A-Za-z_./][\w./+-]*", text) and yaml.safe_load(text) == text:
        return text
    quoted = re.sub(r"(\\*)'", r"\1\1\\'", text)  # backslashes count before a quote, and at the end
    return "'" + re.sub(r"(\\+)$", r"\1\1", quoted) + "'"
