"""What XLA is told in tests: how many CPU devices to make, and to compile quickly.

Compiling is most of what the tests take, and their programs run for moments. With fewer optimizations, and with the
older of its two ways to emit a loop, XLA compiles a program in half of the time. `tools/demo` and `tools/pythons` run
what users run. (Without any optimization it takes a third, and whole episodes of MJX longer than they gain.)
"""

from importlib.metadata import version

QUICKLY = "--xla_backend_optimization_level=1"
if tuple(map(int, version("jaxlib").split(".")[:2])) < (0, 11):  # which has one way
    QUICKLY += " --xla_cpu_use_fusion_emitters=false"


def flags(devices: int | None = None) -> str:
    """XLA_FLAGS with so many CPU devices of one thread each; None for as many as the program itself makes."""
    number = "" if devices is None else f"--xla_force_host_platform_device_count={devices} "
    return f"{number}--xla_cpu_multi_thread_eigen=false {QUICKLY}"
