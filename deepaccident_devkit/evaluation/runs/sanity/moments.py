"""Whether the frames of predicted maps look like those of other moments: a step off, reversed, or not warped.

Most cells are those of parked cars, so that only those count that differ between the two true frames compared.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from deepaccident_devkit.arrays import BoolArray
from deepaccident_devkit.evaluation.runs.sanity.probes import Suspicion, overlap, tally

LAGS: Final = {"one step late": -1, "one step early": 1}
"""Which of the true frames is found in the place of a frame."""
TWO_LATE: Final = "two steps late"
REVERSED: Final = "frames reversed"
UNWARPED: Final = "frames not warped"
_LEAST: Final = 0.2
_LEAST_OTHERWISE: Final = 0.12
_LEAST_TWO: Final = 0.3
"""In a queue, fast predictions reach the places of those ahead, whose past they then seem to show."""
_CELLS: Final = 100
_LONG: Final = 4
"""Frames in which a slow prediction and a late one have become different."""
_LONGER: Final = 5
"""Frames in which a slow prediction and one that is two steps late have."""


def moment_suspicions() -> list[Suspicion]:
    """What is looked for in the frames of maps."""
    order = "the first frame of a prediction is the present, the next one is a step later"
    no_past = "the first frame must be the present: leave out the past frames"
    result = [
        _suspicion(
            name,
            f"each frame shows the moment one step {'before' if lag < 0 else 'after'} it",
            order,
            least=_LEAST,
            also=("not two", "everywhere", *(("at first",) if lag < 0 else ())),
        )
        for name, lag in LAGS.items()
    ]
    return [
        *result,
        _suspicion(
            TWO_LATE,
            "each frame shows the moment two steps before it",
            no_past,
            least=_LEAST_TWO,
            also=("not one", "not three"),
        ),
        _suspicion(REVERSED, "the frames are in the reverse order, the last one first", order, also=("everywhere",)),
        _suspicion(
            UNWARPED,
            "each frame is seen from where the agent will be at that moment",
            "all frames are seen from where the agent is at the present: warp labels with `to_present` before training",
            also=("not still",),
        ),
    ]


def moment_tallies(
    predicted: BoolArray, true: BoolArray, unwarped: BoolArray | None, length: int
) -> dict[str, list[float]]:
    """What a sample says of each suspicion.

    Args:
        predicted: (T, H, W) actors' cells.
        true: (T, H, W) likewise, seen from the present.
        unwarped: (T, H, W) likewise, each frame seen from where the agent is then; None where that is not known.
        length: how many frames were predicted, of which there may be more than are compared.
    """
    every, last = range(len(true)), length - 1
    known = [frame for frame in every if last - frame in every and 2 * frame != last]
    backwards = true[np.clip(last - np.arange(len(true)), 0, len(true) - 1)]
    result = {
        REVERSED: _decided(predicted, backwards, true, known),
        f"{REVERSED}: everywhere": _decided(predicted, backwards, true, known[:1]),
    }
    for name, lag in LAGS.items():
        result |= _lag_tallies(name, lag, predicted, true)
    result |= _two_late_tallies(predicted, true)
    if unwarped is not None:
        result[UNWARPED] = _decided(predicted, unwarped, true, every)
        result[f"{UNWARPED}: not still"] = _decided(predicted, unwarped, true[:1].repeat(len(true), axis=0), every)
    return result


def _suspicion(
    name: str, says: str, remedy: str, *, least: float = _LEAST_OTHERWISE, also: Sequence[str] = ()
) -> Suspicion:
    return Suspicion(
        name=name,
        group="time",
        says=says,
        remedy=remedy,
        measure="IoU in the cells where the two moments differ",
        least=least,
        evidence=_CELLS,
        also=tuple(f"{name}: {each}" for each in also),
    )


def _lag_tallies(name: str, lag: int, predicted: BoolArray, true: BoolArray) -> dict[str, list[float]]:
    """Whether frames show the true ones a step off.

    A model that predicts no or slow motion is later from frame to frame, one that overestimates speeds is earlier: so a
    prediction that is off by one step as a whole is not off by two, least of all in the last frame, and not right in
    the first one that tells.
    """
    late = lag < 0
    known = range(-lag, len(true)) if late else range(len(true) - lag)
    twice = range(-2 * lag, len(true)) if late else range(len(true) - 2 * lag)
    once, two = (np.roll(true, -shift, axis=0) for shift in (lag, 2 * lag))
    extreme = _decided(predicted, once, two, twice[-1:]) if late else _decided(predicted, once, true, known[:1])
    if len(true) < _LONG:
        extreme = tally(0, 0, 0)
    at_first = {f"{name}: at first": _decided(predicted, once, true, known[:1])} if late else {}
    return {
        **at_first,
        name: _decided(predicted, once, true, known),
        f"{name}: not two": _decided(predicted, once, two, twice),
        f"{name}: everywhere": extreme,
    }


def _two_late_tallies(predicted: BoolArray, true: BoolArray) -> dict[str, list[float]]:
    """Whether frames show the true ones two steps before.

    A model that predicts slow motion is less late in the first of these frames, or later in the last one; a model that
    predicts no motion is later in the last one.
    """
    known = range(2, len(true))
    one, two, three = (np.roll(true, lag, axis=0) for lag in (1, 2, 3))
    result = {
        TWO_LATE: _decided(predicted, two, true, known),
        f"{TWO_LATE}: not one": _decided(predicted, two, one, known[:1]),
        f"{TWO_LATE}: not three": _decided(predicted, two, three, known[-1:]),
    }
    return result if len(true) >= _LONGER else {name: tally(0, 0, 0) for name in result}


def _decided(predicted: BoolArray, one: BoolArray, other: BoolArray, frames: Sequence[int]) -> list[float]:
    """The overlap of some frames with those of one truth against that with another's, where these two differ."""
    here = np.array([*frames], dtype=np.int64)
    first, second, found = one[here], other[here], predicted[here]
    where = first != second
    return tally(*overlap(found, first, where), *overlap(found, second, where))
