"""Sensor setups of two sources side by side.

Reports what a model that was trained on one source will notice in the other.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, Final

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.plugins.nuscenes.check import labelled_rows, looks_to, road_height, spread
from deepaccident_devkit.support.arrays import FloatArray, IntArray
from deepaccident_devkit.support.reports import CheckReport, Row, record_rows
from deepaccident_devkit.taxonomy import (
    CAMERAS,
    CATEGORIES,
    FRAME_PERIOD,
    IGNORED_ID,
    LIDAR,
    OWN_ACTOR_ID,
)

# Numbers of `SensorSetupFacts`, besides the shares of classes.
_FACTS: Final = ("lidar_above", "lanes", "points", "reach", "road", "labels_a_second", "boxes")
_NUM_SAMPLES: Final = 12
# Smallest difference in elevation between two lanes.
_MIN_LANE_GAP_DEG: Final = 0.2
# Smallest differences that are reported: of ratios of sizes, of heights, of angles, and of shares
# of classes.
_MIN_RATIO_CHANGE: Final = 0.05
_MIN_HEIGHT_CHANGE_M: Final = 0.2
_MIN_TURN_DEG: Final = 2.0
_MIN_SHARE_CHANGE: Final = 0.05
_CLASSES: Final = (*CATEGORIES, "ignored")


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraFacts:
    """One camera of a vehicle.

    Attributes:
        camera: Channel of the camera.
        width: Width of its images in pixels.
        height: Height of its images in pixels.
        focal: Focal length as a share of the width.
        field_of_view: Degrees from the left edge to the right one.
        looks: Direction in degrees to the left of x.
        pitch: Degrees upwards.
        above: Metres above the ego's origin.
        overlap: Degrees that it shares with the next camera to its left; negative if there is a gap
            that no camera sees.
    """

    camera: str
    width: int
    height: int
    focal: float
    field_of_view: float
    looks: float
    pitch: float
    above: float
    overlap: float


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorSetupFacts:
    """One source; None where its files are not available.

    Attributes:
        name: Name of its folder.
        cameras: Cameras of the first vehicle.
        lidar_above: Height of the LiDAR above the ego's origin in metres.
        lanes: Number of elevations of the LiDAR's beams.
        points: Median number of points of a cloud.
        reach: Distance in metres within which 99 % of them lie.
        road: Height of the road above the ego's origin in metres.
        labels_a_second: Number of labelled moments a second.
        boxes: Mean number of boxes of a labelled sample.
        shares: Category → its share of the boxes; classes that we do not have are `ignored`.
    """

    name: str
    cameras: tuple[CameraFacts, ...]
    lidar_above: float
    lanes: int | None
    points: float | None
    reach: float | None
    road: float | None
    labels_a_second: float
    boxes: float
    shares: Mapping[str, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorSetupReport(CheckReport):
    """One source or two.

    Attributes:
        sources: Facts of the sources.
        odd: Differences that a model trained on the first source will notice in the second, a
            sentence each.
    """

    sources: tuple[SensorSetupFacts, ...]
    odd: tuple[str, ...]

    def named_tables(self) -> dict[str, list[Row]]:
        """Return a table of cameras for each source, and one of all other facts."""
        tables = {
            f"cameras of {source.name}": record_rows(CameraFacts, source.cameras)
            for source in self.sources
        }
        columns = []
        for source in self.sources:
            facts = attrgetter(*_FACTS)(source)
            columns.append((source.name, *facts, *source.shares.values()))
        names = ("", *_FACTS, *map("share of {}".format, _CLASSES))
        return {**tables, "sources": [*zip(names, *columns, strict=True)]}

    def to_text(self) -> str:
        """Return the tables, what was compared, and what is odd."""
        names = [source.name for source in self.sources]
        text = CheckReport.to_text(self)  # no `super()`: a dataclass with slots is another class
        if len(names) == 1:
            return text
        sentences = self.odd or ("nothing of what was compared",)
        lines = "".join(f"\n- {sentence}" for sentence in sentences)
        return f"{text}\n\na model that learned on {names[0]} will find odd in {names[1]}:{lines}"


def sensor_setup_report(*datasets: Dataset) -> SensorSetupReport:
    """Return the facts of one source or two, about the first vehicle of each.

    Raises the errors of `Dataset`'s readers.

    Raises:
        NotAvailableError: A source has no labels.
    """
    sources = tuple(map(sensor_setup_facts, datasets))
    missing = [name for name in _FACTS if None in map(attrgetter(name), sources)]
    cannot_say: tuple[str, ...] = ()
    if missing:
        cannot_say = (f"{', '.join(missing)}: a source has no files of the LiDAR.",)
    return SensorSetupReport(
        compared={"cameras": len(CAMERAS), "other facts": len(_FACTS) + 1 - len(missing)},
        cannot_say=cannot_say,
        sources=sources,
        odd=tuple(_differences(*sources)) if len(sources) == 2 else (),
    )


def sensor_setup_facts(dataset: Dataset) -> SensorSetupFacts:
    """Return the facts of one source; raise NotAvailableError if it has no labels."""
    view, boxes = dataset.columns("sample"), dataset.with_ignored.columns("annotation")
    rows = labelled_rows(dataset)
    steps = np.diff(rows)[np.diff(view["scenario_row"][rows]) == 0]
    labels_a_second = 0.0
    if len(steps):
        labels_a_second = round(1 / (FRAME_PERIOD * float(np.median(steps))), 1)
    tokens = [dataset.sample[row]["token"] for row in rows.tolist()]
    codes = _class_codes(boxes, rows)
    shares = np.bincount(codes, minlength=len(_CLASSES)) / max(len(codes), 1)
    lidar_height = float(dataset.ego_from(tokens[0], LIDAR).translation[2])
    return SensorSetupFacts(
        name=dataset.dataroot.name,
        cameras=tuple(_cameras(dataset, tokens[0])),
        lidar_above=round(lidar_height, 2),
        **_cloud_facts(dataset, tokens),
        labels_a_second=labels_a_second,
        boxes=round(len(codes) / len(rows), 1),
        shares=dict(zip(_CLASSES, shares.round(4).tolist(), strict=True)),
    )


def _class_codes(boxes: Mapping[str, Any], rows: IntArray) -> IntArray:
    """Return the indices in `_CLASSES` of the boxes of some samples, without the ego."""
    is_counted = np.isin(boxes["sample_row"], rows) & (boxes["actor_id"] != OWN_ACTOR_ID)
    is_ignored = boxes["actor_id"][is_counted] >= IGNORED_ID
    return np.where(is_ignored, len(CATEGORIES), boxes["category"][is_counted])


def _cloud_facts(dataset: Dataset, tokens: Sequence[str]) -> dict[str, Any]:
    """Return the facts about the LiDAR's clouds of some samples; None without files."""
    recorded = [token for token in tokens if dataset.sensor_path(token, LIDAR).exists()]
    samples = spread(recorded, _NUM_SAMPLES)
    clouds = [dataset.load_point_cloud(token, "lidar").xyz for token in samples]
    if not clouds:
        return dict.fromkeys(("lanes", "points", "reach", "road"))
    ranges = np.linalg.norm(np.concatenate(clouds), axis=1)
    roads = [
        road_height(dataset.ego_from(token, LIDAR).apply(cloud))
        for token, cloud in zip(samples, clouds, strict=True)
    ]
    return {
        "lanes": _count_lanes(clouds[0]),
        "points": round(float(np.median([len(cloud) for cloud in clouds]))),
        "reach": round(float(np.quantile(ranges, 0.99)), 1),
        "road": round(float(np.nanmedian(roads)), 2),
    }


