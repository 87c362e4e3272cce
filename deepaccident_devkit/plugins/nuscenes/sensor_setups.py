"""What two sources' vehicles carry, side by side, and what a model that learned on one will find odd in the other."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from operator import attrgetter
from typing import Final

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.plugins.nuscenes.check import labelled_rows, looks_to, road_height, spread
from deepaccident_devkit.support.arrays import FloatArray
from deepaccident_devkit.support.reports import CheckReport, Row, record_rows
from deepaccident_devkit.taxonomy import (
    CAMERAS,
    CATEGORIES,
    FRAME_PERIOD,
    IGNORED_ID,
    LIDAR,
    OWN_ACTOR_ID,
)

# Numbers of `SensorSetupFacts`, beside the shares of classes.
_FACTS: Final = ("lidar_above", "lanes", "points", "reach", "road", "labels_a_second", "boxes")
_SHARES: Final = (*CATEGORIES, "ignored")
_SAMPLES: Final = 12
# Degrees of elevation between two lanes at least.
_LANE_GAP: Final = 0.2
_LARGER: Final = 0.05
# Metres.
_RISE: Final = 0.2
# Degrees.
_TURN: Final = 2.0
_SHARE: Final = 0.05
_CLASSES: Final = (*CATEGORIES, "ignored")


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraFacts:
    """One camera of a vehicle.

    Attributes:
        camera: its channel.
        width: of its images, pixels.
        height: of its images.
        focal: focal length as a share of the width.
        field_of_view: degrees from the left edge to the right one.
        looks: degrees to the left of x.
        pitch: degrees upwards.
        above: metres above the ego's origin.
        overlap: degrees that it shares with the next camera to its left; below 0, that nobody sees between them.
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
    """One source; None where its files are not here.

    Attributes:
        name: the folder's.
        cameras: of the first vehicle.
        lidar_above: metres of the LiDAR above the ego's origin.
        lanes: directions up and down in which the LiDAR looks.
        points: of a cloud, the median.
        reach: metres within which 99 % of them lie.
        road: height of the road above the ego's origin, metres.
        labels_a_second: how often a moment is labelled.
        boxes: of a labelled sample, the mean.
        shares: category → its share of the boxes; of classes that we do not have, `ignored`.
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
        sources: their facts.
        odd: what a model that learned on the first will find odd in the second, a sentence each.
    """

    sources: tuple[SensorSetupFacts, ...]
    odd: tuple[str, ...]

    def named_tables(self) -> dict[str, list[Row]]:
        """A table of cameras for each source, and one of all else."""
        tables = {
            f"cameras of {source.name}": record_rows(CameraFacts, source.cameras)
            for source in self.sources
        }
        columns = [
            (source.name, *attrgetter(*_FACTS)(source), *source.shares.values())
            for source in self.sources
        ]
        names = ("", *_FACTS, *map("share of {}".format, _SHARES))
        return {**tables, "sources": [*zip(names, *columns, strict=True)]}

    def to_text(self) -> str:
        """The tables, what was compared, and what is odd."""
        names = [source.name for source in self.sources]
        text = CheckReport.to_text(self)  # no `super()`: a dataclass with slots is another class
        if len(names) == 1:
            return text
        odd = "".join(
            f"\n- {sentence}" for sentence in self.odd or ("nothing of what was compared",)
        )
        return f"{text}\n\na model that learned on {names[0]} will find odd in {names[1]}:{odd}"


def sensor_setup_report(*datasets: Dataset) -> SensorSetupReport:
    """The facts of one source or two, of the first vehicle that each has; raises the errors of `Dataset`'s readers.

    Raises:
        NotAvailableError: a source has no labels.
    """
    sources = tuple(map(sensor_setup_facts, datasets))
    missing = [name for name in _FACTS if None in map(attrgetter(name), sources)]
    return SensorSetupReport(
        compared={"cameras": len(CAMERAS), "other facts": len(_FACTS) + 1 - len(missing)},
        cannot_say=(f"{', '.join(missing)}: a source has no files of the LiDAR.",)
        if missing
        else (),
        sources=sources,
        odd=tuple(_odd(*sources)) if len(sources) == 2 else (),
    )


