"""The sensor setups of one source, or of two sources side by side.

A report on two sources lists what a model that was trained on the first one will notice in the
second one.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.plugins.nuscenes.check import (
    find_labelled_rows,
    measure_direction,
    measure_road_height,
    spread_samples,
)
from deepaccident_devkit.support.arrays import FloatArray, IntArray
from deepaccident_devkit.support.human_names import human_name
from deepaccident_devkit.support.reports import CheckReport, Row, record_rows
from deepaccident_devkit.support.values import NamedValues, ReadOnlyValues
from deepaccident_devkit.taxonomy import (
    CAMERAS,
    CATEGORIES,
    FRAME_PERIOD,
    IGNORED_ID,
    LIDAR,
    OWN_ACTOR_ID,
)

# Names of the numbers in `SensorSetupFacts`, apart from the shares of classes.
_FACTS = ("lidar_above", "lanes", "points", "reach", "road", "labels_a_second", "boxes")
_NUM_SAMPLES = 12
# Smallest difference in elevation between two lanes.
_MIN_LANE_GAP_DEG = 0.2
# Smallest differences that are reported, of ratios of sizes, heights, angles and shares of classes.
_MIN_RATIO_CHANGE = 0.05
_MIN_HEIGHT_CHANGE_M = 0.2
_MIN_TURN_DEG = 2.0
_MIN_SHARE_CHANGE = 0.05
# Bounds of the ratio of two facts about the LiDAR that are not reported.
_MIN_RATIO = 0.8
_MAX_RATIO = 1.25
_CLASSES = (*CATEGORIES, "ignored")


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraFacts:
    """One camera of a vehicle.

    Attributes:
        camera: Channel of the camera.
        width: Width of its images in pixels.
        height: Height of its images in pixels.
        focal: Focal length as a share of the width.
        field_of_view: Angle between the left and the right edge in degrees.
        looks: Direction in degrees to the left of x.
        pitch: Direction in degrees upwards.
        above: Height above the ego's origin in metres.
        overlap: Angle in degrees that it shares with the next camera to its left; negative for a
            gap that no camera sees.
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
    """The sensors and boxes of one source; None for facts about files that are not available.

    Attributes:
        name: Name of the source's folder.
        cameras: Cameras of the first vehicle.
        lidar_above: Height of the LiDAR above the ego's origin in metres.
        lanes: Number of elevations of the LiDAR's beams.
        points: Median number of points in a cloud.
        reach: Distance in metres within which 99 % of the points lie.
        road: Height of the road above the ego's origin in metres.
        labels_a_second: Number of labelled moments in a second.
        boxes: Mean number of boxes in a labelled sample.
        shares: Share of the boxes by category; classes that we do not have are `ignored`.
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
    """The sensor setups of one source or of two.

    Attributes:
        sources: Facts of the sources.
        odd: Sentences about differences that will be unusual, in the second source, to a model
            trained on the first.
    """

    sources: tuple[SensorSetupFacts, ...]
    odd: tuple[str, ...]

    def named_tables(self) -> dict[str, list[Row]]:
        """Return a table of the cameras of each source, and a table of all other facts."""
        tables = {}
        columns = []
        for source in self.sources:
            tables[f"cameras of {source.name}"] = record_rows(CameraFacts, source.cameras)
            facts = attrgetter(*_FACTS)(source)
            columns.append((source.name, *facts, *source.shares.values()))
        share_names = [f"share of {name}" for name in _CLASSES]
        names = ("", *_FACTS, *share_names)
        tables["sources"] = [*zip(names, *columns, strict=True)]
        return tables

    def _readable_tables(self) -> dict[str, list[Row]]:
        """Return the tables with the names of the facts in the heading or the first column."""
        tables = self.named_tables()
        *camera_tables, fact_rows = tables.values()
        for rows in camera_tables:
            rows[0] = [*map(_fact_name, rows[0])]
        fact_rows[:] = [(_fact_name(fact), *values) for fact, *values in fact_rows]
        return tables

    def to_text(self) -> str:
        """Return the tables, what was compared, and what a model would notice."""
        names = [source.name for source in self.sources]
        # `super()` fails here, since a dataclass with slots is another class.
        text = CheckReport.to_text(self)
        if len(names) == 1:
            return text
        sentences = self.odd or ("none in what was compared",)
        lines = "".join(f"\n- {sentence}" for sentence in sentences)
        trained, tested = names
        title = f"Differences that a model trained on {trained} will notice in {tested}"
        return f"{text}\n\n{title}:{lines}"


def sensor_setup_report(*datasets: Dataset) -> SensorSetupReport:
    """Return the facts of one source or of two, about the first vehicle of each.

    It raises the errors of `Dataset`'s readers too.

    Raises:
        NotAvailableError: If a source has no labels.
    """
    sources = tuple(map(sensor_setup_facts, datasets))
    missing_facts = [name for name in _FACTS if None in map(attrgetter(name), sources)]
    cannot_say: tuple[str, ...] = ()
    if missing_facts:
        cannot_say = (
            f"{', '.join(map(_fact_name, missing_facts))}: at least one source has no LiDAR files.",
        )
    return SensorSetupReport(
        compared={"cameras": len(CAMERAS), "other facts": len(_FACTS) + 1 - len(missing_facts)},
        cannot_say=cannot_say,
        sources=sources,
        odd=tuple(_describe_differences(*sources)) if len(sources) == 2 else (),
    )


def sensor_setup_facts(dataset: Dataset) -> SensorSetupFacts:
    """Return the facts of one source; raise NotAvailableError if it has no labels."""
    view = dataset.columns("sample")
    boxes = dataset.with_ignored.columns("annotation")
    rows = find_labelled_rows(dataset)
    is_same_scenario = np.diff(view["scenario_row"][rows]) == 0
    steps = np.diff(rows)[is_same_scenario]
    labels_a_second = 0.0
    if len(steps):
        labels_a_second = round(1 / (FRAME_PERIOD * float(np.median(steps))), 1)
    tokens = [dataset.sample[row]["token"] for row in rows.tolist()]
    codes = _read_class_codes(boxes, rows)
    shares = np.bincount(codes, minlength=len(_CLASSES)) / max(len(codes), 1)
    lidar_height = float(dataset.ego_from(tokens[0], LIDAR).translation[2])
    return SensorSetupFacts(
        name=dataset.dataroot.name,
        cameras=tuple(_describe_cameras(dataset, tokens[0])),
        lidar_above=round(lidar_height, 2),
        **_measure_clouds(dataset, tokens),
        labels_a_second=labels_a_second,
        boxes=round(len(codes) / len(rows), 1),
        shares=dict(zip(_CLASSES, shares.round(4).tolist(), strict=True)),
    )


def _read_class_codes(boxes: ReadOnlyValues, rows: IntArray) -> IntArray:
    """Return the indices in `_CLASSES` of the boxes of some samples, without the ego."""
    is_in_samples = np.isin(boxes["sample_row"], rows)
    is_counted = is_in_samples & (boxes["actor_id"] != OWN_ACTOR_ID)
    is_ignored = boxes["actor_id"][is_counted] >= IGNORED_ID
    return np.where(is_ignored, len(CATEGORIES), boxes["category"][is_counted])


def _measure_clouds(dataset: Dataset, tokens: Sequence[str]) -> NamedValues:
    """Return the facts about the LiDAR's clouds of some samples; None without files."""
    recorded = [token for token in tokens if dataset.sensor_path(token, LIDAR).exists()]
    samples = spread_samples(recorded, _NUM_SAMPLES)
    clouds = [dataset.load_point_cloud(token, "lidar").xyz for token in samples]
    if not clouds:
        return dict.fromkeys(("lanes", "points", "reach", "road"))
    ranges = np.linalg.norm(np.concatenate(clouds), axis=1)
    road_heights = []
    for token, cloud in zip(samples, clouds, strict=True):
        points = dataset.ego_from(token, LIDAR).apply(cloud)
        road_heights.append(measure_road_height(points))
    return {
        "lanes": _count_lanes(clouds[0]),
        "points": round(float(np.median(list(map(len, clouds))))),
        "reach": round(float(np.quantile(ranges, 0.99)), 1),
        "road": round(float(np.nanmedian(road_heights)), 2),
    }


