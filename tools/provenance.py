"""What was measured or tried: stands beside every figure."""

import shutil
import subprocess
from pathlib import Path

from vecpsmbpo import versions

HERE = Path(__file__).resolve().parents[1]
MEASURED = ("configs", "envs", "hydra_plugins", "tools", "vecpsmbpo")


def code() -> dict[str, str]:
    """The commit of what is measured, with + where it has been changed since, and versions of what it runs on."""

    def git(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(["git", *words], cwd=HERE, capture_output=True, text=True, check=False)

    commit = "unknown"
    if shutil.which("git") and (found := git("rev-parse", "--short", "HEAD")).returncode == 0:
        changed = git("diff", "--quiet", "HEAD", "--", *MEASURED).returncode != 0
        commit = found.stdout.strip() + "+" * changed
    return {"commit": commit, "versions": versions.line()}


def everything() -> dict[str, str]:
    """The code, and the computer."""
    return {**code(), "machine": versions.machine()}
