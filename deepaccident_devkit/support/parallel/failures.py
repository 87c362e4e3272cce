"""Failing items of bulk work: the others are finished, and failures are listed at the end."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Generic, TypeVar

from deepaccident_devkit.errors import (
    DeepAccidentError,
    MissingExtraError,
    ReleaseError,
    SomeFailedError,
    WorkerError,
)

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


@dataclass(frozen=True, slots=True)
class Failure:
    """A failure, which takes the place of an item's result.

    Attributes:
        message: Message of the error.
    """

    message: str


@dataclass(frozen=True, slots=True)
class Tried(Generic[_Item, _Result]):
    """Work that returns a Failure for an item with a fault of its own.

    A full disk or a lost worker still ends all work.

    Attributes:
        work: Function that is applied to each item.
    """

    work: Callable[[_Item], _Result]

    def __call__(self, item: _Item) -> _Result | Failure:
        """Do the work on an item."""
        try:
            return self.work(item)
        except ReleaseError as error:  # a missing file is an OSError too
            return Failure(str(error))
        except (OSError, MissingExtraError, WorkerError):
            raise
        except DeepAccidentError as error:
            return Failure(str(error))


def check_failures(results: Iterable[tuple[str, object]], where: str) -> None:
    """Raise SomeFailedError, which lists all failures, if a named result is a Failure."""
    count = 0
    failures = []
    for name, result in results:
        count += 1
        if isinstance(result, Failure):
            failures.append(f"  {name}: {result.message}")
    if failures:
        lines = [f"{where}: {len(failures)} of {count} failed:", *failures]
        lines.append(
            "The others are done. Fix these and run the same command again; it does only the rest."
        )
        raise SomeFailedError("\n".join(lines))
