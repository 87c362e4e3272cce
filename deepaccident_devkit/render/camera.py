"""A camera's image with the boxes it may see."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.geometry import PinholeCamera
from deepaccident_devkit.render.axes import axes_or_new
from deepaccident_devkit.render.bev import collider_ids
from deepaccident_devkit.render.boxes import box_colors, draw_boxes_in_image
from deepaccident_devkit.taxonomy import OWN_ACTOR_ID

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def render_sample_data(dataset: Dataset, sample_data: RowArgument, *, ax: Axes | None = None) -> Axes:
    """Draw a camera's image and the boxes that any of the agent's cameras sees.

    Args:
        dataset: the release.
        sample_data: token or record of a camera's file.
        ax: axes to draw on; new ones if None.

    Returns:
        The axes drawn on, in pixels.

    Raises:
        TokenError: no such sensor file.
        ChoiceError: the sensor is no camera.
        MissingFileError: the image was not downloaded.
    """
    record = dataset.get("sample_data", sample_data)
    if record["modality"] != "camera":
        raise ChoiceError(f"render_sample_data: expected a camera, found {record['channel']}; see render_bev")
    ax = axes_or_new(ax, (8, 4.5))
    image = dataset.load_image(record)
    height, width = image.shape[:2]
    sensor = dataset.get("calibrated_sensor", record["calibrated_sensor_token"])
    camera = PinholeCamera(np.array(sensor["camera_intrinsic"]), width, height)
    boxes = dataset.boxes(record["sample_token"], frame=record["channel"], visible="camera")
    boxes = boxes.select(boxes.actor_id != OWN_ACTOR_ID)
    ax.imshow(image, extent=(0, width, height, 0))
    draw_boxes_in_image(boxes, camera, ax, box_colors(boxes, collider_ids(dataset, record["sample_token"])))
    ax.set(xlim=(0, width), ylim=(height, 0), aspect="equal", title=record["channel"])
    ax.set_axis_off()
    return ax
