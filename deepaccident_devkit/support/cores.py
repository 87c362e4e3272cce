"""The processor cores that this process may use: in a job or a container fewer than the machine has."""

import math
import os
import re
from collections.abc import Iterator
from functools import cache
from itertools import product
from pathlib import Path
from typing import Final

_CONTROL_GROUPS: Final = (
    (r"(?m)^0::(/.*)$", r"(?m)^(?:\S+ ){3}(\S+) (\S+) .* - cgroup2 "),
    (r"(?m)^\d+:(?:\S+,)?cpu(?:,\S+)?:(/.*)$", r"(?m)^(?:\S+ ){3}(\S+) (\S+) .* - cgroup \S+ (?:\S+,)?cpu\b"),
)
"""Of versions 2 and 1, as /proc lists them: the group of a process; the group that is mounted, and the folder."""
_QUOTA: Final = r"(\d+)\s+([1-9]\d*)\s*"
"""Microseconds of all cores together, and the period in which they may be used; `max` or -1 stand for no quota."""


def usable_cores() -> int:
    """Return how many cores this process may use, at least 1: by its affinity and by quotas of its control groups."""
    affinity = getattr(os, "sched_getaffinity", None)  # macOS has none
    cores = len(affinity(0)) if affinity else os.cpu_count() or 1
    return max(1, min(cores, quota_of(Path("/proc/self"))))


@cache
def quota_of(process: Path) -> float:
    """Return the cores, rounded up, that the control groups of a process and those above them allow; or infinity.

    Args:
        process: Its folder in /proc.
    """
    return min(_quotas(process), default=math.inf)


def _quotas(process: Path) -> Iterator[int]:
    groups, mounts = _text(process / "cgroup"), _text(process / "mountinfo")
    for of_process, of_mount in _CONTROL_GROUPS:
        for group, (mounted, folder) in product(re.findall(of_process, groups), re.findall(of_mount, mounts)):
            inner = Path(folder, os.path.relpath(group, mounted))
            for level in (Path(folder), inner, *inner.parents):
                version_1 = f"{_text(level / 'cpu.cfs_quota_us')} {_text(level / 'cpu.cfs_period_us')}"
                if quota := re.fullmatch(_QUOTA, _text(level / "cpu.max") or version_1):
                    yield math.ceil(int(quota[1]) / int(quota[2]))


def _text(path: Path) -> str:
    try:
        return path.read_text()
    except (OSError, ValueError):
        return ""
