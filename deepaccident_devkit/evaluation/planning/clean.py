"""`CleanPlanning`: effects of a plan on a recorded accident, and costs where nothing happens."""

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
from deepaccident_devkit.evaluation.planning.cells import (
    HORIZONS,
    STEP,
    plan_displacement_errors,
)
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

# Seconds, metres or m/s²: times are decimal numbers, and a path projected on itself loses digits.
_ROUNDING_TOLERANCE: Final = 1e-6
# Seconds between a sample and the lead that it counts for: lists of samples count back from each
# recording's own end.
_LEAD_TOLERANCE_S: Final = 0.2
# Recorded progress in metres above which the lost share of it is meaningful.
_MIN_PROGRESS_M: Final = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class CleanPlanning:
    """Rules of the protocol `clean`; docs/protocols.md, Planning, defines the numbers.

    Attributes:
        leads: Seconds before the accident at which plans are judged.
        most_acceleration: m/s² along or across beyond which a plan cannot be driven.
        braking: m/s² of a deceleration that passengers feel.
    """

    leads: tuple[float, ...] = (3.0, 2.0, 1.0, 0.5)
    most_acceleration: float = 10.0
    braking: float = 3.0


def add_clean(
    sums: Sums, plans: Mapping[str, Plan], scene: PlanningScene, rules: CleanPlanning
) -> None:
    """Add the effects of plans, among others that keep their recorded motion, to the sums.

    Args:
        sums: Sums of the sample.
        plans: Plans by the name of their row; the recorded path is called `recorded`.
        scene: Scene of the sample.
        rules: The protocol.
    """
    if len(scene.recorded) < 2:
        sums.note(
            "no numbers of {sample} without a later frame that counts; twins end where their "
            "accident does"
        )
        return
    margin = _margin(scene)
    contacts = {name: _contacts(plan, scene, margin) for name, plan in plans.items()}
    recorded_contacts = contacts["recorded"]
    overlapping = recorded_contacts.overlapping
    if overlapping.any():
        sums.note("left out: {actor} touching the ego at the present", int(overlapping.sum()))
    if scene.is_collider and not scene.is_twin:
        reason = _unusable(scene, margin, recorded_contacts)
        if reason:
            sums.note(f"{scene.scenario}: {reason}; left out: {{sample}}")
            return
    leads = _lead_tables(scene, rules)
    steps = steps_of(STEP, min(scene.duration, HORIZONS[-1]))
    recorded = recorded_poses(scene, steps)[:, :2]
    for row, plan in plans.items():
        errors = plan_displacement_errors(plan.poses(steps)[:, :2], recorded)
        for horizon in HORIZONS:
            for column, value in _at_horizon(errors, scene, contacts[row], horizon).items():
                sums.add(f"{horizon} s", row, column, value)
        if leads:
            numbers = _at_lead(plan, scene, contacts[row], recorded_contacts, rules)
            for table, (column, value) in product(leads, numbers.items()):
                sums.add(table, row, column, value)


def _lead_tables(scene: PlanningScene, rules: CleanPlanning) -> list[str]:
    """Return the names of the tables of the leads that a sample counts for."""
    role = "" if scene.is_collider else "bystander, "
    tables = []
    for end, suffix in ((scene.to_end, ""), (scene.to_contact, " to contact")):
        for lead in rules.leads:
            if abs(end - lead) <= _LEAD_TOLERANCE_S + _ROUNDING_TOLERANCE:
                tables.append(f"{role}lead {lead:g} s{suffix}")
    return tables


def _contacts(plan: Plan, scene: PlanningScene, margin: float) -> Contacts:
    """Return the first contacts of a plan with the others.

    They are searched for at least 3 s, up to the plan's end or the recording's; with the partner
    for 3 s after the recording.
    """
    partner_end = scene.duration + (HORIZON if scene.partner.any() else 0.0)
    other_end = min(scene.duration, max(float(plan.times[-1]), HORIZONS[-1]))
    times = np.append(0.0, steps_of(FRAME_PERIOD, partner_end))
    return first_contacts(
        box_path(plan.poses(times), scene.offset),
        scene.size,
        _prolonged(scene, len(times)),
        np.where(scene.partner, margin, 0.0),
        np.where(scene.partner, partner_end, other_end),
    )


def _at_horizon(
    errors: FloatArray, scene: PlanningScene, contacts: Contacts, horizon: int
) -> dict[str, float]:
    """Return displacement errors and contacts of a plan up to a horizon.

    Args:
        errors: (N,) distances from the recorded path at its steps, metres.
        scene: Scene of the sample.
        contacts: First contacts of the plan.
        horizon: Seconds.

    Returns:
        Metres and percent by column; NaN where nothing is recorded.
    """
    if not len(errors):
        return {"l2": np.nan, "l2_mean": np.nan, "contact": np.nan}
    count = round(horizon / STEP)
    end = min(horizon, scene.duration)
    touches = (contacts.time <= end + _ROUNDING_TOLERANCE).any()
    return {
        "l2": float(errors[count - 1]) if len(errors) >= count else np.nan,
        "l2_mean": float(errors[:count].mean()),
        "contact": 100.0 * touches,
    }


