"""`over_bytes`: headline numbers of evaluations over the bytes that partners send, which their results note."""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import Annotated, Any

import msgspec

from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.breakdowns import cluster_of
from deepaccident_devkit.evaluation.intervals import Resampling, intervals_of
from deepaccident_devkit.evaluation.runs.bundles import read_bundle
from deepaccident_devkit.evaluation.runs.comparison import comparable
from deepaccident_devkit.evaluation.runs.setups import scenario_of
from deepaccident_devkit.evaluation.task import Unit, headlines, value_text
from deepaccident_devkit.support.reports import Report, Row, record_rows
from deepaccident_devkit.support.text import columns_text, counted, path_of
from deepaccident_devkit.taxonomy import FRAME_PERIOD


class SentBytes(msgspec.Struct, kw_only=True, frozen=True):
    """What partners send, by the notes of results (`v2x.messages.traffic_note`).

    Attributes:
        payload: the kind of data, or the bytes of every message.
        mean: bytes a sample, from all partners together.
        partners: how many they are, on average.
    """

    payload: int | Annotated[str, msgspec.Meta(pattern=r"^[\w +-]{1,40}\Z")]
    mean: Annotated[float, msgspec.Meta(ge=0)]
    partners: Annotated[float, msgspec.Meta(ge=0)]

    def text(self) -> str:
        """In a line; also as a power of 2, and as what a radio has to carry."""
        return (
            f"{self.mean:,.0f} a sample"
            + (f" (2^{math.log2(self.mean):.1f})" if self.mean else "")
            + f", {self.mean * 8e-6 / FRAME_PERIOD:,.2f} Mbit/s at 10 Hz, {self.partners:.1f} partners"
            + f", payload {self.payload}"
        )


def sent_bytes(summary: Mapping[str, Any]) -> SentBytes | None:
    """What the results of an evaluation note, by its summary; None if they note nothing, or something else."""
    try:
        return msgspec.convert(summary["results"]["meta"]["bytes"], SentBytes)
    except (LookupError, TypeError, msgspec.ValidationError):
        return None


@dataclass(frozen=True, slots=True, kw_only=True)
class BytesPoint:
    """A headline number of one evaluation.

    Attributes:
        evaluation: its folder, by its name where that is enough; `(partial)` where it is.
        bytes: a sample, from all partners together.
        headline: the number's short name.
        unit: of the number.
        value: of the number.
        low: where its interval begins; None for no interval.
        high: where it ends.
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
        task: of all.
        protocol: of all.
        samples: evaluated.
        resampling: how intervals were made.
        points: by headline, four at most, and by evaluation, as they were given.
    """

    task: str
    protocol: str
    samples: int
    resampling: Resampling
    points: tuple[BytesPoint, ...]

    def to_text(self) -> str:
        """A line for each headline of each evaluation."""
        rows = [
            (
                "number",
                "evaluation",
                "bytes a sample",
                "value",
                f"{self.resampling.confidence:.0%} interval",
            ),
            *(
                (
                    each.headline,
                    each.evaluation,
                    f"{each.bytes:,.0f}",
                    value_text(each.value, each.unit),
                    "–"
                    if each.low is None or each.high is None
                    else f"[{each.low:.3f}, {each.high:.3f}]",
                )
                for each in self.points
            ),
        ]
        head = f"{self.task}, protocol {self.protocol}: {counted(self.samples, 'sample')}"
        return f"{head}\n\n{columns_text(rows, left=2)}"

    def named_tables(self) -> dict[str, list[Row]]:
        """A line a point."""
        return {"numbers": record_rows(BytesPoint, self.points)}


def over_bytes(
    folders: Sequence[str | os.PathLike[str]],
    resampling: Resampling | None = None,
    *,
    common: bool = False,
) -> OverBytes:
    """The headlines that all of some bundles have, over the bytes that partners sent for them.

    Args:
        folders: of the bundles, as `save_run` writes them.
        resampling: how intervals are made; None for the defaults.
        common: whether to take only the samples that all have, if they differ; bytes stay those of all.

    Raises:
        ResultsError: one of them is no bundle.
        EvaluationError: results do not note the bytes; or as of `compare_bundles`.
    """
    bundles, chosen = (
        [read_bundle(path_of(folder)) for folder in folders],
        resampling or Resampling(),
    )
    sent = [each for bundle in bundles if (each := sent_bytes(bundle.summary))]
    if len(sent) < len(bundles):
        raise EvaluationError(
            f"{next(bundle.folder for bundle in bundles if sent_bytes(bundle.summary) is None)}: its results do not "
            "note how many bytes partners send; predict again into a new folder (deepaccident predict … --out), and "
            "evaluate those results"
        )
    runs, tokens = comparable(bundles, common=common)
    task, points = bundles[0].setup.task, list[BytesPoint]()
    clusters = dict(
        sorted(((token, cluster_of(scenario_of(token))) for token in tokens), key=itemgetter(1))
    )
    names = [bundle.folder.name for bundle in bundles]
    for name, bundle, by, run in zip(names, bundles, sent, runs, strict=True):
        result = run.compute(tokens)
        ends = intervals_of(run, run.clustered(clusters), result, chosen).ends
        points += [
            BytesPoint(
                evaluation=f"{name if names.count(name) == 1 else bundle.folder}"
                f"{' (partial)' * bool(bundle.summary['partial'])}",
                bytes=by.mean,
                headline=each.name,
                unit=each.unit,
                value=each.value,
                low=ends[each.path][0] if each.path in ends else None,
                high=ends[each.path][1] if each.path in ends else None,
            )
            for each in headlines(result)
            if each.value is not None
        ]
    shown = [
        name
        for name, count in Counter(each.headline for each in points).items()
        if count == len(bundles)
    ]
    return OverBytes(
        task=task,
        protocol=bundles[0].setup.protocol,
        samples=len(tokens),
        resampling=chosen,
        points=tuple(
            each for headline in shown[:4] for each in points if each.headline == headline
        ),
    )
