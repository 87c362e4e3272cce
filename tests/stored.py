"""Work on items of a store that tests do in other processes: in a module that a spawned process can
import by name.
"""

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

ITEMS = tuple(f"type/{number:02d}" for number in range(12))


@dataclass(frozen=True)
class Work:
    """Doubles a name, and leaves a mark for each time that it does: `NAME.PROCESS`."""

    store: Store
    marks: Path
    key: str = "settings"
    killed_at: str = ""
    broken: Sequence[str] = ()

    def __call__(self, name: str) -> bytes:
        content = self.store.kept(name, self.key)
        if content is None:
            (self.marks / f"{name.replace('/', '.')}.{os.getpid()}").touch()
            time.sleep(0.02)
            if name in self.broken:
                raise ConfigError(f"{name}: broken")
            content = f"{name} {name} {self.key}".encode()
            self.store.keep(name, self.key, content)
            if name == self.killed_at:
                os.kill(os.getpid(), signal.SIGKILL)
        return content


def store_in(folder: Path) -> Store:
    return Store(folder / "out.unfinished", folder / "out", "doubles", ConfigError)


def made(folder: Path, workers: int = 1, **how: object) -> dict[str, bytes]:
    """Make all items, then write the whole of them as `out`, if nobody else has."""
    (folder / "marks").mkdir(parents=True, exist_ok=True)
    store = store_in(folder)
    with store.shared() as turn:
        results = store.run(
            Work(store, folder / "marks", **how),  # type: ignore[arg-type]
            dict(zip(ITEMS, ITEMS, strict=True)),
            workers=workers,
        )
        if turn.alone():
            (folder / "wholes").mkdir(exist_ok=True)
            (folder / "wholes" / str(os.getpid())).touch()
            (folder / "out").write_bytes(b"\n".join(results.values()))
            store.remove()
    return results


def process(folder: Path, workers: int = 1, killed_at: str = "") -> "subprocess.Popen[str]":
    """Another process that makes all, and imports this module by its name as its workers do."""
    code = (
        f"from pathlib import Path; import stored; stored.made(Path({str(folder)!r}), "
        f"{workers}, {killed_at=!r})"
    )
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
    return subprocess.Popen(
        [sys.executable, "-c", code], stderr=subprocess.PIPE, text=True, env=environment
    )
