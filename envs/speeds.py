"""Where the other backend was measured to step a task faster (`tools/bench.py envs`; results/gpu/bench_envs.jsonl)."""

import math

# Steps per second, of all lanes together: lanes -> by MJX on an H100, by the original on a CPU core beside it.
ON_GPU = {
    "ant": {1: (50, 2961), 10: (479, 3259), 100: (2232, 2915)},
    "halfcheetah": {1: (214, 7468), 10: (2108, 14355), 100: (14760, 15624)},
    "hopper": {1: (97, 3426), 10: (879, 4144), 100: (6581, 4008)},
}
ENOUGH = 1.5  # times as fast, to be worth a line: the way from the device and back has not been measured there


def hint(name: str, backend: str, platform: str, lanes: int) -> str:
    """A line for whom MJX, which `backend=auto` takes, steps more slowly than the original; else nothing.

    On a CPU it is true of robots, too, but there what is around a step of the original may cost more than it saves
    (`tools/bench.py hosted`): nothing is said.

    Args:
        platform: as `jax.default_backend` names it.
        lanes: that are stepped together.
    """
    if backend != "mjx" or platform != "gpu" or name not in ON_GPU:
        return ""
    nearest = min(ON_GPU[name], key=lambda count: abs(math.log(count / lanes)))
    mjx, original = ON_GPU[name][nearest]
    if original < ENOUGH * mjx:
        return ""
    times = f"{original / mjx:.0f}" if original > 3 * mjx else f"{original / mjx:.1f}"
    return (
        f"backend=host may be faster: C MuJoCo stepped {nearest} of {name} {times} times as fast as MJX, on a core "
        "beside an H100"
    )
