"""Work on the items of a store, in a module that a spawned process can import by name."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.support.parallel import Store

ITEM_NAMES = tuple(f"type/{number:02d}" for number in range(12))


@dataclass(frozen=True)
class DoubleNames:
    """Doubles a name, and leaves a file `NAME.PROCESS` as a mark whenever it does so."""

    store: Store
    marks: Path
    key: str = "settings"
    killed_at: str = ""
    broken: Sequence[str] = ()

    def __call__(self, name: str) -> bytes:
        content = self.store.read_result(name, self.key)
        if content is None:
            (self.marks / f"{name.replace('/', '.')}.{os.getpid()}").touch()
            time.sleep(0.02)
            if name in self.broken:
                raise ConfigError(f"{name}: broken")
            content = f"{name} {name} {self.key}".encode()
            self.store.write_result(name, self.key, content)
            if name == self.killed_at:
                os.kill(os.getpid(), signal.SIGKILL)
        return content


def open_store(folder: Path) -> Store:
    return Store(folder / "out.unfinished", folder / "out", "doubles", ConfigError)


def make_items(folder: Path, workers: int = 1, **options: object) -> dict[str, bytes]:
    """Make all items, then write them together as `out` unless another process has done so."""
    (folder / "marks").mkdir(parents=True, exist_ok=True)
    store = open_store(folder)
    with store.shared() as turn:
        work = DoubleNames(store, folder / "marks", **options)  # type: ignore[arg-type]
        items = {name: name for name in ITEM_NAMES}
        results = store.run(work, items, workers=workers)
        if turn.alone():
            (folder / "wholes").mkdir(exist_ok=True)
            (folder / "wholes" / str(os.getpid())).touch()
            (folder / "out").write_bytes(b"\n".join(results.values()))
            store.remove()
    return results


def start_process(folder: Path, workers: int = 1, killed_at: str = "") -> "subprocess.Popen[str]":
    """Start another process that makes all items, with this module imported by name."""
    code = (
        "from pathlib import Path; from support import store_process; "
        f"store_process.make_items(Path({str(folder)!r}), {workers}, {killed_at=!r})"
    )
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])}
    return subprocess.Popen(
        [sys.executable, "-c", code], stderr=subprocess.PIPE, text=True, env=environment
    )
