"""The boxes of a scene's keyframes: its rows in `instance` and `sample_annotation`, in nuScenes' words."""

from __future__ import annotations

from collections.abc import Iterator
from types import MappingProxyType
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from deepaccident_devkit.export.nuscenes.names import token
from deepaccident_devkit.export.nuscenes.scenes import Row, Rows, Scene, linked
from deepaccident_devkit.taxonomy import OWN_ACTOR_ID, STATIC_ACTOR_ID, UNTRACKED_ID

if TYPE_CHECKING:
    from deepaccident_devkit.export.bulk import Output

Van = Literal["car", "truck"]
CATEGORIES: Final = MappingProxyType(
    {
        "car": "vehicle.car",
        "truck": "vehicle.truck",
        "motorcycle": "vehicle.motorcycle",
        "cyclist": "vehicle.bicycle",
        "pedestrian": "human.pedestrian.adult",
    }
)
"""Our class → nuScenes' category; vans are said to be one of the first two."""
SEEN: Final = MappingProxyType({True: "4", False: "1"})
"""Whether a camera of the agent sees a box → nuScenes' visibility; the levels between cannot be known."""
_MOVING: Final = 0.2
"""m/s, above which an actor moves."""


def box_rows(scene: Scene, van: Van, output: Output) -> Rows:
    """The rows of `instance` and `sample_annotation`: an actor has an instance of its own in each scene.

    The agent's own row is left out, as nuScenes does not annotate the ego. An untracked row is an instance by itself,
    and so is one whose id stands in its label already.
    """
    rows: list[Row] = []
    tracks: dict[str, list[Row]] = {}
    for number in range(1, scene.last + 1):
        sample = scene.dataset.sample.get(scene.sample(number))
        if not scene.is_key(number):
            output.leave_out("boxes between keyframes, which readers interpolate", sample["num_annotations"])
            continue
        output.leave_out("labels that are not in this release", not sample["labelled"])
        for row in _annotations(scene, number, output):
            rows.append(row)
            tracks.setdefault(row["instance_token"], []).append(row)
    for track in tracks.values():
        linked(track)
    return {"instance": [_instance(track, van) for track in tracks.values()], "sample_annotation": rows}


def _annotations(scene: Scene, number: int, output: Output) -> Iterator[Row]:
    """The row of each box of a keyframe, without the boxes before and after it."""
    sample = scene.sample(number)
    boxes = scene.dataset.boxes(sample)
    derived = scene.dataset.boxes(sample, velocity="derived").velocity
    velocity = np.where(np.isnan(derived), boxes.velocity, derived)  # an untracked actor has the label's alone
    speed = np.hypot(velocity[:, 0], velocity[:, 1]).tolist()
    seen = {OWN_ACTOR_ID}
    for index, (actor, category) in enumerate(zip(boxes.actor_id.tolist(), boxes.category_names, strict=True)):
        if actor == OWN_ACTOR_ID:
            output.leave_out("boxes of the recording agents themselves")
            continue
        own = token("sample_annotation", sample, boxes.row.item(index))
        alone = actor == UNTRACKED_ID or actor in seen
        output.leave_out("tracks of untracked boxes (each is an instance of its own)", alone)
        seen.add(actor)
        length, width, height = boxes.size[index].tolist()
        yield {
            "token": own,
            "sample_token": token("sample", sample),
            "instance_token": token("instance", *((own,) if alone else (scene.scenario, scene.agent, actor))),
            "visibility_token": SEEN[boxes.camera_visible.item(index)],
            "attribute_tokens": [token("attribute", name) for name in _attributes(category, actor, speed[index])],
            "translation": boxes.center[index].tolist(),
            "size": [width, length, height],
            "rotation": boxes.rotation[index].tolist(),
            "num_lidar_pts": boxes.num_lidar_pts.item(index),
            "num_radar_pts": 0,
            "actor_id": actor,
            "category_deepaccident": category,
        }


def _attributes(category: str, actor: int, speed: float) -> list[str]:
    """NuScenes' word for what an actor of our class does, as a list; none where its speed is NaN and would decide."""
    if category in ("motorcycle", "cyclist"):
        return ["cycle.with_rider"]
    if category != "pedestrian" and actor >= STATIC_ACTOR_ID:
        return ["vehicle.parked"]
    if np.isnan(speed):
        return []
    if category == "pedestrian":
        return ["pedestrian.moving" if speed > _MOVING else "pedestrian.standing"]
    return ["vehicle.moving" if speed > _MOVING else "vehicle.stopped"]


def _instance(rows: list[Row], van: Van) -> Row:
    """The row of an actor in a scene; its class is that of its first box."""
    category = rows[0]["category_deepaccident"]
    return {
        "token": rows[0]["instance_token"],
        "category_token": token("category", CATEGORIES[van if category == "van" else category]),
        "nbr_annotations": len(rows),
        "first_annotation_token": rows[0]["token"],
        "last_annotation_token": rows[-1]["token"],
        "actor_id": rows[0]["actor_id"],
        "category_deepaccident": category,
    }
