"""`vecpsmbpo export`: a policy as files that need neither this package nor its run.

policy.npz    the weights, as NumPy reads them
act.py        the policy in NumPy alone, with the weights beside it
policy.json   which task, run, member and step it is of, and the run's settings
policy.jax    with also=jax: the same for CPUs, GPUs and TPUs, StableHLO that `jax.export.deserialize` reads
policy.onnx   with also=onnx: the same for ONNX's runtimes
minari/       with also=minari: the real data, as a Minari data set
"""

import dataclasses
import importlib.util
import io
import json
import zipfile
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from vecpsmbpo import arguments, jsonl, recorded
from vecpsmbpo.feedforward import RULES, Feedforward
from vecpsmbpo.look import dataset, files, runs
from vecpsmbpo.look.exported import ABOUT_FILE, WEIGHTS_FILE
from vecpsmbpo.settings import SettingError, Settings

if TYPE_CHECKING:
    from vecpsmbpo.look.members import Trained

OPTIONS = {
    "member": arguments.text("whose policy", "best", "best or n,m"),
    "lane": arguments.whole("of which seed and swept value, counted from 0", 0),
    "also": arguments.names("what else to write", allowed="of jax, onnx, minari, separated by commas"),
    "out": arguments.out("where the files go", "policy"),
}

