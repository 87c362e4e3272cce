"""`CleanPlanning`: what a plan makes of a recorded accident, and what it costs where nothing happens."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from deepaccident_devkit.accidents.outcomes import MOST_MARGIN
from deepaccident_devkit.accidents.replay import HORIZON
from deepaccident_devkit.evaluation.means import Sums
from deepaccident_devkit.evaluation.planning.cells import HORIZONS, STEP
from deepaccident_devkit.evaluation.planning.contacts import Contacts, first_contacts
from deepaccident_devkit.evaluation.planning.scene import Plan, PlanningScene, recorded_poses, steps_of
from deepaccident_devkit.geometry.box_arrays import gaps_of_pairs
from deepaccident_devkit.support.arrays import FloatArray
from deepaccident_devkit.taxonomy import FRAME_PERIOD

_SLACK: Final = 1e-6
"""Seconds and metres: times are decimal numbers, and a path projected on itself loses digits."""
_NEAREST: Final = 0.2
"""Seconds from a sample to the lead that it counts for: lists of samples count back from each recording's own end."""
_FAR: Final = 1.0
"""Metres of a recorded way from which the share of it that is lost says something."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CleanPlanning:
    """What is counted; docs/protocols.md, Planning, defines it.

    Attributes:
        leads: seconds before the accident at which plans are judged.
        most_acceleration: m/s² along or across from which a plan cannot be driven.
        braking: m/s² of a deceleration that passengers feel.
    """

    leads: tuple[float, ...] = (3.0, 2.0, 1.0, 0.5)
    most_acceleration: float = 10.0
    braking: float = 3.0


class Driven(NamedTuple):
    """A plan as it is driven.

    Attributes:
        contacts: with the others, for at least 3 s, up to the end of the plan or of the recording; with the partner up
            to 3 s after the recording.
        error: (N,) metres from the recorded path at each step of 0.5 s that was recorded.
        lost: metres of the recorded way that it lacks at the end of the window.
        way: metres of the recorded way up to there.
        infeasible: whether an acceleration is above the limit.
        brakes: whether a deceleration is above that of passengers' comfort.
        known: seconds up to which neither the plan nor the recording is prolonged.
    """

    contacts: Contacts
    error: FloatArray
    lost: float
    way: float
    infeasible: bool
    brakes: bool
    known: float


def drive(plan: Plan, scene: PlanningScene, margin: float, rules: CleanPlanning) -> Driven:
    """Drive a plan among others that keep their recorded motion; `margin` is that of the recorded pair's contact."""
    known = min(float(plan.times[-1]), scene.duration)
    partner = scene.actor_id == scene.partner
    until = scene.duration + (HORIZON if partner.any() else 0.0)
    times = np.append(0.0, steps_of(FRAME_PERIOD, until))
    contacts = first_contacts(
        box_path(plan.poses(times), scene.offset),
        scene.size,
        _prolonged(scene.footprint, len(times), partner),
        np.where(partner, margin, 0.0),
        np.where(partner, until, max(known, min(scene.duration, HORIZONS[-1]))),
    )
    steps = steps_of(STEP, min(scene.duration, HORIZONS[-1]))
    away = plan.poses(steps) - recorded_poses(scene, steps)
    along, across = _accelerations(plan, scene.before)
    lost, way = _progress(plan, scene, known)
    return Driven(
        contacts=contacts,
        error=np.hypot(*away[:, :2].T),
        lost=lost,
        way=way,
        infeasible=bool(max(np.abs(along).max(), np.abs(across).max()) > rules.most_acceleration + _SLACK),
        brakes=bool(along.min() < -rules.braking),
        known=known,
    )


def box_path(poses: FloatArray, offset: FloatArray) -> FloatArray:
    """(N, 3) x, y, yaw of the box's centre, of poses (N, 3) of the ego frame; `offset` (2,) is the centre in it."""
    cosine, sine = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    x = poses[:, 0] + cosine * offset[0] - sine * offset[1]
    return np.column_stack([x, poses[:, 1] + sine * offset[0] + cosine * offset[1], poses[:, 2]])


def margin_of(scene: PlanningScene) -> float:
    """The gap between the recorded pair at the end, which counts as contact; NaN without a partner."""
    partner = np.flatnonzero(scene.actor_id == scene.partner)
    if not len(partner):
        return np.nan
    x, y, yaw = box_path(scene.recorded[-1:], scene.offset)[0]
    return float(gaps_of_pairs(np.array([x, y, *scene.size, yaw]), scene.footprint[-1, partner[0]])) + 1e-9


def _prolonged(footprint: FloatArray, frames: int, goes_on: FloatArray) -> FloatArray:
    """(frames, A, 5) recorded footprints, and those of the actors that go on, straight on; others are not there."""
    more = frames - len(footprint)
    if not more:
        return footprint
    after = np.full((more, *footprint.shape[1:]), np.nan)
    if len(footprint) > 1:
        last = np.broadcast_to(footprint[-1], after.shape).copy()
        last[..., :2] += np.arange(1, more + 1)[:, None, None] * (footprint[-1] - footprint[-2])[:, :2]
        after = np.where(goes_on[:, None], last, after)
    return np.concatenate([footprint, after])


