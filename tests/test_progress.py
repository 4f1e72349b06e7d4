"""What the progress line says of speed and time left."""

import pytest

from tests.helpers import algorithm, tiny
from vecpsmbpo.algorithms.base import Algorithm
from vecpsmbpo.progress import Pace, Rates, duration
from vecpsmbpo.types import EnvSpec

SPEC = EnvSpec("any", obs_size=2, action_size=1, episode_length=25, terminated=None)


def tiny_algorithm(**changes) -> Algorithm:
    return algorithm(tiny(**changes), SPEC)


def test_rates_count_steps_updates_and_imagined_rows():
    """40 warm-up steps, then G = 2 updates of 4 members at every step and a refresh of 16 rows each every 20 steps."""
    ops_mbpo = tiny_algorithm()
    assert Rates.over(ops_mbpo, 40, 40, 2.0) == (20.0, 0.0, 0.0)
    assert Rates.over(ops_mbpo, 60, 20, 2.0) == (10.0, 80.0, 32.0)
    assert Rates.over(ops_mbpo, 50, 20, 1.0) == (20.0, 80.0, 64.0)  # the last ten of 20 steps learn
    assert Rates.over(tiny_algorithm(num_seeds=3), 60, 20, 2.0) == (30.0, 240.0, 96.0)


def test_rates_of_the_other_algorithms():
    """20 learning steps, with one refresh."""
    assert Rates.over(tiny_algorithm(algo="sac"), 60, 20, 2.0) == (10.0, 20.0, 0.0)
    # Plans: 8 candidates, 2 iterations, 2 particles, 3 actions ahead.
    assert Rates.over(tiny_algorithm(algo="pets"), 60, 20, 2.0) == (10.0, 0.0, 20 * 8 * 2 * 2 * 3 / 2)
    # A turn of 2 policy steps, each from 4 rollouts of 5 steps.
    assert Rates.over(tiny_algorithm(algo="slbo"), 60, 20, 2.0) == (10.0, 1.0, 20.0)


def test_time_left_is_not_told_by_the_warm_up_and_counts_a_whole_period():
    pace = Pace(tiny_algorithm())
    pace.chunk(40, 40, 0.1)
    assert pace.left(40) == "–"
    pace.chunk(50, 10, 30.0)  # with the refresh
    pace.chunk(60, 10, 10.0)
    assert pace.left(60) == "2:00"  # 60 more steps at 2 s each
    pace.chunk(70, 10, 30.0)
    assert pace.rates.env_steps == pytest.approx(0.5)
    assert duration(3723) == "1:02:03"
