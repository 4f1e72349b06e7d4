"""Files of JSON lines that something has befallen: nothing is dropped without a word, and nothing stops a run."""

import json

import pytest

from vecpsmbpo import jsonl

STRANGE = [
    b"[1, 2]\n",
    b'{"seed": 0}\n',
    b"\xff\x00\x9f\n",
    b'{"env_steps": "inf", "seed": 0}\n',
    b'{"env_steps": 20, "se\n',
]
STRANGE += [b'{"env_steps": 1e400, "seed": 0}\n', b"[" * 10_000 + b"\n", b'{"env_steps": -1, "seed": 0}\n', b"null\n"]


def line(step: int) -> bytes:
    return json.dumps({"env_steps": step, "seed": 0, "return": 0.1}).encode() + b"\n"


def opened(path, env_steps, mark=None):
    """The file and what was said of it."""
    said: list[str] = []
    return jsonl.Growing(path, env_steps, ("env_steps", "seed"), mark, said.append), said


@pytest.mark.parametrize("strange", STRANGE, ids=range(len(STRANGE)))
def test_a_strange_line_is_set_aside_and_the_lines_after_it_stay(strange, tmp_path):
    path = tmp_path / "metrics.jsonl"
    path.write_bytes(line(10) + strange + line(20) + line(30))
    file, said = opened(path, 20)
    assert path.read_bytes() == line(10) + line(20)
    assert (tmp_path / "metrics.jsonl.strange").read_bytes() == strange
    assert said == [f"{path}: 1 line(s) that cannot be read, set aside in metrics.jsonl.strange"]
    assert file.written == 30
    assert opened(path, 20)[1] == []  # said once


def test_an_unfinished_last_line_is_work_that_will_be_done_again(tmp_path):
    path = tmp_path / "metrics.jsonl"
    path.write_bytes(line(10) + b"\n" + line(20)[:-1])  # an editor took the last line's end
    file, said = opened(path, 20)
    file.append([{"env_steps": 30, "seed": 0}])
    assert [found["env_steps"] for found in jsonl.read(path)] == [10, 20, 30]
    path.write_bytes(path.read_bytes() + line(40)[:-5])
    assert opened(path, 30)[1] == said == []
    assert {found.name for found in tmp_path.iterdir()} == {"metrics.jsonl"}


def test_what_a_checkpoint_knows_of_a_file_tells_of_lines_lost_and_changed(tmp_path):
    path = tmp_path / "metrics.jsonl"
    file, _ = opened(path, 0)
    for step in (10, 20, 30):
        file.append([{"env_steps": step, "seed": 0, "return": 0.1}])
    mark, whole = file.mark, path.read_bytes()
    assert whole == line(10) + line(20) + line(30)
    file.append([{"env_steps": 40, "seed": 0, "return": 0.1}])
    assert opened(path, 30, mark)[1] == []
    assert path.read_bytes() == whole
    for damaged, what in (
        (line(10), "2 of its lines up to step 30 are lost"),
        (b"", "3 of its lines up to step 30 are lost"),
        (whole[:-10], "1 line(s) that cannot be read, set aside in metrics.jsonl.strange"),
        (whole.replace(b"0.1", b"0.3", 1), "lines up to step 30 are not as they were written"),
        (line(10) + line(2**14 + 20) + line(30), "1 line(s) that cannot be read, set aside in metrics.jsonl.strange"),
        (line(10) + b"{\n" + line(30), "1 line(s) that cannot be read, set aside in metrics.jsonl.strange"),
    ):
        path.write_bytes(damaged)
        assert opened(path, 30, mark)[1] == [f"{path}: {what}"]
    assert line(30)[:-10] + b"\n" in (tmp_path / "metrics.jsonl.strange").read_bytes()
