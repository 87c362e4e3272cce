"""`python forked.py CALIB…` reads each file in a process with little memory and time, and prints
how it went.

A crash or a process that has to be killed is an outcome as well. Each is a fork of this one, which
has everything
imported: that costs no interpreter's start.
"""

import json
import os
import resource
import signal
import sys
from pathlib import Path

from deepaccident_devkit.errors import CalibError
from deepaccident_devkit.release import read_calib

MEMORY = 1 << 30
SECONDS = 60


def main() -> None:
    for path in sys.argv[1:]:
        print(json.dumps(outcome(Path(path))), flush=True)


def outcome(path: Path) -> dict[str, object]:
    """`status` is the process's exit status, negative for a signal; `message` its error, `peak` its
    further bytes.
    """
    reading, writing = os.pipe()
    process = os.fork()
    if process == 0:
        _read(path, writing)
    os.close(writing)
    with os.fdopen(reading) as pipe:
        said = json.loads(pipe.read() or "{}")
    _, status = os.waitpid(process, 0)
    return {"status": os.waitstatus_to_exitcode(status), "message": "", "peak": 0} | said


def _read(path: Path, writing: int) -> None:
    status, message = 1, ""
    try:
        signal.alarm(SECONDS)
        virtual = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (virtual + MEMORY, virtual + MEMORY))
        before = _peak()
        try:
            read_calib(path)
        except CalibError as error:
            message = str(error)
        os.write(
            writing, json.dumps({"message": message[:10_000], "peak": _peak() - before}).encode()
        )
        status = 0
    finally:
        os._exit(status)


def _peak() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


if __name__ == "__main__":
    main()
