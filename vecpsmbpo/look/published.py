"""What others have reached on these tasks, and what there is to be reached."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from vecpsmbpo.envs.registry import TASKS
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


# MBPO (Janner et al., 2019), evaluation return, as erl_lib has it (`results/main/gym/mbpo` of 4kubo/erl_lib): mean and
# deviation of the five columns there over the five evaluations before each step. The columns lie at equal distances at
# every step: they were made from a mean and a deviation, and are no logs of five seeds.
_MBPO = {
    "hopper": _mbpo(
        "10:227±121 20:491±219 30:629±190 40:818±226 50:1441±748 60:2369±942 75:3049±600 100:3262±395 125:3308±396"
    ),
    "walker2d": _mbpo(
        "10:139±75 20:377±127 30:451±160 40:565±316 50:772±489 60:1181±656 "
        "75:2013±1213 100:3377±1058 125:3570±1264 150:4027±765 200:4019±998 300:4873±484"
    ),
    "halfcheetah": _mbpo(
        "10:1169±301 20:3796±573 30:5457±1000 40:6881±682 50:7804±530 60:8370±502 "
        "75:9108±401 100:9524±659 125:10012±527 150:10173±1012 200:10668±1529 300:12637±639 400:12926±1116"
    ),
    "ant": _mbpo(
        "10:200±107 20:651±50 30:729±24 40:794±32 50:781±185 60:893±307 "
        "75:1113±605 100:1624±894 125:2203±1348 150:2883±1305 200:4324±1247 300:5398±559"
    ),
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
    if rewards := TASKS[settings.env].rewards:
        steps = float(settings.episode_length or 1000)
        return rewards[0] * steps, rewards[1] * steps
    return (0.0, _SAC[settings.env].high) if settings.env in _SAC else None