def _at_lead(
    plan: Plan,
    scene: PlanningScene,
    contacts: Contacts,
    recorded_contacts: Contacts,
    rules: CleanPlanning,
) -> dict[str, float]:
    """Return the effects of a plan on the accident, or on the same moment of a twin."""
    end = min(float(plan.times[-1]), scene.duration)
    latest = end + _ROUNDING_TOLERANCE
    is_new = (contacts.time <= latest) & (recorded_contacts.time > latest) & ~scene.partner
    along, across = _accelerations(plan, scene.before)
    lost, progress = _progress(plan, scene, end)
    hardest = max(np.abs(along).max(), np.abs(across).max())
    numbers = {
        "striking": 100.0 * (is_new & ~contacts.struck).any(),
        "struck": 100.0 * (is_new & contacts.struck).any(),
        "lost_way": lost,
        "lost": 100.0 * lost / progress if progress > _MIN_PROGRESS_M else np.nan,
        "infeasible": 100.0 * (hardest > rules.most_acceleration + _ROUNDING_TOLERANCE),
    }
    if scene.is_twin:
        numbers = {f"{name}_twins": value for name, value in numbers.items()}
        numbers["braking_twins"] = 100.0 * (along.min() < -rules.braking)
    for partner in np.flatnonzero(scene.partner):
        time = float(contacts.time[partner])
        numbers |= {
            "avoided": 100.0 * np.isinf(time),
            "impact_speed": float(contacts.speed[partner]),
            "relative_speed": float(contacts.relative_speed[partner]),
            "prolonged": 100.0 * (latest < time < np.inf),
        }
    return {name: float(value) for name, value in numbers.items()}


def box_path(poses: FloatArray, offset: FloatArray) -> FloatArray:
    """Return x, y, yaw of the centre of the ego's box, shape (N, 3).

    Args:
        poses: (N, 3) x, y, yaw of the ego frame.
        offset: (2,) centre of the box in the ego frame, metres.
    """
    cosine = np.cos(poses[:, 2])
    sine = np.sin(poses[:, 2])
    x = poses[:, 0] + cosine * offset[0] - sine * offset[1]
    y = poses[:, 1] + sine * offset[0] + cosine * offset[1]
    return np.column_stack([x, y, poses[:, 2]])


def _margin(scene: PlanningScene) -> float:
    """Return the gap between the recorded pair at the end, which counts as contact, metres.

    NaN without a partner.
    """
    last_pose = scene.recorded[-1:]
    center = box_path(last_pose, scene.offset)[0, :2]
    ego = np.concatenate([center, scene.size, scene.recorded[-1, 2:]])
    gaps = gaps_of_pairs(ego, scene.footprint[-1, scene.partner])
    return float(gaps[0]) + TOUCHING if len(gaps) else np.nan


def _prolonged(scene: PlanningScene, frames: int) -> FloatArray:
    """Return the recorded footprints (frames, A, 5), after their end only the partner's.

    The partner goes straight on; its velocity is that between its last two labels, however many
    frames between them have none.
    """
    recorded = without_gaps(scene.footprint)
    absent = np.full((frames - len(recorded), *recorded.shape[1:]), np.nan)
    later = np.broadcast_to(recorded[-1], absent.shape).copy()
    step = (recorded[-1] - recorded[-2])[:, :2]
    steps = np.arange(1, len(absent) + 1)
    later[..., :2] += steps[:, None, None] * step
    partner = scene.partner[:, None]
    return np.concatenate([recorded, np.where(partner, later, absent)])


def _accelerations(plan: Plan, before: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the accelerations along and across the heading at each step, m/s².

    Args:
        plan: The plan.
        before: (2,) velocity at the present, m/s, from which the first change counts.
    """
    times = np.append(0.0, plan.times[plan.times > 0])
    poses = plan.poses(times)
    periods = np.diff(times)
    later_velocity = np.diff(poses[:, :2], axis=0) / periods[:, None]
    velocity = np.vstack([before, later_velocity])
    change = np.diff(velocity, axis=0) / periods[:, None]
    cosine = np.cos(poses[:-1, 2])
    sine = np.sin(poses[:-1, 2])
    along = cosine * change[:, 0] + sine * change[:, 1]
    across = cosine * change[:, 1] - sine * change[:, 0]
    return along, across


def _progress(plan: Plan, scene: PlanningScene, time: float) -> tuple[float, float]:
    """Return the progress that a plan loses up to a time, and the recorded progress.

    Both in metres along the recorded path.
    """
    times = np.append(np.arange(len(scene.recorded)) * FRAME_PERIOD, scene.duration + 100.0)
    path = recorded_poses(scene, times)[:, :2]
    steps = np.diff(path, axis=0)
    lengths = np.hypot(*steps.T)
    arcs = np.append(0.0, np.cumsum(lengths))
    offset = plan.poses(np.array([time]))[0, :2] - path[:-1]
    projection = (offset * steps).sum(axis=1)
    zeros = np.zeros(len(steps))
    share = np.divide(projection, lengths**2, out=zeros, where=lengths > 0).clip(0, 1)
    distance = np.hypot(*(offset - share[:, None] * steps).T)
    nearest = int(np.argmin(distance))
    recorded_progress = float(np.interp(time, times, arcs))
    progress = float(arcs[nearest] + share[nearest] * lengths[nearest])
    return recorded_progress - progress, recorded_progress


def _unusable(scene: PlanningScene, margin: float, recorded_contacts: Contacts) -> str:
    """Return why an accident does not count, as half a sentence; empty if it does.

    The recorded path must meet the partner.
    """
    if not scene.partner.any():
        return "no label shows the partner from here on"
    if recorded_contacts.overlapping[scene.partner].any():
        return "the pair touches at the present already"
    if not margin <= MOST_MARGIN:
        return f"the pair is {margin:.2f} m apart at the end"
    contact_time = recorded_contacts.time[scene.partner][0]
    if contact_time <= scene.duration + _ROUNDING_TOLERANCE:
        return ""
    return "the recorded path does not meet the partner"
