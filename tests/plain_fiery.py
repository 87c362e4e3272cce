"""FIERY's own reading of a sample, computed once more and plainly: what its dataset class draws
(fd03f16).

It takes the world's boxes and the ego's pose, as the nuScenes export writes them.
"""

import cv2
import numpy as np
from pyquaternion import Quaternion

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.taxonomy import OWN_ACTOR_ID, UNTRACKED_ID

INNER = slice(4, -4)
"""Cells that no version of OpenCV fills otherwise: they differ in how they cut polygons at the
edge.
"""


def instances(
    release: DeepAccident, token: str, *, filter_invisible: bool, steps: int = 5
) -> np.ndarray:
    """(steps, 200, 200) ids in the order drawn, rows along x; 0 beyond the recording's end."""
    recording, number = token.rsplit("/", 1)
    last = release.get("scenario", release.get("sample", token)["scenario_token"])["num_frames"]
    maps, ids = np.zeros((steps, 200, 200), dtype=np.int32), {}
    for step, raster in enumerate(maps):
        if int(number) + 5 * step > last:
            break
        at = f"{recording}/{int(number) + 5 * step:03d}"
        pose, boxes = release.ego_pose.get(at), release.boxes(at)
        yaw = Quaternion(pose["rotation"]).yaw_pitch_roll[0]
        level = Quaternion(scalar=np.cos(yaw / 2), vector=[0, 0, np.sin(yaw / 2)]).inverse
        for row, (actor, category) in enumerate(
            zip(boxes.actor_id.tolist(), boxes.category_names, strict=True)
        ):
            hidden = filter_invisible and not boxes.camera_visible[row]
            if actor == OWN_ACTOR_ID or category == "pedestrian" or hidden:
                continue
            own = ids.setdefault((step, row) if actor == UNTRACKED_ID else actor, len(ids) + 1)
            length, width, height = boxes.size[row] / 2
            bottom = np.array([(1, -1, -1), (1, 1, -1), (-1, 1, -1), (-1, -1, -1)]) * (
                length,
                width,
                height,
            )
            corners = bottom @ Quaternion(boxes.rotation[row]).rotation_matrix.T + boxes.center[row]
            corners = (corners - pose["translation"]) @ level.rotation_matrix.T
            cells = np.round((corners[:, 1::-1] + 50) / 0.5).astype(np.int32)
            cv2.fillPoly(raster, [np.ascontiguousarray(cells)], own)
    return maps