ADDITIONS = {"jax": ("flatbuffers",), "onnx": ("onnx",), "minari": ("minari", "h5py")}  # and what each needs
OPSET, IR_VERSION = 17, 8  # of ONNX, from 2022: every runtime since then reads it
PLATFORMS = ("cpu", "cuda", "rocm", "tpu")
ACT = '''\
"""A policy that vecpsmbpo has trained, in NumPy alone: obs [..., O] -> action [..., A] in [-1, 1]."""

from pathlib import Path

import numpy as np

WEIGHTS = np.load(Path(__file__).with_name("policy.npz"))
LAYERS = [(WEIGHTS[f"kernel_{{i}}"], WEIGHTS[f"bias_{{i}}"]) for i in range(len(WEIGHTS) // 2)]


def act(obs):
    x = np.asarray(obs, np.float32)
    for kernel, bias in LAYERS[:-1]:
        x = {hidden}
    kernel, bias = LAYERS[-1]
    return {end}


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
    files.check_writable(out / WEIGHTS_FILE)
    for name in options["also"]:
        _check_extra(name)
    found = runs.load(path)
    runs.check_lane(found, options["lane"])
    _check_exportable(found, options["member"])
    from vecpsmbpo.look import members

    trained = members.load(found, options["lane"])
    episodes = dataset.collect(trained, out / "minari") if "minari" in options["also"] else []
    # All of them in memory first: what fails, fails before anything is written.
    network, contents = policy(trained, options["member"])
    makers = {"policy.jax": jax_function, "policy.onnx": onnx_model}
    asked = {name: make for name, make in makers.items() if name.partition(".")[2] in options["also"]}
    contents |= {name: make(network) for name, make in asked.items()}
    files.write_together(out, contents, without=makers.keys() - asked.keys())
    written = [out / name for name in contents]
    if "minari" in options["also"]:
        written.append(dataset.write(trained, episodes, out / "minari"))
    print(f"written: {', '.join(map(str, written))}")
    return 0


def _check_exportable(run: runs.Run, member: str) -> None:
    """Raises:
    SettingError: the run has no single policy.
    """
    settings = run.settings
    if settings.plans_actions:
        raise SettingError(f"run_dir={run.path}: algo={settings.algo} plans its actions; there is no policy to export")
    if settings.averages_members and member == "best":
        raise SettingError(
            "member=best: with posterior=average all members act together, which is no single policy; name one, n,m"
        )


def _check_extra(name: str) -> None:
    """Raises:
    SettingError: there is no such addition, or its package is absent.
    """
    if name not in ADDITIONS:
        raise SettingError(f"also={name}: must be {OPTIONS['also'].allowed}")
    for package in ADDITIONS[name]:
        if importlib.util.find_spec(package) is None:
            raise SettingError(f"also={name}: needs the package {package}; pip install 'vecpsmbpo[export]'")


def policy(trained: "Trained", member: str) -> tuple[Feedforward, dict[str, bytes]]:
    """A policy, and its files by name.

    Raises:
        SettingError: there is no such member, or an option of the task cannot be written as JSON.
    """
    from vecpsmbpo.look import members

    run, index = trained.run, _index(trained, member)
    network = trained.feedforward(index)
    about = {
        "task": run.settings.task,
        "run": run.name,
        "algo": run.settings.algo,
        "env_steps": trained.step,
        **run.settings.lanes[trained.index],
        "member": members.member_names(run)[index],
        "obs_size": network.obs_size,
        "action_size": network.action_size,
        "network": {"hidden": network.hidden, "end": network.end},
        "settings": settings_of(run.settings, trained.index),
    }
    try:
        text = json.dumps(about, indent=2, allow_nan=False) + "\n"
    except ValueError:  # a task's own option may be infinite
        raise SettingError(f"run_dir={run.path}: has an option that JSON cannot have, infinity or NaN") from None
    return network, {
        WEIGHTS_FILE: _archive(network.arrays),
        "act.py": code(network).encode(),
        ABOUT_FILE: text.encode(),
    }


def code(network: Feedforward) -> str:
    """act.py: the policy in NumPy, with policy.npz beside it."""
    rules = {"hidden": RULES[network.hidden].code, "end": RULES[network.end].code}
    return ACT.format(**{name: code.format("x @ kernel + bias") for name, code in rules.items()})


def settings_of(settings: Settings, lane: int) -> dict[str, Any]:
    """Of a run with this lane alone, as JSON can have them."""
    alone = dataclasses.replace(settings, num_seeds=1, sweep=(), **settings.lanes[lane])
    values = {name: value for name, value in recorded.plain(alone).items() if name != "run_dir"}
    return {name: jsonl.INFINITY if value == float("inf") else value for name, value in values.items()}


def _index(trained: "Trained", member: str) -> int:
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


def jax_function(network: Feedforward) -> bytes:
    """obs [b, O] -> action [b, A], for any b, as `jax.export.deserialize(...).call` takes it."""
    import jax
    import jax.numpy as jnp
    from jax import export

    shape = (*export.symbolic_shape("b"), network.obs_size)
    function = jax.jit(lambda obs: network(obs, jnp))
    exported = export.export(function, platforms=PLATFORMS)(jax.ShapeDtypeStruct(shape, jnp.float32))
    return bytes(exported.serialize())


def onnx_model(network: Feedforward) -> bytes:
    """The same as an ONNX model with input `obs` [b, O] and output `action` [b, A]; no converter is needed for so few
    operations."""
    from onnx import TensorProto, checker, helper, numpy_helper

    arrays = network.arrays | {"least": np.float32(-1.0), "most": np.float32(1.0)}
    nodes, value, last = [], "obs", len(network.layers) - 1
    for index in range(last + 1):
        nodes.append(helper.make_node("Gemm", [value, f"kernel_{index}", f"bias_{index}"], [f"sum_{index}"]))
        value, rule = (f"hidden_{index}", network.hidden) if index < last else ("action", network.end)
        inputs = [f"sum_{index}", *(("least", "most") if rule == "clip" else ())]
        nodes.append(helper.make_node(RULES[rule].onnx, inputs, [value]))

    def info(name: str, size: int) -> Any:
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, ["b", size])

    used = {name for node in nodes for name in node.input}
    initial = [numpy_helper.from_array(np.ascontiguousarray(arrays[name]), name) for name in arrays if name in used]
    shapes = [info("obs", network.obs_size)], [info("action", network.action_size)]
    graph = helper.make_graph(nodes, "policy", *shapes, initial)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)
    checker.check_model(model)
    return bytes(model.SerializeToString())


def _archive(arrays: dict[str, np.ndarray]) -> bytes:
    """What `np.savez` writes, without the moment of writing: the same policy is the same file."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for name, values in arrays.items():
            with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w") as entry:
                np.lib.format.write_array(entry, np.asarray(values), allow_pickle=False)
    return content.getvalue()
