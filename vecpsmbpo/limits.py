"""How much address space the system lets this process have (`ulimit -v`, and queues of clusters that set it)."""

from pathlib import Path

from vecpsmbpo.settings import SettingError

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

GIB = 2**30
# What Python, JAX and MuJoCo take until a driver is there. With less than they need, OpenBLAS asks again for ever.
START_BYTES = 3 * GIB // 2


def free_address_space() -> int:
    """Bytes; 2^63 where there is no limit."""
    limit = -1 if resource is None else resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit == -1:  # RLIM_INFINITY
        return 2**63
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[0])
    except OSError:
        return limit  # not Linux: nothing says what is taken
    return limit - pages * resource.getpagesize()


def check_start() -> None:
    """Before JAX is imported, whether it can be.

    Raises:
        SettingError: it cannot.
    """
    free = free_address_space()
    if free < START_BYTES:
        raise SettingError(
            f"this process may take {free / GIB:.2f} GiB of address space more (ulimit -v), "
            f"and JAX and MuJoCo alone need {START_BYTES / GIB:.2f}"
        )
