"""What XLA makes of one SAC update."""

import re
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from tools.benches.program import PAPER
from vecpsmbpo import config, replay, runtime, sac
from vecpsmbpo.envs import specs
from vecpsmbpo.settings import Settings
from vecpsmbpo.types import Hyper


def bench_pieces(words: Sequence[str]) -> dict[str, Any]:
    settings = config.compose([*PAPER, *words])
    runtime.configure(settings)
    what = {"task": settings.env, "width": settings.policy_hidden_size, "critic_norm": settings.critic_norm}
    return {**what, **pieces_of_update(settings)}


def pieces_of_update(settings: Settings) -> dict[str, int]:
    """How many instructions of each kind the compiled loop over G updates of one member has in its body."""
    spec = specs.get(settings.env)
    nets, key = sac.make_networks(settings, spec), jax.random.key(0)

    def inputs() -> tuple:
        shape = (settings.updates_per_step, settings.policy_batch_size)
        rows = jnp.zeros((*shape, replay.row_size(spec.obs_size, spec.action_size)))
        batches = replay.unpack(rows, spec.obs_size, spec.action_size)
        noise = sac.Noise.draw(key, (*shape, spec.action_size))
        return sac.init(key, nets, spec), batches, noise, Hyper.of(settings)

    def run(agent: Any, batches: Any, noise: Any, hyper: Hyper) -> Any:
        return sac.updates(agent, batches, noise, hyper, nets=nets)

    return loop_pieces(jax.jit(run).lower(*jax.eval_shape(inputs)).compile().as_text())


def loop_pieces(program: str) -> dict[str, int]:
    """Of an XLA program in its text form: what is in the bodies of its loops, and in all that these call.

    Raises:
        ValueError: there is no loop.
    """
    computations = dict(re.findall(r"^(?:ENTRY )?%?([\w.\-]+) \([^\n]*\{\n(.*?)^\}", program, re.M | re.S))
    called = r"(?:calls|to_apply|body|condition|\w+_computations?)=\{?([^,}\s]+(?:, %[^,}\s]+)*)"
    seen: set[str] = set()
    waiting = re.findall(r" while\(.*body=%?([\w.\-]+)", program)
    if not waiting:
        raise ValueError("the program has no loop: XLA unrolls one of a single update")
    while waiting:
        name = waiting.pop()
        if name not in seen:
            seen.add(name)
            for parts in re.findall(called, computations[name]):
                waiting += [part.lstrip("%") for part in parts.split(", ")]
    body = "".join(computations[name] for name in seen)
    products = len(re.findall(r" dot\(|custom_call_target=\"[^\"]*(?:gemm|matmul)", body))
    return {"products": products, "fusions": body.count(" fusion("), "copies": body.count(" copy(")}
