"""Functions that tests run in other processes: in a module that a spawned process can import by
name.
"""

import os
import signal
import time
from pathlib import Path

from deepaccident_devkit import DeepAccident


def num_boxes(release: DeepAccident, row: int) -> int:
    return len(release.boxes(release.sample[row]))


def killed(item: int) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def interrupted(item: int) -> int:
    """Ctrl-C in a terminal reaches the workers too."""
    os.kill(os.getpid(), signal.SIGINT)
    return item


def told_and_asleep(path: str) -> None:
    if path:
        Path(path).write_text(str(os.getpid()))
        time.sleep(600)  # longer than anybody waits


def told_or_broken(path: str) -> None:
    """Done a little later, but for the first item, which fails."""
    if path.endswith("0"):
        raise ValueError("broken")
    time.sleep(0.2)
    Path(path).touch()


def following(item: int) -> int:
    return item + 1


def process(item: int) -> int:
    return os.getpid()
