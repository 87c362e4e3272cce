"""What is sent to workers of other hosts: the work, and what must be true where it is done."""

from __future__ import annotations

import platform
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Generic, TypeVar

from deepaccident_devkit._version import __version__
from deepaccident_devkit.errors import WorkerError
from deepaccident_devkit.support.files import temporary_path

Item = TypeVar("Item")
Result = TypeVar("Result")


@dataclass(frozen=True, slots=True, kw_only=True)
class Places:
    """Files and folders that all workers must see.

    Attributes:
        reads: what they read.
        writes: folders that they write into; made where needed.
    """

    reads: tuple[Path, ...] = ()
    writes: tuple[Path, ...] = ()


@dataclass(frozen=True, slots=True)
class Call(Generic[Item, Result]):
    """The work on one item, called without arguments; raises WorkerError where it cannot be done.

    Attributes:
        work: a function that workers can import.
        item: what it is applied to.
        seen: paths that must be there.
    """

    work: Callable[[Item], Result]
    item: Item
    seen: tuple[str, ...]

    def __call__(self) -> Result:
        """Do the work."""
        _check_worker(__version__, self.seen)
        return self.work(self.item)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle it so that work and item are read when it is called, and nothing of the devkit is needed before.

        So a scheduler on the way needs no devkit, and a worker without one, or that cannot open the dataset of the
        item, says so as the task's error; dask's workers end if a message cannot be unpickled.
        """
        from multiprocessing.reduction import ForkingPickler  # here, as it takes ten milliseconds to import

        done_when_read = _DoneWhenRead(bytes(ForkingPickler.dumps((self.work, self.item))), self.seen)
        return partial, (ForkingPickler.loads, bytes(ForkingPickler.dumps(done_when_read)))


@dataclass(frozen=True, slots=True)
class _DoneWhenRead:
    """What becomes the result when it is read of the work whose pickle is `content`."""

    content: bytes
    seen: tuple[str, ...]

    def __reduce__(self) -> tuple[Any, ...]:
        return _checked_and_done, (__version__, self.seen, self.content)


def _checked_and_done(version: str, seen: tuple[str, ...], content: bytes) -> Any:
    from multiprocessing.reduction import ForkingPickler

    _check_worker(version, seen)
    work, item = ForkingPickler.loads(content)
    return work(item)


@contextmanager
def marked(places: Places) -> Iterator[tuple[str, ...]]:
    """The paths that workers must see. In folders that they write into a file is there meanwhile, of a new name.

    A folder of the same name on a worker's own disk has no such file.
    """
    with ExitStack() as stack:
        marks = []
        for folder in places.writes:
            folder.mkdir(parents=True, exist_ok=True)
            mark = temporary_path(folder / "seen")
            mark.touch()
            stack.callback(mark.unlink, missing_ok=True)
            marks.append(mark)
        yield tuple(map(str, (*places.reads, *marks)))


@lru_cache(maxsize=64)
def _check_worker(version: str, seen: tuple[str, ...]) -> None:
    """Raise WorkerError unless this process has the caller's devkit and sees these paths; asked once a process."""
    here = f"a worker on {platform.node()}"
    if version != __version__:
        raise WorkerError(
            f"{here} has deepaccident_devkit {__version__}, and this is {version}; install the same version on all"
        )
    for path in map(Path, seen):
        if not path.exists():
            unseen = path.parent if path.suffix == ".tmp" else path
            raise WorkerError(
                f"{here} does not see {unseen}; give an absolute path on a file system that all workers share"
            )
