"""The conditions that the study of V2X compares: who cooperates, how far ahead, and over which link."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

from deepaccident_devkit.v2x import AGENT_CONFIGS, Link

HORIZONS: Final = (2.0, 3.0, 4.0)
"""Seconds, as the paper has them."""
POSE_NOISES: Final = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)
"""Metres, means of the law `paper`."""
LATENCIES: Final = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)
"""Seconds."""
LINKED: Final = ("+infrastructure", "all")
"""The configurations whose link is studied."""
_QUICK_HORIZONS: Final = (2.0, 4.0)
_QUICK_STEPS: Final = (0.0, 0.2, 0.5)


@dataclass(frozen=True, slots=True, kw_only=True)
class Condition:
    """What the study's tables distinguish.

    Attributes:
        agents: name of the configuration, of `v2x.AGENT_CONFIGS`.
        horizon: seconds that are looked ahead, and before the end from which samples are.
        pose_noise: metres, mean of the law `paper`; 0 for none.
        latency: seconds.
    """

    agents: str
    horizon: float = HORIZONS[0]
    pose_noise: float = 0.0
    latency: float = 0.0

    def link(self, seed: int) -> Link | None:
        """The link between the agents; None for a perfect one."""
        if not (self.pose_noise or self.latency):
            return None
        return Link(latency=self.latency, pose_noise=self.pose_noise or None, seed=seed)

    @property
    def base(self) -> Condition:
        """What it is compared with: the same agents with a perfect link; of these, a single vehicle."""
        if self.pose_noise or self.latency:
            return replace(self, pose_noise=0.0, latency=0.0)
        return replace(self, agents="single")

    def seeds(self, wanted: Sequence[int]) -> Sequence[int]:
        """The seeds that are needed: without noise nothing is drawn, so that one is enough."""
        return wanted if self.pose_noise else wanted[:1]


@dataclass(frozen=True, slots=True, kw_only=True)
class TablePlan:
    """A table of the study.

    Attributes:
        name: also of its files.
        title: for people.
        varied: which fields of the conditions differ beside the agents.
        by: the attributes by which its samples are split, one after the other; `all` for all of them together.
        conditions: in the order of its rows.
    """

    name: str
    title: str
    varied: tuple[str, ...]
    by: tuple[str, ...]
    conditions: tuple[Condition, ...]


def study_plan(agents: Sequence[str] = tuple(AGENT_CONFIGS), *, quick: bool = False) -> list[TablePlan]:
    """The tables of the study.

    Args:
        agents: names of the configurations that are there.
        quick: leave out a horizon and every other step of noise and latency.
    """
    noises, latencies = (_QUICK_STEPS, _QUICK_STEPS) if quick else (POSE_NOISES, LATENCIES)
    perfect = tuple(Condition(agents=name) for name in agents)
    linked = [each for each in perfect if each.agents in LINKED]
    horizons = _QUICK_HORIZONS if quick else HORIZONS
    far = tuple(replace(each, horizon=horizon) for horizon in horizons for each in perfect)
    noisy = tuple(replace(each, pose_noise=noise) for each in linked for noise in noises)
    late = tuple(replace(each, latency=latency) for each in linked for latency in latencies)
    plans = [
        TablePlan(name="configurations", title="Who cooperates", varied=(), by=("all",), conditions=perfect),
        TablePlan(
            name="visibility",
            title="By whether the ego itself sees the accident come",
            varied=(),
            by=("accident_visibility",),
            conditions=perfect,
        ),
        TablePlan(
            name="horizons",
            title="By seconds looked ahead and seconds to the impact",
            varied=("horizon",),
            by=("all", "time_to_impact"),
            conditions=far,
        ),
        TablePlan(
            name="pose_noise",
            title="By wrong poses of the partners",
            varied=("pose_noise",),
            by=("all",),
            conditions=noisy,
        ),
        TablePlan(
            name="latency", title="By late data of the partners", varied=("latency",), by=("all",), conditions=late
        ),
    ]
    return [plan for plan in plans if plan.conditions]
