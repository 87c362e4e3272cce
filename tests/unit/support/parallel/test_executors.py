"""Schedulers that cannot be used; working ones are in tests/engines."""

import concurrent.futures
import gc
import sys
from functools import partial
from pathlib import Path
from unittest.mock import Mock

import pytest
from click.testing import CliRunner
from support.expected_errors import assert_raises

from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.errors import MissingExtraError, WorkerError
from deepaccident_devkit.support.parallel import cluster_executor, run_batch
from deepaccident_devkit.support.parallel.executors import describe_worker_fault


def test_a_dead_scheduler_is_an_error() -> None:
    import distributed  # noqa: F401 - sets its own settings, which must exist before one is changed
    from dask import config

    message = (
        r"^tcp://127\.0\.0\.1:1: no dask scheduler answers \(.*\); start one with "
        r"`dask scheduler`, and give its"
    )
    with (
        config.set({"distributed.comm.timeouts.connect": "300ms"}),
        pytest.raises(WorkerError, match=message),
        cluster_executor("tcp://127.0.0.1:1"),
    ):
        pass


@pytest.mark.parametrize(
    "content",
    [
        None,
        "",
        "[1]",
        "{}",
        "[" * 100_000,
        '{"address": 8786}',
        '{"address": "tcp://127.0.0.1:1", "address": "tcp://127.0.0.1:2"}',
        f'{{"address": "tcp://{"x" * 500_000}:1"}}',
        '{"address": "tcp://127.0.0.1:99999999"}',
        '{"address": "ucx://127.0.0.1:1"}',
        '{"address": "tcp://\\u0000:1"}',
        '{"address": "\\ud800"}',
        f'{{"address": "{"x" * 100}://"}}',
    ],
)
def test_a_wrong_scheduler_file_is_an_error(
    tmp_path: Path, content: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    import distributed  # noqa: F401 - as above
    from dask import config

    monkeypatch.setattr("deepaccident_devkit.support.parallel.executors.ADDRESS_WAIT", 0.2)
    path = tmp_path / "scheduler.json"
    if content is not None:
        path.write_text(content)
    with (
        config.set({"distributed.comm.timeouts.connect": "300ms"}),
        pytest.raises(WorkerError, match=rf"^{path}: no dask scheduler answers") as error,
        cluster_executor(None, path),
    ):
        pass
    assert len(str(error.value)) < 700 + len(str(path))
    # a client left open would be closed by the garbage collector, which may hang the next one
    clients = [value for value in gc.get_objects() if type(value).__name__ == "Client"]
    assert all(getattr(client, "status", "closed") == "closed" for client in clients)


@pytest.mark.parametrize(
    ("package", "address"), [("distributed", "tcp://127.0.0.1:1"), ("mpi4py", "mpi")]
)
def test_a_scheduler_without_its_package_names_the_extra(
    monkeypatch: pytest.MonkeyPatch, package: str, address: str
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MissingExtraError, match="pip install"), cluster_executor(address):
        pass


@pytest.mark.parametrize(
    "error",
    [
        MissingExtraError("install deepaccident_devkit[synth]"),
        AttributeError("'Box' of deepaccident_devkit has no attribute 'x'"),
        ValueError("deepaccident_devkit"),
    ],
)
def test_errors_of_the_work_are_not_blamed_on_workers(error: Exception) -> None:
    assert describe_worker_fault(error) is None


def test_the_scheduler_option_of_verbs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = ["index", "release", "--scheduler"]
    result = CliRunner().invoke(deepaccident, [*words, "tcp://x", "--workers", "2"])
    assert result.exit_code == 2
    assert "--workers has no effect with a scheduler" in result.output

    monkeypatch.setattr("deepaccident_devkit.support.parallel.executors.ADDRESS_WAIT", 0.2)
    path = str(tmp_path / "absent.json")
    invoke = partial(CliRunner().invoke, deepaccident, [*words, path], catch_exceptions=False)
    assert_raises((invoke, WorkerError, f"^{path}: no dask scheduler answers"))


def test_processes_that_cannot_be_started_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """The locks of a pool lie in /dev/shm, which may be full."""
    monkeypatch.setattr(
        concurrent.futures, "ProcessPoolExecutor", Mock(side_effect=OSError(28, "No space left"))
    )
    facts = ("cannot be started", "No space left", "/dev/shm", "fewer workers")  # noqa: S108
    assert_raises((lambda: run_batch(abs, range(9), workers=2), WorkerError, facts))


def test_there_is_no_executor_without_a_scheduler() -> None:
    with cluster_executor() as executor:
        assert executor is None
