"""Define a measured figure with its bound, and print a table of figures."""

import os
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import KW_ONLY, dataclass
from pathlib import Path

import click

from deepaccident_devkit.errors import MissingExtraError


@dataclass(frozen=True, slots=True)
class Figure:
    """One measured number.

    Attributes:
        name: Name in the JSON output.
        value: Measured value.
        unit: Unit of value and bound.
        bound: Worst acceptable value, or None for a figure that only informs.
        higher_is_better: Whether the bound is a lower one.
        reference: Value of the released code, or in `beside` of the other implementation, in the
            same unit; None if there is none.
    """

    name: str
    value: float
    unit: str = ""
    _: KW_ONLY
    bound: float | None = None
    higher_is_better: bool = False
    reference: float | None = None

    @property
    def ratio(self) -> float | None:
        """How many times the value is better than the bound; below 1 the bound is missed."""
        if self.bound is None:
            return None
        return self.value / self.bound if self.higher_is_better else self.bound / self.value


def milliseconds(
    name: str, seconds: float, bound: float | None = None, reference: float | None = None
) -> Figure:
    """Return the figure of a time; bound and reference are milliseconds."""
    return Figure(name, 1e3 * seconds, "ms", bound=bound, reference=reference)


def has_torch(benchmark: str) -> bool:
    """Return whether figures that need PyTorch can be measured; report on stderr if they cannot."""
    try:
        import deepaccident_devkit.training.torch  # noqa: F401
    except MissingExtraError as error:
        click.echo(f"{benchmark}: training images are not measured; {error}", err=True)
        return False
    return True


def best_of(repeats: int, work: Callable[[], object]) -> float:
    """Return the seconds of the fastest of several runs."""
    return min(_seconds(work) for _ in range(repeats))


@contextmanager
def temporary_folder(purpose: str = "benchmark") -> Iterator[Path]:
    """Yield a new folder that is removed at the end of the block."""
    with tempfile.TemporaryDirectory(prefix=f"deepaccident_{purpose}_") as folder:
        yield Path(folder)


@contextmanager
def one_core() -> Iterator[None]:
    """Keep this process and its threads on one processor, where the system can (Linux)."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(allowed)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, allowed)


def table(figures: Sequence[Figure]) -> str:
    """Return the figures as aligned text."""
    rows = [["figure", "measured", "bound", "times better", "the other", "times faster"]]
    for figure in figures:
        measured = f"{_number(figure.value)} {figure.unit}".strip()
        bound = ""
        ratio = ""
        reference = ""
        speed_up = ""
        if figure.bound is not None:
            bound = f"{_number(figure.bound)} {figure.unit}"
            ratio = f"{figure.ratio:.2f}"
        if figure.reference is not None:
            reference = f"{_number(figure.reference)} {figure.unit}"
            speed_up = f"{figure.reference / figure.value:.3g}"
        rows.append([figure.name, measured, bound, ratio, reference, speed_up])
    columns = [column for column in zip(*rows, strict=True) if any(column[1:])]
    widths = [max(map(len, column)) for column in columns]
    lines = []
    for name, *cells in zip(*columns, strict=True):
        aligned = [name.ljust(widths[0]), *map(str.rjust, cells, widths[1:])]
        lines.append("  ".join(aligned).rstrip())
    return "\n".join(lines)


def _seconds(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def _number(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
