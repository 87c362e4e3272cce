"""What others measured of the real release, and what our readers take for granted: the table behind `info --facts`.

docs/validation.md, Facts of the real release, defines the rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

from deepaccident_devkit.support.arrays import ShortRepr

Verdict = Literal["agree", "differ", "cannot say"]
Kind = Literal["all", "some", "share", "mean", "median", "few", "most", "least", "area", "range"]
"""What is compared: a share (that must be all, or some, or is a number), a mean, a median, percentiles where there are
few real cases, the most, the least, an AUC, or a median that lies in a range."""


@dataclass(frozen=True, slots=True)
class Fact(ShortRepr):
    """One fact; and, once a release was looked at, what it has of it. Shares are from 0 to 1.

    Attributes:
        key: of `ScenarioFacts.values`.
        name: what it is.
        kind: how it is compared.
        confidence: `A`: several sources, or recomputed; `B`: one source; `C`: a remark; empty for what our readers take
            for granted.
        source: the part of the real release that was measured; empty for our readers'.
        real_cases: how many real cases there were; 0 where that is not known.
        real: what others measured: one number, of `few` one or more, none of `all`, `some` and `range`.
        unit: of the numbers; `share` for shares.
        limits: between which numbers it agrees, of all kinds but `share`, `mean`, `median` and `few`.
        here: the release's share, mean, median, most, least or AUC; None where it has none.
        ends: of its 95 % interval, or the 5th and 95th percentile for few real cases; None where there is none.
        cases: how many cases there are here.
        scenarios: how many scenarios they are of.
        verdict: whether the two agree.
    """

    key: str
    name: str
    kind: Kind
    confidence: Literal["A", "B", "C", ""] = ""
    source: str = ""
    real_cases: int = 0
    real: tuple[float, ...] = ()
    unit: str = "share"
    limits: tuple[float, float] = (1.0, 1.0)
    here: float | None = None
    ends: tuple[float, float] | None = None
    cases: int = 0
    scenarios: int = 0
    verdict: Verdict = "cannot say"

    def texts(self) -> tuple[str, ...]:
        """A table's cells: fact, confidence, others, here, cases, verdict."""
        words = {"all": "always", "some": "occurs", "range": _text(self.limits, self.unit, " to ")}
        of = f" ({self.source}{f', {self.real_cases:,}' if self.real_cases else ''})" if self.source else ""
        others = words.get(self.kind) or _text(self.real, self.unit)
        here = "–" if self.here is None else _text([self.here], self.unit)
        within = f" [{_text(self.ends or (), self.unit, ' … ')}]" if len({self.here, *(self.ends or ())}) > 1 else ""
        return self.name, self.confidence, others + of, here + within, f"{self.cases:,}", self.verdict


def _text(values: Sequence[float], unit: str, between: str = ", ") -> str:
    scale, sign = (100, "%") if unit == "share" else (1, unit)
    return f"{between.join(f'{scale * each:.3g}' for each in values)} {sign}".rstrip()


