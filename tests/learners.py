"""Learners on the probe environments (`probes`), by both drivers."""

from functools import partial
from typing import Any

from tests import probes
from tests.helpers import algorithm, tiny
from vecpsmbpo.algorithms.catalogue import of_algorithm
from vecpsmbpo.drivers import Driver, HostDriver, ScanDriver
from vecpsmbpo.settings import Settings

DISCOUNT = 0.5
STEPS = 1000  # after 600, Q is still 0.14 below its limit (mean over ten seeds), after these 0.06


def settings_for(**changes: Any) -> Settings:
    """Small but able to learn; the entropy bonus vanishes, since the target is always exceeded and α falls."""
    chosen = {
        "total_steps": STEPS,
        "epoch_steps": STEPS,
        "episode_length": probes.EPISODE_LENGTH,
        "warmup_steps": 120,
        "replay_capacity": 1000,
        "model_hidden_size": 32,
        "model_batch_size": 32,
        "model_max_epochs": 40,
        "rollout_starts": 100,
        "model_update_every": 40,
        "policy_hidden_size": 16,
        "policy_batch_size": 32,
        "policy_learning_rate": 3e-3,
        "target_update_rate": 0.05,
        "updates_per_step": 10,
        "discount": DISCOUNT,
        "target_entropy": -20.0,
    }
    has = of_algorithm(changes.get("algo", "ops_mbpo"))
    return tiny(**{**{name: value for name, value in chosen.items() if name in has}, **changes})


def make_driver(kind: str, terminates: bool, settings: Settings) -> Driver:
    learner = algorithm(settings, probes.spec(terminates))
    if kind == "scan":
        return ScanDriver(learner, probes.Probe(terminates))
    make_env = partial(probes.host, terminates)
    return HostDriver(learner, make_env(num_envs=len(settings.lanes), seed=settings.seed), make_env)
