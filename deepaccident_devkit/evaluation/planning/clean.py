"""`CleanPlanning`: what a plan changes in a recorded accident, and what it costs elsewhere."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product

import numpy as np

from deepaccident_devkit.collisions.contact import TOUCHING
from deepaccident_devkit.collisions.outcomes import MAX_END_GAP_M
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

# Seconds, metres or m/s². Times are decimal numbers, and a path that is projected onto itself loses
# digits.
_ROUNDING_TOLERANCE = 1e-6
# A sample counts for a lead if its time to the accident differs from it by at most this, seconds.
# Lists of samples are counted back from the end of each recording, so leads are not exact.
_LEAD_TOLERANCE_S = 0.2
# The lost share of the recorded progress is only meaningful if the progress is longer than this.
_MIN_PROGRESS_M = 1.0
# To measure progress, the recorded path is extended by this many seconds after the recording.
_PATH_EXTENSION_S = 100.0


@dataclass(frozen=True, slots=True, kw_only=True)
class CleanPlanning:
    """Rules of the protocol `clean`; docs/protocols.md, section "Planning", defines its numbers.

    Attributes:
        leads: Seconds before the accident at which plans are judged.
        most_acceleration: If a plan's longitudinal or lateral acceleration exceeds this, it cannot
            be driven; m/s².
        braking: Decelerations from which passengers notice braking, m/s².
    """

    leads: tuple[float, ...] = (3.0, 2.0, 1.0, 0.5)
    most_acceleration: float = 10.0
    braking: float = 3.0


def add_clean(
    sums: Sums, plans: Mapping[str, Plan], scene: PlanningScene, rules: CleanPlanning
) -> None:
    """Add the effects of plans to the sums; all other actors move as recorded.

    Args:
        sums: Sums of the sample, which are changed.
        plans: Name of the row → plan; the row `recorded` has the recorded path.
        scene: Scene of the sample.
        rules: Rules of the protocol.
    """
    if len(scene.recorded) < 2:
        sums.note(
            "no numbers for {sample} without a later frame that counts; a twin ends where its "
            "accident ends"
        )
        return
    margin = _contact_margin(scene)
    contacts = {name: _contacts(plan, scene, margin) for name, plan in plans.items()}
    recorded_contacts = contacts["recorded"]
    overlapping = recorded_contacts.overlapping
    if overlapping.any():
        sums.note(
            "excluded: {actor} touching ego in the sample's own frame", int(overlapping.sum())
        )
    if scene.is_collider and not scene.is_twin:
        reason = _reason_to_leave_out(scene, margin, recorded_contacts)
        if reason:
            sums.note(f"{scene.scenario}: {reason}; excluded: {{sample}}")
            return
    lead_tables = _lead_tables(scene, rules)
    times = steps_of(STEP, min(scene.duration, HORIZONS[-1]))
    recorded_path = recorded_poses(scene, times)[:, :2]
    for row, plan in plans.items():
        path = plan.poses(times)[:, :2]
        errors = plan_displacement_errors(path, recorded_path)
        for horizon in HORIZONS:
            numbers = _numbers_at_horizon(errors, scene, contacts[row], horizon)
            for column, value in numbers.items():
                sums.add(f"{horizon} s", row, column, value)
        if lead_tables:
            numbers = _numbers_at_lead(plan, scene, contacts[row], recorded_contacts, rules)
            for table, (column, value) in product(lead_tables, numbers.items()):
                sums.add(table, row, column, value)


def _lead_tables(scene: PlanningScene, rules: CleanPlanning) -> list[str]:
    """Return the names of the tables of the leads at which the sample counts."""
    role = "bystander, "
    if scene.is_collider:
        role = ""
    tables = []
    for end, suffix in ((scene.to_end, ""), (scene.to_contact, " to contact")):
        for lead in rules.leads:
            if abs(end - lead) <= _LEAD_TOLERANCE_S + _ROUNDING_TOLERANCE:
                tables.append(f"{role}lead {lead:g} s{suffix}")
    return tables


def _contacts(plan: Plan, scene: PlanningScene, margin: float) -> Contacts:
    """Find the first contact of a plan with each other actor.

    The search ends with the plan or after 3 s, whichever is later, but at the latest with the
    recording. For the partner it ends 3 s after the recording.

    Args:
        plan: Plan of the agent.
        scene: Scene of the sample.
        margin: Gap that counts as contact with the partner, metres; for others it is 0.
    """
    partner_end = scene.duration
    if scene.partner.any():
        partner_end += HORIZON
    plan_end = max(float(plan.times[-1]), HORIZONS[-1])
    other_end = min(scene.duration, plan_end)
    times = np.append(0.0, steps_of(FRAME_PERIOD, partner_end))
    return first_contacts(
        box_path(plan.poses(times), scene.offset),
        scene.size,
        _extended_footprints(scene, len(times)),
        np.where(scene.partner, margin, 0.0),
        np.where(scene.partner, partner_end, other_end),
    )


def plan_contacts(plan: Plan, scene: PlanningScene) -> Contacts | None:
    """Find the first contact of a plan with each other actor, as the protocol `clean` does.

    Returns:
        The contacts; None if no later frame is recorded.
    """
    if len(scene.recorded) < 2:
        return None
    return _contacts(plan, scene, _contact_margin(scene))


def _numbers_at_horizon(
    errors: FloatArray, scene: PlanningScene, contacts: Contacts, horizon: int
) -> dict[str, float]:
    """Compute the displacement errors and contacts of a plan up to a horizon.

    Args:
        errors: (N,) distances from the recorded path at its steps, metres.
        scene: Scene of the sample.
        contacts: First contacts of the plan.
        horizon: Seconds after the current frame.

    Returns:
        Column → metres or percent; NaN if no step is recorded (for `l2`: the horizon's step).
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


def _numbers_at_lead(
    plan: Plan,
    scene: PlanningScene,
    contacts: Contacts,
    recorded_contacts: Contacts,
    rules: CleanPlanning,
) -> dict[str, float]:
    """Compute the effects of a plan on the accident, or at the same time of a twin.

    Returns:
        Column → metres, m/s or percent.
    """
    end = min(float(plan.times[-1]), scene.duration)
    latest = end + _ROUNDING_TOLERANCE
    is_new = (contacts.time <= latest) & (recorded_contacts.time > latest) & ~scene.partner
    along, across = _accelerations(plan, scene.before)
    hardest = max(np.abs(along).max(), np.abs(across).max())
    progress, recorded_progress = _progress(plan, scene, end)
    lost_progress = recorded_progress - progress
    lost_percent = np.nan
    if recorded_progress > _MIN_PROGRESS_M:
        lost_percent = 100.0 * lost_progress / recorded_progress
    numbers = {
        "striking": 100.0 * (is_new & ~contacts.struck).any(),
        "struck": 100.0 * (is_new & contacts.struck).any(),
        "lost_way": lost_progress,
        "lost": lost_percent,
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
    """Convert poses of the ego frame to poses of the centre of the ego's box, (N, 3: x, y, yaw).

    Args:
        poses: (N, 3) x, y, yaw of the ego frame, metres and radians.
        offset: (2,) centre of the box in the ego frame, metres.
    """
    x, y, yaw = poses.T
    cosine = np.cos(yaw)
    sine = np.sin(yaw)
    box_x = x + cosine * offset[0] - sine * offset[1]
    box_y = y + sine * offset[0] + cosine * offset[1]
    return np.column_stack([box_x, box_y, yaw])


def _contact_margin(scene: PlanningScene) -> float:
    """Return the gap between the recorded pair in the last frame, metres; NaN without a partner.

    A gap up to this size counts as contact with the partner.
    """
    x, y, yaw = box_path(scene.recorded[-1:], scene.offset)[0]
    ego_footprint = np.array([x, y, *scene.size, yaw])
    gaps = gaps_of_pairs(ego_footprint, scene.footprint[-1, scene.partner])
    if not len(gaps):
        return np.nan
    return float(gaps[0]) + TOUCHING


def _extended_footprints(scene: PlanningScene, frames: int) -> FloatArray:
    """Extend the recorded footprints to a number of frames; only the partner moves on.

    The partner goes straight on with its velocity between its last two labels, even if there are
    frames without a label between them.

    Returns:
        Footprints, shape (frames, A, 5); NaN where an actor is missing.
    """
    recorded = without_gaps(scene.footprint)
    later_frames = np.arange(1, frames - len(recorded) + 1)
    later = np.repeat(recorded[-1:], len(later_frames), axis=0)
    last_step = (recorded[-1] - recorded[-2])[:, :2]
    later[..., :2] += later_frames[:, None, None] * last_step
    later[:, ~scene.partner] = np.nan
    return np.concatenate([recorded, later])


def _accelerations(plan: Plan, before: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Compute the longitudinal and lateral accelerations of a plan at each step, m/s².

    Args:
        plan: Plan of the agent.
        before: (2,) velocity before the plan begins, m/s; the first step is compared with it.
    """
    times = np.append(0.0, plan.times[plan.times > 0])
    poses = plan.poses(times)
    periods = np.diff(times)[:, None]
    planned_velocity = np.diff(poses[:, :2], axis=0) / periods
    velocity = np.vstack([before, planned_velocity])
    ax, ay = (np.diff(velocity, axis=0) / periods).T
    yaw = poses[:-1, 2]
    cosine = np.cos(yaw)
    sine = np.sin(yaw)
    along = cosine * ax + sine * ay
    across = cosine * ay - sine * ax
    return along, across


def _progress(plan: Plan, scene: PlanningScene, time: float) -> tuple[float, float]:
    """Return the planned and the recorded progress along the recorded path up to a time, metres."""
    recorded_times = np.arange(len(scene.recorded)) * FRAME_PERIOD
    times = np.append(recorded_times, scene.duration + _PATH_EXTENSION_S)
    path = recorded_poses(scene, times)[:, :2]
    steps = np.diff(path, axis=0)
    lengths = np.hypot(steps[:, 0], steps[:, 1])
    arc_lengths = np.append(0.0, np.cumsum(lengths))
    recorded_progress = float(np.interp(time, times, arc_lengths))
    planned_position = plan.poses(np.array([time]))[0, :2]
    offsets = planned_position - path[:-1]
    projections = (offsets * steps).sum(axis=1)
    zeros = np.zeros(len(steps))
    shares = np.divide(projections, lengths**2, out=zeros, where=lengths > 0).clip(0, 1)
    dx, dy = (offsets - shares[:, None] * steps).T
    nearest_index = int(np.argmin(np.hypot(dx, dy)))
    progress = float(arc_lengths[nearest_index] + shares[nearest_index] * lengths[nearest_index])
    return progress, recorded_progress


def _reason_to_leave_out(scene: PlanningScene, margin: float, recorded_contacts: Contacts) -> str:
    """Return why an accident does not count, as half a sentence; empty if it counts.

    It only counts if the ego on its recorded path touches the partner.
    """
    if not scene.partner.any():
        return "no label shows the partner from here on"
    if recorded_contacts.overlapping[scene.partner].any():
        return "the pair already touches at the present moment"
    if not margin <= MAX_END_GAP_M:
        return f"the pair is {margin:.2f} m apart at the end"
    contact_time = recorded_contacts.time[scene.partner][0]
    if contact_time <= scene.duration + _ROUNDING_TOLERANCE:
        return ""
    return "the recorded path does not meet the partner"
