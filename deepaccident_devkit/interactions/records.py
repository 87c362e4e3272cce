"""The records of the derived tables of interactions: each field's type, storage and meaning, written once.

Infinite stands for never, null for what cannot be known: an actor's velocity, or a direction where boxes overlap.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Annotated, Final, TypedDict

from deepaccident_devkit.tables.columns import Key, Number, TableSpec, Vector
from deepaccident_devkit.tables.records import spec_of


def _number(doc: str, unit: str) -> Number:
    return Number(dtype="float64", doc=doc, unit=unit)


class InteractionRecord(TypedDict):
    """A pair of road users at a moment at which it comes under a threshold (`InteractionConfig`).

    Derived from `track`, made when it is first asked for, and kept in a file a scenario beside the tables. Seen from
    above; velocities are the tracks', displacements where these are unknown.
    """

    frame_token: Annotated[str, Key(table="frame", doc="The moment.")]
    first_token: Annotated[str, Key(table="instance", doc="The one with the smaller actor id.")]
    second_token: Annotated[str, Key(table="instance", doc="The other.")]
    gap: Annotated[float, _number("Between the boxes; 0 where they touch.", "m")]
    closing_speed: Annotated[
        float | None, _number("With which the gap shrinks, negative where it grows; null where the boxes touch.", "m/s")
    ]
    ttc: Annotated[
        float | None,
        _number("Time to collision of the boxes at steady velocities; infinite if never, or after the horizon.", "s"),
    ]
    ttc_1d: Annotated[
        float | None, _number("Time to collision along the heading of the one behind, the less of both.", "s")
    ]
    drac: Annotated[
        float | None, _number("Deceleration rate to avoid a crash: relative speed over twice the `ttc`.", "m/s²")
    ]
    mttc: Annotated[
        float | None,
        _number("As `ttc`, each with its acceleration along its heading, until it stops or the horizon.", "s"),
    ]
    delta_v: Annotated[
        list[float] | None,
        Vector(
            shape=(2,),
            doc="Change of velocity of the first and the second if they collided now, with assumed masses.",
            unit="m/s",
        ),
    ]
    impact_angle: Annotated[
        float, _number("The second's heading as the first sees it, in (−π, π]: 0 the same, ±π head-on.", "rad")
    ]


class InteractionPairRecord(TypedDict):
    """A pair of road users that comes under a threshold at one moment at least, over its whole recording.

    Least and most are over all frames at which both are annotated and at least one moves, not only those in
    `interaction`. A pair that is not here was never under a threshold.
    """

    scenario_token: Annotated[str, Key(table="scenario", doc="Its scenario.")]
    first_token: Annotated[str, Key(table="instance", doc="The one with the smaller actor id.")]
    second_token: Annotated[str, Key(table="instance", doc="The other.")]
    num_frames: Annotated[int, Number(dtype="int64", doc="Frames that the least and most are over.")]
    moving: Annotated[bool, Number(dtype="bool", doc="Whether each of the two moves at some frame.")]
    min_ttc: Annotated[float, _number("Least time to collision; infinite if there is none.", "s")]
    min_ttc_frame_token: Annotated[str | None, Key(table="frame", doc="The first moment of the least `ttc`.")]
    min_gap: Annotated[float, _number("Least gap.", "m")]
    min_gap_frame_token: Annotated[str, Key(table="frame", doc="The first moment of the least gap.")]
    max_drac: Annotated[float, _number("Most deceleration needed; infinite where the boxes touch.", "m/s²")]
    min_mttc: Annotated[float, _number("Least time to collision with accelerations.", "s")]
    pet: Annotated[
        float,
        _number(
            "Post-encroachment time over the recording: positive if the first was there first, negative if the second "
            "was, 0 if they touch, infinite if their ways do not meet.",
            "s",
        ),
    ]
    tet: Annotated[
        list[float], Vector(shape=(2,), doc="Time exposed: with a `ttc` of at most 1.5 s, and of 3 s.", unit="s")
    ]
    tit: Annotated[
        list[float], Vector(shape=(2,), doc="Time integrated: sum of threshold − `ttc` over that time.", unit="s²")
    ]


ROWS: Final = "interaction"
PAIRS: Final = "interaction_pair"


@cache
def interaction_specs() -> Mapping[str, TableSpec]:
    """The derived tables: of pairs at moments, and of pairs."""
    return {ROWS: spec_of(ROWS, InteractionRecord), PAIRS: spec_of(PAIRS, InteractionPairRecord)}
