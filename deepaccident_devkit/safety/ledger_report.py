"""`LeadTimeLedger`: the lead times of many accidents as means with intervals, text, JSON and CSV."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np

from deepaccident_devkit.arrays import FloatArray, ShortRepr
from deepaccident_devkit.files import writable_folder
from deepaccident_devkit.safety.accidents import Skipped
from deepaccident_devkit.safety.lead_times import COALITIONS, EGO, PARTNERS, LeadTimes
from deepaccident_devkit.safety.observation import ObservationRule
from deepaccident_devkit.safety.tables import short_agent, write_csv
from deepaccident_devkit.text import columns_text

CAVEAT: Final = "Observation bounds warning from above; it is no prediction."
_RESAMPLES: Final = 2000
_CONFIDENCE: Final = 0.95
_FEWEST: Final = 6
"""Accidents of which a mean has an interval."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MeanTime:
    """A mean over accidents.

    Attributes:
        mean: seconds; None of no accident.
        low: end of the interval of 95 % by the bootstrap over accidents; None of fewer than six.
        high: its other end.
        accidents: of how many.
    """

    mean: float | None
    low: float | None
    high: float | None
    accidents: int

    @property
    def text(self) -> str:
        """Such as `1.52 [1.20, 1.86]`."""
        if self.mean is None:
            return "–"
        return f"{self.mean:.2f}" + ("" if self.low is None else f" [{self.low:.2f}, {self.high:.2f}]")


@dataclass(frozen=True, kw_only=True)
class LeadTimeLedger(ShortRepr):
    """The lead times of the accidents of a release, or of some of its scenarios.

    Attributes:
        dataroot: the release's folder.
        version: `v1` or `v1-mini`.
        rule: when an actor counts as observed.
        accidents: in the order of the release.
        skipped: scenarios of which the lead times cannot be told, and why.
        without_accident: scenarios whose meta file names no collision.
    """

    dataroot: str
    version: str
    rule: ObservationRule
    accidents: tuple[LeadTimes, ...]
    skipped: tuple[Skipped, ...]
    without_accident: int

    @cached_property
    def mean_leads(self) -> tuple[MeanTime, ...]:
        """Of each of `COALITIONS`, the mean lead time; accidents without one of its agents do not count."""
        return mean_times(np.array([each.leads for each in self.accidents]).reshape(-1, len(COALITIONS)))

    @cached_property
    def mean_gains(self) -> tuple[MeanTime, ...]:
        """Of each of `PARTNERS`, the mean of what it adds to the ego alone."""
        return mean_times(np.array([each.gains for each in self.accidents]).reshape(-1, len(PARTNERS)))

    @cached_property
    def mean_losses(self) -> tuple[MeanTime, ...]:
        """Of each of `PARTNERS`, the mean of what all agents lose without it."""
        return mean_times(np.array([each.losses for each in self.accidents]).reshape(-1, len(PARTNERS)))

    @cached_property
    def mean_shapley(self) -> tuple[MeanTime, ...]:
        """Of each of `PARTNERS`, its mean Shapley value."""
        return mean_times(np.array([each.shapley for each in self.accidents]).reshape(-1, len(PARTNERS)))

    @property
    def mean_together(self) -> MeanTime:
        """Of all agents that each accident has."""
        return mean_times(np.array([each.together for each in self.accidents]).reshape(-1, 1))[0]

    @property
    def share_never_alone(self) -> float | None:
        """Share of the accidents whose colliders the ego alone never observes at the same frame; None of none."""
        return _share([each.never_alone for each in self.accidents])

    @property
    def share_never_together(self) -> float | None:
        """The same of all agents together."""
        return _share([each.never_together for each in self.accidents])

    @property
    def share_from_the_start(self) -> float | None:
        """Share of the accidents that all agents observe from the first frame on, so that more may have been cut."""
        return _share([each.from_the_start for each in self.accidents])

    def to_dict(self) -> dict[str, Any]:
        """For JSON; None for what is not known."""
        names = ["+".join(members) for members in COALITIONS]
        return {
            "dataroot": self.dataroot,
            "version": self.version,
            "rule": asdict(self.rule),
            "caveat": CAVEAT,
            "summary": {
                "accidents": len(self.accidents),
                "ego_collides": sum(each.ego_collides for each in self.accidents),
                "with_missing_agents": sum(bool(each.missing) for each in self.accidents),
                "skipped": len(self.skipped),
                "without_accident": self.without_accident,
                "share_never_alone": self.share_never_alone,
                "share_never_together": self.share_never_together,
                "share_from_the_start": self.share_from_the_start,
                "together": asdict(self.mean_together),
                "lead_seconds": _by_name(names, self.mean_leads),
                "gain_seconds": _by_name(PARTNERS, self.mean_gains),
                "loss_seconds": _by_name(PARTNERS, self.mean_losses),
                "shapley_seconds": _by_name(PARTNERS, self.mean_shapley),
            },
            "accidents": [each.to_dict() for each in self.accidents],
            "skipped": [asdict(each) for each in self.skipped],
        }

    def to_json(self) -> str:
        """One JSON object."""
        return json.dumps(self.to_dict(), indent=2, ensure_ascii=False)

    def to_csv(self, folder: str | os.PathLike[str]) -> list[Path]:
        """Write `lead_times.csv`, a row an accident, and `skipped.csv` into a folder, over those that are there.

        Seconds have all their digits; a cell is empty where nothing is known.

        Raises:
            ConfigError: `folder` cannot be written to, or is not one.
        """
        folder = writable_folder(folder)
        skipped = ((each.scenario, each.reason) for each in self.skipped)
        return [
            write_csv(folder / "lead_times.csv", [_CSV_HEADING, *map(_csv_row, self.accidents)]),
            write_csv(folder / "skipped.csv", [("scenario", "reason"), *skipped]),
        ]

    def to_text(self) -> str:
        """A table of the accidents and of their means, for a terminal."""
        counts = (
            f"{len(self.accidents)} accidents, {sum(each.ego_collides for each in self.accidents)} of them with {EGO} "
            f"among the colliders; {self.without_accident} scenarios without an accident; {len(self.skipped)} skipped"
        )
        head = f"Lead times: DeepAccident {self.version} at {self.dataroot}\nobserved: {self.rule.text}\n{counts}"
        blocks = [f"{head}\n{CAVEAT}"]
        if self.accidents:
            blocks += [self._accidents_text(), self._means_text()]
        if self.skipped:
            blocks.append("\n".join(["skipped:", *(f"  {each.reason}" for each in self.skipped)]))
        return "\n\n".join(blocks)

    def _accidents_text(self) -> str:
        heading = ("seconds before the impact", "ego alone", *(f"+ {short_agent(name)}" for name in PARTNERS), "all")
        rows = [
            (
                each.scenario,
                _lead_text(each.alone, never=each.never_alone),
                *(_gain_text(*pair) for pair in zip(each.gains.tolist(), each.shapley.tolist(), strict=True)),
                _lead_text(each.together, never=each.never_together) + "*" * bool(each.missing),
            )
            for each in self.accidents
        ]
        notes = [
            "+: what the partner alone adds to the ego, and in brackets its Shapley value",
            "never: the colliders are not observed at the same frame",
        ]
        if any(each.missing for each in self.accidents):
            notes.append("*: of the agents that are there; – for the missing ones")
        return "\n".join([columns_text([heading, *rows]), *notes])

    def _means_text(self) -> str:
        means = zip(PARTNERS, self.mean_gains, self.mean_losses, self.mean_shapley, strict=True)
        rows = [(short_agent(name), *(mean.text for mean in each)) for name, *each in means]
        alone, together = self.mean_leads[0].text, self.mean_together.text
        start = "observed by all agents from the first frame on, so that the lead may be longer than the recording: "
        never = f"never observed together: by the ego alone {_percent(self.share_never_alone)}, by all agents "
        return "\n".join(
            [
                "means in seconds [interval of 95 %, bootstrap over accidents]",
                columns_text([("partner", "adds to the ego", "all lose without", "Shapley value"), *rows]),
                f"lead time: the ego alone {alone}, all agents {together}",
                f"{never}{_percent(self.share_never_together)} of the accidents",
                f"{start}{_percent(self.share_from_the_start)}",
            ]
        )


