"""Whether explicit accidents look mirrored, turned, scaled, in cells or in another frame, or with wrong times."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from deepaccident_devkit.arrays import FloatArray
from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.evaluation.metrics.accident import BoxTruth
from deepaccident_devkit.evaluation.metrics.alarms.raised import LABEL_STEP, by_sureness, position_difference
from deepaccident_devkit.evaluation.metrics.predictions import Accident
from deepaccident_devkit.evaluation.runs.sanity.probes import (
    SCALES,
    SYMMETRIES,
    Suspicion,
    nearer_tally,
    scale_says,
    tally,
)
from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.taxonomy import FRAME_PERIOD

Move = Callable[[FloatArray], FloatArray]
_LEAST: Final = 0.65
_LEAST_TIMES: Final = 0.75
_SAMPLES: Final = 4
_DEVIATIONS: Final = 2.2
_DECIDED: Final = {"place": 0.4, "time": 0.4}
"""The share of the useful samples that have to fit a mistake or the truth."""
_TELLING: Final = 2.0
"""Metres by which both true positions together have to change for their sample to tell."""
_TINY: Final = 1e-6
"""What those who are close by count for a mistake if there are none."""
_WEIGHTIEST: Final = 4.0
"""Metres: a larger change of positions counts as this one."""
_OFF: Final = 6.0
"""Metres by which both positions together may always be off, and still fit; where much changes, half of that."""
_OFF_SCALED: Final = 4.0
"""Likewise of scales, where it is a quarter."""
_CLOSE: Final = 15.0
"""Metres: true positions that are closer have to fit a scale, too, which one and the same place for all does not."""
_FAR: Final = 50.0
_CELL: Final = 0.5
_EDGE: Final = 50.0
"""Metres: the released grid's cells, and how far it reaches."""
_SOON: Final = 0.55
"""Share of the horizon: most accidents that come sooner have to fit a unit of time, too."""
_BEYOND: Final = 1.5
"""Horizons: nobody foresees times beyond, so that none that comes soon has to tell."""
_TELLING_TIME: Final = 0.5
_TIME_OFF: Final = 0.4
"""Seconds by which a time may be off, and still fit; where little changes, less than half of that."""
_LAGS: Final = {"0.5 s late": LABEL_STEP, "0.5 s early": -LABEL_STEP}
_LAG_WINDOW: Final = (0.37, 0.8)
"""Seconds: who is later than this and less than that is a step late; a slight delay does not count."""
_UNITS: Final = {
    "times in milliseconds": (1000.0, "milliseconds"),
    "times in recorded frames": (1 / FRAME_PERIOD, "recorded frames of 0.1 s"),
    "times in label frames": (1 / LABEL_STEP, "frames of 0.5 s"),
}
_BACKWARDS: Final = "times backwards"
_OF_RECORDING: Final = "times of the recording"
_POSITIONS: Final = "positions are x forward, y to the left, in metres from the agent's own ego frame at the present"
_TIMES: Final = "times are seconds after the present, which is 0"
_FRAMES: Final = {
    "world frame": "positions are given in the world frame",
    "left-handed world": "positions are given in the world frame with the wrong sign of y, as in CARLA",
    "lidar frame": "positions are given in the agent's LiDAR frame",
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AccidentMoment:
    """The wrong frames and times in which accidents of a sample may be given.

    Attributes:
        horizon: seconds that predictions look ahead.
        present: seconds from the recording's first frame to the sample.
        frames: name → from the present ego frame to a frame; fewer where that is not known.
    """

    horizon: float = 2.0
    present: float = 0.0
    frames: Mapping[str, SE3] = field(default_factory=dict)


def accident_moment(dataset: Dataset, token: str, horizon: float) -> AccidentMoment:
    """Of a sample; raises TokenError."""
    world_from_ego = dataset.world_from(token, "ego")
    frames = {
        "world frame": world_from_ego,
        "left-handed world": world_from_ego,
        "lidar frame": dataset.world_from(token, "lidar").inverse() @ world_from_ego,
    }
    present = (int(token.rsplit("/", 1)[1]) - 1) * FRAME_PERIOD
    return AccidentMoment(horizon=horizon, present=present, frames=frames)


def accident_suspicions() -> list[Suspicion]:
    """What is looked for in lists of accidents."""
    places = {each.name: f"{each.says} in the positions" for each in SYMMETRIES}
    places |= {name: scale_says(scale) for name, scale in SCALES.items()}
    places |= {name: f"positions are a {order} of the grid, not metres" for name, order in _CELLS.items()}
    times = {
        name: f"accidents are predicted 0.5 s {'later' if lag > 0 else 'earlier'} than they happen"
        for name, lag in _LAGS.items()
    }
    times |= {name: f"times are numbers of {unit}" for name, (_, unit) in _UNITS.items()}
    times[_BACKWARDS] = "times run from the horizon back to the present, or frames of the prediction are reversed"
    times[_OF_RECORDING] = "times are counted from the first frame of the recording"
    return [
        Suspicion(
            name=name,
            group="place",
            says=says,
            remedy=_POSITIONS,
            measure="how near the positions are to the true ones, from 0 to 1",
            least=_LEAST,
            evidence=_SAMPLES * _WEIGHTIEST,
            also=(_mostly(name), _close(name)) if name in SCALES else (_mostly(name),),
        )
        for name, says in {**places, **_FRAMES}.items()
    ] + [
        Suspicion(
            name=name,
            group="time",
            says=says,
            remedy=_TIMES,
            measure="share of the samples whose time is right",
            least=_LEAST_TIMES,
            evidence=_SAMPLES,
            deviations=_DEVIATIONS,
            also=(_mostly(name),) if name in _LAGS else (_mostly(name), _close(name)),
        )
        for name, says in times.items()
    ]


def accident_tallies(
    alarms: Sequence[Accident], truth: BoxTruth, moment: AccidentMoment | None = None
) -> dict[str, list[float]]:
    """The tallies of a sample for each suspicion, by its surest alarm; none without an alarm and a true accident."""
    if truth.accident is None or not alarms:
        return {}
    alarm = min(alarms, key=by_sureness)
    known = moment or AccidentMoment()
    true, late = truth.accident.positions, alarm.time - truth.accident.time
    result: dict[str, list[float]] = {}
    for name, wrong in _misplaced(true, known).items():
        result |= _place(name, alarm.positions, true, wrong)
    for name, lag in _LAGS.items():
        low, high = sorted(edge * np.sign(lag) for edge in _LAG_WINDOW)
        fits, right = low < late < high, abs(late) < LABEL_STEP / 2
        result |= _tallies(name, "time", fits, right, misfit=min(abs(late - lag), known.horizon))
    for name, wrong_time, undone in _mistimed(truth.accident.time, alarm.time, known):
        change, after = abs(wrong_time - truth.accident.time), abs(undone - truth.accident.time)
        off, misfit = min(_TIME_OFF, 0.45 * change), min(after, known.horizon)
        told = 1.0 if change >= _TELLING_TIME else 0.0
        fits = after < off
        result |= _tallies(name, "time", fits, abs(late) < off, told, misfit)
        soon = told * (truth.accident.time < known.horizon * _SOON)
        beyond = alarm.time > _BEYOND * known.horizon
        result[_close(name)] = tally(soon * fits + beyond * _TINY, 1, soon * (1 - fits))
    return result


def _misplaced(true: FloatArray, moment: AccidentMoment) -> dict[str, FloatArray]:
    """Name of a mistake → where the true positions (2, 2) are found with it."""
    in_cells = (true + _EDGE) / _CELL
    frames = {
        name: frame.apply(np.column_stack([true, np.zeros(len(true))]))[:, :2] for name, frame in moment.frames.items()
    }
    if "left-handed world" in frames:
        frames["left-handed world"] = frames["left-handed world"] * (1.0, -1.0)
    return {
        **{each.name: each.apply(true) for each in SYMMETRIES},
        **{name: true * scale for name, scale in SCALES.items()},
        "columns and rows": in_cells,
        "rows and columns": in_cells[:, ::-1],
        **frames,
    }


_CELLS: Final = {"columns and rows": "column and a row", "rows and columns": "row and a column"}


def _place(name: str, found: FloatArray, true: FloatArray, wrong: FloatArray) -> dict[str, list[float]]:
    """How much nearer the positions found are to where a mistake takes the true ones, if that tells.

    A sample tells in proportion, so that many near the axis of a mirror tell together what none does alone.
    """
    before, after, change = (position_difference(*each) for each in ((found, true), (found, wrong), (wrong, true)))
    misfit = min(after, _FAR)
    if change < _TELLING:
        return _tallies(name, "place", 0.0, 0.0, 0.0, misfit)
    near = max(change / 4, _OFF_SCALED) if name in SCALES else max(change / 2, _OFF)
    if min(before, after) >= near:
        return _tallies(name, "place", 0.0, 0.0, 1.0, misfit)
    weight = min(change, _WEIGHTIEST) / change
    part, _, given, *_ = nearer_tally(np.array([before]), np.array([after]), np.array([change]))
    close = float(np.linalg.norm(true.mean(axis=0)) < _CLOSE)
    return {
        _close(name): tally(close * part + _TINY, 1, close * given),
        **_tallies(name, "place", weight * part, weight * given, 1.0, misfit),
    }


def _tallies(
    name: str, group: str, part: float, given: float, told: float = 1.0, misfit: float = 0.0
) -> dict[str, list[float]]:
    """The tally of a sample that fits so or as given, or neither; and whether enough samples fit one of them."""
    part, given = told * part, told * given
    decided = float(part + given > 0)
    enough = (1 - _DECIDED[group]) / _DECIDED[group]
    return {
        name: tally(part, part + given, given, misfit=misfit),
        _mostly(name): tally(enough * decided, 1, told - decided),
    }


def _close(name: str) -> str:
    return f"{name}: close by"


def _mostly(name: str) -> str:
    return f"{name}: mostly"


def _mistimed(true: float, found: float, moment: AccidentMoment) -> list[tuple[str, float, float]]:
    """Name of a mistake, the true time with it, and the time found without it; seconds."""
    units = [(name, true * unit, found / unit) for name, (unit, _) in _UNITS.items()]
    return [
        *units,
        (_BACKWARDS, moment.horizon - true, moment.horizon - found),
        (_OF_RECORDING, moment.present + true, found - moment.present),
    ]
