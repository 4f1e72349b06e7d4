"""`vecpsmbpo export`: a policy as files that need neither this package nor its run.

policy.npz    the weights, as NumPy reads them
act.py        the policy in NumPy alone, with the weights beside it
policy.jax    the same as a compiled function for any machine (`jax.export`); needs JAX alone
policy.json   which task, run, member and step it is of
"""

import functools
import json
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vecpsmbpo.look import arguments, files, runs
from vecpsmbpo.settings import SettingError

OPTIONS = {
    "member": arguments.text("best", "best or n,m"),
    "lane": arguments.whole(0),
    "out": arguments.out("policy"),
}

FILES = ("policy.npz", "act.py", "policy.json")
ACT = '''\
"""A policy that vecpsmbpo has trained, in NumPy alone: obs [..., O] -> action [..., A] in [-1, 1]."""

from pathlib import Path

import numpy as np

WEIGHTS = np.load(Path(__file__).with_name("policy.npz"))
LAYERS = [(WEIGHTS[f"kernel_{i}"], WEIGHTS[f"bias_{i}"]) for i in range(len(WEIGHTS) // 2)]


def act(obs):
    hidden = np.asarray(obs, np.float32)
    for kernel, bias in LAYERS[:-1]:
        hidden = np.maximum(hidden @ kernel + bias, 0)
    kernel, bias = LAYERS[-1]
    return np.tanh(hidden @ kernel + bias)


if __name__ == "__main__":
    print(act(np.zeros(LAYERS[0][0].shape[0])))
'''


def run(words: Sequence[str]) -> int:
    """The command; its exit status.

    Raises:
        SettingError: a mistake in `words`, the run has no such policy, or the files cannot be written.
    """
    named, options = arguments.parse("export", words, OPTIONS)
    (path,) = arguments.run_dirs("export", named, most=1)
    out = options["out"]
    if out.exists() and not out.is_dir():
        raise SettingError(f"out={out}: must be a directory")
    files.check_writable(out / "policy.npz")
    found = runs.load(path)
    if found.settings.plans or found.settings.alternates:
        raise SettingError(
            f"run_dir={path}: only policies that learn by SAC can be exported, not algo={found.settings.algo}"
        )
    export(found, out, options["member"], options["lane"])
    print(f"written: {', '.join(str(out / name) for name in FILES)}")
    return 0


def export(run: runs.Run, out: Path, member: str, lane: int) -> None:
    """Writes the files into the directory `out`.

    Raises:
        SettingError: as `members.load`; there is no such member.
    """
    import jax

    from vecpsmbpo.look import members

    trained = members.load(run, lane)
    index = _index(trained, member)
    layers = weights(jax.tree.map(lambda x: np.asarray(x[index]), trained.actors()), trained.algorithm.spec.action_size)
    about = {
        "task": run.settings.task,
        "run": run.name,
        "algo": run.settings.algo,
        "env_steps": trained.step,
        **run.settings.lanes[lane],
        "member": members.member_names(run)[index],
        "obs_size": trained.algorithm.spec.obs_size,
        "action_size": trained.algorithm.spec.action_size,
    }
    files.write(out / "policy.npz", functools.partial(_save, layers))
    files.write_text(out / "act.py", ACT)
    files.write_text(out / "policy.json", json.dumps(about, indent=2) + "\n")


def _index(trained: Any, member: str) -> int:
    """n·M + m of the member.

    Raises:
        SettingError: there is no such member.
    """
    from vecpsmbpo.look import members

    if member == "best":
        return trained.best()
    names = members.member_names(trained.run)
    if member not in names:
        raise SettingError(f"member={member}: must be best or one of {'  '.join(names)}")
    return names.index(member)


def weights(actor: Any, action_size: int) -> dict[str, np.ndarray]:
    """Kernels [in, out] and biases [out] of an actor's layers, in order; of the last one what gives the mean action."""
    layers = actor["params"]["ReluMLP_0"]
    ordered = sorted(layers, key=lambda name: int(name.removeprefix("Dense_")))
    found = {}
    for index, name in enumerate(ordered):
        last = index == len(ordered) - 1
        kernel, bias = layers[name]["kernel"], layers[name]["bias"]
        found[f"kernel_{index}"] = kernel[:, :action_size] if last else kernel
        found[f"bias_{index}"] = bias[:action_size] if last else bias
    return found


def _save(layers: dict[str, np.ndarray], path: Path) -> None:
    """As `np.savez`, without the moment of writing: the same policy is the same file."""
    with zipfile.ZipFile(path, "w") as archive:
        for name, values in layers.items():
            with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w") as entry:
                np.lib.format.write_array(entry, np.asarray(values), allow_pickle=False)
