"""What happens after a question's present: the truth, which is kept in a file of its own."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.evaluation.metrics.accident import box_truth
from deepaccident_devkit.taxonomy import FRAME_PERIOD
from deepaccident_devkit.v2x.collisions import collision, labelled_pair
from deepaccident_devkit.v2x.tracks import scenario_tracks

if TYPE_CHECKING:
    from deepaccident_devkit.dataset import Dataset
    from deepaccident_devkit.export.questions.question import Names

_SECOND: Final = round(1 / FRAME_PERIOD)
_DESIGN: Final = ("accident_type", "signalized", "spawn_side", "ego_direction", "other_direction")
_CONTACT: Final = ("sides", "speeds", "closing_speed", "impact_angle", "gap")
Seconds = list[bool | None]
"""Whether there is an accident in each second ahead; None where the recording does not say."""


def unanswerable(dataset: Dataset, scenario: Mapping[str, Any]) -> str | None:
    """Why nothing can be asked about a scenario, as a plural that is counted; None if it can."""
    if scenario["weather"] is None:
        return "scenarios without meta, which says whether there is an accident"
    actors = scenario_tracks(dataset, scenario["token"]).actor_id
    if not len(actors):
        return "scenarios without labels"
    told = scenario["collision"]
    if told is not None and labelled_pair(told, actors) is None:
        return "scenarios with an actor in the accident that no label shows"
    return None


def seconds_ahead(frames_to_impact: int | None, frames_to_end: int, ahead: int) -> Seconds:
    """Whether there is an accident in each second: after n − 1 seconds, and up to n seconds, for n from 1 to `ahead`.

    Nobody knows what comes after an impact, or after the recording: these seconds are None.

    Args:
        frames_to_impact: recorded frames from the present to the impact; None if there is none.
        frames_to_end: to the recording's last frame.
        ahead: number of seconds.
    """
    if frames_to_impact is None:
        return [False if second * _SECOND <= frames_to_end else None for second in range(1, ahead + 1)]
    there = math.ceil(frames_to_impact / _SECOND)
    return [second == there if second <= there else None for second in range(1, ahead + 1)]


def truth_facts(
    dataset: Dataset, sample: str, names: Names, ahead: int, contact: Mapping[str, Any] | None
) -> dict[str, Any]:
    """What is known of a question's answer.

    Args:
        dataset: the release.
        sample: token of the present.
        names: of the question.
        ahead: seconds that are asked about.
        contact: why, as `why_facts` gives it for the scenario.

    Returns:
        `sample`, `last_frame`, the names, `accident` for each second, and for an accident in one of them `when`, `who`
        (names, None for one that the question does not show), `actor_ids`, `where` (2, 2) in the present ego frame,
        `last_seen` of each, and `why`; None where there is none.

    Raises:
        NotAvailableError: a label is missing without which the places are not known.
    """
    record = dataset.sample.get(sample)
    to_impact, to_end = record["time_to_impact"], record["time_to_end"]
    scenario = dataset.scenario.get(record["scenario_token"])
    seconds = seconds_ahead(_frames(to_impact), round(to_end / FRAME_PERIOD), ahead)
    found: dict[str, Any] = dict.fromkeys(("when", "who", "actor_ids", "where", "last_seen", "why"))
    if True in seconds:
        impact = box_truth(dataset, sample, float(ahead)).accident
        if impact is not None and impact.ids is not None:
            found = {
                "when": round(impact.time, 1),
                "who": [names.of_actor(actor) for actor in impact.ids],
                "actor_ids": list(impact.ids),
                "where": (np.round(impact.positions, 2) + 0.0).tolist(),
                "last_seen": [names.last_seen.get(actor) for actor in impact.ids],
                "why": contact,
            }
    return {
        "sample": sample,
        "last_frame": scenario["num_frames"],
        "observers": dict(names.observers),
        "actors": dict(names.actors),
        "accident": seconds,
        **found,
    }


def why_facts(dataset: Dataset, scenario: Mapping[str, Any]) -> dict[str, Any] | None:
    """The design of an accident and how the two met: metres, seconds, radians; None without a collision."""
    if scenario["collision"] is None:
        return None
    design = {name: scenario[name] for name in _DESIGN}
    try:
        contact = collision(dataset, scenario["token"])
    except NotAvailableError:  # the two are never labelled together
        contact = None
    return {**design, **{name: None if contact is None else _plain(getattr(contact, name)) for name in _CONTACT}}


def _plain(value: Any) -> Any:
    """A value as JSON holds it: numbers with two decimals, None in place of NaN."""
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_plain(each) for each in value]
    if isinstance(value, float):
        return None if math.isnan(value) else round(value, 2) + 0.0
    return value


def _frames(seconds: float | None) -> int | None:
    return None if seconds is None else round(seconds / FRAME_PERIOD)