def _cameras(dataset: Dataset, sample: str) -> Iterator[CameraFacts]:
    """Yield the cameras of a sample."""
    directions = {camera: looks_to(dataset.ego_from(sample, camera)) for camera in CAMERAS}
    half_angles = {}
    for camera in CAMERAS:
        calibration = dataset.camera(sample, camera)
        half_width = calibration.width / 2 / calibration.intrinsic[0, 0]
        half_angles[camera] = math.degrees(math.atan(half_width))
    for camera, angle in directions.items():
        calibration, pose = dataset.camera(sample, camera), dataset.ego_from(sample, camera)
        turns = [((directions[other] - angle) % 360, other) for other in CAMERAS if other != camera]
        turn, neighbour = min(turns)
        yield CameraFacts(
            camera=camera,
            width=calibration.width,
            height=calibration.height,
            focal=round(float(calibration.intrinsic[0, 0] / calibration.width), 3),
            field_of_view=round(2 * half_angles[camera], 1),
            looks=180.0 if abs(angle) > 179.95 else round(angle, 1) + 0.0,
            pitch=round(math.degrees(math.asin(pose.rotation[2, 2])), 1) + 0.0,  # no -0
            above=round(float(pose.translation[2]), 2),
            overlap=round(half_angles[camera] + half_angles[neighbour] - turn, 1),
        )


