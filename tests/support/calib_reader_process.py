"""Read untrusted calibrations in processes with little memory and time, and print the outcomes.

Usage: `python calib_reader_process.py CALIB…`.

A crash, or a process that has to be killed, is an outcome as well. Each process is a fork of this
one, which has imported everything, so that no interpreter needs to start.
"""

import json
import os
import resource
import signal
import sys
from pathlib import Path

from deepaccident_devkit.errors import CalibError
from deepaccident_devkit.release import read_calib

MEMORY_BYTES = 1 << 30
TIME_LIMIT_S = 60


def main() -> None:
    for path in sys.argv[1:]:
        print(json.dumps(read_in_fork(Path(path))), flush=True)


def read_in_fork(path: Path) -> dict[str, object]:
    """Read a calibration in a fork.

    Returns its exit `status`, negative for a signal; the `message` of its error; and its `peak`,
    the growth of its memory in bytes.
    """
    reading, writing = os.pipe()
    process = os.fork()
    if process == 0:
        _read(path, writing)
    os.close(writing)
    with os.fdopen(reading) as pipe:
        report = json.loads(pipe.read() or "{}")
    _, status = os.waitpid(process, 0)
    return {"status": os.waitstatus_to_exitcode(status), "message": "", "peak": 0, **report}


def _read(path: Path, writing: int) -> None:
    status = 1
    message = ""
    try:
        signal.alarm(TIME_LIMIT_S)
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        limit_bytes = pages * resource.getpagesize() + MEMORY_BYTES
        resource.setrlimit(resource.RLIMIT_AS, (limit_bytes, limit_bytes))
        before = _peak()
        try:
            read_calib(path)
        except CalibError as error:
            message = str(error)
        report = {"message": message[:10_000], "peak": _peak() - before}
        os.write(writing, json.dumps(report).encode())
        status = 0
    finally:
        os._exit(status)


def _peak() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


if __name__ == "__main__":
    main()
