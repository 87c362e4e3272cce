"""All statistics of a release in one value, and its forms: JSON, CSV, text."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

from deepaccident_devkit.statistics.results import (
    CRITICAL,
    GROUPS,
    PROBABILITIES,
    TOTAL,
    CollisionPair,
    CountTable,
    Histogram,
    QuantileTable,
    StatisticsRow,
    StatisticsTable,
    collision_rows,
)
from deepaccident_devkit.support.reports import Report
from deepaccident_devkit.support.text import columns_text, number_text, share_text
from deepaccident_devkit.taxonomy import CATEGORIES

# Seconds; edges of the histogram of least times to collision.
_LIMITS = (0.5, 1.0, 1.5, 3.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class DatasetStatistics(Report):
    """The statistics of a release, or of some of its scenarios; groups are those of `GROUPS`.

    Attributes:
        dataroot: the release's folder.
        version: `v1` or `v1-mini`.
        release_scenarios: how many scenarios the release has, selected or not.
        selected: whether they are of a selection.
        scenarios: group → scenarios.
        frames: group → frames.
        samples: group → samples (an agent at a moment).
        unlabelled: group → scenarios without labels, which count only where labels are not needed.
        counts: name → table of counts.
        histograms: name → histogram.
        quantiles: name → table of quantiles.
        collisions: the colliding pairs at the last frame.
    """

    dataroot: str
    version: str
    release_scenarios: int
    selected: bool
    scenarios: Mapping[str, int]
    frames: Mapping[str, int]
    samples: Mapping[str, int]
    unlabelled: Mapping[str, int]
    counts: Mapping[str, CountTable]
    histograms: Mapping[str, Histogram]
    quantiles: Mapping[str, QuantileTable]
    collisions: tuple[CollisionPair, ...]

    @property
    def tables(self) -> tuple[StatisticsTable, ...]:
        """All tables: counts, histograms, quantiles."""
        return (*self.counts.values(), *self.histograms.values(), *self.quantiles.values())

    @property
    def groups(self) -> tuple[str, ...]:
        """The total and the groups that have a scenario."""
        return (TOTAL, *(group for group in GROUPS[1:] if self.scenarios[group]))

    def to_dict(self) -> dict[str, Any]:
        """For JSON; None for what has no value."""
        return {**asdict(self), "probabilities": PROBABILITIES}

    def named_tables(self) -> dict[str, Iterable[StatisticsRow]]:
        """All tables, and the colliding pairs."""
        return {
            **{table.name: table.rows() for table in self.tables},
            "collision_pairs": collision_rows(self.collisions),
        }

    def to_text(self) -> str:
        """Some aligned blocks for a terminal: scenarios (without zeros), a line a category, what is left out."""
        head = f"DeepAccident {self.version} at {self.dataroot}"
        if self.selected:
            count = self.scenarios[TOTAL]
            head += f"\nselected: {count} of {self.release_scenarios} scenarios; all counts are of these"
            if not count:
                return f"{head}\nno scenario meets the filters, so there is nothing to count"
        sums = {"scenarios": self.scenarios, "frames": self.frames, "samples": self.samples}
        blocks = [
            head,
            columns_text(
                [("", *self.groups)]
                + [(word, *self._cells(counts)) for word, counts in sums.items()]
            ),
        ]
        blocks += [
            self._shares_text(table)
            for table in self.counts.values()
            if table.counted == "scenarios"
        ]
        blocks += [self._lengths_text(), self._categories_text()]
        if CRITICAL in self.histograms:
            blocks.append(self._critical_text())
        left_out = {
            f"{table.left_out.counts[TOTAL]:,} {table.left_out.what}"
            for table in self.tables
            if table.left_out and table.left_out.counts[TOTAL]
        }
        if left_out:
            blocks.append(
                "\n".join(["left out where a value is needed that they lack:", *sorted(left_out)])
            )
        return "\n\n".join(blocks)

    def _cells(self, counts: Mapping[str, int]) -> list[str]:
        return [f"{counts[group]:,}" for group in self.groups]

    def _shares_text(self, table: CountTable) -> str:
        """A row a value that occurs: how many of each group have it."""
        rows = [
            (value, *(share_text(counts[group], table.total(group)) for group in self.groups))
            for value, counts in table.counts.items()
            if counts[TOTAL]
        ]
        return columns_text([(table.field, *self.groups), *rows])

    def _lengths_text(self) -> str:
        lengths = self.histograms["lengths"]
        rows = [
            (label, *(str(lengths.counts[group][index]) for group in self.groups))
            for index, label in enumerate(lengths.bin_labels())
        ]
        return columns_text(
            [("length in frames", *self.groups), *rows, ("other", *self._cells(lengths.outside))]
        )

    def _critical_text(self) -> str:
        """Scenarios in which a moving pair comes below some times to collision, of those with labels."""
        times = self.histograms[CRITICAL]
        labelled = {group: self.scenarios[group] - self.unlabelled[group] for group in self.groups}
        rows = [
            (
                f"below {limit:g} s",
                *(
                    share_text(sum(times.counts[each][: times.edges.index(limit)]), labelled[each])
                    for each in labelled
                ),
            )
            for limit in _LIMITS
        ]
        return columns_text([("least TTC of moving pairs", *self.groups), *rows])

    def _categories_text(self) -> str:
        """A line a category: counts, and medians of size, distance and speed."""
        sizes = self.quantiles["box_sizes"]
        rows = []
        for category in CATEGORIES:
            size = [
                number_text(sizes.median(field, category), 2)
                for field in ("length", "width", "height")
            ]
            rows.append(
                (
                    category,
                    f"{self.counts['instances'].counts[category][TOTAL]:,}",
                    f"{self.counts['annotations'].counts[category][TOTAL]:,}",
                    " × ".join(size) if size[0] != "–" else "–",
                    number_text(
                        self.quantiles["distance_quantiles"].median("distance", category), 1
                    ),
                    number_text(self.quantiles["speed_quantiles"].median("speed", category), 1),
                )
            )
        heading = (
            "category, medians",
            "instances",
            "annotations",
            "l × w × h (m)",
            "distance (m)",
            "speed (m/s)",
        )
        return columns_text([heading, *rows])
