"""What docs/extending.md promises: each of its patches touches the files named there, and works."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests import looks
from tests.helpers import environment
from vecpsmbpo import jsonl

ROOT = Path(__file__).parents[1]
EXAMPLES = sorted((ROOT / "docs" / "examples").glob("new_*.diff"))


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_a_patch_touches_only_the_files_that_the_document_names(example):
    text = (ROOT / "docs" / "extending.md").read_text()
    section = next(part for part in text.split("\n## ") if f"docs/examples/{example.name}" in part)
    named = set(re.findall(r"^\| `([^`]+)` \|", section, re.MULTILINE))
    touched = set(re.findall(r"^\+\+\+ b/(.+)$", example.read_text(), re.MULTILINE))
    assert touched == named


@pytest.fixture(scope="module")
def extended(tmp_path_factory):
    """A folder with the package as it is with all patches, to be imported from."""
    copy, site = tmp_path_factory.mktemp("copy"), tmp_path_factory.mktemp("site")
    for name in ("vecpsmbpo", "envs", "configs"):
        shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", copy)
    for example in EXAMPLES:
        subprocess.run(["git", "apply", str(example)], cwd=copy, check=True)
    (copy / "vecpsmbpo").rename(site / "vecpsmbpo")
    for name in ("envs", "configs"):  # as pyproject.toml maps them
        (copy / name).rename(site / "vecpsmbpo" / name)
    return site


def python(site: Path, cwd: Path, *argv: str) -> str:
    """What Python says, with the extended package."""
    result = subprocess.run(
        [sys.executable, *argv],
        cwd=cwd,
        env={**environment(), "PYTHONPATH": str(site)},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert result.returncode == 0, result.stderr
    return result.stdout


def train(site: Path, run_dir: Path, *words: str) -> tuple[list[dict], list[dict]]:
    """The lines of a tiny run."""
    task = ("env=cartpole_swingup", "size=tiny", "backend=host", f"run_dir={run_dir}")
    python(site, run_dir.parent, "-m", "vecpsmbpo.cli", "train", *task, *words)
    return jsonl.read(run_dir / "metrics.jsonl"), jsonl.read(run_dir / "episodes.jsonl")


def test_a_new_algorithm_trains(extended, tmp_path):
    words = ["algo=random_shooting", "shooting_plans=8", "shooting_horizon=3"]
    epochs, episodes = train(extended, tmp_path / "run", *words)
    assert [line["env_steps"] for line in epochs] == [40, 80, 120]
    assert np.isfinite([line["eval_return"] for line in epochs]).all()
    assert epochs[-1]["model_loss"] is not None
    assert epochs[-1]["critic_loss"] is None  # nothing learns so
    assert all(line["probs"] == [[1.0]] for line in episodes)


def test_a_new_rule_and_a_new_number_are_logged(extended, tmp_path):
    temperature = 0.1
    epochs, episodes = train(extended, tmp_path / "run", "weights=means", f"temperature={temperature}")
    assert epochs[-1]["actor_gradient"] > 0
    earned, counts = np.zeros((2, 2)), np.zeros((2, 2))
    for line in episodes:
        logits = earned / np.maximum(counts, 1) / temperature
        expected = np.exp(logits - logits.max())
        np.testing.assert_allclose(line["probs"], expected / expected.sum(), atol=1e-5)
        if not line["random"]:
            earned[line["model"], line["policy"]] += line["return"]
            counts[line["model"], line["policy"]] += 1
    assert counts.sum() >= 2


BARS = """
import json, pathlib
from vecpsmbpo.look import earned, runs
axes = earned.draw(runs.load(pathlib.Path("run")).lanes[0]).axes[0]
print(json.dumps([[bar.get_height() for bar in axes.patches], [text.get_text() for text in axes.texts]]))
"""


def test_a_new_picture_is_on_the_page(extended, tmp_path):
    looks.write(tmp_path / "run", looks.epochs([1, 2, 3]), looks.episodes(6))
    python(extended, tmp_path, "-m", "vecpsmbpo.cli", "report", "run", "out=page.html")
    page = (tmp_path / "page.html").read_text()
    assert "seed 0: mean return of each member, and in how many episodes it acted" in page
    # Members 1, 2, 3, 0, 1 earned 1 to 5; the episode before theirs was random.
    heights, counts = json.loads(python(extended, tmp_path, "-c", BARS))
    assert heights == [4, 3, 2, 3]
    assert counts == ["1", "2", "1", "1"]
