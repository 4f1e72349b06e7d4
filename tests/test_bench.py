"""What `tools/bench.py pieces` counts, and that an update does not fall into more pieces unnoticed."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

from tools.benches import pieces
from vecpsmbpo import config


def test_products_are_counted_inside_loops_only():
    def program(x):
        def body(carry, _):
            return jnp.tanh(carry @ x) @ x, None  # two

        return jax.lax.scan(body, x @ x, None, length=3)[0]  # and one before

    text = jax.jit(program).lower(jnp.ones((8, 8))).compile().as_text()
    assert pieces.loop_pieces(text)["products"] == 2


FUSIONS = {"none": 180, "layer": 233}  # of jax 0.10.2
COPIES = 12


@pytest.mark.parametrize(("norm", "means"), [("none", 0), ("layer", 40)])
def test_an_update_is_41_products_and_the_norm_s_means(norm, means):
    """By hand, networks being of three products, forwards: an actor, two targets and two critics, 15, and an actor and
    two critics for the actor's loss, 9. Backwards: two critics to weights and hidden layers, 10, two critics to the
    actions, 6, and the actor, 5: 45. Four of them are outer products, which XLA multiplies out by itself: each critic's
    way back from its single output, for its own loss and for the actor's. LayerNorm's means are products with a column
    of ones: two for each of the critics' 12 hidden layers forwards, and of the 8 backwards. Of fusions and copies there
    may be a tenth more than there were when this was written, since XLA changes, too."""
    found = pieces.pieces_of_update(config.compose(["env=hopper", f"critic_norm={norm}", "updates_per_step=5"]))
    assert found["products"] == 41 + means
    assert found["fusions"] <= 1.1 * FUSIONS[norm]
    assert found["copies"] <= 1.1 * COPIES


def test_a_mistake_in_what_is_measured_is_a_line():
    """Of every bench, whether it is told settings, tasks or another interpreter, and of `tools/gpu` without a GPU."""
    for words, said in (
        (["bench", "pieces", "env=hoper"], "env=hoper: did you mean hopper?"),
        (["bench", "envs", "hoper"], "hoper: did you mean hopper?"),
        (["bench", "updates", "backend=host"], "env=hopper backend=host: only programs with MJX inside are measured"),
        (["bench", "compare", "peer=/bin/true"], "compare: peer=/bin/true did not measure mbrl-lib (exit status 0)"),
        (["gpu", "updates"], "JAX sees no GPU here; size=tiny tries the script on a CPU"),
        (["gpu", "out=/dev/null/gpu", "size=tiny"], "/dev/null/gpu: Not a directory"),
    ):
        tool = Path(__file__).parents[1] / "tools" / f"{words[0]}.py"
        command, environment = [sys.executable, tool, *words[1:]], {**os.environ, "JAX_PLATFORMS": "cpu"}
        done = subprocess.run(command, env=environment, capture_output=True, text=True)
        assert (done.returncode, done.stdout, done.stderr) == (2, "", f"{words[0]}: {said}\n")
