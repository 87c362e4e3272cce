"""`CleanPlanning`: what a plan makes of a recorded accident, and what it costs where nothing happens."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from typing import Final

import numpy as np

from deepaccident_devkit.collisions.contact import TOUCHING
from deepaccident_devkit.collisions.outcomes import MOST_MARGIN
from deepaccident_devkit.collisions.replay import HORIZON
from deepaccident_devkit.evaluation.means import Sums
from deepaccident_devkit.evaluation.planning.cells import HORIZONS, STEP
from deepaccident_devkit.evaluation.planning.contacts import Contacts, first_contacts, without_gaps
from deepaccident_devkit.evaluation.planning.scene import (
    Plan,
    PlanningScene,
    recorded_poses,
    steps_of,
)
from deepaccident_devkit.geometry.box_arrays import gaps_of_pairs
from deepaccident_devkit.support.arrays import FloatArray
from deepaccident_devkit.taxonomy import FRAME_PERIOD

# Seconds and metres: times are decimal numbers, and a path projected on itself loses digits.
_SLACK: Final = 1e-6
# Seconds from a sample to the lead that it counts for: lists of samples count back from each recording's own end.
_NEAREST: Final = 0.2
# Metres of a recorded way from which the share of it that is lost says something.
_FAR: Final = 1.0


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


def add_clean(
    sums: Sums, plans: Mapping[str, Plan], scene: PlanningScene, rules: CleanPlanning
) -> None:
    """Add what plans do, among others that keep their recorded motion, to the sums.

    Args:
        sums: of the sample.
        plans: by the name of their row; the recorded path is the one called `recorded`.
        scene: of the sample.
        rules: the protocol.
    """
    if len(scene.recorded) < 2:
        sums.note(
            "no numbers of {sample} without a later frame that counts; twins end where their accident does"
        )
        return
    margin = _margin(scene)
    found = {name: _contacts(plan, scene, margin) for name, plan in plans.items()}
    true = found["recorded"]
    if true.overlapping.any():
        sums.note("left out: {actor} touching the ego at the present", int(true.overlapping.sum()))
    if scene.is_collider and not scene.is_twin and (reason := _unusable(scene, margin, true)):
        sums.note(f"{scene.scenario}: {reason}; left out: {{sample}}")
        return
    role = "" if scene.is_collider else "bystander, "
    leads = [
        f"{role}lead {lead:g} s{suffix}"
        for end, suffix in ((scene.to_end, ""), (scene.to_contact, " to contact"))
        for lead in rules.leads
        if abs(end - lead) <= _NEAREST + _SLACK
    ]
    steps = steps_of(STEP, min(scene.duration, HORIZONS[-1]))
    recorded = recorded_poses(scene, steps)
    for row, plan in plans.items():
        away = np.hypot(*(plan.poses(steps) - recorded)[:, :2].T)
        for horizon in HORIZONS:
            for column, value in _at_horizon(away, scene, found[row], horizon).items():
                sums.add(f"{horizon} s", row, column, value)
        if leads:
            numbers = _at_lead(plan, scene, found[row], true, rules)
            for table, (column, value) in product(leads, numbers.items()):
                sums.add(table, row, column, value)


def _contacts(plan: Plan, scene: PlanningScene, margin: float) -> Contacts:
    """With the others, for at least 3 s, up to the plan's end or the recording's; with the partner 3 s longer."""
    until = scene.duration + (HORIZON if scene.partner.any() else 0.0)
    times = np.append(0.0, steps_of(FRAME_PERIOD, until))
    return first_contacts(
        box_path(plan.poses(times), scene.offset),
        scene.size,
        _prolonged(scene, len(times)),
        np.where(scene.partner, margin, 0.0),
        np.where(
            scene.partner, until, min(scene.duration, max(float(plan.times[-1]), HORIZONS[-1]))
        ),
    )


def _at_horizon(
    away: FloatArray, scene: PlanningScene, contacts: Contacts, horizon: int
) -> dict[str, float]:
    """Errors (N,) at the recorded steps, and contacts, of a plan up to a horizon; NaN where nothing is recorded."""
    last = round(horizon / STEP)
    touches = (contacts.time <= min(horizon, scene.duration) + _SLACK).any()
    return {
        "l2": float(away[last - 1]) if len(away) >= last else np.nan,
        "l2_mean": float(away[:last].mean()) if len(away) else np.nan,
        "contact": 100.0 * touches if len(away) else np.nan,
    }


def _at_lead(
    plan: Plan, scene: PlanningScene, contacts: Contacts, true: Contacts, rules: CleanPlanning
) -> dict[str, float]:
    """What a plan makes of the accident, or of what happens in its place in a twin."""
    known = min(float(plan.times[-1]), scene.duration)
    new = (contacts.time <= known + _SLACK) & (true.time > known + _SLACK) & ~scene.partner
    along, across = _accelerations(plan, scene.before)
    lost, way = _progress(plan, scene, known)
    hardest = max(np.abs(along).max(), np.abs(across).max())
    numbers = {
        "striking": 100.0 * (new & ~contacts.struck).any(),
        "struck": 100.0 * (new & contacts.struck).any(),
        "lost_way": lost,
        "lost": 100.0 * lost / way if way > _FAR else np.nan,
        "infeasible": 100.0 * (hardest > rules.most_acceleration + _SLACK),
    }
    if scene.is_twin:
        numbers = {f"{name}_twins": value for name, value in numbers.items()}
        numbers["braking_twins"] = 100.0 * (along.min() < -rules.braking)
    for at in np.flatnonzero(scene.partner):
        time = float(contacts.time[at])
        numbers |= {
            "avoided": 100.0 * np.isinf(time),
            "impact_speed": float(contacts.speed[at]),
            "relative_speed": float(contacts.relative_speed[at]),
            "prolonged": 100.0 * (known + _SLACK < time < np.inf),
        }
    return {name: float(value) for name, value in numbers.items()}


def box_path(poses: FloatArray, offset: FloatArray) -> FloatArray:
    """(N, 3) x, y, yaw of the box's centre, of poses (N, 3) of the ego frame; `offset` (2,) is the centre in it."""
    cosine, sine = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    x = poses[:, 0] + cosine * offset[0] - sine * offset[1]
    return np.column_stack([x, poses[:, 1] + sine * offset[0] + cosine * offset[1], poses[:, 2]])


