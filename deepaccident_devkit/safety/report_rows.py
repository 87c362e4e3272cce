"""`AccidentRow`: an accident as a row of the safety report, for people, JSON and CSV."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

from deepaccident_devkit.arrays import ShortRepr
from deepaccident_devkit.interactions import InteractionConfig, InteractionPairs
from deepaccident_devkit.safety.avoidability import BRAKERS, Avoidability
from deepaccident_devkit.safety.lead_times import LeadTimes
from deepaccident_devkit.safety.outcomes import BRAKINGS
from deepaccident_devkit.safety.stories import Story
from deepaccident_devkit.safety.twin_diff import TwinDiff
from deepaccident_devkit.taxonomy import AGENTS

CRITICAL: Final = InteractionConfig().taus[0]
"""Seconds: the time to collision under which a pair counts as exposed."""
DECELERATIONS: Final = tuple(sorted({each.deceleration for each in BRAKINGS}))
"""m/s² of the last moments to brake."""
_SIDES: Final = ("first", "second")
_OF_COLLIDERS: Final = ("actor_id", "category", "agent", "turn", "speed", "side", "delta_v")
ROW_HEADING: Final = (
    "scenario",
    *(f"{side}_{name}" for side in _SIDES for name in _OF_COLLIDERS),
    *("gap", "closing_speed", "impact_angle", "margin", "head_on", "time_exposed", "pet"),
    *(f"lead_{agent}" for agent in AGENTS),
    "lead_all",
    "brakes",
    *(f"last_moment_{deceleration:g}" for deceleration in DECELERATIONS),
    *("twin", "twin_parts"),
    "story",
)
"""Columns of the CSV file."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PairMeasures:
    """Measures of the colliders over the recording; None for what is not known.

    Their least time to collision is left out: it is 0 where they touch.

    Attributes:
        time_exposed: seconds with a time to collision of at most `CRITICAL`.
        pet: post-encroachment time, seconds; 0 if their boxes touch.
    """

    time_exposed: float | None
    pet: float | None

    @classmethod
    def of(cls, pairs: InteractionPairs, first: int, second: int) -> PairMeasures | None:
        """Those of two actors in `interactions(…).pairs`; None if they never come under a threshold there."""
        at = pairs.position(first, second)
        return None if at is None else cls(time_exposed=_known(pairs.tet[at, 0]), pet=_known(abs(pairs.pet[at])))


@dataclass(frozen=True, slots=True, kw_only=True)
class AccidentRow(ShortRepr):
    """An accident.

    Attributes:
        story: its facts, and sentences of them.
        replayed: until when braking would have avoided it; None if the recording does not show it.
        times: how long before the impact sets of agents observed both; None if there are no labels of the ego.
        twin: where it parts from its twin; None without one.
        measures: of the colliders over the recording.
    """

    story: Story
    replayed: Avoidability | None
    times: LeadTimes | None
    twin: TwinDiff | None
    measures: PairMeasures | None

    @property
    def scenario(self) -> str:
        """Token."""
        return str(self.story.facts["scenario"])

    @property
    def colliders(self) -> list[dict[str, Any]]:
        """The two as the story's facts tell them."""
        return list(self.story.facts["accident"]["pair"])

    @property
    def severity(self) -> float:
        """The larger delta-v of the two, m/s; −1 if none is known."""
        return max((each["delta_v"] for each in self.colliders if each["delta_v"] is not None), default=-1.0)

    @property
    def leads(self) -> dict[str, float | None]:
        """Agent → seconds before the impact at which it alone first observes both; then `all`. None: not there."""
        seen = self.story.facts["accident"]["seen"]
        together = None if self.times is None else round(self.times.together, 1)
        return {**{agent: seen.get(agent) for agent in AGENTS}, "all": together}

    @property
    def brakes(self) -> list[str | None]:
        """Who brakes in `last_moments`: the ego alone if it collides, both else; None for one that is no agent."""
        braking = self.story.facts["accident"]["braking"]
        return [] if braking is None else list(braking["by"])

    @property
    def last_moments(self) -> dict[float, float | None]:
        """Deceleration → seconds before the impact at which braking still avoids it; None if it never does."""
        if self.replayed is None:
            return {}
        row = BRAKERS.index("both")
        if len(self.brakes) == 1:
            row = self.replayed.accident.agents.index("ego_vehicle")
        values = zip(self.replayed.decelerations.tolist(), self.replayed.slack[row].tolist(), strict=True)
        return {deceleration: _known(slack) for deceleration, slack in values}

    @property
    def parts(self) -> float | None:
        """Seconds before the impact at which the first actor acts otherwise in the twin; None if none does."""
        return None if self.twin is None else _known(self.twin.to_dict()["time_to_impact"], 1)

    def to_dict(self) -> dict[str, Any]:
        """For JSON; None for what is not known."""
        accident = self.story.facts["accident"]
        replayed = self.replayed
        return {
            "scenario": self.scenario,
            "colliders": self.colliders,
            **{name: accident[name] for name in ("gap", "closing_speed", "impact_angle")},
            "margin": None if replayed is None else replayed.check.margin,
            "head_on": None if replayed is None else replayed.head_on,
            "time_exposed": None if self.measures is None else self.measures.time_exposed,
            "pet": None if self.measures is None else self.measures.pet,
            "leads": self.leads,
            "brakes": self.brakes,
            "last_moments": {f"{key:g}": value for key, value in self.last_moments.items()},
            "twin": None if self.twin is None else self.twin.twin,
            "twin_parts": self.parts,
            "story": self.story.text,
            "unknown": list(self.story.facts["unknown"]),
        }


def csv_row(row: AccidentRow) -> list[Any]:
    """The cells of `ROW_HEADING`."""
    told = row.to_dict()
    colliders = [each[name] for each in row.colliders for name in _OF_COLLIDERS]
    measures = [told[name] for name in ("gap", "closing_speed", "impact_angle", "margin", "head_on", "time_exposed")]
    moments = [row.last_moments.get(deceleration) for deceleration in DECELERATIONS]
    brakes = " ".join(each or "none" for each in row.brakes)
    last = [told[name] for name in ("twin", "twin_parts", "story")]
    return [row.scenario, *colliders, *measures, told["pet"], *row.leads.values(), brakes, *moments, *last]


def _known(value: float | None, digits: int = 2) -> float | None:
    return None if value is None or not math.isfinite(value) else round(float(value), digits)