def _describe_cameras(dataset: Dataset, sample: str) -> Iterator[CameraFacts]:
    """Yield the facts of each camera of a sample."""
    directions = {camera: measure_direction(dataset.ego_from(sample, camera)) for camera in CAMERAS}
    half_angles = {}
    for camera in CAMERAS:
        calibration = dataset.camera(sample, camera)
        half_width = calibration.width / 2 / calibration.intrinsic[0, 0]
        half_angles[camera] = math.degrees(math.atan(half_width))
    for camera, angle in directions.items():
        calibration = dataset.camera(sample, camera)
        pose = dataset.ego_from(sample, camera)
        turns = [((directions[other] - angle) % 360, other) for other in CAMERAS if other != camera]
        turn, neighbour = min(turns)
        yield CameraFacts(
            camera=camera,
            width=calibration.width,
            height=calibration.height,
            focal=round(float(calibration.intrinsic[0, 0] / calibration.width), 3),
            field_of_view=round(2 * half_angles[camera], 1),
            looks=180.0 if abs(angle) > 179.95 else round(angle, 1) + 0.0,
            pitch=round(math.degrees(math.asin(pose.rotation[2, 2])), 1) + 0.0,  # Never −0.
            above=round(float(pose.translation[2]), 2),
            overlap=round(half_angles[camera] + half_angles[neighbour] - turn, 1),
        )


