"""One box: large from above, in a camera and in words."""

import numpy as np
import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.render import detached_figure, render_annotation
from deepaccident_devkit.taxonomy import OWN_ACTOR_ID


def test_an_annotation_is_shown_large_from_above_and_in_words(da: DeepAccident, frame: str) -> None:
    sample = f"{frame.rsplit('/', 1)[0]}/ego_vehicle_behind/004"
    ego = da.get("agent", f"{frame.rsplit('/', 1)[0]}/ego_vehicle")["actor_id"]
    boxes = da.boxes(sample, "ego")
    row = int(np.flatnonzero(boxes.actor_id == ego)[0])
    fig = render_annotation(da, f"{sample}/{row}", margin=8, fig=detached_figure((10, 5)))
    camera, above, words = fig.axes
    assert camera.get_title() == "Camera_Front"
    assert np.ptp(camera.get_xlim()) <= 64
    center = np.mean([above.get_xlim(), above.get_ylim()], axis=1)
    np.testing.assert_allclose(center, boxes.center[row, :2], atol=1e-9)
    assert np.ptp(above.get_xlim()) == pytest.approx(16)
    text = "\n".join(one.get_text() for one in words.texts)
    length, width, height = boxes.size[row]
    for fact in (
        f"category: {boxes.category_names[row]}",
        f"label id: {ego}",
        f"size: {length:.2f} × {width:.2f} × {height:.2f} m",
        f"speed: {np.linalg.norm(boxes.velocity[row]):.1f} m/s",
        f"distance: {np.linalg.norm(boxes.center[row, :2]):.1f} m from the agent",
        f"LiDAR points: {boxes.num_lidar_pts[row]}",
        "impact: in 0.2 s, with this actor",
        "annotated by: ego, ego behind",
    ):
        assert fact in text


def test_an_agent_s_own_box_is_in_none_of_its_cameras(da: DeepAccident, frame: str) -> None:
    sample = f"{frame.rsplit('/', 1)[0]}/ego_vehicle/004"
    own = da.boxes(sample, "lidar").actor_id.tolist().index(OWN_ACTOR_ID)
    fig = render_annotation(da, f"{sample}/{own}", fig=detached_figure((10, 5)))
    assert [one.get_text() for one in fig.axes[0].texts] == ["in no image of its agent's cameras"]
