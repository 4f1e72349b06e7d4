"""The stabilisers of `recipe=stable`, each by hand, and that `recipe=paper` has none of them at any size."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from flax import linen as nn

import configs
from vecpsmbpo import config, dynamics, networks
from vecpsmbpo.envs import registry, specs
from vecpsmbpo.types import Transition

from .helpers import new_model, tiny

OFF = {  # what configs/recipe/*.yaml may switch on
    "whiten_targets": False,
    "nll_beta": 0.0,
    "reward_nll_beta": 0.0,
    "critic_norm": "none",
    "policy_learning_rate_cooldown": 0.0,
}


@pytest.mark.parametrize("env", list(registry.TASKS))
@pytest.mark.parametrize("size", ["tiny", "cpu", "paper"])
def test_the_paper_s_recipe_has_no_stabiliser_at_any_size(env, size):
    options = [f"env.{name}=x" for name, value in config.env_options(env).items() if value == "???"]
    settings = config.compose([f"env={env}", f"size={size}", "recipe=paper", *options])
    assert {name: getattr(settings, name) for name in OFF} == OFF
    assert settings.recipe == "paper"


def test_every_stabiliser_of_a_recipe_is_looked_for():
    folder = Path(configs.__file__).parent / "recipe"
    switched = {name: yaml.safe_load((folder / f"{name}.yaml").read_text()).keys() for name in ("paper", "stable")}
    assert switched["paper"] - {"recipe"} == OFF.keys()
    assert switched["stable"] - {"recipe"} <= OFF.keys()


def test_a_laptop_takes_the_stable_recipe_and_the_command_line_wins():
    assert config.compose(["size=cpu"]).recipe == "stable"
    assert config.compose(["size=cpu"]).critic_norm == "layer"
    assert config.compose(["size=cpu", "critic_norm=none"]).critic_norm == "none"


ONE_POLICY = {  # tasks whose preset has one policy for each model; two, with half of the updates each, cost as much
    "cartpole_swingup",  # for time
    "ball_in_cup",  # two learn more slowly
    "halfcheetah",  # two are at half of it
    "walker2d",  # two cannot be told from one in 20,000 steps
    "cartpole_swingup_sparse",  # two are lower in the mean of two seeds
    "ant",  # two stand later, on two seeds
    "window_open",  # two open it less often, on two seeds
}


@pytest.mark.parametrize("env", list(registry.TASKS))
def test_presets_learn_from_what_is_imagined(env):
    """λ at most one half, more than one model, and more than one policy for each but where that is known: what SAC on
    real data alone would not be."""
    options = [f"env.{name}=x" for name, value in config.env_options(env).items() if value == "???"]
    settings = config.compose([f"env={env}", "size=cpu", *options])
    assert settings.real_ratio <= 0.5
    assert settings.n_models >= 2
    assert (settings.n_policies == 1) == (env in ONE_POLICY)


def test_layer_norm_by_hand():
    # (1, 3, 5, 3) has mean 3 and variance 2.
    found = networks.layer_norm(jnp.array([1.0, 3.0, 5.0, 3.0]))
    np.testing.assert_allclose(found, np.array([-2, 0, 2, 0]) / 2**0.5, rtol=1e-5)


def test_the_gradient_of_layer_norm_is_flax_s(key):
    """Ours is written out; flax's is derived."""
    x, weights = jax.random.normal(key, (2, 5, 16))
    x = 3 * x + jnp.array([0.0, 1.0, -1.0, 30.0, 100.0])[:, None]
    norm = nn.LayerNorm(use_bias=False, use_scale=False, use_fast_variance=False, epsilon=1e-6)

    def gradient(function):
        return jax.grad(lambda x: jnp.sum(weights * function(x)))(x)

    ours, theirs = gradient(networks.layer_norm), gradient(lambda x: norm.apply({}, x))
    np.testing.assert_allclose(ours, theirs, rtol=1e-3, atol=1e-5)


def test_layer_norm_does_not_lose_small_differences_beside_a_large_mean():
    """By the difference of two large squares, they would be rounding."""
    row = 1e4 + np.array([-1.0, 0.0, 1.0, 0.0])
    np.testing.assert_allclose(networks.layer_norm(jnp.asarray(row, jnp.float32)), [-(2**0.5), 0, 2**0.5, 0], rtol=1e-3)


def test_a_normed_critic_cannot_grow_with_its_input(key):
    """What lets critics run away: a ReLU network is linear in an input that leaves the data."""

    def rise(norm):
        critic = networks.TwinCritic(16, 2, norm)
        near, far = jnp.ones(4), 1e4 * jnp.ones(4)
        params = critic.init(key, near, jnp.zeros(1))
        return abs(critic.values(params, far, jnp.zeros(1))[0]) / abs(critic.values(params, near, jnp.zeros(1))[0])

    assert rise("none") > 1e3
    assert rise("layer") < 10


@pytest.mark.parametrize("beta", [(0.0, 0.0), (0.5, 1.0)])
def test_what_is_poorly_predicted_counts_by_beta(beta, key):
    """In units of the outputs, the loss moves a mean by (μ - y) σ^(2β - 2), and a log-variance by σ^(2β) / 2 - (μ - y)²
    σ^(2β - 2) / 2, whose optimum is the error's square whatever β is; averaged over rows and outputs."""
    spec, settings = specs.get("hopper"), tiny()
    net = dynamics.network(settings, spec)
    model = new_model(key, settings, spec)
    units = jnp.linspace(0.1, 3.0, spec.obs_size + 1)
    model = model.replace(scaling=model.scaling._replace(output_std=units))
    obs, action, change = (jax.random.normal(jax.random.fold_in(key, i), (5, n)) for i, n in enumerate((11, 3, 11)))
    batch = Transition(obs, action, jnp.arange(5.0), obs + change, jnp.zeros(5))
    gradient = jax.grad(
        lambda params: dynamics.loss(model.replace(params=params), batch, net=net, beta=dynamics.Beta(*beta))
    )
    last = sorted(model.params["params"])[-1]
    of_mean, of_variance = jnp.split(gradient(model.params)["params"][last]["bias"], 2)
    mean, log_variance, _ = dynamics.forward(model, obs, action, net=net)
    error = (mean - jnp.concatenate([change, jnp.arange(5.0)[:, None]], axis=1)) / units
    deviation = jnp.exp(0.5 * log_variance) / units
    powers = 2 * np.array([beta[0]] * spec.obs_size + [beta[1]])
    expected = jnp.mean(error * deviation ** (powers - 2), axis=0) / len(units)
    np.testing.assert_allclose(of_mean, expected, rtol=1e-3)
    # A.1's soft clamps, of the network's own output to [-10, most], have slopes of their own.
    inputs = jnp.concatenate([obs, action], axis=1)
    free = jnp.split(net.apply(model.params, inputs, method=net.outputs), 2, axis=1)[1]
    most = 2 + jnp.maximum(-2 * jnp.log(units), 0)
    slope = jax.nn.sigmoid(most - free) * jax.nn.sigmoid(most - jax.nn.softplus(most - free) + 10)
    expected = jnp.mean(slope * (deviation**powers - error**2 * deviation ** (powers - 2)) / 2, axis=0) / len(units)
    np.testing.assert_allclose(of_variance, expected, rtol=1e-3, atol=1e-6)
