"""`over_bytes`: headline numbers of evaluations, plotted over the bytes that partners send."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from operator import itemgetter
from typing import Annotated, Any

import msgspec

from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.breakdowns import cluster_of
from deepaccident_devkit.evaluation.intervals import Resampling, intervals_of
from deepaccident_devkit.evaluation.runs.bundles import Bundle, read_bundle
from deepaccident_devkit.evaluation.runs.comparison import comparable
from deepaccident_devkit.evaluation.runs.setups import scenario_of
from deepaccident_devkit.evaluation.task import Unit, headlines, value_text
from deepaccident_devkit.support.human_names import metric_name, rules_name
from deepaccident_devkit.support.reports import Report, Row, record_rows
from deepaccident_devkit.support.text import (
    PathType,
    columns_text,
    counted,
    distinct_names,
    interval_text,
    path_of,
)
from deepaccident_devkit.support.values import ReadOnlyValues
from deepaccident_devkit.taxonomy import FRAME_PERIOD

# Largest number of headlines that are compared.
_MAX_HEADLINES = 4


class SentBytes(msgspec.Struct, kw_only=True, frozen=True):
    """How many bytes partners send, as stated in results (`v2x.messages.traffic_note`).

    Attributes:
        payload: Kind of data, or the size of every message in bytes.
        mean: Mean number of bytes per sample, summed over all partners.
        partners: Mean number of partners.
    """

    payload: int | Annotated[str, msgspec.Meta(pattern=r"^[\w +-]{1,40}\Z")]
    mean: Annotated[float, msgspec.Meta(ge=0)]
    partners: Annotated[float, msgspec.Meta(ge=0)]

    def text(self) -> str:
        """Format the bytes in one line, also as a power of 2 and as the load of a radio link."""
        if not self.mean:
            return "none"
        megabits = self.mean * 8e-6 / FRAME_PERIOD
        return (
            f"{self.mean:,.0f} bytes per sample (2^{math.log2(self.mean):.1f}), {megabits:,.2f} "
            f"Mbit/s at 10 Hz, {self.partners:.1f} partners, payload {self.payload}"
        )


def sent_bytes(summary: ReadOnlyValues) -> SentBytes | None:
    """Return the bytes that the notes of a summary's results state; None if they state none."""
    try:
        return msgspec.convert(summary["results"]["meta"]["bytes"], SentBytes)
    except (LookupError, TypeError, msgspec.ValidationError):
        return None


@dataclass(frozen=True, slots=True, kw_only=True)
class BytesPoint:
    """A headline number of one evaluation.

    Attributes:
        evaluation: Part of the folder's path in which the evaluations differ, followed by
            `(partial)` if the evaluation is partial.
        bytes: Mean number of bytes per sample, summed over all partners.
        headline: Short name of the number.
        unit: Unit of the number.
        value: The number.
        low: Lower end of the interval; None if there is no interval.
        high: Upper end of the interval; None if there is no interval.
    """

    evaluation: str
    bytes: float
    headline: str
    unit: Unit
    value: float
    low: float | None
    high: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class OverBytes(Report):
    """Headline numbers of evaluations that use the same samples and rules.

    Attributes:
        task: Task of all evaluations.
        protocol: Protocol of all evaluations.
        samples: Number of evaluated samples.
        resampling: Settings of the intervals.
        points: Points ordered by headline (four at most), then by evaluation, as they were passed.
    """

    task: str
    protocol: str
    samples: int
    resampling: Resampling
    points: tuple[BytesPoint, ...]

    def to_text(self) -> str:
        """Format one line for each headline of each evaluation."""
        interval_title = f"{100 * self.resampling.confidence:.0f} % interval"
        rows = [("number", "evaluation", "bytes per sample", "value", interval_title)]
        for point in self.points:
            interval = interval_text(point.low, point.high)
            value = value_text(point.value, point.unit)
            name = metric_name(point.headline)
            rows.append((name, point.evaluation, f"{point.bytes:,.0f}", value, interval))
        head = f"{rules_name(self.task, self.protocol)}; {counted(self.samples, 'sample')}"
        return f"{head}\n\n{columns_text(rows, left=2)}"

    def named_tables(self) -> dict[str, list[Row]]:
        """Return a single table with one row per point."""
        return {"numbers": record_rows(BytesPoint, self.points)}


def over_bytes(
    folders: Sequence[PathType],
    resampling: Resampling | None = None,
    *,
    common: bool = False,
) -> OverBytes:
    """Collect the headlines that all bundles have, with the bytes that partners sent for them.

    Args:
        folders: Folders of the bundles, as written by `save_run`.
        resampling: Settings of the intervals; None for the defaults.
        common: Whether to use only the common samples if the samples of the bundles differ; bytes
            are still averaged over all samples of a bundle.

    Raises:
        ResultsError: If one of the folders does not contain a bundle.
        EvaluationError: If results do not state the bytes, or the bundles cannot be compared (see
            `compare_bundles`).
    """
    bundles = [read_bundle(path_of(folder)) for folder in folders]
    resampling = resampling or Resampling()
    traffic = list(map(_noted_bytes, bundles))
    evaluators, tokens = comparable(bundles, common=common)
    token_clusters = [(token, cluster_of(scenario_of(token))) for token in tokens]
    cluster_by_token = dict(sorted(token_clusters, key=itemgetter(1)))
    names = distinct_names([bundle.folder for bundle in bundles])
    points_by_headline: dict[str, list[BytesPoint]] = {}
    for name, bundle, sent, evaluator in zip(names, bundles, traffic, evaluators, strict=True):
        label = f"{name} (partial)" if bundle.summary["partial"] else name
        result = evaluator.compute(tokens)
        clusters = evaluator.clustered(cluster_by_token)
        intervals = intervals_of(evaluator, clusters, result, resampling)
        for point in _make_points(label, sent, result, intervals.ends):
            points_by_headline.setdefault(point.headline, []).append(point)
    shared = [points for points in points_by_headline.values() if len(points) == len(bundles)]
    shared_points = chain.from_iterable(shared[:_MAX_HEADLINES])
    return OverBytes(
        task=bundles[0].setup.task,
        protocol=bundles[0].setup.protocol,
        samples=len(tokens),
        resampling=resampling,
        points=tuple(shared_points),
    )


def _noted_bytes(bundle: Bundle) -> SentBytes:
    """Return the bytes that a bundle's results state; raise EvaluationError if they do not."""
    sent = sent_bytes(bundle.summary)
    if sent is None:
        raise EvaluationError(
            f"{bundle.folder}: its results do not note how many bytes partners send; predict "
            "again into a new folder (deepaccident predict … --out), and evaluate those results"
        )
    return sent


def _make_points(
    evaluation: str,
    sent: SentBytes,
    result: Any,
    ends: Mapping[str, tuple[float | None, float | None]],
) -> Iterator[BytesPoint]:
    """Yield a point for each headline of a result that has a value."""
    for headline in headlines(result):
        if headline.value is None:
            continue
        low, high = ends.get(headline.path, (None, None))
        yield BytesPoint(
            evaluation=evaluation,
            bytes=sent.mean,
            headline=headline.name,
            unit=headline.unit,
            value=headline.value,
            low=low,
            high=high,
        )
