"""Other processes, as Linux shows them: what they wait for and whom they started."""

import signal
import time
from collections.abc import Callable
from pathlib import Path


def is_running(process: int) -> bool:
    """Whether there is such a process; one that has ended and was not asked for is none."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


def workers_of(process: int) -> list[int]:
    """The pool's processes that a process has started."""
    try:
        found = [
            int(child)
            for child in Path(f"/proc/{process}/task/{process}/children").read_text().split()
        ]
    except OSError:
        return []
    return [child for child in found if is_running(child) and b"spawn_main" in _command(child)]


def catches(process: int, number: int) -> bool:
    """Whether a process has a handler for a signal."""
    return _has(process, "SigCgt", number)


def works(process: int) -> bool:
    """Whether a process of the pool has begun: it leaves Ctrl-C to its parent."""
    return _has(process, "SigIgn", signal.SIGINT)


def _has(process: int, signals: str, number: int) -> bool:
    """Whether a signal is in one of the sets that the system keeps of a process; one that has ended
    has none.
    """
    try:
        lines = Path(f"/proc/{process}/status").read_text().splitlines()
    except OSError:
        return False
    found = next((line.split()[1] for line in lines if line.startswith(signals)), "0")
    return bool(int(found, 16) >> (number - 1) & 1)


def wait_for(condition: Callable[[], object], seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited for in vain"
        time.sleep(0.005)


def _command(process: int) -> bytes:
    try:
        return Path(f"/proc/{process}/cmdline").read_bytes()
    except OSError:
        return b""
