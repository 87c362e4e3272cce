"""Whether explicit accidents look mirrored, turned, scaled, given in cells, or a step off in time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from deepaccident_devkit.arrays import FloatArray
from deepaccident_devkit.evaluation.metrics.accident import BoxTruth
from deepaccident_devkit.evaluation.metrics.alarms.raised import position_difference
from deepaccident_devkit.evaluation.metrics.predictions import Accident
from deepaccident_devkit.evaluation.runs.sanity.probes import SCALES, SYMMETRIES, Suspicion, scale_says, tally

Move = Callable[[FloatArray], FloatArray]
STEP: Final = 0.5
"""Seconds: how far a shift in time is looked for."""
_LEAST: Final = 0.5
_LEAST_TIMES: Final = 0.6
_SAMPLES: Final = 3
_TELLING: Final = 4.0
"""Metres by which the true positions have to change for their sample to tell."""
_FAR: Final = 50.0
_CELL: Final = 0.5
_EDGE: Final = 50.0
"""Metres: the released grid's cells, and how far it reaches."""
_LAGS: Final = {"0.5 s late": -STEP, "0.5 s early": STEP}
_POSITIONS: Final = "positions are x forward, y to the left, in metres from the agent's own ego frame at the present"


def accident_suspicions() -> list[Suspicion]:
    """What is looked for in lists of accidents."""
    said = {each.name: each.says for each in SYMMETRIES} | {name: says for name, says, _, _ in _MOVES}
    places = [
        Suspicion(
            name=name,
            group="place",
            says=f"{says} in the positions",
            remedy=_POSITIONS,
            measure="share of the telling samples whose positions fit",
            least=_LEAST,
            evidence=_SAMPLES,
        )
        for name, says in said.items()
    ]
    return places + [
        Suspicion(
            name=name,
            group="time",
            says=f"accidents are foretold for 0.5 s {'later' if lag < 0 else 'earlier'} than they come",
            remedy="times are seconds after the present, which is 0",
            measure="share of the samples whose time is right",
            least=_LEAST_TIMES,
            evidence=_SAMPLES,
        )
        for name, lag in _LAGS.items()
    ]


def accident_tallies(alarms: Sequence[Accident], truth: BoxTruth) -> dict[str, list[float]]:
    """What a sample says of each suspicion, by its surest alarm; nothing without an alarm and a true accident."""
    if truth.accident is None or not alarms:
        return {}
    alarm = min(alarms, key=lambda each: (-each.score, each.time))
    true = truth.accident.positions
    given = position_difference(alarm.positions, true)
    moves: dict[str, tuple[Move, Move]] = {each.name: (each.apply, each.undo) for each in SYMMETRIES}
    moves |= {name: (apply, undo) for name, _, apply, undo in _MOVES}
    result = {}
    for name, (apply, undo) in moves.items():
        change = position_difference(apply(true), true)
        apart = position_difference(undo(alarm.positions), true)
        tells = change >= _TELLING
        half = change / 2
        result[name] = tally(tells and apart < half, tells, tells and given < half, misfit=min(apart, _FAR))
    late = alarm.time - truth.accident.time
    for name, lag in _LAGS.items():
        result[name] = tally(abs(late + lag) < STEP / 2, 1, abs(late) < STEP / 2)
    return result


def _scaled(name: str, scale: float) -> tuple[str, str, Move, Move]:
    return name, scale_says(scale), lambda points: points * scale, lambda points: points / scale


def _in_cells(name: str, says: str, *, rows_first: bool) -> tuple[str, str, Move, Move]:
    """Positions as columns and rows of the released grid, counted from its corner."""
    order = np.array([1, 0] if rows_first else [0, 1])
    return (
        name,
        says,
        lambda points: ((points + _EDGE) / _CELL)[..., order],
        lambda points: points[..., order] * _CELL - _EDGE,
    )


_MOVES: Final = (
    *(_scaled(name, scale) for name, scale in SCALES.items()),
    _in_cells("columns and rows", "there are a column and a row of the grid, not metres,", rows_first=False),
    _in_cells("rows and columns", "there are a row and a column of the grid, not metres,", rows_first=True),
)
"""Name, what is wrong then, from true to found, and back."""
