"""`Comparison`: the numbers of two evaluations side by side, as text, JSON and CSV."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from deepaccident_devkit.evaluation.metrics.breakdowns import Bootstrap
from deepaccident_devkit.evaluation.metrics.frozen_mappings import plain
from deepaccident_devkit.files import write_bytes
from deepaccident_devkit.text import columns_text

_COLUMNS: Final = ("number", "headline", "unit", "a", "b", "difference", "low", "high", "reversed", "real", "better")


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparedNumber:
    """A number of both results.

    Attributes:
        number: its path in the result: `ranges/30x30/iou`.
        headline: its short name, if it is one of the task's headlines; else None.
        unit: of a headline; else None.
        a: of the first; None where it has nothing to count.
        b: of the second; likewise.
        difference: b − a; None if one of them is.
        low: where the middle share of the resamples' differences begins; None without resamples.
        high: where it ends.
        reversed: share of the resamples whose difference has the other sign; None without resamples or difference.
        real: whether the interval from low to high lies on one side of 0, and more than one scenario has the number;
            False without one.
        better: `a` or `b`, where a difference is real and one knows which way is better; else None.
    """

    number: str
    headline: str | None
    unit: str | None
    a: float | None
    b: float | None
    difference: float | None
    low: float | None
    high: float | None
    reversed: float | None
    real: bool
    better: str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """Two evaluations by the same rules.

    Attributes:
        a: folder of the first.
        b: folder of the second.
        task: of both.
        protocol: of both.
        samples: compared.
        scenarios: that they are of.
        left_out: samples that only one of them has.
        partial: marks of those that are partial themselves.
        bootstrap: how resamples were drawn.
        numbers: headlines first.
    """

    a: Path
    b: Path
    task: str
    protocol: str
    samples: int
    scenarios: int
    left_out: int
    partial: tuple[str, ...]
    bootstrap: Bootstrap
    numbers: tuple[ComparedNumber, ...]

    def to_text(self) -> str:
        """A table of the headlines, how many other numbers differ, and what to make of that."""
        marks = [f"a, b: only the samples that both have; {self.left_out} left out"] if self.left_out else []
        head = [
            f"{self.task}, protocol {self.protocol}: {self.samples} samples of {self.scenarios} scenarios",
            f"a: {self.a}",
            f"b: {self.b}",
            *self.partial,
            *marks,
        ]
        shown = [each for each in self.numbers if each.headline]
        percent = f"{self.bootstrap.confidence:.0%}"
        rows: list[Sequence[str]] = [("number", "a", "b", "b − a", f"{percent} interval", "reversed", "real")]
        rows += [_text_row(each) for each in shown]
        return "\n".join([*head, "", columns_text(rows), "", *self.notes()])

    def notes(self) -> list[str]:
        """What a reader of the table has to know."""
        drawn = [each for each in self.numbers if each.reversed is not None]
        if not drawn:
            why = f"they are drawn over scenarios, of which there are {self.scenarios}"
            return [f"no intervals: {why if self.bootstrap.resamples else 'no resamples were asked for'}"]
        others = [each for each in self.numbers if not each.headline]
        by_chance = (1 - self.bootstrap.confidence) * len(drawn)
        meaning = (
            f"real: the interval over {self.bootstrap.resamples} resamples of whole scenarios, the same for both, "
            "excludes 0, and several scenarios have the number; reversed: share of the resamples with the other sign"
        )
        honesty = (
            f"{len(drawn)} numbers are compared: if the two were equally good, about {by_chance:.1f} would be called "
            "real by chance; decide on one headline before you look"
        )
        rest = f"beside the headlines: {sum(each.real for each in others)} of {len(others)} numbers differ really"
        return [meaning, honesty, rest]

    def as_dict(self) -> dict[str, Any]:
        """All of it, as JSON holds it."""
        made: dict[str, Any] = plain(asdict(self) | {"a": os.fspath(self.a), "b": os.fspath(self.b)})
        return made | {"notes": self.notes()}

    def to_csv(self, path: str | os.PathLike[str]) -> Path:
        """Write a line a number; returns the file's path."""
        text = io.StringIO(newline="")
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(_COLUMNS)
        writer.writerows([getattr(each, name) for name in _COLUMNS] for each in self.numbers)
        target = Path(path).expanduser()
        write_bytes(target, text.getvalue().encode())
        return target


def _text_row(each: ComparedNumber) -> tuple[str, ...]:
    unit = f" ({each.unit})" if each.unit and each.unit != "share" else ""
    interval = "–" if each.low is None or each.high is None else f"[{each.low:+.3f}, {each.high:+.3f}]"
    return (
        f"{each.headline}{unit}",
        *("–" if value is None else f"{value:.3f}" for value in (each.a, each.b)),
        "–" if each.difference is None else f"{each.difference:+.3f}",
        interval,
        "–" if each.reversed is None else f"{each.reversed:.1%}",
        f"yes, {each.better} is better" if each.better else "yes" if each.real else "no",
    )
