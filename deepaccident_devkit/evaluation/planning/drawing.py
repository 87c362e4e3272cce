"""Pictures of plans: the planned and the recorded path, and the contact that a plan runs into."""

import numpy as np

from deepaccident_devkit.evaluation.drawing import Drawing, DrawnBoxes, DrawnPath, DrawnPlaces
from deepaccident_devkit.evaluation.planning.clean import box_path, plan_contacts
from deepaccident_devkit.evaluation.planning.contacts import without_gaps
from deepaccident_devkit.evaluation.planning.scene import Plan, PlanningScene
from deepaccident_devkit.geometry import Box, Boxes
from deepaccident_devkit.support.arrays import FloatArray
from deepaccident_devkit.taxonomy import FRAME_PERIOD

# Height of the boxes at a contact, metres; footprints have none.
_BOX_HEIGHT_M = 1.5
# A contact counts up to this long after the plan's last time, seconds.
_TIME_TOLERANCE_S = FRAME_PERIOD / 2


def drawing_of_plan(plan: Plan, scene: PlanningScene) -> Drawing:
    """Describe a plan, the recorded path of the same duration, and the plan's first contact.

    Args:
        plan: Plan of the agent.
        scene: Scene of the sample.
    """
    width = float(scene.size[1])
    planned = plan.drawing(width).paths
    duration = float(plan.times[-1])
    frame_count = round(duration / FRAME_PERIOD) + 1
    recorded = scene.recorded[:frame_count, :2]
    recorded_path = DrawnPath(
        xy=recorded,
        times=np.arange(len(recorded), dtype=np.float64) * FRAME_PERIOD,
        role="truth",
        label="recorded path",
    )
    paths = planned
    if len(recorded) > 1:
        paths = (*planned, recorded_path)
    contact = _first_contact(plan, scene)
    if contact is None:
        return Drawing(paths=paths, words=f"no contact in {duration:.1f} s")
    time, actor = contact
    pair = _boxes_at(time, actor, plan, scene)
    ego, other = pair
    touching_point = _nearest_in(other, _nearest_in(ego, other.center))
    words = f"contact in {time:.1f} s"
    place = DrawnPlaces(
        xy=touching_point[None, :2],
        time=time,
        role="collision",
        note=words,
        label="contact of the plan",
    )
    boxes = DrawnBoxes(boxes=pair, role="collision", time=time, label="boxes at the contact")
    return Drawing(paths=paths, boxes=(boxes,), places=(place,), words=f"the plan has {words}")


def _first_contact(plan: Plan, scene: PlanningScene) -> tuple[float, int] | None:
    """Return the time of a plan's first contact, seconds, and the actor's column in the scene.

    Return None if the plan touches nobody up to its end.
    """
    contacts = plan_contacts(plan, scene)
    if contacts is None or not len(contacts.time):
        return None
    actor = int(np.argmin(contacts.time))
    time = float(contacts.time[actor])
    if time > plan.times[-1] + _TIME_TOLERANCE_S:
        return None
    return time, actor


def _boxes_at(time: float, actor: int, plan: Plan, scene: PlanningScene) -> Boxes:
    """Return the boxes of the ego and of another actor at a time, in the current ego frame.

    After the recording's end, the actor is where it was last recorded.
    """
    ego_pose = box_path(plan.poses(np.array([time])), scene.offset)[0]
    ego = np.array([*ego_pose[:2], *scene.size, ego_pose[2]])
    frame_times = np.arange(len(scene.recorded)) * FRAME_PERIOD
    footprints = without_gaps(scene.footprint[:, [actor]])[:, 0]
    is_known = np.isfinite(footprints[:, 0])
    known_times = frame_times[is_known]
    columns = footprints[is_known].T
    other = np.array([np.interp(time, known_times, column) for column in columns])
    return _upright_boxes(np.stack([ego, other]))


def _nearest_in(box: Box, point: FloatArray) -> FloatArray:
    """Return the position (3,) in a box that is nearest to a point (3,)."""
    half = box.size / 2
    in_box = box.rotation_matrix.T @ (point - box.center)
    return np.asarray(box.center + box.rotation_matrix @ in_box.clip(-half, half))


def _upright_boxes(footprints: FloatArray) -> Boxes:
    """Return boxes on the ground of the ego frame from footprints (N, 5)."""
    x, y, length, width, yaw = footprints.T
    height = np.full(len(x), _BOX_HEIGHT_M)
    center = np.column_stack([x, y, height / 2])
    size = np.column_stack([length, width, height])
    return Boxes.from_arrays(center, size, yaw, frame="ego")
