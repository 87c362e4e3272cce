"""`over_bytes`: headline numbers of evaluations over the bytes that partners send."""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import Annotated, Any, Final

import msgspec

from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.breakdowns import cluster_of
from deepaccident_devkit.evaluation.intervals import Resampling, intervals_of
from deepaccident_devkit.evaluation.runs.bundles import Bundle, read_bundle
from deepaccident_devkit.evaluation.runs.comparison import comparable
from deepaccident_devkit.evaluation.runs.setups import scenario_of
from deepaccident_devkit.evaluation.task import Unit, headlines, value_text
from deepaccident_devkit.support.reports import Report, Row, record_rows
from deepaccident_devkit.support.text import columns_text, counted, path_of
from deepaccident_devkit.taxonomy import FRAME_PERIOD

# Number of headlines that are compared.
_MAX_HEADLINES: Final = 4


class SentBytes(msgspec.Struct, kw_only=True, frozen=True):
    """The bytes that partners send, as noted in results (`v2x.messages.traffic_note`).

    Attributes:
        payload: Kind of data, or the bytes of every message.
        mean: Mean bytes a sample, from all partners together.
        partners: Mean number of partners.
    """

    payload: int | Annotated[str, msgspec.Meta(pattern=r"^[\w +-]{1,40}\Z")]
    mean: Annotated[float, msgspec.Meta(ge=0)]
    partners: Annotated[float, msgspec.Meta(ge=0)]

    def text(self) -> str:
        """Return one line, with the bytes also as a power of 2 and as the load of a radio."""
        power = ""
        if self.mean:
            power = f" (2^{math.log2(self.mean):.1f})"
        megabits = self.mean * 8e-6 / FRAME_PERIOD
        return (
            f"{self.mean:,.0f} a sample{power}, {megabits:,.2f} Mbit/s at 10 Hz, "
            f"{self.partners:.1f} partners, payload {self.payload}"
        )


def sent_bytes(summary: Mapping[str, Any]) -> SentBytes | None:
    """Return the bytes that the results of a summary note; None without a valid note."""
    try:
        return msgspec.convert(summary["results"]["meta"]["bytes"], SentBytes)
    except (LookupError, TypeError, msgspec.ValidationError):
        return None


@dataclass(frozen=True, slots=True, kw_only=True)
class BytesPoint:
    """A headline number of one evaluation.

    Attributes:
        evaluation: Name of its folder, or its path if names repeat; with `(partial)` if it is
            partial.
        bytes: Mean bytes a sample, from all partners together.
        headline: Short name of the number.
        unit: Unit of the number.
        value: The number.
        low: Lower end of its interval; None for no interval.
        high: Upper end.
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
    """Evaluations of the same samples by the same rules.

    Attributes:
        task: Task of all.
        protocol: Protocol of all.
        samples: Number of samples evaluated.
        resampling: How intervals were made.
        points: Points by headline, four at most, and by evaluation in the order of the arguments.
    """

    task: str
    protocol: str
    samples: int
    resampling: Resampling
    points: tuple[BytesPoint, ...]

    def to_text(self) -> str:
        """Return a line for each headline of each evaluation."""
        interval_title = f"{self.resampling.confidence:.0%} interval"
        rows = [("number", "evaluation", "bytes a sample", "value", interval_title)]
        for point in self.points:
            interval = "–"
            if point.low is not None and point.high is not None:
                interval = f"[{point.low:.3f}, {point.high:.3f}]"
            value = value_text(point.value, point.unit)
            rows.append((point.headline, point.evaluation, f"{point.bytes:,.0f}", value, interval))
        head = f"{self.task}, protocol {self.protocol}: {counted(self.samples, 'sample')}"
        return f"{head}\n\n{columns_text(rows, left=2)}"

    def named_tables(self) -> dict[str, list[Row]]:
        """Return a table with a row for each point."""
        return {"numbers": record_rows(BytesPoint, self.points)}


def over_bytes(
    folders: Sequence[str | os.PathLike[str]],
    resampling: Resampling | None = None,
    *,
    common: bool = False,
) -> OverBytes:
    """Return the headlines that all bundles have, over the bytes that partners sent for them.

    Args:
        folders: Folders of the bundles, as written by `save_run`.
        resampling: How intervals are made; None for the defaults.
        common: Whether to use only the samples common to all, if they differ; the bytes stay the
            mean over all samples of a bundle.

    Raises:
        ResultsError: one of them is no bundle.
        EvaluationError: results do not note the bytes; or as in `compare_bundles`.
    """
    bundles = [read_bundle(path_of(folder)) for folder in folders]
    resampling = resampling or Resampling()
    traffic = list(map(_noted_bytes, bundles))
    evaluators, tokens = comparable(bundles, common=common)
    pairs = [(token, cluster_of(scenario_of(token))) for token in tokens]
    clusters = dict(sorted(pairs, key=itemgetter(1)))
    folder_names = [bundle.folder.name for bundle in bundles]
    points = list[BytesPoint]()
    for bundle, sent, evaluator in zip(bundles, traffic, evaluators, strict=True):
        name = bundle.folder.name
        label = name if folder_names.count(name) == 1 else str(bundle.folder)
        if bundle.summary["partial"]:
            label += " (partial)"
        result = evaluator.compute(tokens)
        intervals = intervals_of(evaluator, evaluator.clustered(clusters), result, resampling)
        points += _points(label, sent, result, intervals.ends)
    shared = [
        name
        for name, count in Counter(point.headline for point in points).items()
        if count == len(bundles)
    ]
    shared_points = []
    for headline in shared[:_MAX_HEADLINES]:
        shared_points += [point for point in points if point.headline == headline]
    return OverBytes(
        task=bundles[0].setup.task,
        protocol=bundles[0].setup.protocol,
        samples=len(tokens),
        resampling=resampling,
        points=tuple(shared_points),
    )


def _noted_bytes(bundle: Bundle) -> SentBytes:
    """Return the bytes that the results of a bundle note; raises EvaluationError."""
    sent = sent_bytes(bundle.summary)
    if sent is None:
        raise EvaluationError(
            f"{bundle.folder}: its results do not note how many bytes partners send; predict "
            "again into a new folder (deepaccident predict … --out), and evaluate those results"
        )
    return sent


def _points(
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
