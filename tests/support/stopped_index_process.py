"""Serve jobs that index a release and are stopped on the way.

`python stopped_index_process.py` reads one job a line and answers each with a line.

A job forks this process, which has imported everything, so that no interpreter needs to start
before a kill. Instead of indexing, a job with `words` runs them as a command line, and one with a
`function` (module and name) calls it with `arguments`. The arguments of the server are further
modules to import.
"""

import importlib
import json
import os
import resource
import shutil
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow.compute

from deepaccident_devkit import cli
from deepaccident_devkit.errors import DeepAccidentError
from deepaccident_devkit.release import find_release
from deepaccident_devkit.tables import open_index

assert pyarrow.compute  # imported here, because the work would import it after the clock starts


def main() -> None:
    for name in sys.argv[1:]:
        importlib.import_module(name)
    for line in sys.stdin:
        print(json.dumps(run_job(json.loads(line))), flush=True)


def run_job(job: dict[str, Any]) -> dict[str, Any]:
    """Run a job in a new process.

    Returns its exit `status`, −9 if it was killed, the `message` of its error, and the `seconds`
    that it took.
    """
    reading, writing = os.pipe()
    start = time.perf_counter()
    process = os.fork()
    if process == 0:
        _work(job, writing)
    os.close(writing)
    if job.get("delay") is not None:
        time.sleep(job["delay"])
        os.kill(process, signal.SIGKILL)
    _, status = os.waitpid(process, 0)
    seconds = time.perf_counter() - start
    with os.fdopen(reading) as pipe:  # workers of a killed process may hold it a moment longer
        message = pipe.read()
    return {"status": os.waitstatus_to_exitcode(status), "message": message, "seconds": seconds}


def _work(job: dict[str, Any], writing: int) -> None:
    status = 1
    try:
        if job.get("step") is not None:
            _kill_at(job["step"], after=job["after"])
        if job.get("limit") is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (job["limit"], job["limit"]))
        if "words" in job:
            _command(job["words"], writing)
        elif "function" in job:
            module, name = job["function"]
            getattr(importlib.import_module(module), name)(*job["arguments"])
        else:
            open_index(
                find_release(Path(job["root"])),
                index_dir=Path(job["index_dir"]),
                workers=job.get("workers", 1),
                check_files=job.get("check", False),
            )
        status = 0
    except SystemExit as end:
        status = int(end.code or 0)
    except DeepAccidentError as error:
        os.write(writing, f"{type(error).__name__}: {error}".encode())
    except BaseException as error:  # noqa: BLE001 - a fork must not return into the server
        os.write(writing, f"not ours: {error!r}".encode())
    finally:
        os._exit(status)


def _command(words: list[str], errors: int) -> None:
    """Run the command line; what it prints is dropped, except its errors."""
    os.dup2(errors, 2)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    sys.argv = ["deepaccident", *words]
    cli.main()


def _kill_at(step: int, *, after: bool) -> None:
    """End this process, as kill -9 would, before or after its n-th renaming or removal of a folder.

    One of the twelve tables is enough: all are in a folder that is removed if it is not renamed.
    """
    steps_left = iter(range(step, -1, -1))

    def watch(function: Callable[..., Any], counts: Callable[..., bool]) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            is_last = counts(*arguments) and next(steps_left) == 0
            if is_last and not after:
                os.kill(os.getpid(), signal.SIGKILL)
            result = function(*arguments, **options)
            if is_last:
                os.kill(os.getpid(), signal.SIGKILL)
            return result

        return call

    os.replace = watch(
        os.replace,
        lambda _, path: not path.parent.name.startswith(".tables-") or path.name == "track.arrow",
    )
    shutil.rmtree = watch(shutil.rmtree, lambda path, *_: Path(path).exists())


if __name__ == "__main__":
    main()
