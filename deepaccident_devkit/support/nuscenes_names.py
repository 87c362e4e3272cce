"""Names of the nuScenes devkit that this devkit does not have, and what to use here; docs/reading.md has all."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import wraps
from inspect import signature
from typing import Final, NoReturn, ParamSpec, TypeVar

from deepaccident_devkit.errors import KeywordError, MissingNameError
from deepaccident_devkit.support.text import meant_text

T = TypeVar("T")
P = ParamSpec("P")
_PAGE: Final = "docs/reading.md"
_SCENARIO_FIELDS: Final = "town, weather and time of day are fields of da.scenario"
_MAPS: Final = "use da.town_map(town), made from the recordings, or da.load_bev(sample), the road from above"
_NO_LIDARSEG: Final = "LiDAR points have no classes"
_NO_ATTRIBUTES: Final = "boxes have no attributes"
_COLORS: Final = "each category has its own colour; render.style() says how pictures look"
_WITHOUT_NAME: Final = "give it without a name, as the first argument"
_VIDEO: Final = "use da.render_scenario_video(scenario, path) or da.render_replay(scenario, path)"

TABLES: Final[Mapping[str, str]] = {
    "scene": "use 'scenario'",
    "sample_annotation": "use 'annotation', which is in the LiDAR frame (da.get_boxes gives world), or 'track'",
    "attribute": _NO_ATTRIBUTES,
    "visibility": "use camera_visible and num_lidar_pts of 'annotation'",
    "log": _SCENARIO_FIELDS,
    "map": _MAPS,
    "lidarseg": _NO_LIDARSEG,
    "panoptic": _NO_LIDARSEG,
}
"""nuScenes' tables → what to use here."""

DATASET: Final[Mapping[str, str]] = {
    "scene": "use da.scenario",
    "sample_annotation": "use da.annotation, which is in the LiDAR frame (da.get_boxes gives world), or da.track",
    "attribute": _NO_ATTRIBUTES,
    "visibility": "use box.camera_visible and box.num_lidar_pts",
    "log": _SCENARIO_FIELDS,
    "map": _MAPS,
    "lidarseg": _NO_LIDARSEG,
    "panoptic": _NO_LIDARSEG,
    "explorer": "its functions are da's own, such as da.map_pointcloud_to_image",
    "nusc": "its functions are da's own",
    "table_root": "use da.tables_folder",
    "image_annotations": "use da.camera(sample, channel).boxes_in_image(boxes)",
    "verbose": "it is only an argument, as in DeepAccident(verbose=False)",
    "colormap": _COLORS,
    "get_color": _COLORS,
    "scenes": "use da.scenario",
    "list_scenes": "use da.list_scenarios()",
    "list_attributes": _NO_ATTRIBUTES,
    **dict.fromkeys(
        (
            *("list_lidarseg_categories", "load_lidarseg_cat_name_mapping", "get_sample_lidarseg_stats"),
            *("lidarseg_idx2name_mapping", "lidarseg_name2idx_mapping", "list_panoptic_instances"),
            *("render_scene_lidarseg", "render_scene_channel_lidarseg"),
        ),
        _NO_LIDARSEG,
    ),
    "get_box": "use da.get_boxes(sample), where each box has its token",
    "box_velocity": "use box.velocity",
    "render_scene": _VIDEO,
    "render_scene_channel": _VIDEO,
    "render_egoposes_on_map": "use da.render_town_map(town), or da.render_bev(sample, layers=('map', 'trajectories'))",
    "render_ego_centric_map": "use da.render_bev(sample, layers=('map',))",
}
"""Attributes of nuScenes' `NuScenes` → what to use here."""

BOX: Final[Mapping[str, str]] = {
    "name": "use box.category",
    "label": "use box.category",
    "score": "use DetectedBoxes of evaluation, which has scores",
    "copy": "use copy.copy(box); no method changes a box",
    "render": "use render.draw_box(box, ax)",
    "render_cv2": "use render.draw_box(box, ax)",
}
"""Attributes of nuScenes' `Box` → what to use here."""

BOX_MADE: Final = (
    "boxes[0] picks one, and nuScenes' Box(center, wlh, orientation) is Box.from_wlh(center, wlh, orientation, "
    f"frame='ego') (see {_PAGE})"
)
"""What to use here in place of making nuScenes' `Box`."""

CLOUD: Final[Mapping[str, str]] = {
    "from_file": "use da.load_point_cloud(sample); of a path, release.read_lidar(path)",
    "from_file_multisweep": "use da.aggregate_point_cloud(sample, agents='single', sweeps=5)",
    "nbr_points": "use len(cloud)",
    "translate": "use cloud.transform(target_from_source, frame)",
    "rotate": "use cloud.transform(target_from_source, frame)",
    "nbr_dims": "use cloud.points.shape[1]",
    "subsample": "use cloud.select(rows)",
    "render_height": "use da.render_bev(sample)",
    "render_intensity": "use cloud.intensity; no picture shows it",
}
"""Attributes of nuScenes' `LidarPointCloud` → what to use here."""

