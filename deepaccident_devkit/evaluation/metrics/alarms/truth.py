"""What really happens after a sample: `BoxTruth`, the actors' boxes at 10 Hz, and `AccidentContext`, all else known."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from deepaccident_devkit.arrays import FloatArray, FrozenArrays, IntArray
from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import NotAvailableError, TokenError
from deepaccident_devkit.evaluation.metrics.alarms.reading import InstanceTracks
from deepaccident_devkit.evaluation.metrics.predictions import Accident
from deepaccident_devkit.geometry.footprints import gaps
from deepaccident_devkit.taxonomy import FRAME_PERIOD
from deepaccident_devkit.v2x.tracks import ScenarioTracks, scenario_tracks

RELEASED_HORIZON: Final = 2.0
"""Seconds that the released models look ahead."""
SLACK: Final = FRAME_PERIOD / 2
"""Seconds: half a recorded frame, so that decimal moments compare as they are meant."""
_MOVES: Final = 0.5
"""Metres that an actor covers in the window if it does more than stand."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BoxTruth(FrozenArrays):
    """The actors' boxes from a sample's present to the horizon or the recording's end; arrays are read-only.

    Attributes:
        time: (F,) float64 seconds after the present, from 0 in steps of 0.1.
        actor_id: (A,) int64, ascending.
        footprint: (F, A, 5) float64 x forward, y left, length, width, yaw in the present ego frame, metres and radians;
            NaN where nobody annotated the actor.
        accident: what meta says will happen within the horizon: the pair at the impact; None if nothing does.
        impact: the same however far ahead; None also if it is beyond the horizon and no label shows one of the pair.
    """

    time: FloatArray
    actor_id: IntArray
    footprint: FloatArray
    accident: Accident | None
    impact: Accident | None = None

    def tracks(self, seconds: float, frames: int) -> InstanceTracks:
        """The actors' centres at so many frames, so many seconds apart, from the present on; NaN beyond the window."""
        frame = np.rint(np.arange(frames) * seconds / FRAME_PERIOD).astype(np.int64)
        there = frame < len(self.time)
        center = np.full((frames, len(self.actor_id), 2), np.nan)
        center[there] = self.footprint[frame[there], :, :2]
        return InstanceTracks(identity=self.actor_id, center=center)

    def nearest_pair(self, danger_distance: float) -> tuple[int, int] | None:
        """The two whose boxes come nearest to each other, nearer than a distance; the earliest of several, by id.

        Two that both stand all the time, such as parked cars, are none.
        """
        found = []
        x_and_y = self.footprint[..., :2]
        low, high = (
            edge.reduce(np.where(np.isnan(x_and_y), empty, x_and_y), axis=0)
            for edge, empty in ((np.minimum, np.inf), (np.maximum, -np.inf))
        )
        moves = np.linalg.norm(high - low, axis=-1) >= _MOVES
        for frame, rows in enumerate(self.footprint):
            here = np.flatnonzero(np.isfinite(rows[:, 0]))
            apart = np.linalg.norm(rows[here, None, :2] - rows[here, :2], axis=-1)
            reach = np.hypot(rows[here, 2], rows[here, 3]) / 2
            near = np.triu(apart < reach[:, None] + reach + danger_distance, 1)
            near &= moves[here, None] | moves[here]
            first, second = (here[side] for side in np.nonzero(near))
            if len(first):
                gap = gaps(rows[np.unique(first)], rows[np.unique(second)])
                gap = gap[np.unique(first, return_inverse=True)[1], np.unique(second, return_inverse=True)[1]]
                best = int(np.argmin(gap))
                found.append((float(gap[best]), frame, int(first[best]), int(second[best])))
        if not found or min(found)[0] >= danger_distance:
            return None
        *_, one, other = min(found)
        return int(self.actor_id[one]), int(self.actor_id[other])


_OTHER_ENDING: Final[Mapping[str, str]] = MappingProxyType({"normal": "accident", "accident": "normal"})


@dataclass(frozen=True, slots=True, kw_only=True)
class AccidentContext:
    """What is known of a sample beside its motion labels; a protocol may need some of it.

    Attributes:
        pair: actor ids of the two that collide, from the scenario's meta file; None if nobody does, or if it is not
            `known`.
        known: whether `pair` says anything.
        own_actor_id: the actor id of the agent whose sample it is; None for the roadside, or if not known.
        truth: what a protocol without rasters compares with (see `boxes`); None for the others.
        time_to_impact: seconds to the recorded impact, however far ahead; None if nobody collides, or not known.
        time_to_end: seconds to the recording's last frame; None if not known.
        twin: whether nobody collides here, but somebody does in the scenario's twin; None if that is not known, such
            as where the release has no twin of it.
    """

    pair: tuple[int, int] | None = None
    known: bool = False
    own_actor_id: int | None = None
    truth: BoxTruth | None = None
    time_to_impact: float | None = None
    time_to_end: float | None = None
    twin: bool | None = None


