"""Number of processor cores that this process may use.

In a batch job or a container, this may be fewer than the machine has.
"""

import math
import os
import re
from functools import cache
from pathlib import Path

# A process's control group as the system lists it: `cpu` in version 1, and the path.
_GROUP = re.compile(r"(?m)^\d+:(?:[^:]*,)?(cpu)?(?:,[^:]*)?:(/.*)$")
# Names of files in version 2, and in version 1.
_QUOTA_FILES = ("cpu.max", "cpu.cfs_quota_us", "cpu.cfs_period_us")
# CPU time of all cores together per period, and the period, microseconds; `max` or -1 means no
# quota.
_QUOTA = re.compile(r"([1-9]\d*)\s+([1-9]\d*)\s*")


def usable_cores() -> int:
    """Return how many cores this process may use under its affinity and its quotas.

    Its control groups set the quotas.
    """
    get_affinity = getattr(os, "sched_getaffinity", None)  # macOS has none
    if get_affinity:
        cores = len(get_affinity(0))
    else:
        cores = os.cpu_count() or 1
    return math.ceil(min(cores, quota_below(Path("/"))))


@cache
def quota_below(root: Path) -> float:
    """Return the number of cores that this process's control groups and their parents allow.

    The number is infinite if there is no limit.

    Args:
        root: Top folder of the file system that lists the groups.
    """
    lowest_quota = math.inf
    for version_1, group in _GROUP.findall(_read_text(root / "proc/self/cgroup")):
        folder = root / f"sys/fs/cgroup/{version_1}{group}"
        for level in (folder, *folder.parents):
            text = "".join(_read_text(level / name) for name in _QUOTA_FILES)
            quota = _QUOTA.fullmatch(text)
            if quota:
                lowest_quota = min(lowest_quota, int(quota[1]) / int(quota[2]))
    return lowest_quota


def _read_text(path: Path) -> str:
    """Read a file's text; empty if it cannot be read."""
    try:
        return path.read_text()
    except (OSError, ValueError):
        return ""
