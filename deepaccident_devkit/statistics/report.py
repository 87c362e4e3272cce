"""All statistics of a release in one object, which can be written as JSON, CSV and text."""

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
from deepaccident_devkit.support.human_names import human_name
from deepaccident_devkit.support.reports import Report
from deepaccident_devkit.support.text import columns_text, counted, number_text, share_text
from deepaccident_devkit.taxonomy import CATEGORIES

# Edges of the histogram of smallest times to collision.
_TTC_LIMITS_S = (0.5, 1.0, 1.5, 3.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class DatasetStatistics(Report):
    """The statistics of a release, or of some of its scenarios; the groups are `GROUPS`.

    Attributes:
        dataroot: Folder of the release.
        version: `v1` or `v1-mini`.
        release_scenarios: Number of scenarios in the release, selected or not.
        selected: Whether the statistics cover only selected scenarios.
        scenarios: Group → number of scenarios.
        frames: Group → number of frames.
        samples: Group → number of samples (one agent in one frame).
        unlabelled: Group → number of scenarios without labels, counted only where none are needed.
        counts: Name → table of counts.
        histograms: Name → histogram.
        quantiles: Name → table of quantiles.
        collisions: Colliding pairs in the last frame.
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
        quantiles = self.quantiles.values()
        return (*counts, *histograms, *quantiles)

    @property
    def groups(self) -> tuple[str, ...]:
        """The total, and the groups that contain a scenario."""
        split_groups = [group for group in GROUPS[1:] if self.scenarios[group]]
        return (TOTAL, *split_groups)

    def to_dict(self) -> dict[str, Any]:
        """Return a dictionary for JSON, with None for missing values."""
        return {**asdict(self), "probabilities": PROBABILITIES}

    def named_tables(self) -> dict[str, Iterable[StatisticsRow]]:
        """Return all tables, and the table of colliding pairs."""
        tables = {table.name: table.rows() for table in self.tables}
        return {**tables, "collision_pairs": collision_rows(self.collisions)}

    def to_text(self) -> str:
        """Return the statistics as aligned blocks for a terminal.

        They list the attributes of scenarios (without zeros), each category, and what is left out.
        """
        head = f"DeepAccident {self.version} at {self.dataroot}"
        if self.selected:
            count = self.scenarios[TOTAL]
            head += f"\nselected: {count} of {counted(self.release_scenarios, 'scenario')}"
            if not count:
                return f"{head}\nno scenario matches the filters, so there is nothing to count"
            head += "; all counts cover only these"
        sums = {"scenarios": self.scenarios, "frames": self.frames, "samples": self.samples}
        sum_rows = [(word, *self._group_cells(counts)) for word, counts in sums.items()]
        blocks = [head, columns_text([("", *self.groups), *sum_rows])]
        for table in self.counts.values():
            if table.counted == "scenarios":
                blocks.append(self._shares_text(table))
        blocks += [self._lengths_text(), self._categories_text()]
        if CRITICAL in self.histograms:
            blocks.append(self._critical_text())
        left_out = self._left_out_lines()
        if left_out:
            blocks.append("\n".join(["excluded, because a value is missing:", *left_out]))
        return "\n\n".join(blocks)

    def _left_out_lines(self) -> list[str]:
        """Return a line for each kind of item that a table leaves out, sorted."""
        lines = set()
        for table in self.tables:
            left_out = table.left_out
            if left_out and left_out.counts[TOTAL]:
                lines.add(f"{left_out.counts[TOTAL]:,} {left_out.what}")
        return sorted(lines)

    def _group_cells(self, counts: Mapping[str, int]) -> list[str]:
        return [f"{counts[group]:,}" for group in self.groups]

    def _shares_text(self, table: CountTable) -> str:
        """Return a row for each value that occurs, with its share in each group."""
        rows = []
        for value, counts in table.counts.items():
            if counts[TOTAL]:
                shares = [share_text(counts[group], table.total(group)) for group in self.groups]
                rows.append((human_name(value), *shares))
        return columns_text([(human_name(table.field, "attributes"), *self.groups), *rows])

    def _lengths_text(self) -> str:
        lengths = self.histograms["lengths"]
        rows = []
        for index, label in enumerate(lengths.bin_labels()):
            counts = [str(lengths.counts[group][index]) for group in self.groups]
            rows.append((label, *counts))
        outside_cells = ("other", *self._group_cells(lengths.outside))
        return columns_text([("length in frames", *self.groups), *rows, outside_cells])

    def _critical_text(self) -> str:
        """Return how many labelled scenarios have a moving pair below each time to collision.

        The numbers are shares of the scenarios.
        """
        times = self.histograms[CRITICAL]
        rows = []
        for limit in _TTC_LIMITS_S:
            cells = [f"below {limit:g} s"]
            for group in self.groups:
                critical = sum(times.counts[group][: times.edges.index(limit)])
                labelled = self.scenarios[group] - self.unlabelled[group]
                cells.append(share_text(critical, labelled))
            rows.append(cells)
        return columns_text([("min. TTC of moving pairs", *self.groups), *rows])

    def _categories_text(self) -> str:
        """Return a row per category: counts, and the median size, distance and speed."""
        sizes = self.quantiles["box_sizes"]
        distances = self.quantiles["distance_quantiles"]
        speeds = self.quantiles["speed_quantiles"]
        instances = self.counts["instances"].counts
        annotations = self.counts["annotations"].counts
        rows = []
        for category in CATEGORIES:
            medians = []
            for field in ("length", "width", "height"):
                medians.append(number_text(sizes.median(field, category), 2))
            size = "–"
            if medians[0] != "–":
                size = " × ".join(medians)
            cells = (
                category,
                f"{instances[category][TOTAL]:,}",
                f"{annotations[category][TOTAL]:,}",
                size,
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