def accident_context(dataset: Dataset, sample: RowArgument, horizon: float | None = None) -> AccidentContext:
    """What a release knows of a sample beside its motion labels, for the accident metrics.

    Args:
        dataset: the release.
        sample: token or record.
        horizon: seconds that the protocol `boxes` looks ahead; None leaves out what it alone needs.

    Raises:
        TokenError: no such sample.
        NotAvailableError: the sample has no label; with a horizon also as of `box_truth`.
    """
    there = labelled_sample(dataset, sample)
    scenario = dataset.get("scenario", there["scenario_token"])
    collision = scenario["collision"]
    return AccidentContext(
        pair=None if collision is None else (collision["ids"][0], collision["ids"][1]),
        known=scenario["weather"] is not None,
        own_actor_id=dataset.get("agent", there["agent_token"])["actor_id"],
        truth=None if horizon is None else box_truth(dataset, there, horizon),
        time_to_impact=there["time_to_impact"],
        time_to_end=there["time_to_end"],
        twin=_is_twin_of_an_accident(dataset, scenario),
    )


def box_truth(dataset: Dataset, sample: RowArgument, horizon: float = RELEASED_HORIZON) -> BoxTruth:
    """What happens after a sample, from the labels of all agents of the release.

    The pair is meta's, and the moment the recording's last frame, which in an accident scenario is the impact. Each of
    the two is where it was last annotated up to then: at that frame, but for partial labels.

    Args:
        dataset: the release.
        sample: token or record of the present.
        horizon: seconds to look ahead.

    Raises:
        TokenError: no such sample.
        NotAvailableError: the sample has no label, the scenario has no meta file, or no label ever shows one of the
            pair.
    """
    there = labelled_sample(dataset, sample)
    scenario = dataset.get("scenario", there["scenario_token"])
    if scenario["weather"] is None:
        raise NotAvailableError(f"{scenario['token']} has no meta file, which names the colliding pair; unpack meta")
    tracks = scenario_tracks(dataset, scenario)
    present = int(there["token"].rsplit("/", 1)[1])
    boxes = tracks.boxes.transform(dataset.world_from(there, "ego").inverse(), "ego")
    footprints = np.column_stack([boxes.center[:, :2], boxes.size[:, :2], boxes.yaw])
    last = min(scenario["num_frames"], present + round(horizon / FRAME_PERIOD))
    inside = (tracks.index >= present) & (tracks.index <= last)
    actors, which = np.unique(tracks.actor_id[inside], return_inverse=True)
    footprint = np.full((last - present + 1, len(actors), 5), np.nan)
    footprint[tracks.index[inside] - present, which] = footprints[inside]
    time_to_impact, impact = there["time_to_impact"], None
    within = time_to_impact is not None and time_to_impact <= horizon + SLACK
    if time_to_impact is not None and (within or np.isin(scenario["collision"]["ids"], tracks.actor_id).all()):
        first, second = scenario["collision"]["ids"]
        positions = [_last_position(tracks, footprints, actor, scenario["token"]) for actor in (first, second)]
        impact = Accident(positions=np.array(positions), time=time_to_impact, ids=(first, second))
    return BoxTruth(
        time=np.arange(last - present + 1) * FRAME_PERIOD,
        actor_id=actors,
        footprint=footprint,
        accident=impact if within else None,
        impact=impact,
    )


def labelled_sample(dataset: Dataset, sample: RowArgument) -> Any:
    """A sample's record; raises TokenError, and NotAvailableError if it has no label."""
    record = dataset.get("sample", sample)
    if not record["labelled"]:
        raise NotAvailableError(
            f"{record['token']}: has no label (the test split ships without), so that nothing can be evaluated; "
            "choose a labelled sample"
        )
    return record


def _last_position(tracks: ScenarioTracks, footprints: FloatArray, actor: int, scenario: str) -> FloatArray:
    rows = np.flatnonzero(tracks.actor_id == actor)
    if not len(rows):
        raise NotAvailableError(f"{scenario}: no label shows actor {actor}, who collides; leave its samples out")
    position: FloatArray = footprints[rows[-1], :2]
    return position


def _is_twin_of_an_accident(dataset: Dataset, scenario: Mapping[str, Any]) -> bool | None:
    """Whether nobody collides in a scenario, but somebody in that of the same family and name with the other ending."""
    if scenario["collision"] is not None:
        return False
    family, _, ending = scenario["scenario_type"].rpartition("_")
    try:
        twin = dataset.scenario.get(f"{family}_{_OTHER_ENDING.get(ending, ending)}/{scenario['name']}")
    except TokenError:
        return None
    if scenario["weather"] is None or twin["weather"] is None:  # no meta file, so nobody knows
        return None
    return twin["collision"] is not None
