"""Number of processor cores that this process may use.

In a job or a container it is smaller than the machine's.
"""

import math
import os
import re
from functools import cache
from pathlib import Path

# Control group of a process as the system lists it: `cpu` for version 1, and the path.
_GROUP = re.compile(r"(?m)^\d+:(?:[^:]*,)?(cpu)?(?:,[^:]*)?:(/.*)$")
# Names of files in version 2, and in version 1.
_QUOTA_FILES = ("cpu.max", "cpu.cfs_quota_us", "cpu.cfs_period_us")
# Microseconds of all cores together, and the period in which they may be used; `max` or -1 stand
# for no quota.
_QUOTA = re.compile(r"([1-9]\d*)\s+([1-9]\d*)\s*")


def usable_cores() -> int:
    """Return how many cores this process may use, by its affinity and its quotas.

    The quotas are set by its control groups.
    """
    affinity = getattr(os, "sched_getaffinity", None)  # macOS has none
    cores = len(affinity(0)) if affinity else os.cpu_count() or 1
    return math.ceil(min(cores, quota_below(Path("/"))))


@cache
def quota_below(root: Path) -> float:
    """Return the cores that the control groups of this process and their parents allow.

    Infinity if there is no limit.

    Args:
        root: Top folder of the file system that lists them.
    """
    lowest = math.inf
    for version_1, group in _GROUP.findall(_text(root / "proc/self/cgroup")):
        folder = root / f"sys/fs/cgroup/{version_1}{group}"
        for level in (folder, *folder.parents):
            text = "".join(_text(level / name) for name in _QUOTA_FILES)
            quota = _QUOTA.fullmatch(text)
            if quota:
                lowest = min(lowest, int(quota[1]) / int(quota[2]))
    return lowest


def _text(path: Path) -> str:
    try:
        return path.read_text()
    except (OSError, ValueError):
        return ""