def sensor_setup_facts(dataset: Dataset) -> SensorSetupFacts:
    """The facts of one source; raises NotAvailableError if it has no labels."""
    view, boxes = dataset.columns("sample"), dataset.with_ignored.columns("annotation")
    rows = labelled_rows(dataset)
    apart = np.diff(rows)[np.diff(view["scenario_row"][rows]) == 0]
    tokens = [dataset.sample[row]["token"] for row in rows.tolist()]
    there = [token for token in tokens if dataset.sensor_path(token, LIDAR).exists()]
    chosen = spread(there, _SAMPLES)
    clouds = [dataset.load_point_cloud(token, "lidar").xyz for token in chosen]
    own = np.isin(boxes["sample_row"], rows) & (boxes["actor_id"] != OWN_ACTOR_ID)
    codes = np.where(boxes["actor_id"][own] >= IGNORED_ID, len(CATEGORIES), boxes["category"][own])
    counts = np.bincount(codes, minlength=len(_CLASSES)) / max(len(codes), 1)
    ranges = np.linalg.norm(np.concatenate(clouds), axis=1) if clouds else np.zeros(0)
    roads = [
        road_height(dataset.ego_from(token, LIDAR).apply(each))
        for token, each in zip(chosen, clouds, strict=True)
    ]
    return SensorSetupFacts(
        name=dataset.dataroot.name,
        cameras=tuple(_cameras(dataset, tokens[0])),
        lidar_above=round(float(dataset.ego_from(tokens[0], LIDAR).translation[2]), 2),
        lanes=_lanes(clouds[0]) if clouds else None,
        points=round(float(np.median([len(cloud) for cloud in clouds]))) if clouds else None,
        reach=round(float(np.quantile(ranges, 0.99)), 1) if clouds else None,
        road=round(float(np.nanmedian(roads)), 2) if clouds else None,
        labels_a_second=round(1 / (FRAME_PERIOD * float(np.median(apart))), 1)
        if len(apart)
        else 0.0,
        boxes=round(len(codes) / len(rows), 1),
        shares=dict(zip(_SHARES, counts.round(4).tolist(), strict=True)),
    )


def _cameras(dataset: Dataset, sample: str) -> Iterator[CameraFacts]:
    """Those of a sample."""
    looks = {camera: looks_to(dataset.ego_from(sample, camera)) for camera in CAMERAS}
    half = {}
    for camera in CAMERAS:
        lens = dataset.camera(sample, camera)
        half[camera] = math.degrees(math.atan(lens.width / 2 / lens.intrinsic[0, 0]))
    for camera, angle in looks.items():
        lens, pose = dataset.camera(sample, camera), dataset.ego_from(sample, camera)
        turn, other = min(((looks[each] - angle) % 360, each) for each in CAMERAS if each != camera)
        yield CameraFacts(
            camera=camera,
            width=lens.width,
            height=lens.height,
            focal=round(float(lens.intrinsic[0, 0] / lens.width), 3),
            field_of_view=round(2 * half[camera], 1),
            looks=180.0 if abs(angle) > 179.95 else round(angle, 1) + 0.0,
            pitch=round(math.degrees(math.asin(pose.rotation[2, 2])), 1) + 0.0,  # no -0
            above=round(float(pose.translation[2]), 2),
            overlap=round(half[camera] + half[other] - turn, 1),
        )


def _lanes(cloud: FloatArray) -> int:
    """How many directions up and down a cloud's points lie in, from the LiDAR's origin."""
    known = cloud[np.isfinite(cloud).all(axis=1)]
    elevation = np.sort(np.degrees(np.arctan2(known[:, 2], np.hypot(known[:, 0], known[:, 1]))))
    return int((np.diff(elevation) > _LANE_GAP).sum()) + 1


def _odd(first: SensorSetupFacts, second: SensorSetupFacts) -> Iterator[str]:
    """Yield what differs so much that a model notices it."""
    for one, other in zip(first.cameras, second.cameras, strict=True):
        if apart := ", ".join(_apart(one, other)):
            yield f"{one.camera}: {apart}"
    yield from _moved("the LiDAR is {:.1f} m {}", _RISE, second.lidar_above - first.lidar_above)
    for name, words in (
        ("lanes", "lanes of the LiDAR"),
        ("points", "points a cloud"),
        ("reach", "metres of reach"),
    ):
        was, now = getattr(first, name), getattr(second, name)
        if was and now and not 0.8 < now / was < 1.25:
            yield f"{now:,.0f} {words}, not {was:,.0f}"
    if first.labels_a_second != second.labels_a_second:
        yield f"{second.labels_a_second:g} labels a second, not {first.labels_a_second:g}"
    for name, share in first.shares.items():
        there = second.shares[name]
        if abs(there - share) >= _SHARE or (share > 0) != (there > 0):
            yield f"{there:.0%} of the boxes are of the class {name}, not {share:.0%}"


def _apart(one: CameraFacts, other: CameraFacts) -> Iterator[str]:
    """Yield what differs between two cameras of one name."""
    larger = other.focal / one.focal
    if abs(larger - 1) > _LARGER:
        views = (
            f"its field of view is {other.field_of_view:.0f} degrees, not {one.field_of_view:.0f}"
        )
        yield f"things look {larger:.2g} times as large in it, since {views}"
    yield from _moved("it is {:.1f} m {}", _RISE, other.above - one.above)
    yield from _moved("it looks {:.0f} degrees {}", _TURN, other.pitch - one.pitch)
    turn = (other.looks - one.looks + 180) % 360 - 180
    yield from _moved("it is turned by {:.0f} degrees to the {}", _TURN, turn, ("left", "right"))
    shape, wanted = other.width / other.height, one.width / one.height
    if abs(shape / wanted - 1) > _LARGER:
        yield f"its images are {shape:.2f} times as wide as high, not {wanted:.2f}"


def _moved(
    sentence: str, least: float, change: float, sides: tuple[str, str] = ("higher", "lower")
) -> Iterator[str]:
    """Yield a sentence on a change of metres or degrees, with its size and side, unless it is too small to matter."""
    if abs(change) >= least:
        yield sentence.format(abs(change), sides[change < 0])
