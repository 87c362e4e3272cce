"""The state of other processes from Linux's /proc: their signal handlers and children."""

import signal
import time
from collections.abc import Callable
from pathlib import Path


def is_running(process: int) -> bool:
    """Return whether a process exists and has not ended; a zombie has ended."""
    try:
        status = Path(f"/proc/{process}/stat").read_text()
    except OSError:
        return False
    state = status.rpartition(")")[2].split()[0]
    return state not in "ZX"


def worker_processes(process: int) -> list[int]:
    """Return the ids of the pool's processes that a process has started."""
    try:
        words = Path(f"/proc/{process}/task/{process}/children").read_text().split()
    except OSError:
        return []
    children = map(int, words)
    return [child for child in children if is_running(child) and b"spawn_main" in _command(child)]


def catches(process: int, number: int) -> bool:
    """Return whether a process has a handler for a signal."""
    return _has_signal(process, "SigCgt", number)


def works(process: int) -> bool:
    """Return whether a process of the pool has begun: then it ignores Ctrl-C."""
    return _has_signal(process, "SigIgn", signal.SIGINT)


def _has_signal(process: int, field: str, number: int) -> bool:
    """Return whether a signal is in one of the system's signal sets of a process.

    A process that has ended has no signals.
    """
    try:
        lines = Path(f"/proc/{process}/status").read_text().splitlines()
    except OSError:
        return False
    mask = next((line.split()[1] for line in lines if line.startswith(field)), "0")
    return bool(int(mask, 16) >> (number - 1) & 1)


def wait_for(condition: Callable[[], object], seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, f"the condition was not met in {seconds} s"
        time.sleep(0.005)


def _command(process: int) -> bytes:
    try:
        return Path(f"/proc/{process}/cmdline").read_bytes()
    except OSError:
        return b""
