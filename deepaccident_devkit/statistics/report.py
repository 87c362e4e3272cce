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

# Edges of the histogram of least times to collision.
_TTC_LIMITS_S = (0.5, 1.0, 1.5, 3.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class DatasetStatistics(Report):
    """The statistics of a release, or of a selection of its scenarios; groups are from `GROUPS`.

    Attributes:
        dataroot: Folder of the release.
        version: `v1` or `v1-mini`.
        release_scenarios: Number of scenarios of the release, selected or not.
        selected: Whether the statistics cover a selection of scenarios.
        scenarios: Group → scenarios.
        frames: Group → frames.
        samples: Group → samples (an agent at a moment).
        unlabelled: Group → scenarios without labels, which count only where labels are not needed.
        counts: Name → table of counts.
        histograms: Name → histogram.
        quantiles: Name → table of quantiles.
        collisions: Colliding pairs at the last frame.
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
        counts = self.counts.values()
        histograms = self.histograms.values()
        return (*counts, *histograms, *self.quantiles.values())

    @property
    def groups(self) -> tuple[str, ...]:
        """The total and the groups that have a scenario."""
        split_groups = [group for group in GROUPS[1:] if self.scenarios[group]]
        return (TOTAL, *split_groups)

    def to_dict(self) -> dict[str, Any]:
        """Return a dictionary for JSON, with None for missing values."""
        return {**asdict(self), "probabilities": PROBABILITIES}

    def named_tables(self) -> dict[str, Iterable[StatisticsRow]]:
        """Return the rows of all tables, and of the colliding pairs."""
        tables = {table.name: table.rows() for table in self.tables}
        return {**tables, "collision_pairs": collision_rows(self.collisions)}

    def to_text(self) -> str:
        """Return aligned blocks for a terminal.

        They are the scenarios (without zeros), a line a category, and what is left out.
        """
        head = f"DeepAccident {self.version} at {self.dataroot}"
        if self.selected:
            count = self.scenarios[TOTAL]
            head += f"\nselected: {count} of {self.release_scenarios} scenarios"
            head += "; all counts are of these"
            if not count:
                return f"{head}\nno scenario meets the filters, so there is nothing to count"
        sums = {"scenarios": self.scenarios, "frames": self.frames, "samples": self.samples}
        sum_rows = [(word, *self._cells(counts)) for word, counts in sums.items()]
        blocks = [head, columns_text([("", *self.groups), *sum_rows])]
        for table in self.counts.values():
            if table.counted == "scenarios":
                blocks.append(self._shares_text(table))
        blocks += [self._lengths_text(), self._categories_text()]
        if CRITICAL in self.histograms:
            blocks.append(self._critical_text())
        left_out = self._left_out_lines()
        if left_out:
            blocks.append(
                "\n".join(["left out where a value is needed that they lack:", *left_out])
            )
        return "\n\n".join(blocks)

    def _left_out_lines(self) -> list[str]:
        """Return a sorted line for each kind of items that a table leaves out."""
        lines = set()
        for table in self.tables:
            if table.left_out and table.left_out.counts[TOTAL]:
                lines.add(f"{table.left_out.counts[TOTAL]:,} {table.left_out.what}")
        return sorted(lines)

    def _cells(self, counts: Mapping[str, int]) -> list[str]:
        return [f"{counts[group]:,}" for group in self.groups]

    def _shares_text(self, table: CountTable) -> str:
        """Return a row a value that occurs, with its share of each group."""
        rows = []
        for value, counts in table.counts.items():
            if counts[TOTAL]:
                shares = [share_text(counts[group], table.total(group)) for group in self.groups]
                rows.append((value, *shares))
        return columns_text([(table.field, *self.groups), *rows])

    def _lengths_text(self) -> str:
        lengths = self.histograms["lengths"]
        rows = []
        for index, label in enumerate(lengths.bin_labels()):
            rows.append((label, *(str(lengths.counts[group][index]) for group in self.groups)))
        others = ("other", *self._cells(lengths.outside))
        return columns_text([("length in frames", *self.groups), *rows, others])

    def _critical_text(self) -> str:
        """Return shares of labelled scenarios with a moving pair under each time to collision."""
        times = self.histograms[CRITICAL]
        rows = []
        for limit in _TTC_LIMITS_S:
            cells = [f"below {limit:g} s"]
            for group in self.groups:
                critical = sum(times.counts[group][: times.edges.index(limit)])
                labelled = self.scenarios[group] - self.unlabelled[group]
                cells.append(share_text(critical, labelled))
            rows.append(cells)
        return columns_text([("least TTC of moving pairs", *self.groups), *rows])

    def _categories_text(self) -> str:
        """Return a line a category: counts, and medians of size, distance and speed."""
        sizes = self.quantiles["box_sizes"]
        distances = self.quantiles["distance_quantiles"]
        speeds = self.quantiles["speed_quantiles"]
        rows = []
        for category in CATEGORIES:
            medians = [
                sizes.median("length", category),
                sizes.median("width", category),
                sizes.median("height", category),
            ]
            size = [number_text(median, 2) for median in medians]
            cells = (
                category,
                f"{self.counts['instances'].counts[category][TOTAL]:,}",
                f"{self.counts['annotations'].counts[category][TOTAL]:,}",
                " × ".join(size) if size[0] != "–" else "–",
                number_text(distances.median("distance", category), 1),
                number_text(speeds.median("speed", category), 1),
            )
            rows.append(cells)
        heading = (
            "category, medians",
            "instances",
            "annotations",
            "l × w × h (m)",
            "distance (m)",
            "speed (m/s)",
        )
        return columns_text([heading, *rows])
