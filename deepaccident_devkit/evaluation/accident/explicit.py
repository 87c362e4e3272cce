"""Explicit accidents against what instance maps show: for the protocol `paper`, whose truth is a raster."""

from __future__ import annotations

from collections.abc import Sequence

from deepaccident_devkit.evaluation.accident.alarms import Naming, nearest_two
from deepaccident_devkit.evaluation.accident.reading import InstanceAccident
from deepaccident_devkit.evaluation.accident.scoring import Alarm, foreseen, position_difference
from deepaccident_devkit.evaluation.predictions import Accident


def explicit_alarm(
    predicted: Accident,
    truth: InstanceAccident,
    actors: Sequence[int | None] | None,
    *,
    seconds: float,
    naming: Naming,
    gate: float,
) -> Alarm:
    """A predicted accident against the true one, if there is one.

    Args:
        predicted: in the present ego frame, as the truth.
        truth: read off the labels' maps.
        actors: who the two true instances are, None for one that is not known; None without a true accident.
        seconds: from frame to frame of the maps.
        naming: whom the predicted one names if it has no `ids`.
        gate: metres: how far off the nearest instances may be.
    """
    if truth.contact is None:
        return foreseen()
    return foreseen(
        position=position_difference(predicted.positions, truth.positions),
        time=predicted.time - truth.contact.frame * seconds,
        id_error=_id_error(predicted, truth, actors, seconds, naming, gate),
    )


def _id_error(
    predicted: Accident,
    truth: InstanceAccident,
    actors: Sequence[int | None] | None,
    seconds: float,
    naming: Naming,
    gate: float,
) -> int | None:
    """1 if others are named than the two true instances; None if nobody is named, or it is not known who those are."""
    if truth.contact is None or actors is None:
        return None
    if predicted.ids is not None:
        return None if None in actors else int(set(predicted.ids) != set(actors))
    if naming == "given":
        return None
    frame = min(round(predicted.time / seconds), len(truth.tracks.center) - 1)
    nearest = nearest_two(predicted.positions, truth.tracks.identity, truth.tracks.center[frame], gate)
    return int(set(nearest) != set(truth.contact.ids))
