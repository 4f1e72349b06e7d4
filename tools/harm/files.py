"""Damaged files of a run directory."""

import random
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

from tools.harm.runs import END, RUN, SAID, STOPPED, Found, contents, here, one_line, same_end


def files(folder: Path, options: dict) -> Iterator[Found]:
    run, whole = [*RUN, "backend=host"], folder / "stopped"
    assert here([*run, f"total_steps={STOPPED}", f"run_dir={whole}"])[0] == 0
    reference = folder / "reference"
    shutil.copytree(whole, reference)
    assert here([f"run_dir={reference}", f"total_steps={END}"])[0] == 0
    for which, damage in ((which, damage) for which in _kinds(whole) for damage in DAMAGES):
        damaged = folder / "damaged"
        shutil.rmtree(damaged, ignore_errors=True)
        shutil.copytree(whole, damaged)
        DAMAGES[damage](damaged / which)
        before = contents(damaged)
        status, said = here([f"run_dir={damaged}", f"total_steps={END}"])
        if status == 0:
            ended = same_end(damaged, reference)
            if ended == "other logs" and any(told in said for told in ("set aside", "are lost", "not as they were")):
                ended = SAID
        else:
            ended = one_line(status, said) if contents(damaged) == before else "it has been changed"
        yield f"{which} {damage}", ended


def _kinds(run_dir: Path) -> list[Path]:
    """One file of each kind in a run directory."""
    found: dict[str, Path] = {}
    newest = f"checkpoints/{STOPPED}"
    for path in sorted(run_dir.rglob("*"), key=lambda path: -path.stat().st_size):
        name = path.relative_to(run_dir)
        if path.is_file() and path.stat().st_size and (name.parts[0] != "checkpoints" or newest in str(name)):
            found.setdefault("array" if path.name[0].isdigit() else f"{name.parts[0]}/{path.name}", name)
    return list(found.values())


def _flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1 << 2
    path.write_bytes(content)


DAMAGES: dict[str, Callable[[Path], object]] = {
    "truncated": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    "emptied": lambda path: path.write_bytes(b""),
    "noise": lambda path: path.write_bytes(random.Random(0).randbytes(path.stat().st_size)),
    "one bit flipped": _flip,
}
