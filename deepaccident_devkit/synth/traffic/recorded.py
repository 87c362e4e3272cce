"""Which part of what happens is recorded: it ends with the impact, or when ego has arrived, or when time is over."""

from dataclasses import dataclass

import numpy as np

from deepaccident_devkit.synth.spec import ScenarioSpec
from deepaccident_devkit.synth.traffic.casting import WARM_UP
from deepaccident_devkit.synth.traffic.drama import Performance, Stage
from deepaccident_devkit.synth.traffic.impact import Impact, impact_of
from deepaccident_devkit.synth.traffic.ways import middle_of
from deepaccident_devkit.taxonomy import FRAME_PERIOD

_LEAST_FRAMES, _MOST_FRAMES = 40, 100
"""Of a recording of natural length, as in the release."""
_EARLIEST = 5.5
"""Seconds from the beginning until the pair meets, at least."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Recorded:
    """A part of a performance.

    Attributes:
        performance: what happens.
        start: time of the first recorded frame, in the simulation's time, seconds.
        frames: how many are recorded.
        impact: with which it ends, if it does.
    """

    performance: Performance
    start: float
    frames: int
    impact: Impact | None


def usual_duration(rng: np.random.Generator, spec: ScenarioSpec, frames: int | None) -> float:
    """Seconds from the beginning until the pair meets: as is natural, or as long as the frames asked for need."""
    natural = float(rng.uniform(_EARLIEST, max(spec.end.time, _EARLIEST) + 0.3))
    return natural if frames is None else max(natural, frames * FRAME_PERIOD + 1.5)


def latest_end(stage: Stage, frames: int | None) -> float:
    """The time until which a normal scenario is simulated, seconds."""
    longest = max(stage.spec.end.time, (frames or 0) * FRAME_PERIOD)
    return stage.cast.begin + WARM_UP + longest


def recorded_accident(stage: Stage, performance: Performance, frames: int | None) -> Recorded:
    """The recording that ends with the impact.

    Args:
        stage: who took part.
        performance: with a contact of the pair.
        frames: how many are recorded; None for as many as there are, within limits.
    """
    pair = stage.cast.pair or (0, 0)
    size = np.array([stage.users[row].body.size[:2] for row in pair])
    impact = impact_of(performance.simulation, pair, size)
    count = frames or _natural_frames(stage, impact.time, _MOST_FRAMES)
    return Recorded(
        performance=performance, start=impact.time - FRAME_PERIOD * (count - 1), frames=count, impact=impact
    )


def recorded_normal(stage: Stage, performance: Performance, frames: int | None) -> Recorded:
    """The recording that ends when ego has arrived, or when time is over; arguments as in `recorded_accident`."""
    begin = stage.cast.begin + WARM_UP
    longest = round(stage.spec.end.time / FRAME_PERIOD)
    arrival = _arrival_time(stage, performance)
    natural = _natural_frames(stage, min(arrival, begin + stage.spec.end.time), max(longest, _LEAST_FRAMES))
    if frames is None:
        return Recorded(performance=performance, start=begin, frames=natural, impact=None)
    end = max(begin + FRAME_PERIOD * (natural - 1), begin + FRAME_PERIOD * (frames - 1))
    return Recorded(performance=performance, start=end - FRAME_PERIOD * (frames - 1), frames=frames, impact=None)


def _natural_frames(stage: Stage, end: float, most: int) -> int:
    since = end - (stage.cast.begin + WARM_UP)
    return int(np.clip(int(since / FRAME_PERIOD + 1e-6) + 1, _LEAST_FRAMES, most))


def _arrival_time(stage: Stage, performance: Performance) -> float:
    """When ego is far enough past the junction, infinite if it never is."""
    row = stage.cast.row_of("ego")
    ego, simulation = stage.users[row], performance.simulation
    if ego.route is None:
        return np.inf
    coarse = slice(None, None, 5)
    along, _ = ego.path.project(simulation.poses[coarse, performance.present.index(row), :2])
    arrived = along > middle_of(ego.route) + stage.spec.end.arrival
    return float(simulation.time[coarse][arrived.argmax()]) if arrived.any() else np.inf
