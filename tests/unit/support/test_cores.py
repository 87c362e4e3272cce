"""The cores that this process may use, by its affinity and by control groups in folders of the
test.
"""

import math
from pathlib import Path

import pytest

from deepaccident_devkit.support.cores import quota_below, usable_cores
from deepaccident_devkit.support.parallel import batches, own_threads

VERSION_1 = {"cpu.cfs_quota_us": "{0}\n", "cpu.cfs_period_us": "{1}\n"}
VERSION_2 = {"cpu.max": "{} {}\n"}


def write_system(root: Path, groups: str, quotas: dict[str, str], files: dict[str, str]) -> Path:
    """Write a system's files on this process; `quotas` has quota and period by path below the
    control groups.
    """
    (root / "proc/self").mkdir(parents=True)
    (root / "proc/self/cgroup").write_text(f"9:name=systemd:/\n8:cpuset:/other\n{groups}\n")
    for path, words in quotas.items():
        folder = root / "sys/fs/cgroup" / path
        folder.mkdir(parents=True, exist_ok=True)
        for name, template in files.items():
            (folder / name).write_text(template.format(*words.split()))
    return root


@pytest.mark.parametrize(
    ("groups", "quotas", "files", "expected"),
    [
        ("0::/job", {"job": "200000 100000"}, VERSION_2, 2),
        ("0::/job", {"job": "150000 100000"}, VERSION_2, 1.5),
        ("0::/job", {"job": "10000 100000"}, VERSION_2, 0.1),
        ("0::/job", {"job": "max 100000"}, VERSION_2, math.inf),
        ("0::/user/job/step", {"user": "300000 100000", "user/job": "max 100000"}, VERSION_2, 3),
        ("0::/user/job", {"user": "800000 100000", "user/job": "400000 100000"}, VERSION_2, 4),
        ("0::/", {"": "500000 100000"}, VERSION_2, 5),
        ("0::/docker/not_seen_from_inside", {"": "500000 100000"}, VERSION_2, 5),
        ("0::/../other", {"": "500000 100000"}, VERSION_2, 5),
        ("4:cpu,cpuacct:/job", {"cpu/job": "250000 50000"}, VERSION_1, 5),
        (
            "4:cpuacct,cpu:/job/step",
            {"cpu/job": "250000 50000", "cpu/job/step": "-1 50000"},
            VERSION_1,
            5,
        ),
        ("4:cpu:/docker/not_seen_from_inside", {"cpu": "100000 100000"}, VERSION_1, 1),
        ("4:cpuset:/job", {"cpu/job": "100000 100000"}, VERSION_1, math.inf),
        ("0::/\n4:cpu:/job", {"cpu/job": "300000 100000"}, VERSION_1, 3),
        ("0::/job", {"job": "many 0"}, VERSION_2, math.inf),
        ("no groups", {}, VERSION_2, math.inf),
    ],
)
def test_quotas_of_control_groups(
    groups: str, quotas: dict[str, str], files: dict[str, str], expected: float, tmp_path: Path
) -> None:
    assert quota_below(write_system(tmp_path, groups, quotas, files)) == expected


def test_workers_and_threads_follow_the_quota(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.cpu_count", lambda: 64)
    monkeypatch.setattr("os.sched_getaffinity", lambda _: set(range(64)), raising=False)
    for quota, cores in ((3.0, 3), (2.5, 3), (0.1, 1), (math.inf, 64)):
        monkeypatch.setattr(
            "deepaccident_devkit.support.cores.quota_below", lambda _, quota=quota: quota
        )
        assert usable_cores() == cores
        assert batches._choose_worker_count(None, 10_000) == cores
        with own_threads() as threads:
            assert threads._max_workers == cores