def _accelerations(plan: Plan, before: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Changes of velocity along and across the heading at each step, m/s², that from the present speed included."""
    times = np.append(0.0, plan.times[plan.times > 0])
    poses = plan.poses(times)
    periods = np.diff(times)
    velocity = np.vstack([before, np.diff(poses[:, :2], axis=0) / periods[:, None]])
    change = np.diff(velocity, axis=0) / periods[:, None]
    cosine, sine = np.cos(poses[:-1, 2]), np.sin(poses[:-1, 2])
    return cosine * change[:, 0] + sine * change[:, 1], cosine * change[:, 1] - sine * change[:, 0]


def _progress(plan: Plan, scene: PlanningScene, until: float) -> tuple[float, float]:
    """Metres of the recorded path that the plan's place at a time lacks, and those of the recording up to then."""
    times = np.append(np.arange(len(scene.recorded)) * FRAME_PERIOD, scene.duration + 100.0)
    path = recorded_poses(scene, times)[:, :2]
    steps = np.diff(path, axis=0)
    lengths = np.hypot(*steps.T)
    arcs = np.append(0.0, np.cumsum(lengths))
    place = plan.poses(np.array([until]))[0, :2] - path[:-1]
    share = np.divide((place * steps).sum(axis=1), lengths**2, out=np.zeros(len(steps)), where=lengths > 0).clip(0, 1)
    nearest = int(np.argmin(np.hypot(*(place - share[:, None] * steps).T)))
    way = float(np.interp(until, times, arcs))
    return way - float(arcs[nearest] + share[nearest] * lengths[nearest]), way


def add_plan(
    sums: Sums, row: str, driven: Driven, recorded: Driven, scene: PlanningScene, rules: CleanPlanning
) -> None:
    """Add what a plan does to the sums, beside what the recorded path does."""
    time = np.where(driven.contacts.overlapping, np.inf, driven.contacts.time)
    for horizon in HORIZONS:
        table, steps = f"{horizon} s", round(horizon / STEP)
        sums.add(table, row, "l2", driven.error[steps - 1 : steps])
        if len(driven.error):
            sums.add(table, row, "l2_mean", float(driven.error[:steps].mean()))
            touches = time.min(initial=np.inf) <= min(horizon, scene.duration) + _SLACK
            sums.add(table, row, "contact", 100.0 * touches)
    for ends, suffix in ((scene.to_end, ""), (scene.to_contact, " to contact")):
        leads = [lead for lead in rules.leads if abs(ends - lead) <= _NEAREST + _SLACK]
        for lead in leads:
            role = "" if scene.is_collider else "bystander, "
            _add_lead(sums, f"{role}lead {lead:g} s{suffix}", row, driven, recorded, scene)


def _add_lead(sums: Sums, table: str, row: str, driven: Driven, recorded: Driven, scene: PlanningScene) -> None:
    twin = "_twins" if scene.kind == "twin" else ""
    contacts, partner = driven.contacts, scene.actor_id == scene.partner
    at = np.flatnonzero(partner)
    if len(at):
        time = float(contacts.time[at[0]])
        avoided = np.isinf(time)
        sums.add(table, row, "avoided", 100.0 * avoided)
        sums.add(table, row, "impact_speed", float(contacts.speed[at[0]]))
        sums.add(table, row, "relative_speed", float(contacts.relative_speed[at[0]]))
        sums.add(table, row, "prolonged", 100.0 * (driven.known + _SLACK < time < np.inf))
    until = min(driven.known, recorded.known) + _SLACK
    new = (contacts.time <= until) & (recorded.contacts.time > until) & ~contacts.overlapping & ~partner
    sums.add(table, row, f"striking{twin}", 100.0 * bool((new & ~contacts.struck).any()))
    sums.add(table, row, f"struck{twin}", 100.0 * bool((new & contacts.struck).any()))
    sums.add(table, row, f"lost_way{twin}", driven.lost)
    if driven.way > _FAR:
        sums.add(table, row, f"lost{twin}", 100.0 * driven.lost / driven.way)
    sums.add(table, row, f"infeasible{twin}", 100.0 * driven.infeasible)
    if twin:
        sums.add(table, row, "braking_twins", 100.0 * driven.brakes)


def usable(scene: PlanningScene, margin: float, recorded: Driven) -> str:
    """Why an accident does not count, as half a sentence; empty if it does: the recorded path must meet the partner."""
    at = np.flatnonzero(scene.actor_id == scene.partner)
    if not len(at):
        return "no label shows the partner from here on"
    if recorded.contacts.overlapping[at[0]]:
        return "the pair touches at the present already"
    if margin > MOST_MARGIN:
        return f"the pair is {margin:.2f} m apart at the end"
    if not recorded.contacts.time[at[0]] <= scene.duration + _SLACK:
        return "the recorded path does not meet the partner"
    return ""
