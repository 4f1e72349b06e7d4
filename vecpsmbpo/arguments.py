"""What the commands of this package and its tools may be told: words by themselves, and `name=value` each."""

import sys
import textwrap
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from vecpsmbpo import stopping, words
from vecpsmbpo.config import CONFIG_FILE, closest
from vecpsmbpo.settings import SettingError


class Option(NamedTuple):
    """A `name=value`.

    Attributes:
        what: it is for, in words.
        default: where it is not given.
        read: the value from its text; a ValueError says that it cannot be.
        allowed: what the value may be, in words.
    """

    what: str
    default: Any
    read: Callable[[str], Any]
    allowed: str


def text(what: str, default: str = "", allowed: str = "a name") -> Option:
    """One word."""
    return Option(what, default, _filled, allowed)


def names(what: str, *default: str, allowed: str = "names, separated by commas") -> Option:
    """Some words: `a,b`."""
    return Option(what, default, lambda value: tuple(_filled(part) for part in value.split(",")), allowed)


def choice(what: str, *options: str, default: str | None = None) -> Option:
    """One of `options`; the first is the default, unless another is given."""
    return Option(
        what,
        options[0] if default is None else default,
        lambda value: options[options.index(value)],
        "one of " + ", ".join(options),
    )


def whole(what: str, default: int, at_least: int = 0, at_most: int | None = None) -> Option:
    """A whole number in a range."""

    def read(value: str) -> int:
        # isdecimal before int: int() also takes 1_0, " 1" and other spellings.
        if not (value.isascii() and value.isdecimal() and int(value) >= at_least):
            raise ValueError
        if at_most is not None and int(value) > at_most:
            raise ValueError
        return int(value)

    within = f", at least {at_least}" if at_most is None else f" from {at_least} to {at_most}"
    return Option(what, default, read, f"a whole number{within}")


def wholes(what: str) -> Option:
    """Whole numbers, none by default; `1,2` or `[1,2]`."""
    one = whole(what, 0)
    return Option(
        what,
        (),
        lambda value: tuple(one.read(part) for part in value.removeprefix("[").removesuffix("]").split(",")),
        "whole numbers, separated by commas",
    )


def number(what: str, default: float | None = None, above: float = -float("inf")) -> Option:
    """A finite number above another."""

    def read(value: str) -> float:
        found = float(value)
        if not above < found < float("inf"):
            raise ValueError
        return found

    return Option(what, default, read, "a number" if above == -float("inf") else f"a number above {above:g}")


def out(what: str, default: str, *suffixes: str) -> Option:
    """A file to write, of one of the kinds that `suffixes` name; without any, a directory."""

    def read(value: str) -> Path:
        path = Path(_filled(value))
        if suffixes and path.suffix.lower() not in suffixes:
            raise ValueError
        return path

    kinds = f"a file that ends in {', '.join(suffixes)}" if suffixes else "a directory"
    return Option(what, Path(default) if default else None, read, kinds)


def _filled(value: str) -> str:
    if not value:
        raise ValueError
    return value


def parse(command: str, words: Sequence[str], options: Mapping[str, Option]) -> tuple[list[str], dict[str, Any]]:
    """Splits a command line into what stands by itself and the value of every option.

    `run_dir=x` is the same as `x`.

    Raises:
        SettingError: an option that there is not, or a value that it cannot have.
    """
    alone: list[str] = []
    values = {name: option.default for name, option in options.items()}
    for word in words:
        name, equals, value = word.partition("=")
        if not equals:
            alone.append(word)
        elif name == "run_dir":
            alone.append(value)
        elif name not in options:
            raise SettingError(f"{word}: no such option of {command}; {closest(name, options)}")
        else:
            try:
                values[name] = options[name].read(value)
            except ValueError:
                raise SettingError(f"{word}: must be {options[name].allowed}") from None
    return alone, values


def explain(command: str, about: str, options: Mapping[str, Option]) -> str:
    """What `--help` prints: the documentation `about` the command, and a paragraph for every option."""
    lines = [about.strip(), *(["", f"options of {command}:"] if options else [])]
    for name, option in options.items():
        words = f"{option.what}; {option.allowed}"
        lines += ["", f"  {name}={_shown(option.default)}", textwrap.fill(words, 110, **_INDENTED)]
    return "\n".join(lines)


def as_tool(name: str, main: Callable[[Sequence[str]], int], about: str | None, options: Mapping[str, Option]) -> int:
    """Runs a program of `tools/` as `vecpsmbpo` runs a command: with `--help`, and one line for a mistake; its exit
    status."""
    given = sys.argv[1:]
    try:
        if {"-h", "--help"} & set(given):
            print(explain(name, about or "", options))
            status = 0
        else:
            status = main(given)
        print(end="", flush=True)
        return status
    except SettingError as error:
        status, said = 2, str(error)
    except OSError as error:
        if isinstance(error, BrokenPipeError) and stopping.is_unheard():
            return stopping.UNHEARD
        status, said = 2, words.of_system(error)
    except KeyboardInterrupt:  # what it has started got the signal, too, and saves
        status, said = 130, "interrupted"
    print(f"{name}: {said}", file=sys.stderr)
    return status


_INDENTED: Any = {"initial_indent": "      ", "subsequent_indent": "      "}


def _shown(default: Any) -> str:
    if isinstance(default, tuple):
        return ",".join(map(str, default))
    return "" if default is None else str(default)


def run_dirs(command: str, words: Sequence[str], *, most: int | None = None) -> list[Path]:
    """The run directories that `words` name: each is one, or holds some.

    Raises:
        SettingError: none is named, one holds no run, or there are more than `most`.
    """
    if not words:
        raise SettingError(f"run_dir: {command} needs the directory of a run that train has written")
    found: list[Path] = []
    for word in words:
        path = Path(word)
        here = [path] if (path / CONFIG_FILE).exists() else sorted(p.parent for p in path.glob(f"*/{CONFIG_FILE}"))
        if not here:
            raise SettingError(f"run_dir={word}: holds no {CONFIG_FILE}, so no run")
        found += [run for run in here if run not in found]
    if most is not None and len(found) > most:
        raise SettingError(f"run_dir: {command} takes {most} run, not {len(found)}")
    return found