def _margin(scene: PlanningScene) -> float:
    """The gap between the recorded pair at the end, which counts as contact; NaN without a partner."""
    ego = np.concatenate(
        [box_path(scene.recorded[-1:], scene.offset)[0, :2], scene.size, scene.recorded[-1, 2:]]
    )
    gaps = gaps_of_pairs(ego, scene.footprint[-1, scene.partner])
    return float(gaps[0]) + TOUCHING if len(gaps) else np.nan


def _prolonged(scene: PlanningScene, frames: int) -> FloatArray:
    """Return (frames, A, 5) recorded footprints, and later those of the partner, which goes straight on.

    Its velocity is that between its last two labels, however many frames between them have none.
    """
    known = without_gaps(scene.footprint)
    after = np.full((frames - len(known), *known.shape[1:]), np.nan)
    last = np.broadcast_to(known[-1], after.shape).copy()
    last[..., :2] += np.arange(1, len(after) + 1)[:, None, None] * (known[-1] - known[-2])[:, :2]
    return np.concatenate([known, np.where(scene.partner[:, None], last, after)])


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
    share = np.divide(
        (place * steps).sum(axis=1), lengths**2, out=np.zeros(len(steps)), where=lengths > 0
    ).clip(0, 1)
    nearest = int(np.argmin(np.hypot(*(place - share[:, None] * steps).T)))
    way = float(np.interp(until, times, arcs))
    return way - float(arcs[nearest] + share[nearest] * lengths[nearest]), way


def _unusable(scene: PlanningScene, margin: float, true: Contacts) -> str:
    """Why an accident does not count, as half a sentence; empty if it does: the recorded path must meet the partner."""
    if not scene.partner.any():
        return "no label shows the partner from here on"
    if true.overlapping[scene.partner].any():
        return "the pair touches at the present already"
    if not margin <= MOST_MARGIN:
        return f"the pair is {margin:.2f} m apart at the end"
    return (
        ""
        if true.time[scene.partner][0] <= scene.duration + _SLACK
        else "the recorded path does not meet the partner"
    )
