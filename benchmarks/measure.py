"""A measured figure, its bound, and the table of them."""

import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import click

from deepaccident_devkit.errors import MissingExtraError


@dataclass(frozen=True, slots=True, kw_only=True)
class Figure:
    """One measured number.

    Attributes:
        name: as in the JSON output.
        value: measured.
        unit: of value and bound.
        bound: what it should not be worse than, None for a figure that only informs.
        higher_is_better: whether the bound is a lower one.
        reference: what the released code takes, or in `beside` the other way, in the same unit;
            None without such.
    """

    name: str
    value: float
    unit: str = ""
    bound: float | None = None
    higher_is_better: bool = False
    reference: float | None = None

    @property
    def ratio(self) -> float | None:
        """How many times better than the bound; below 1 the bound is missed."""
        if self.bound is None:
            return None
        return self.value / self.bound if self.higher_is_better else self.bound / self.value


def has_torch(benchmark: str) -> bool:
    """Whether what needs PyTorch can be measured; else says that it is not."""
    try:
        import deepaccident_devkit.training.torch  # noqa: F401
    except MissingExtraError as error:
        click.echo(f"{benchmark}: training images are not measured; {error}", err=True)
        return False
    return True


def best_of(repeats: int, work: Callable[[], object]) -> float:
    """Seconds of the fastest of some runs."""
    return min(_seconds(work) for _ in range(repeats))


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
    """The figures as aligned text."""
    rows = [["figure", "measured", "bound", "times better", "the other", "times faster"]]
    for figure in figures:
        row = [figure.name, f"{_number(figure.value)} {figure.unit}".strip(), "", "", "", ""]
        if figure.bound is not None:
            row[2:4] = f"{_number(figure.bound)} {figure.unit}", f"{figure.ratio:.2f}"
        if figure.reference is not None:
            row[4:6] = (
                f"{_number(figure.reference)} {figure.unit}",
                f"{figure.reference / figure.value:.3g}",
            )
        rows.append(row)
    columns = [column for column in zip(*rows, strict=True) if any(column[1:])]
    widths = [max(map(len, column)) for column in columns]
    lines = []
    for name, *words in zip(*columns, strict=True):
        aligned = (f"{word:>{width}}" for word, width in zip(words, widths[1:], strict=True))
        lines.append("  ".join([f"{name:<{widths[0]}}", *aligned]).rstrip())
    return "\n".join(lines)


def _seconds(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def _number(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
