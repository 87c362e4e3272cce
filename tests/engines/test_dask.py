"""Every bulk command on dask workers, even if one is killed, and clusters that cannot work."""

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest
from engines.products import (
    COMMANDS,
    Cluster,
    Local,
    command_line,
    opencood_files,
    python_command,
    read_files,
)
from support.linux_processes import wait_for

pytestmark = pytest.mark.slow

FIRST_OUTPUTS = {"opencood": "opencood/*/*", "synth": ".made.unfinished/parts/*"}
"""Pattern of the first outputs of the commands that lose a worker."""
WITHOUT_PACKAGE = "import sys; sys.modules['deepaccident_devkit'] = None"
OTHER_VERSION = "import deepaccident_devkit.support.version as here; here.__version__ = '0.0.1'"
START_WORKER = "from distributed.cli.dask_worker import main; main()"
START_SCHEDULER = "from distributed.cli.dask_scheduler import main; main()"


def test_every_command_writes_the_same_with_a_worker_killed_half_way(
    local: Local, cluster: Cluster, tmp_path: Path
) -> None:
    remaining_workers = list(cluster.workers)
    for name in COMMANDS:
        arguments = command_line(name, {**local.paths, "out": tmp_path})
        with subprocess.Popen(
            python_command([*arguments, "--scheduler", cluster.address]),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        ) as process:
            if name in FIRST_OUTPUTS:  # dask starts another worker
                wait_for(lambda pattern=FIRST_OUTPUTS[name]: any(tmp_path.glob(pattern)))
                os.kill(remaining_workers.pop(), signal.SIGKILL)
            printed, errors = process.communicate(timeout=300)

        assert process.returncode in (0, 1), f"{name}: {errors}"

        if name == "validate":
            assert printed == local.printed

    assert read_files(tmp_path) == local.files


def test_a_killed_scheduler_costs_only_unfinished_work(local: Local, tmp_path: Path) -> None:
    scheduler, address = start_scheduler(tmp_path)
    workers = [start_worker(address) for _ in range(2)]
    command = python_command(command_line("opencood", {**local.paths, "out": tmp_path}))
    with subprocess.Popen(
        [*command, "--scheduler", address], stderr=subprocess.PIPE, text=True
    ) as export:
        wait_for(lambda: list(tmp_path.glob("opencood/.deepaccident-parts/kept/opencood/*/done")))
        scheduler.kill()
        _, errors = export.communicate(timeout=120)
    for process in (scheduler, *workers):
        process.kill()
        process.wait()

    assert export.returncode == 2
    assert errors.splitlines()[-1].startswith("error: the scheduler has ended")

    second = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True)
    assert " 0 already there" not in second.stdout
    assert read_files(tmp_path / "opencood", prefix="opencood/") == opencood_files(local)


@pytest.fixture
def scheduler(tmp_path: Path) -> Iterator[str]:
    process, address = start_scheduler(tmp_path)
    yield address
    process.kill()
    process.wait()


@pytest.mark.parametrize(
    ("setup", "message"),
    [
        (WITHOUT_PACKAGE, "a worker cannot do the work"),
        (OTHER_VERSION, "has deepaccident_devkit 0.0.1, but this machine has"),
    ],
)
def test_a_worker_without_the_package_or_with_another_version(
    local: Local, scheduler: str, tmp_path: Path, setup: str, message: str
) -> None:
    worker = start_worker(scheduler, setup)
    result = export_on_cluster(local, scheduler, worker, tmp_path)
    assert result.returncode == 2
    assert message in result.stderr.splitlines()[-1]
    assert not (tmp_path / "opencood").exists()


@pytest.mark.parametrize("unseen", ["release", "opencood"])
def test_a_folder_that_workers_cannot_see(
    local: Local, scheduler: str, tmp_path: Path, unseen: str
) -> None:
    """An empty file system is mounted over the folder, but only for the worker."""
    out = tmp_path / "opencood"
    out.mkdir()
    hidden = {"release": local.paths["release"], "opencood": out}[unseen]
    if shutil.which("unshare") is None:
        pytest.skip("no right to mount")
    if subprocess.run(["unshare", "-m", "true"], check=False).returncode:
        pytest.skip("no right to mount")
    hide_folder = [
        "unshare",
        "-m",
        "sh",
        "-c",
        f'mount -t tmpfs none "{hidden}" && exec "$@"',
        "sh",
    ]
    worker = start_worker(scheduler, prefix=hide_folder)
    result = export_on_cluster(local, scheduler, worker, tmp_path)

    assert result.returncode == 2

    last_line = result.stderr.splitlines()[-1]
    assert last_line.startswith("error: a worker on ")
    assert f" does not see {hidden}" in last_line


def start_scheduler(folder: Path) -> tuple[subprocess.Popen[str], str]:
    """Start a scheduler, which does not need the devkit, and wait for its address."""
    file = folder / "scheduler.json"
    process = subprocess.Popen(
        [
            *(sys.executable, "-c", f"{WITHOUT_PACKAGE}; {START_SCHEDULER}"),
            *("--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--no-show"),
            *("--scheduler-file", str(file)),
        ],
        stderr=subprocess.DEVNULL,
        text=True,
    )
    wait_for(lambda: file.exists() and '"address"' in file.read_text())
    return process, json.loads(file.read_text())["address"]


def start_worker(
    address: str, setup: str = "", prefix: Sequence[str] = ()
) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [
            *(*prefix, sys.executable, "-c", f"{setup}\n{START_WORKER}", address),
            *("--no-nanny", "--nthreads", "1", "--no-dashboard"),
        ],
        stderr=subprocess.DEVNULL,
        text=True,
    )


def export_on_cluster(
    local: Local, scheduler: str, worker: subprocess.Popen[str], folder: Path
) -> subprocess.CompletedProcess[str]:
    """Export once the worker is connected, and end the worker afterwards."""
    from distributed import Client

    with Client(scheduler) as client:
        client.wait_for_workers(1, timeout=60)
    arguments = command_line("opencood", {**local.paths, "out": folder})
    result = subprocess.run(
        python_command([*arguments, "--scheduler", scheduler]),
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    worker.kill()
    worker.wait()
    return result
