"""Draw the instances of a sample plainly, as FIERY's dataset class does (fd03f16).

It takes the world's boxes and the ego's pose, as the nuScenes export writes them.
"""

import cv2
import numpy as np
from pyquaternion import Quaternion

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.taxonomy import OWN_ACTOR_ID, UNTRACKED_ID

INNER_MARGIN = slice(4, -4)
"""Cells that all versions of OpenCV fill alike; they cut polygons at the edge differently."""
BOTTOM_CORNERS = np.array([(1, -1, -1), (1, 1, -1), (-1, 1, -1), (-1, -1, -1)])


def instances(
    release: DeepAccident, token: str, *, filter_invisible: bool, steps: int = 5
) -> np.ndarray:
    """Draw (steps, 200, 200) ids in the order of drawing, rows along x; 0 beyond the recording's
    end.
    """
    recording, number = token.rsplit("/", 1)
    scenario = release.get("scenario", release.get("sample", token)["scenario_token"])
    maps = np.zeros((steps, 200, 200), dtype=np.int32)
    ids = {}
    for step, raster in enumerate(maps):
        frame = int(number) + 5 * step
        if frame > scenario["num_frames"]:
            break
        frame_token = f"{recording}/{frame:03d}"
        pose = release.ego_pose.get(frame_token)
        boxes = release.boxes(frame_token)
        yaw = Quaternion(pose["rotation"]).yaw_pitch_roll[0]
        level = Quaternion(scalar=np.cos(yaw / 2), vector=[0, 0, np.sin(yaw / 2)]).inverse
        for row, (actor, category) in enumerate(
            zip(boxes.actor_id.tolist(), boxes.category_names, strict=True)
        ):
            hidden = filter_invisible and not boxes.camera_visible[row]
            if actor == OWN_ACTOR_ID or category == "pedestrian" or hidden:
                continue
            key = (step, row) if actor == UNTRACKED_ID else actor
            instance = ids.setdefault(key, len(ids) + 1)
            bottom = BOTTOM_CORNERS * boxes.size[row] / 2
            corners = bottom @ Quaternion(boxes.rotation[row]).rotation_matrix.T + boxes.center[row]
            corners = (corners - pose["translation"]) @ level.rotation_matrix.T
            cells = np.round((corners[:, 1::-1] + 50) / 0.5).astype(np.int32)
            cv2.fillPoly(raster, [np.ascontiguousarray(cells)], instance)
    return maps
