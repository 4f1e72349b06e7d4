"""What others have reached on these tasks, and what there is to be reached."""

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


def _mbpo(means: str) -> tuple[list[int], list[float], list[float]]:
    """From `thousands of steps:mean±deviation` each."""
    points = [text.replace("±", ":").split(":") for text in means.split()]
    return [1000 * int(k) for k, _, _ in points], [float(m) for _, m, _ in points], [float(d) for _, _, d in points]


# MBPO (Janner et al., 2019), evaluation return over five seeds: per-seed logs of 4kubo/erl_lib.
_MBPO = {
    "hopper": _mbpo("50:1440±747 75:3048±600 100:3261±394 125:3308±395"),
    "walker2d": _mbpo("50:772±489 75:2013±1213 100:3376±1057 125:3569±1264 150:4027±764 200:4019±998 300:4873±484"),
    "halfcheetah": _mbpo(
        "50:7803±529 75:9107±400 100:9524±658 125:10011±527 150:10173±1012 200:10669±1499 300:12637±638 400:12952±1085"
    ),
    "ant": _mbpo("50:781±185 75:1112±604 100:1624±894 125:2203±1348 150:2883±1304 200:4323±1247 300:5397±559"),
}
# SAC after three million steps (erl_lib): what figure 4 calls asymptotic.
SAC_3M = {"hopper": 3809.0, "walker2d": 6934.0, "halfcheetah": 13123.0, "ant": 6935.0}

REFERENCES = ("mbpo", "sac")


def mbpo(task: str) -> Published:
    """MBPO's published curve.

    Raises:
        SettingError: there is none for this task.
    """
    if task not in _MBPO:
        raise SettingError(f"reference=mbpo: nothing is published for {task}; for {', '.join(_MBPO)} there is")
    return Published("MBPO, published (± s.d.)", *map(np.array, _MBPO[task]))


def asymptote(task: str) -> float:
    """SAC's return after three million steps.

    Raises:
        SettingError: it is not known for this task.
    """
    if task not in SAC_3M:
        raise SettingError(f"reference=sac: nothing is published for {task}; for {', '.join(SAC_3M)} there is")
    return SAC_3M[task]


def scale(settings: Settings) -> tuple[float, float] | None:
    """Returns that count as 0 and as 1 where scores of tasks are compared; None where no 1 is known.

    1 is the most possible where rewards are bounded (the control suite gives up to 1 a step, window-open takes up to
    10), and SAC's return after three million steps elsewhere.
    """
    steps = float(settings.episode_length or 1000)
    if settings.env in SAC_3M:
        return 0.0, SAC_3M[settings.env]
    if settings.env == "window_open":
        return -10.0 * steps, 0.0
    if settings.env in ("ball_in_cup", "cartpole_swingup", "cartpole_swingup_sparse", "dm_control"):
        return 0.0, steps
    return None
