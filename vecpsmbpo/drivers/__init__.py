"""Step real environments with an algorithm: as one compiled program (MJX), or with a simulator on the host."""

from vecpsmbpo.drivers.common import Driver, Interrupted, Returns, Stopped
from vecpsmbpo.drivers.host import HostDriver
from vecpsmbpo.drivers.scan import ScanDriver

__all__ = ["Driver", "HostDriver", "Interrupted", "Returns", "ScanDriver", "Stopped"]