KEYWORDS: Final[Mapping[str, str]] = {
    "out_path": "save what is returned: a figure with .savefig(path), axes with .figure.savefig(path)",
    "verbose": "nothing opens a window; a notebook shows what is returned",
    "with_anns": "boxes are one of the layers; layers=('image',) leaves them out",
    "box_vis_level": "use da.camera(sample, channel).boxes_in_image(boxes, level)",
    "axes_limit": "use da.render_bev(sample, view_range=40)",
    "nsweeps": "use da.render_bev(sample, sweeps=5)",
    "underlay_map": "use da.render_bev(sample, layers=('map', 'points', 'boxes'))",
    "use_flat_vehicle_coordinates": "use da.get_boxes(sample, frame='ego')",
    "selected_anntokens": "choose among da.get_boxes(sample), where each box has its token",
    "render_intensity": "use da.render_pointcloud_in_image(camera, sample, color_by='height')",
    "extra_info": "use da.list_sample(sample), which prints all of its boxes",
    "view": "views are from above, x of the frame upwards: da.render_bev(sample, frame='ego')",
    "margin": "use da.render_annotation(annotation, margin=15) for one moment",
    "dot_size": "draw the pixels of da.map_pointcloud_to_image(camera, sample) yourself",
    "min_dist": "choose by the depth of what da.map_pointcloud_to_image(camera, sample) returns",
    **dict.fromkeys(
        ("pointsensor_token", "camera_token", "pointsensor_channel", "camera_channel"),
        "give the camera's file and then the sample: da.render_pointcloud_in_image(camera, sample)",
    ),
    "wlh_factor": "use Box.from_wlh(box.center, box.wlh * factor, box.orientation, frame=box.frame)",
    "transf_matrix": "use cloud.transform(SE3(matrix), frame)",
    "map_resolution": "use da.town_map(town, config=TownMapConfig(resolution=0.1))",
    "colormap": _COLORS,
    **dict.fromkeys(
        (
            *("table_name", "sample_token", "sample_data_token", "sample_annotation_token", "anntoken"),
            *("instance_token", "token", "x"),
        ),
        _WITHOUT_NAME,
    ),
    **dict.fromkeys(
        (
            *("show_lidarseg", "show_panoptic", "show_lidarseg_legend", "filter_lidarseg_labels"),
            "lidarseg_preds_bin_path",
        ),
        _NO_LIDARSEG,
    ),
}
"""Arguments of nuScenes' methods → what to use here."""

FIELDS: Final[Mapping[str, str]] = {
    "data": "a sensor file's token is the sample's and a channel: da.get('sample_data', token + '/Camera_Front')",
    "anns": "use da.get_boxes(sample), or the slice da.annotation_rows(sample) of da.annotation",
    "scene_token": "use 'scenario_token'",
    "category_name": "use 'category'",
    "category_token": "use 'category'",
    "first_sample_token": "each agent has samples of its own: it is a field of da.agent",
    "last_sample_token": "each agent has samples of its own: it is a field of da.agent",
    "nbr_samples": "use 'num_frames'",
    "nbr_annotations": "use 'num_annotations'",
    "attribute_tokens": _NO_ATTRIBUTES,
    "visibility_token": "use 'camera_visible' and 'num_lidar_pts' of da.annotation",
    "log_token": _SCENARIO_FIELDS,
    "description": _SCENARIO_FIELDS,
    "is_key_frame": "samples of all frames are labelled, at 10 Hz",
}
"""Fields of nuScenes' records → what to use here."""


class AbsentName:
    """Stands in a class for a name of nuScenes' class: to read it raises MissingNameError, so `hasattr` is False.

    A `__getattr__` of the class would do the same, but make all its other attributes slower.
    """

    def __init__(self, name: str, counterpart: str) -> None:
        """Note the name, and what to use here."""
        self._name = name
        self._counterpart = counterpart

    def __get__(self, instance: object, owner: type) -> NoReturn:
        raise missing_name(owner, self._name, self._counterpart)


def without_names(counterparts: Mapping[str, str]) -> Callable[[type[T]], type[T]]:
    """A decorator of a class that has none of these names, and says so with the counterpart of each."""

    def put(owner: type[T]) -> type[T]:
        for name, counterpart in counterparts.items():
            setattr(owner, name, AbsentName(name, counterpart))
        return owner

    return put


def missing_name(owner: type, name: str, counterpart: str) -> MissingNameError:
    """The error of a class that has no such name."""
    return MissingNameError(f"{owner.__name__} has no {name!r}: {counterpart} (see {_PAGE})")


def with_keywords_named(function: Callable[P, T], module: str | None = None) -> Callable[P, T]:
    """Return the same function, which raises a KeywordError for an argument that it does not have.

    Of an argument of nuScenes' the error says what to use, of others which one may be meant. `module` is where the
    result lies, and where pickle finds it; None for the place of the function itself.
    """
    known = signature(function).parameters
    takes_any = any(parameter.kind is parameter.VAR_KEYWORD for parameter in known.values())
    called = function.__qualname__.removesuffix(".__init__").rpartition(".")[2]

    @wraps(function)
    def checked(*arguments: P.args, **named: P.kwargs) -> T:
        for name in sorted(named.keys() - known.keys()) if named else ():
            if name in KEYWORDS:
                raise KeywordError(f"{called} has no argument {name!r}: {KEYWORDS[name]} (see {_PAGE})")
            if not takes_any:
                raise KeywordError(f"{called} has no argument {name!r}{meant_text(name, known)}")
        return function(*arguments, **named)

    checked.__module__ = module or function.__module__
    return checked


def table_remedy(name: object) -> str:
    """What to say of a table that is nuScenes'; empty for all others."""
    counterpart = TABLES.get(name) if isinstance(name, str) else None
    return f"; of nuScenes' table {name!r}: {counterpart} (see {_PAGE})" if counterpart else ""


def field_remedy(name: object) -> str:
    """What to say of a record's field that is nuScenes'; empty for all others."""
    counterpart = FIELDS.get(name) if isinstance(name, str) else None
    return f": {counterpart} (see {_PAGE})" if counterpart else ""