def _count_lanes(cloud: FloatArray) -> int:
    """Count the distinct elevations of a cloud's points (N, 3), seen from the LiDAR's origin."""
    points = cloud[np.isfinite(cloud).all(axis=1)]
    x, y, z = points.T
    angles = np.arctan2(z, np.hypot(x, y))
    elevations = np.sort(np.degrees(angles))
    num_gaps = np.count_nonzero(np.diff(elevations) > _MIN_LANE_GAP_DEG)
    return int(num_gaps) + 1


def _fact_name(field: object) -> str:
    """Return the name of a fact, such as `boxes per label`, for people."""
    return human_name(str(field), "sensors")


def _describe_differences(source: SensorSetupFacts, other: SensorSetupFacts) -> Iterator[str]:
    """Yield a sentence on each difference that is large enough for a model to notice."""
    for camera, other_camera in zip(source.cameras, other.cameras, strict=True):
        differences = ", ".join(_describe_camera_differences(camera, other_camera))
        if differences:
            yield f"{camera.camera}: {differences}"
    rise = other.lidar_above - source.lidar_above
    yield from _describe_change("the LiDAR is {:.1f} m {}", _MIN_HEIGHT_CHANGE_M, rise)
    words_by_fact = {
        "lanes": "lanes of the LiDAR",
        "points": "points per cloud",
        "reach": "metres of reach",
    }
    for name, words in words_by_fact.items():
        value = getattr(source, name)
        other_value = getattr(other, name)
        if value and other_value and not _MIN_RATIO < other_value / value < _MAX_RATIO:
            yield f"{other_value:,.0f} {words}, not {value:,.0f}"
    if source.labels_a_second != other.labels_a_second:
        yield f"{other.labels_a_second:g} labels per second, not {source.labels_a_second:g}"
    for name, share in source.shares.items():
        other_share = other.shares[name]
        if abs(other_share - share) >= _MIN_SHARE_CHANGE or (share > 0) != (other_share > 0):
            yield f"{other_share:.0%} of the boxes are of the class {name}, not {share:.0%}"


def _describe_camera_differences(camera: CameraFacts, other: CameraFacts) -> Iterator[str]:
    """Yield a clause on each noticeable difference between two cameras of the same name."""
    magnification = other.focal / camera.focal
    if abs(magnification - 1) > _MIN_RATIO_CHANGE:
        views = (
            f"its field of view is {other.field_of_view:.0f} degrees, not "
            f"{camera.field_of_view:.0f}"
        )
        yield f"objects look {magnification:.2g} times as large in it, since {views}"
    yield from _describe_change(
        "it is {:.1f} m {}", _MIN_HEIGHT_CHANGE_M, other.above - camera.above
    )
    yield from _describe_change(
        "it looks {:.0f} degrees {}", _MIN_TURN_DEG, other.pitch - camera.pitch
    )
    turn = (other.looks - camera.looks + 180) % 360 - 180
    directions = ("left", "right")
    yield from _describe_change(
        "it is turned by {:.0f} degrees to the {}", _MIN_TURN_DEG, turn, directions
    )
    aspect = camera.width / camera.height
    other_aspect = other.width / other.height
    if abs(other_aspect / aspect - 1) > _MIN_RATIO_CHANGE:
        yield f"its images are {other_aspect:.2f} times as wide as high, not {aspect:.2f}"


def _describe_change(
    sentence: str,
    min_change: float,
    change: float,
    directions: tuple[str, str] = ("higher", "lower"),
) -> Iterator[str]:
    """Yield a sentence about a change, with its size and direction, unless it is too small.

    Args:
        sentence: Template of the sentence, with two format placeholders: size, direction.
        min_change: Smallest change that matters, in metres or degrees.
        change: Signed change, in the unit of `min_change`.
        directions: Words for a positive and a negative change.
    """
    if abs(change) >= min_change:
        positive, negative = directions
        direction = negative if change < 0 else positive
        yield sentence.format(abs(change), direction)
