"""Damaged files of a run directory, and directories that are not as a run left them."""

import random
import re
import shutil
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from tools.harm.runs import (
    END,
    LOGGED,
    ONE_LINE,
    SAID,
    STOPPED,
    Trial,
    contents,
    here,
    one_line,
    warned_end,
)

METRICS, CONFIG, CHECKPOINTS = "metrics.jsonl", "config.yaml", "checkpoints"


def files(folder: Path, options: dict) -> Iterator[Trial]:
    for backend in ("host", "mjx"):
        task = [*LOGGED, "loggers=[tensorboard]", "report=true", f"backend={backend}"]
        whole, reference = folder / f"{backend}_stopped", folder / f"{backend}_reference"
        _go([*task, f"total_steps={STOPPED - 40}", f"run_dir={whole}"])
        with (whole / METRICS).open("a") as log:
            log.write("[1, 2]\n")  # which is set aside, in a file that is damaged, too
        _go([f"total_steps={STOPPED}", f"run_dir={whole}"])
        shutil.copytree(whole, reference)
        _go([f"total_steps={END}", f"run_dir={reference}"])
        for kind, which in _kinds(whole).items():
            if backend == "mjx" and which.parts[0] != CHECKPOINTS:
                continue  # written by what runs around both drivers
            for damage, act in DAMAGES.items():
                attempt = partial(_gone_on_with, whole, reference, which, act)
                yield f"{backend}: {kind} {damage}", attempt
        for what, (act, word) in MISTAKES.items():
            yield f"{backend}: {what}", partial(_refused, whole, reference, task, act, word)


def _go(words: list[str]) -> None:
    status, said = here(words)
    assert status == 0, said


def _gone_on_with(whole: Path, reference: Path, which: Path, damage: Callable[[Path], object]) -> str:
    damaged = _copied(whole)
    damage(damaged / which)
    before = contents(damaged)
    status, said = here([f"run_dir={damaged}", f"total_steps={END}"])
    if status != 0:
        return one_line(status, said) if contents(damaged) == before else "it has been changed"
    ended = warned_end(said, damaged, reference)
    told = any(words in said for words in ("set aside", "are lost", "not as they were"))
    return SAID if ended == "other logs" and told else ended


def _refused(whole: Path, reference: Path, task: list[str], act: Callable[[Path], object], word: str) -> str:
    """And whether the run can be gone on with when all is right again."""
    wrong = _copied(whole)
    act(wrong)
    before = contents(wrong)
    status, said = here([*task, f"run_dir={wrong}", word])
    ended = one_line(status, said) if contents(wrong) == before else "it has been changed"
    if ended == ONE_LINE:
        if (wrong / CONFIG).exists():  # without it the right words are enough
            shutil.copytree(whole, wrong, dirs_exist_ok=True)
        status, said = here([*task, f"run_dir={wrong}", f"total_steps={END}"])
        ended = warned_end(said, wrong, reference) if status == 0 else f"not gone on with: {said[-200:]!r}"
    return ended


def _copied(whole: Path) -> Path:
    copy = whole.with_name("copy")
    shutil.rmtree(copy, ignore_errors=True)
    return shutil.copytree(whole, copy)


def _kinds(run_dir: Path) -> dict[str, Path]:
    """One file of each kind in a run directory, the largest; by a name that is the same in every run."""
    found: dict[str, Path] = {}
    newest = f"{CHECKPOINTS}/{STOPPED}"
    for path in sorted(run_dir.rglob("*"), key=lambda path: (-path.stat().st_size, path)):
        name = path.relative_to(run_dir)
        if path.is_file() and path.stat().st_size and (name.parts[0] != CHECKPOINTS or newest in str(name)):
            kind = "array" if path.name[0].isdigit() else path.name.partition(".tfevents.")[0]
            found.setdefault(kind if len(name.parts) == 1 else f"{name.parts[0]}/{kind}", name)
    return found


def _flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1 << 2
    path.write_bytes(content)


def _half(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def _say_in_config(run_dir: Path, name: str, value: object) -> None:
    text, edited = re.subn(rf"^{name}: .*$", f"{name}: {value}", (run_dir / CONFIG).read_text(), flags=re.MULTILINE)
    assert edited == 1
    (run_dir / CONFIG).write_text(text)


def _spoil_checkpoints(run_dir: Path) -> None:
    for path in (run_dir / CHECKPOINTS).glob("*/state/**/*"):
        if path.is_file():
            path.write_bytes(path.read_bytes()[:3])


DAMAGES: dict[str, Callable[[Path], object]] = {
    "truncated": _half,
    "emptied": lambda path: path.write_bytes(b""),
    "noise": lambda path: path.write_bytes(random.Random(0).randbytes(path.stat().st_size)),
    "one bit flipped": _flip,
}
ON = f"total_steps={END}"
# What is done to the directory, and the word with which it is gone on with.
MISTAKES: dict[str, tuple[Callable[[Path], object], str]] = {
    "config.yaml is missing, and another seed is given": (lambda run_dir: (run_dir / CONFIG).unlink(), "seed=5"),
    "config.yaml has another seed": (lambda run_dir: _say_in_config(run_dir, "seed", 7), ON),
    "config.yaml has an unknown algorithm": (lambda run_dir: _say_in_config(run_dir, "algo", "foo"), ON),
    "config.yaml has larger networks": (lambda run_dir: _say_in_config(run_dir, "model_hidden_size", 9), ON),
    "config.yaml is no YAML": (lambda run_dir: (run_dir / CONFIG).write_text("["), ON),
    "all checkpoints are gone": (lambda run_dir: shutil.rmtree(run_dir / CHECKPOINTS), ON),
    "all checkpoints are damaged": (_spoil_checkpoints, ON),
    "total_steps below what is done": (lambda run_dir: None, f"total_steps={STOPPED - 40}"),
}
