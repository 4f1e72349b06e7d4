"""Commands and tasks with a mistake in each."""

import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path

from tools.harm.commands import COMMANDS, MODULES
from tools.harm.runs import ANSWER_S, Trial, environment, one_line


def careless(folder: Path, options: dict) -> Iterator[Trial]:
    for name, code in MODULES.items():
        (folder / f"{name}.py").write_text(code)
    for words, surroundings in COMMANDS:
        set_as = "".join(f"{name}={value} " for name, value in surroundings.items())
        yield f"{set_as}{' '.join(words)}"[:80], partial(_answer, folder, words, surroundings)


def _answer(folder: Path, words: Sequence[str], surroundings: Mapping[str, str]) -> str:
    before = {path.name for path in folder.iterdir()}
    surrounded = {**environment(), **surroundings, "PYTHONDONTWRITEBYTECODE": "1"}
    program = [sys.executable, "-m", "vecpsmbpo.cli", *words]
    try:
        result = subprocess.run(
            program, cwd=folder, env=surrounded, capture_output=True, text=True, timeout=ANSWER_S, check=False
        )
        ended = one_line(result.returncode, result.stderr)
    except subprocess.TimeoutExpired:
        ended = f"no answer within {ANSWER_S} s"
    for left in {path.name for path in folder.iterdir()} - before:
        ended = f"left {left}"
        shutil.rmtree(folder / left)
    return ended
