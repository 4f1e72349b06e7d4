"""What others have reached on these tasks, and what there is to be reached."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from vecpsmbpo.settings import SettingError, Settings

Array = np.ndarray


class Published(NamedTuple):
    """A published curve: steps, mean return and its standard deviation over seeds, [P] each."""

    name: str
    steps: Array
    mean: Array
    deviation: Array


class Level(NamedTuple):
    """What was reached at one step.

    Attributes:
        name: of the algorithm, with the step.
        low, high: ends of the range of published returns, the same where one is known.
    """

    name: str
    low: float
    high: float

    @property
    def value(self) -> str:
        """`3,809`, or `55–800`."""
        return "–".join(f"{end:,.0f}" for end in dict.fromkeys((self.low, self.high)))


def _mbpo(means: str) -> Published:
    """From `thousands of steps:mean±deviation` each."""
    points = np.array([text.replace("±", ":").split(":") for text in means.split()], float)
    return Published("MBPO, published (± s.d.)", 1000 * points[:, 0], points[:, 1], points[:, 2])


# MBPO (Janner et al., 2019), evaluation return over five seeds: per-seed logs of 4kubo/erl_lib.
_MBPO = {
    "hopper": _mbpo("50:1440±747 75:3048±600 100:3261±394 125:3308±395"),
    "walker2d": _mbpo("50:772±489 75:2013±1213 100:3376±1057 125:3569±1264 150:4027±764 200:4019±998 300:4873±484"),
    "halfcheetah": _mbpo(
        "50:7803±529 75:9107±400 100:9524±658 125:10011±527 150:10173±1012 200:10669±1499 300:12637±638 400:12952±1085"
    ),
    "ant": _mbpo("50:781±185 75:1112±604 100:1624±894 125:2203±1348 150:2883±1304 200:4323±1247 300:5397±559"),
}
# What figures 4 and 5 call asymptotic: SAC at the last step that is known of it. After three million, from erl_lib; on
# the control suite's tasks after four, three seeds, from the runs that come with TD-MPC2 (`results/sac` of
# nicklashansen/tdmpc2).
_SAC = {
    "hopper": Level("SAC at 3M", 3809.0, 3809.0),
    "walker2d": Level("SAC at 3M", 6934.0, 6934.0),
    "halfcheetah": Level("SAC at 3M", 13123.0, 13123.0),
    "ant": Level("SAC at 3M", 6935.0, 6935.0),
    "ball_in_cup": Level("SAC at 4M", 974.1, 983.5),
    "cartpole_swingup": Level("SAC at 4M", 790.5, 855.2),
    "cartpole_swingup_sparse": Level("SAC at 4M", 786.7, 841.7),
}
REFERENCES: dict[str, Mapping[str, Published | Level]] = {"mbpo": _MBPO, "sac": _SAC}  # by `reference=` and task


def reference(name: str, task: str) -> Published | Level:
    """What is published of an algorithm on a task.

    Args:
        name: one of `REFERENCES`.

    Raises:
        SettingError: nothing is.
    """
    known = REFERENCES[name]
    if task not in known:
        raise SettingError(f"reference={name}: nothing is published for {task}; for {', '.join(known)} there is")
    return known[task]


def scale(settings: Settings) -> tuple[float, float] | None:
    """Returns that count as 0 and as 1 where scores of tasks are compared; None where no 1 is known.

    1 is the most possible where rewards are bounded (the control suite gives up to 1 a step, window-open takes up to
    10), and SAC's return after three million steps elsewhere.
    """
    steps = float(settings.episode_length or 1000)
    if settings.env == "window_open":
        return -10.0 * steps, 0.0
    if settings.env in ("ball_in_cup", "cartpole_swingup", "cartpole_swingup_sparse", "dm_control"):
        return 0.0, steps
    return (0.0, _SAC[settings.env].high) if settings.env in _SAC else None
