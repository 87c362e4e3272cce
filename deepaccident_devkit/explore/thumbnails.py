"""Thumbnails: a scenario at a glance, as the camera that shows its accident best had it, else from above."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.arrays import as_floats
from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import SensorFileError
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.render.best_view import best_view
from deepaccident_devkit.render.boxes import EDGES, segments_in_image
from deepaccident_devkit.render.colors import COLLIDER_COLOR, MISSING_COLOR
from deepaccident_devkit.render.missing import is_there
from deepaccident_devkit.render.roles import actor_color, agent_actors
from deepaccident_devkit.v2x.configurations import agents_of
from deepaccident_devkit.v2x.tracks import scenario_tracks

if TYPE_CHECKING:
    from deepaccident_devkit.tables.records import ScenarioRecord

SIZE: Final = (320, 180)
"""Pixels."""
VERSION: Final = 1
"""Counted up where the same release gives other pictures."""
_QUALITY: Final = 75
_REACH: Final = 40.0
"""Metres from the middle of a picture from above to its left edge."""
_FRONT: Final = "Camera_Front"


def thumbnail(dataset: Dataset, record: ScenarioRecord) -> bytes:
    """A scenario's last moment as JPEG: the colliding pair in the best camera with red boxes; of others, the front one.

    Where no image was downloaded it is the actors from above; without labels a grey panel.
    """
    boxes = scenario_tracks(dataset, record).at(record["num_frames"])
    told = record["collision"]
    pair = boxes.select(np.isin(boxes.actor_id, [] if told is None else told["ids"]))
    samples = [f"{record['token']}/{agent}/{record['num_frames']:03d}" for agent in agents_of(dataset, record)]
    camera = _camera(dataset, samples, pair)
    image: Any = None
    if camera is not None:
        image = _photo(dataset, camera, pair)
    if image is None:
        image = _from_above(dataset, record, boxes, pair)
    written = io.BytesIO()
    image.save(written, "JPEG", quality=_QUALITY)
    return written.getvalue()


def _camera(dataset: Dataset, samples: list[str], pair: Boxes) -> str | None:
    """The camera (token) that is shown; None where no image is there."""
    view = best_view(dataset, samples, pair) if len(pair) else None
    if view is not None and is_there(dataset, view.camera):
        return view.camera
    front = (f"{sample}/{_FRONT}" for sample in samples)
    return next((camera for camera in front if is_there(dataset, camera)), None)


def _photo(dataset: Dataset, camera: str, pair: Boxes) -> Any:
    """What a camera saw, with the pair's boxes; None if the file cannot be read."""
    from PIL import Image, ImageDraw

    width, height = SIZE
    try:
        picture = Image.fromarray(dataset.load_image(camera, least=(height, width), size=(height, width)))
    except SensorFileError:
        return None
    sample, channel = camera.rsplit("/", 1)
    lens = dataset.camera(camera)
    optical = pair.transform(dataset.world_from(sample, channel).inverse(), channel)
    own = dataset.get("agent", sample.rsplit("/", 1)[0])["actor_id"]
    pen, scale = ImageDraw.Draw(picture), as_floats([width / lens.width, height / lens.height])
    for corners in optical.select(optical.actor_id != own).corners():
        segments, _ = segments_in_image(corners[np.array(EDGES)], lens)
        for start, end in (segments * scale).tolist():
            pen.line([*start, *end], fill=COLLIDER_COLOR, width=1)
    return picture


def _from_above(dataset: Dataset, record: ScenarioRecord, boxes: Boxes, pair: Boxes) -> Any:
    """All actors from above, around the pair or the middle of all."""
    from PIL import Image, ImageDraw

    width, height = SIZE
    picture = Image.new("RGB", SIZE, "#ffffff" if len(boxes) else MISSING_COLOR)
    if not len(boxes):
        return picture
    middle = (pair if len(pair) else boxes).center[:, :2].mean(axis=0)
    scale = width / 2 / _REACH
    recorders = {actor: agent for agent, actor in agent_actors(dataset, record["token"]).items()}
    pen = ImageDraw.Draw(picture)
    places = (boxes.bottom_corners()[..., :2] - middle) * as_floats([scale, -scale]) + as_floats(
        [width / 2, height / 2]
    )
    for outline, actor, category in zip(places, boxes.actor_id.tolist(), boxes.category_names, strict=True):
        color = actor_color(category, recorders.get(actor), collides=actor in pair.actor_id)
        pen.polygon([tuple(place) for place in outline.tolist()], fill=color)
    return picture