_SECONDS: Final = ((1, 0.813, 0.08), (2, 0.622, 0.08), (3, 0.536, 0.1), (4, 0.472, 0.1), (5, 0.423, 0.1))
"""Seconds ahead, the AUC that others measured, and how far from it agrees."""
FACTS: Final = (
    Fact("twins", "scenarios with a twin", "share", "A", "val", 104, (1.0,)),
    Fact("lights", "scenarios with traffic lights", "share", "A", "val", 104, (54 / 104,)),
    Fact("accident_without", "accident folders without a collision", "share", "A", "val", 52, (2 / 52,)),
    Fact("normal_with", "normal folders with a collision", "share", "A", "val", 52, (1 / 52,)),
    Fact("folder_right", "folders that say how it ended", "share", "A", "val", 104, (101 / 104,)),
    Fact("accident_frames", "length of accidents, median", "median", "A", "val", 52, (59,), "frames"),
    Fact("accident_frames", "length of accidents, mean", "mean", "A", "val", 52, (61,), "frames"),
    Fact("accident_frames", "length of accidents, shortest", "least", "A", "mini", 8, (36,), "frames", (0, 36)),
    Fact("normal_frames", "length of normal scenarios, median", "median", "A", "val", 52, (96,), "frames"),
    Fact("normal_frames", "length of normal scenarios, mean", "mean", "A", "val", 52, (97,), "frames"),
    Fact("length", "collision by length alone, AUC", "area", "A", "val", 104, (0.983,), "", (0.95, 1.0)),
    Fact("short", "collisions with less than 5 s before", "share", "A", "val", 52, (0.35,)),
    Fact("frames_by_meta", "frames are meta's last token − 10", "all", "A", "val", 52),
    Fact("relation_known", "token 7 is same or opposite", "all", "A", "val", 52),
    Fact("relation_opposite", "token 7 is opposite", "some", "A", "val", 52, limits=(1e-6, 1)),
    Fact("contact_known", "token 8 is front, rear or their sides", "all", "A", "val", 52),
    Fact("unknown_partner", "collisions with id 0", "share", "B", "mini", 8, (1 / 8,)),
    Fact("none_none", "no collision: `none none`", "share", "A", "mini+real", 2, (1 / 2,)),
    Fact("agents_named", "`colliding agents` are the ids' agents", "all", "A", "mini", 0),
    Fact("ids_ascend", "ids: other < ego < ego_behind < other_behind", "all", "A", "mini+real", 5),
    Fact("pair_designed", "pair: ego and other", "share", "C", "mini", 7, (1 / 7,)),
    Fact("pair_behind", "pair: ego_behind and other_behind", "share", "C", "mini", 7, (2 / 7,)),
    Fact("pair_follower", "pair: ego_behind and other", "share", "C", "mini", 7, (2 / 7,)),
    Fact("pair_background", "pair: an agent and a background vehicle", "share", "C", "mini", 7, (1 / 7,)),
    Fact("overlap_frames", "frames in which colliders overlap", "few", "A", "mini", 1, (3,), "frames"),
    Fact("overlap_depth", "depth of the colliders' overlap", "few", "A", "mini", 2, (0.43, 0.68), "m"),
    Fact("touch_in_second", "colliders first touch in the impact's second", "share", "B", "val", 69, (45 / 69,)),
    Fact("touch_at_end", "colliders overlap at the last frame", "share", "A", "mini", 2, (1.0,)),
    Fact("heading", "angle of headings at the contact", "few", "A", "mini", 1, (22,), "°"),
    Fact("relative_speed", "relative speed at the contact", "few", "A", "mini", 1, (2.7,), "m/s"),
    Fact("start_speed", "speed of agents at the first frame", "few", "A", "mini+real", 6, (3.1, 3.7), "m/s"),
    Fact("slow", "agents' time below 0.5 m/s", "few", "A", "real", 1, (0.16,)),
    Fact("fast", "agents' time above 15 m/s", "few", "A", "real", 1, (0.11,)),
    Fact("speed", "fastest agent", "most", "A", "mini+real", 0, (17.6,), "m/s", (17.6, 100)),
    Fact("pitch", "steepest pitch", "most", "A", "val", 0, (11.6,), "°", (11.6, 90)),
    Fact("overlap_samples", "ego labels with overlapping vehicles", "share", "B", "val", 400, (0.31,)),
    Fact("overlap_stand", "overlapping pairs: both stand", "share", "B", "val", 537, (526 / 537,)),
    Fact("overlap_mixed", "overlapping pairs: one moves", "share", "B", "val", 537, (0.0,)),
    Fact("overlap_move", "overlapping pairs: both move", "share", "B", "val", 537, (11 / 537,)),
    Fact("next_touch", "next 2 s: a pair touches", "share", "B", "val", 816, (0.135,)),
    Fact("next_near", "next 2 s: a pair comes below 2.5 m", "share", "B", "val", 816, (0.892,)),
    Fact("next_gap", "next 2 s: least gap, median", "median", "B", "val", 816, (1.34,), "m"),
    Fact("vehicles", "vehicles in an ego label, median", "median", "B", "val", 400, (12,), ""),
    *(
        Fact(
            f"{key}_{second}", f"{name}, {second} s", "area", "A", "val", 0, (real,), "", (real - within, real + within)
        )
        for key, name in (
            ("foreseen", "AUC of constant velocity, a mover in each pair"),
            ("foreseen_all", "AUC of constant velocity, all pairs"),
        )
        for second, real, within in _SECONDS
    ),
    Fact("ade", "constant velocity over 5 s, ADE", "mean", "B", "val", 23453, (4.13,), "m"),
    Fact("fde", "constant velocity over 5 s, FDE", "mean", "B", "val", 23453, (7.42,), "m"),
    Fact("pole_height", "infrastructure above the road, median", "range", "B", "val", 0, (), "m", (3.3, 3.8)),
    Fact("fields", "label rows have 13 fields", "all"),
    Fact("gapless", "frames are 1 to n for every agent", "all"),
    Fact("agents", "five agents have labels", "all"),
    Fact("ids_known", "label ids are −100, −1 or from 1 on", "all"),
    Fact("own_row", "a vehicle's label has one row −100, the pole's none", "all"),
    Fact("known_words", "words of weather, road, side and directions are known", "all"),
    Fact("velocities_released", "velocities are turned by each box's yaw", "all"),
    Fact("gap_closes", "gap at the end closes in 0.1 s, or is below 0.3 m", "all"),
    Fact("sensors_stay", "sensors stay on their agents", "all"),
    Fact("jitter", "a sensor's place jitters by, median", "range", unit="mm", limits=(0, 1)),
)
"""Every row of the table, in its order."""
