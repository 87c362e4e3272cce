"""The cores that this process may use, by its affinity and by control groups in folders made here."""

import math
import os
import subprocess
import sys
from pathlib import Path

import pytest

from deepaccident_devkit.parallel import batches, own_threads
from deepaccident_devkit.support.cores import quota_of, usable_cores

VERSION_1 = {"cpu.cfs_quota_us": "{0}\n", "cpu.cfs_period_us": "{1}\n"}
VERSION_2 = {"cpu.max": "{} {}\n"}


def a_process(folder: Path, groups: str, mounted: str, quotas: dict[str, str], files: dict[str, str]) -> Path:
    """Write what /proc and the control groups say of a process; `quotas`: path in the mount → quota and period."""
    mount, process = folder / "mount", folder / "proc"
    process.mkdir()
    kind = "cgroup2 cgroup rw,nsdelegate" if files is VERSION_2 else "cgroup cgroup rw,cpu,cpuacct"
    (process / "cgroup").write_text(f"9:name=systemd:/\n8:cpuset:/other\n{groups}\n")
    (process / "mountinfo").write_text(
        f"22 1 0:20 / /proc rw - proc proc rw\n30 22 0:26 {mounted} {mount} rw shared:9 - {kind}\n"
        f"31 22 0:27 / {folder}/elsewhere rw - cgroup cgroup rw,cpuset\n"
    )
    for path, words in quotas.items():
        level = mount / path
        level.mkdir(parents=True, exist_ok=True)
        for name, text in files.items():
            (level / name).write_text(text.format(*words.split()))
    return process


@pytest.mark.parametrize(
    ("groups", "mounted", "quotas", "files", "expected"),
    [
        ("0::/job", "/", {"job": "200000 100000"}, VERSION_2, 2),
        ("0::/job", "/", {"job": "150000 100000"}, VERSION_2, 2),
        ("0::/job", "/", {"job": "10000 100000"}, VERSION_2, 1),
        ("0::/job", "/", {"job": "max 100000"}, VERSION_2, math.inf),
        ("0::/user/job/step", "/", {"user": "300000 100000", "user/job": "max 100000"}, VERSION_2, 3),
        ("0::/user/job", "/", {"user": "800000 100000", "user/job": "400000 100000"}, VERSION_2, 4),
        ("0::/", "/", {"": "500000 100000"}, VERSION_2, 5),
        ("0::/docker/one", "/docker/one", {"": "500000 100000"}, VERSION_2, 5),
        ("0::/../other", "/", {"": "500000 100000"}, VERSION_2, 5),
        ("4:cpu,cpuacct:/job", "/", {"job": "250000 50000"}, VERSION_1, 5),
        ("4:cpuacct,cpu:/job/step", "/", {"job": "250000 50000", "job/step": "-1 50000"}, VERSION_1, 5),
        ("4:cpu:/docker/one", "/docker/one", {"": "100000 100000"}, VERSION_1, 1),
        ("4:cpuset:/job", "/", {"job": "100000 100000"}, VERSION_1, math.inf),
        ("0::/job", "/", {"job": "many 0"}, VERSION_2, math.inf),
        ("no groups", "/", {}, VERSION_2, math.inf),
    ],
)
def test_quotas_of_control_groups(
    groups: str, mounted: str, quotas: dict[str, str], files: dict[str, str], expected: float, tmp_path: Path
) -> None:
    assert quota_of(a_process(tmp_path, groups, mounted, quotas, files)) == expected


def test_a_process_that_is_not_listed_has_no_quota(tmp_path: Path) -> None:
    assert quota_of(tmp_path / "gone") == math.inf


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="the system has no affinity")
def test_a_job_on_one_core_of_a_large_node() -> None:
    code = (
        "import os; os.cpu_count = lambda: 128; os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})\n"
        "from deepaccident_devkit.parallel.batches import _worker_count\n"
        "print(_worker_count(None, 10_000))"
    )
    command = [sys.executable, "-c", code]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    assert subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout == "1\n"


def test_workers_and_threads_follow_the_quota(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.cpu_count", lambda: 64)
    monkeypatch.setattr("os.sched_getaffinity", lambda _: set(range(64)), raising=False)
    for quota, cores in ((3, 3), (0, 1), (math.inf, 64)):
        monkeypatch.setattr("deepaccident_devkit.support.cores.quota_of", lambda _, quota=quota: quota)
        assert (usable_cores(), batches._worker_count(None, 10_000)) == (cores, cores)
        with own_threads() as threads:
            assert threads._max_workers == cores
