"""What the progress line says of speed and time left."""

import pytest

from tests.helpers import tiny
from vecpsmbpo.progress import Pace, Rates, duration


def test_rates_count_steps_updates_and_imagined_rows():
    """40 warm-up steps, then G = 2 updates of 4 members at every step and a refresh of 16 rows each every 20 steps."""
    settings = tiny()
    assert Rates.over(settings, 40, 40, 2.0) == (20.0, 0.0, 0.0)
    assert Rates.over(settings, 60, 20, 2.0) == (10.0, 80.0, 32.0)
    assert Rates.over(settings, 50, 20, 1.0) == (20.0, 80.0, 64.0)  # the last ten of 20 steps learn
    assert Rates.over(tiny(num_seeds=3), 60, 20, 2.0) == (30.0, 240.0, 96.0)
    assert Rates.over(tiny(algo="sac"), 60, 20, 2.0) == (10.0, 20.0, 0.0)


def test_time_left_is_not_told_by_the_warm_up_and_counts_a_whole_period():
    pace = Pace(tiny())
    pace.chunk(40, 40, 0.1)
    assert pace.left(40) == "–"
    pace.chunk(50, 10, 30.0)  # with the refresh
    pace.chunk(60, 10, 10.0)
    assert pace.left(60) == "2:00"  # 60 more steps at 2 s each
    pace.chunk(70, 10, 30.0)
    assert pace.rates.env_steps == pytest.approx(0.5)
    assert duration(3723) == "1:02:03"