def mean_times(values: FloatArray) -> tuple[MeanTime, ...]:
    """The mean of each column of (N, K) seconds over accidents, NaN for unknown, with its bootstrap interval.

    The same accidents are taken for all columns, `_RESAMPLES` times, always by the same random numbers.
    """
    count = len(values)
    known = np.isfinite(values)
    if not count:
        return tuple(MeanTime(mean=None, low=None, high=None, accidents=0) for _ in range(values.shape[1]))
    times = np.random.default_rng(0).multinomial(count, np.full(count, 1 / count), size=_RESAMPLES).astype(np.float64)
    with np.errstate(invalid="ignore"):
        drawn = times @ np.where(known, values, 0) / (times @ known)
    return tuple(_mean_time(values[known[:, at], at], drawn[:, at]) for at in range(values.shape[1]))


def _mean_time(values: FloatArray, drawn: FloatArray) -> MeanTime:
    ends: Sequence[float | None] = (None, None)
    if len(values) >= _FEWEST:
        tail = (1 - _CONFIDENCE) / 2
        ends = np.nanquantile(drawn, (tail, 1 - tail)).tolist()
    mean = math.fsum(values.tolist()) / len(values) if len(values) else None
    return MeanTime(mean=mean, low=ends[0], high=ends[1], accidents=len(values))


_OF_ACCIDENT: Final = (
    "scenario",
    "actor_ids",
    "categories",
    "colliding_agents",
    "ego_collides",
    "missing",
    "num_frames",
)
_CSV_HEADING: Final = (
    *_OF_ACCIDENT,
    *(f"lead_{'+'.join(members)}" for members in COALITIONS),
    *(f"first_frame_{'+'.join(members)}" for members in COALITIONS),
    *(f"shapley_{name}" for name in PARTNERS),
)


def _csv_row(times: LeadTimes) -> list[Any]:
    told = times.to_dict()
    lists = ("actor_ids", "categories", "colliding_agents", "missing")
    words = {name: " ".join("none" if each is None else str(each) for each in told[name]) for name in lists}
    return [
        *({**told, **words}[name] for name in _OF_ACCIDENT),
        *told["lead_seconds"].values(),
        *told["first_frames"].values(),
        *told["shapley_seconds"].values(),
    ]


def _by_name(names: Sequence[str], means: Sequence[MeanTime]) -> dict[str, Any]:
    return {name: asdict(mean) for name, mean in zip(names, means, strict=True)}


def _share(truths: Sequence[bool]) -> float | None:
    return sum(truths) / len(truths) if truths else None


def _percent(share: float | None) -> str:
    return "–" if share is None else f"{round(100 * share)} %"


def _gain_text(gain: float, shapley: float) -> str:
    return "–" if math.isnan(gain) else f"{gain:.1f} ({shapley:.2f})"


def _lead_text(lead: float, *, never: bool) -> str:
    return "never" if never else f"{lead:.1f}"