def _count_lanes(cloud: FloatArray) -> int:
    """Return the number of elevations of a cloud's points, from the LiDAR's origin."""
    points = cloud[np.isfinite(cloud).all(axis=1)]
    distance = np.hypot(points[:, 0], points[:, 1])
    elevation = np.sort(np.degrees(np.arctan2(points[:, 2], distance)))
    return int((np.diff(elevation) > _MIN_LANE_GAP_DEG).sum()) + 1


def _differences(source: SensorSetupFacts, other: SensorSetupFacts) -> Iterator[str]:
    """Yield the differences that are so large that a model notices them."""
    for camera, other_camera in zip(source.cameras, other.cameras, strict=True):
        differences = ", ".join(_camera_differences(camera, other_camera))
        if differences:
            yield f"{camera.camera}: {differences}"
    rise = other.lidar_above - source.lidar_above
    yield from _change_text("the LiDAR is {:.1f} m {}", _MIN_HEIGHT_CHANGE_M, rise)
    for name, words in (
        ("lanes", "lanes of the LiDAR"),
        ("points", "points a cloud"),
        ("reach", "metres of reach"),
    ):
        value, other_value = getattr(source, name), getattr(other, name)
        if value and other_value and not 0.8 < other_value / value < 1.25:
            yield f"{other_value:,.0f} {words}, not {value:,.0f}"
    if source.labels_a_second != other.labels_a_second:
        yield f"{other.labels_a_second:g} labels a second, not {source.labels_a_second:g}"
    for name, share in source.shares.items():
        other_share = other.shares[name]
        if abs(other_share - share) >= _MIN_SHARE_CHANGE or (share > 0) != (other_share > 0):
            yield f"{other_share:.0%} of the boxes are of the class {name}, not {share:.0%}"


def _camera_differences(camera: CameraFacts, other: CameraFacts) -> Iterator[str]:
    """Yield the differences between two cameras of one name."""
    magnification = other.focal / camera.focal
    if abs(magnification - 1) > _MIN_RATIO_CHANGE:
        views = (
            f"its field of view is {other.field_of_view:.0f} degrees, not "
            f"{camera.field_of_view:.0f}"
        )
        yield f"things look {magnification:.2g} times as large in it, since {views}"
    yield from _change_text("it is {:.1f} m {}", _MIN_HEIGHT_CHANGE_M, other.above - camera.above)
    yield from _change_text("it looks {:.0f} degrees {}", _MIN_TURN_DEG, other.pitch - camera.pitch)
    turn = (other.looks - camera.looks + 180) % 360 - 180
    sides = ("left", "right")
    yield from _change_text("it is turned by {:.0f} degrees to the {}", _MIN_TURN_DEG, turn, sides)
    aspect, other_aspect = camera.width / camera.height, other.width / other.height
    if abs(other_aspect / aspect - 1) > _MIN_RATIO_CHANGE:
        yield f"its images are {other_aspect:.2f} times as wide as high, not {aspect:.2f}"


def _change_text(
    sentence: str, min_change: float, change: float, sides: tuple[str, str] = ("higher", "lower")
) -> Iterator[str]:
    """Yield a sentence on a change of metres or degrees, with its size and side.

    Nothing if the change is too small to matter.
    """
    if abs(change) >= min_change:
        yield sentence.format(abs(change), sides[change < 0])
