"""Every bulk command on two dask workers, one of which is killed half-way; and clusters that cannot
do the work.
"""

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from engines.products import COMMANDS, Cluster, Local, command, contents, words
from processes import wait_for

pytestmark = pytest.mark.slow

BEGUN = {"opencood": "opencood/*/*", "synth": ".made.unfinished/parts/*"}
"""Commands whose worker is killed, and what they make first."""


def test_all_is_the_same_with_a_worker_killed_half_way(
    local: Local, cluster: Cluster, tmp_path: Path
) -> None:
    left = list(cluster.workers)
    for name in COMMANDS:
        line = [*words(name, {**local.places, "out": tmp_path}), "--scheduler", cluster.address]
        with subprocess.Popen(
            command(line), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        ) as running:
            if name in BEGUN:  # dask begins another worker
                wait_for(lambda pattern=BEGUN[name]: any(tmp_path.glob(pattern)))
                os.kill(left.pop(), signal.SIGKILL)
            printed, errors = running.communicate(timeout=300)
        assert running.returncode in (0, 1), f"{name}: {errors}"
        if name == "validate":
            assert printed == local.printed
    assert contents(tmp_path) == local.files


def test_a_killed_scheduler_costs_what_is_at_hand(local: Local, tmp_path: Path) -> None:
    scheduler, address = started_scheduler(tmp_path)
    workers = [started_worker(address) for _ in range(2)]
    line = words("opencood", {**local.places, "out": tmp_path})
    with subprocess.Popen(
        [*command(line), "--scheduler", address], stderr=subprocess.PIPE, text=True
    ) as running:
        wait_for(lambda: list(tmp_path.glob("opencood/.deepaccident-parts/kept/opencood/*/done")))
        scheduler.kill()
        _, errors = running.communicate(timeout=120)
    for process in (scheduler, *workers):
        process.kill()
        process.wait()
    assert running.returncode == 2
    assert errors.splitlines()[-1].startswith("error: the scheduler has ended")
    again = subprocess.run(command(line), capture_output=True, text=True, timeout=300, check=True)
    assert " 0 were there already" not in again.stdout
    expected = {
        path: content for path, content in local.files.items() if path.startswith("opencood/")
    }
    assert {
        f"opencood/{path}": content for path, content in contents(tmp_path / "opencood").items()
    } == expected


WITHOUT = "import sys; sys.modules['deepaccident_devkit'] = None"
OTHER = "import deepaccident_devkit.support.version as here; here.__version__ = '0.0.1'"
WORKER = "from distributed.cli.dask_worker import main; main()"


@pytest.fixture
def scheduler(tmp_path: Path) -> Iterator[str]:
    process, address = started_scheduler(tmp_path)
    yield address
    process.kill()
    process.wait()


@pytest.mark.parametrize(
    ("setup", "told"),
    [
        (WITHOUT, "a worker cannot do the work"),
        (OTHER, "has deepaccident_devkit 0.0.1, and this is"),
    ],
)
def test_a_worker_without_the_package_or_with_another_version(
    local: Local, scheduler: str, tmp_path: Path, setup: str, told: str
) -> None:
    line = [*words("opencood", {**local.places, "out": tmp_path}), "--scheduler", scheduler]
    worker = started_worker(scheduler, setup)
    wait_for_worker(scheduler)
    ended = subprocess.run(
        command(line), stderr=subprocess.PIPE, text=True, timeout=120, check=False
    )
    worker.kill()
    worker.wait()
    assert ended.returncode == 2
    assert told in ended.stderr.splitlines()[-1]
    assert not (tmp_path / "opencood").exists()


@pytest.mark.parametrize("unseen", ["release", "opencood"])
def test_a_folder_that_workers_cannot_see(
    local: Local, scheduler: str, tmp_path: Path, unseen: str
) -> None:
    """On the worker's side another, empty file system lies over it."""
    out = tmp_path / "opencood"
    out.mkdir()
    place = {"release": local.places["release"], "opencood": out}[unseen]
    if (
        shutil.which("unshare") is None
        or subprocess.run(["unshare", "-m", "true"], check=False).returncode
    ):
        pytest.skip("no right to mount")
    hidden = ["unshare", "-m", "sh", "-c", f'mount -t tmpfs none "{place}" && exec "$@"', "sh"]
    worker = started_worker(scheduler, before=hidden)
    wait_for_worker(scheduler)
    line = [*words("opencood", {**local.places, "out": tmp_path}), "--scheduler", scheduler]
    ended = subprocess.run(command(line), capture_output=True, text=True, timeout=300, check=False)
    worker.kill()
    worker.wait()
    assert ended.returncode == 2
    last = ended.stderr.splitlines()[-1]
    assert last.startswith("error: a worker on ")
    assert f" does not see {place}" in last


def started_scheduler(folder: Path) -> tuple[subprocess.Popen[str], str]:
    file = folder / "scheduler.json"
    options = [
        "--host",
        "127.0.0.1",
        "--port",
        "0",
        "--no-dashboard",
        "--no-show",
        "--scheduler-file",
        str(file),
    ]
    line = [
        sys.executable,
        "-c",
        f"{WITHOUT}; from distributed.cli.dask_scheduler import main; main()",
        *options,
    ]
    process = subprocess.Popen(line, stderr=subprocess.DEVNULL, text=True)  # it needs no devkit
    wait_for(lambda: file.exists() and '"address"' in file.read_text())
    return process, json.loads(file.read_text())["address"]


def started_worker(
    address: str, setup: str = "", before: list[str] | None = None
) -> subprocess.Popen[str]:
    line = [
        sys.executable,
        "-c",
        f"{setup}\n{WORKER}",
        address,
        "--no-nanny",
        "--nthreads",
        "1",
        "--no-dashboard",
    ]
    return subprocess.Popen([*(before or []), *line], stderr=subprocess.DEVNULL, text=True)


def wait_for_worker(address: str) -> None:
    from distributed import Client

    with Client(address) as client:
        client.wait_for_workers(1, timeout=60)
