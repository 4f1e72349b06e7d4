"""`network_precision`: what is multiplied in which numbers, and what stays float32."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import jaxprs_in_params

from vecpsmbpo import dynamics, networks, sac
from vecpsmbpo.envs import specs
from vecpsmbpo.types import Hyper, Transition

from .helpers import new_model, tiny

SPEC = specs.get("hopper")
OBS, ACTION, BATCH = SPEC.obs_size, SPEC.action_size, 8


def products(jaxpr):
    """Every product of a program: the types of what is multiplied, and how precisely."""
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            types = {str(variable.aval.dtype) for variable in equation.invars}
            yield frozenset(types), equation.params["precision"]
        for inner in jaxprs_in_params(equation.params):
            yield from products(inner)


def update_of(precision):
    """One SAC update, as a function of the agent, and an agent."""
    settings = tiny(network_precision=precision, critic_norm="layer")
    nets = sac.make_networks(settings, SPEC)
    rows = Transition(
        jnp.ones((BATCH, OBS)), jnp.zeros((BATCH, ACTION)), jnp.ones(BATCH), jnp.ones((BATCH, OBS)), jnp.zeros(BATCH)
    )
    noise = sac.Noise.draw(jax.random.key(1), (BATCH, ACTION))
    hyper = Hyper.of(settings)
    return lambda agent: sac.update(agent, rows, noise, hyper, nets=nets), sac.init(jax.random.key(0), nets, SPEC)


def test_bfloat16_multiplies_the_inner_layers_in_it_forwards_and_backwards():
    update, agent = update_of("bfloat16")
    found = [types for types, _ in products(jax.make_jaxpr(update)(agent).jaxpr)]
    # By hand: 45 products with two hidden layers. The second of these is the inner one: forwards in two actors and
    # in target, trained and asking critics (twice each), 8; backwards to weights and inputs in the critics' loss, 4;
    # in the actor's loss to the critics' inputs, 2, and to the actor's weights and inputs, 2. LayerNorm's 40 means,
    # which `test_bench` counts, are float32.
    assert len(found) == 45 + 40
    assert found.count(frozenset({"bfloat16"})) == 16
    assert found.count(frozenset({"float32"})) == 45 - 16 + 40


def test_float32_is_asked_for_in_every_product():
    update, agent = update_of("float32")
    highest = jax.lax.Precision.HIGHEST
    assert {how for _, how in products(jax.make_jaxpr(update)(agent).jaxpr)} == {(highest, highest)}


def test_what_is_kept_is_float32():
    update, agent = update_of("bfloat16")
    kept = [leaf.dtype for leaf in jax.tree.leaves(jax.eval_shape(update, agent))]
    assert set(map(str, kept)) <= {"float32", "int32"}


def test_losses_and_log_densities_are_float32(key):
    nets = sac.make_networks(tiny(network_precision="bfloat16"), SPEC)
    agent = sac.init(key, nets, SPEC)
    obs, noise = jnp.ones((BATCH, OBS)), jnp.ones((BATCH, ACTION))
    asked = {
        "log-density": nets.actor.distribution(agent.actor, obs).reparameterized(noise),
        "values": nets.critic.values(agent.critic, obs, noise),
        "loss": sac.actor_loss(agent.actor, agent.critic, 0.1, obs, noise, nets=nets),
    }
    assert {leaf.dtype for leaf in jax.tree.leaves(asked)} == {jnp.dtype(jnp.float32)}


@pytest.mark.parametrize("norm", list(networks.NORMS))
def test_bfloat16_rounds_what_critics_say_by_its_eight_bits(norm, key):
    exact, rounded = (networks.TwinCritic(32, 2, norm, precision) for precision in ("float32", "bfloat16"))
    obs, action = jax.random.normal(key, (64, OBS)), jnp.zeros((64, ACTION))
    params = exact.init(key, obs[0], action[0])
    a, b = np.stack(exact.values(params, obs, action)), np.stack(rounded.values(params, obs, action))
    assert 0 < np.max(np.abs(a - b)) < 8 * 2**-8 * np.std(a)
    # Not a multiple of what bfloat16 can say: the last layer adds up in float32.
    assert np.any(b != np.asarray(jnp.asarray(b, jnp.bfloat16), np.float32))


def test_models_predict_alike_in_bfloat16(key):
    def predict(precision):
        settings = tiny(network_precision=precision)
        model = new_model(key, settings, SPEC)
        obs, action = jax.random.normal(key, (64, OBS)), jnp.zeros((64, ACTION))
        return np.asarray(dynamics.forward(model, obs, action, net=dynamics.network(settings, SPEC)).mean)

    exact, rounded = predict("float32"), predict("bfloat16")
    assert rounded.dtype == np.float32
    # Each of four layers is rounded twice.
    assert 0 < np.max(np.abs(exact - rounded)) < 16 * 2**-8 * np.std(exact)
