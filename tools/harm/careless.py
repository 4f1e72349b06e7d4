"""Commands and tasks with a mistake in each."""

import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from tools.harm.commands import COMMANDS, MODULES
from tools.harm.runs import ANSWER_S, Found, environment, one_line


def careless(folder: Path, options: dict) -> Iterator[Found]:
    for name, code in MODULES.items():
        (folder / f"{name}.py").write_text(code)
    before = {path.name for path in folder.iterdir()}
    for words, surroundings in COMMANDS:
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
        set_as = "".join(f"{name}={value} " for name, value in surroundings.items())
        yield f"{set_as}{' '.join(words)}"[:80], ended
