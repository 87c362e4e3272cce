"""One scene of nuScenes as the rows of our tables: frames at 10 Hz, of which its keyframes are every fifth one."""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import chain
from typing import Any, Final

import numpy as np

from deepaccident_devkit.errors import shortened
from deepaccident_devkit.export.frames import KEY_STEP
from deepaccident_devkit.export.nuscenes.scenes import CAMERA_CHANNELS, CHANNEL_NAMES, LIDAR_CHANNEL
from deepaccident_devkit.geometry import quaternions
from deepaccident_devkit.geometry.conventions import inverses
from deepaccident_devkit.nuscenes.classes import CLASSES, category_of
from deepaccident_devkit.nuscenes.tables import OF_CAMERAS, Tables
from deepaccident_devkit.release import Labels, ScenarioFolder
from deepaccident_devkit.release.calib import Calibs
from deepaccident_devkit.release.labels import label_from_world_velocity
from deepaccident_devkit.support.arrays import FloatArray, IntArray
from deepaccident_devkit.tables.arrow_files import Columns
from deepaccident_devkit.tables.build import scenario_rows
from deepaccident_devkit.tables.scan import ScenarioFiles, ScenarioScan
from deepaccident_devkit.taxonomy import AGENTS, CHANNELS, IGNORED_ID, LIDAR

AGENT: Final = AGENTS[0]
"""Whose recording a scene is."""
_LEAN: Final = 1e-6
"""Of the x and y of a quaternion: below, it is a turn about z alone."""
_UNSEEN: Final = "1"
"""nuScenes' visibility of a box of which the cameras see less than 40 %; FIERY takes it for unseen."""
_INSIDE: Final = re.compile(r"(?!/|(.*/)?\.\.(/|$))[^\x00]+")
"""A path that leads to nothing above its folder."""
_LEAST_GAP: Final = 1e3
"""Microseconds from a keyframe to the next one."""
_MOST_GAP: Final = 1.5
"""Seconds from a box to the next one of its object, beyond which nuScenes knows no velocity."""
_UNIT_TOLERANCE: Final = 0.01
"""How far from 1 the length of a quaternion may be."""


class SceneTables:
    """The rows of a scene, read.

    Attributes:
        row: its row in the table `scene`.
        name: of the scene.
        frames: number of frames.
        tables: whether boxes of all classes are there, not of ours only → the rows of each table.
    """

    def __init__(self, tables: Tables, token: str) -> None:
        """Read a scene; raises DatarootError for a damaged row that it leads to."""
        self._source, self.row = tables, tables.row("scene", token)
        self.name = self.row.name
        self._town = tables.follow(self.row, "log_token").location
        self._samples = list(self._chain())
        self._stamps = {sample.token: 1e-6 * sample.timestamp for sample in self._samples}
        self._files = [self._channels(sample) for sample in self._samples]
        self._boxes = [tables.rows_of("sample_annotation", sample) for sample in self._samples]
        self._box_frames = np.repeat(np.arange(len(self._boxes)) * KEY_STEP, list(map(len, self._boxes)))
        self.frames = KEY_STEP * (len(self._samples) - 1) + 1
        self._world_from_ego, self._ego_from_sensor = self._poses(LIDAR_CHANNEL)
        self._rotations = np.reshape([self._unit(box) for box in chain(*self._boxes)], (-1, 4))
        self._ego_from_lidar = self._turned(upright=bool((np.abs(self._rotations[:, 1:3]) < _LEAN).all()))
        self._calibs = self._all_calibs(np.arange(self.frames))
        self._columns = self._box_columns()
        self.tables = {every_class: self._rows(every_class=every_class) for every_class in (False, True)}

    def _chain(self) -> Iterator[Any]:
        """The samples from the first to the last one; each is later than the one before, so that they end."""
        source, row, field, before = self._source, self.row, "first_sample_token", -_LEAST_GAP
        left = len(source.belonging["sample"].get(row.token, ()))
        while row is self.row or row.next:
            following = source.follow(row, field, "sample")
            if following.scene_token != self.row.token or following.timestamp < before + _LEAST_GAP:
                raise source.error(row, f"{field}: expected a later sample of its scene, found {following.token}")
            row, field, before, left = following, "next", following.timestamp, left - 1
            yield row
        if left:
            raise source.error(row, f"next: expected one of {left} more samples of the scene, found none")

    def _channels(self, sample: Any) -> dict[str, Any]:
        """Channel → the row of its file at a keyframe."""
        follow, found = self._source.follow, dict[str, Any]()
        for file in self._source.rows_of("sample_data", sample):
            if file.is_key_frame:
                if not _INSIDE.fullmatch(file.filename):
                    raise self._source.error(file, f"filename: {shortened(file.filename)!r} leads out of the dataroot")
                found[follow(follow(file, "calibrated_sensor_token"), "sensor_token").channel] = file
        if lacking := CHANNEL_NAMES.values() - found.keys():
            raise self._source.error(sample, f"token: sample_data.json has no {', '.join(sorted(lacking))} for it")
        return found

    def _poses(self, channel: str) -> tuple[FloatArray, FloatArray]:
        """`world_from_ego` and `ego_from_sensor` (K, 4, 4) of a sensor at its keyframes."""
        return tuple(  # type: ignore[return-value]
            np.stack([self._matrix(self._source.follow(files[channel], f"{table}_token")) for files in self._files])
            for table in ("ego_pose", "calibrated_sensor")
        )

    def _matrix(self, row: Any) -> FloatArray:
        """The transform (4, 4) of a row with translation and rotation."""
        result = np.eye(4)
        result[:3, :3], result[:3, 3] = quaternions.to_matrix(self._unit(row)), row.translation
        return result

    def _unit(self, row: Any) -> FloatArray:
        """The unit quaternion (4,) of a row."""
        length = float(np.linalg.norm(row.rotation))
        if abs(length - 1) > _UNIT_TOLERANCE:
            raise self._source.error(row, f"rotation: expected a quaternion of length 1, found length {length:g}")
        return np.array(row.rotation)

    def _turned(self, *, upright: bool) -> FloatArray:
        """`ego_from_lidar` (K, 4, 4): x forward, and upright in the world if all boxes are."""
        result = self._ego_from_sensor.copy()
        turn = result[:, :3, :3]
        if upright:
            world = self._world_from_ego[:, :3, :3]
            turn[:] = np.swapaxes(world, 1, 2) @ _about_z(_heading(world))
        else:
            turn[:] = turn @ _about_z(-_heading(turn))
        return result

    def files(self) -> Iterator[tuple[int, str, str, list[float] | None]]:
        """Row of `sample_data` in the scene, file, nuScenes' token of the sample, and LiDAR's `lidar_from_sensor`."""
        lidar_from_sensor = inverses(self._ego_from_lidar) @ self._ego_from_sensor
        for number, files in enumerate(self._files):
            for code, channel in enumerate(CHANNELS):
                if channel in CHANNEL_NAMES:
                    file = files[CHANNEL_NAMES[channel]]
                    matrix = lidar_from_sensor[number].ravel().tolist() if channel == LIDAR else None
                    yield KEY_STEP * number * len(CHANNELS) + code, file.filename, file.sample_token, matrix

    def _rows(self, *, every_class: bool) -> dict[str, Columns]:
        """The rows of all tables."""
        place = ScenarioFolder(self._source.folder.parent, "", "nuscenes", self.name, (AGENT,))
        scan = ScenarioScan(
            agents=(AGENT,), has_meta=False, labelled=(AGENT,), num_frames=self.frames, problems=(), notices=()
        )
        stamps = np.array([*self._stamps.values()])
        is_key = np.arange(self.frames) % KEY_STEP == 0
        times = np.interp(np.arange(self.frames), np.flatnonzero(is_key), stamps - stamps[0]).round(6)
        chosen = (self._columns["actor_id"] < IGNORED_ID) | every_class
        moved = np.diff(self._calibs.world_from_ego[:, :2, 3], axis=0, append=np.nan)
        labels = Labels(
            raw=False,
            num_boxes=np.bincount(self._box_frames[chosen], minlength=self.frames),
            agent_velocity=moved / np.diff(times, append=np.nan)[:, None],
            **{name: column[chosen] for name, column in self._columns.items()},
        )
        rows = scenario_rows(ScenarioFiles(scenario=place, scan=scan, meta=None, calibs=self._calibs, labels=labels))
        files = rows["sample_data"]
        tokens = [self._files[0][channel].token for channel in CAMERA_CHANNELS.values()]
        images = [self._source.row("sample_data", token, OF_CAMERAS) for token in tokens]
        for side in ("width", "height"):  # K says only where their middle may be
            values = np.array(files[side]).reshape(self.frames, -1)
            values[:, : len(images)] = [getattr(image, side) for image in images]
            files = {**files, side: values.ravel()}
        labelled = is_key & any(self._boxes)
        return {
            **rows,
            "scenario": {**rows["scenario"], "town": [self._town]},
            "frame": {**rows["frame"], "timestamp": times},
            "sample": {**rows["sample"], "timestamp": times, "time_to_end": times[-1] - times, "labelled": labelled},
            "sample_data": files,
            "ego_pose": {**rows["ego_pose"], "timestamp": times},
        }

    def _all_calibs(self, frame: IntArray) -> Calibs:
        """Of all frames: poses between keyframes are interpolated, sensors stay as at the keyframe before."""
        from scipy.spatial.transform import Rotation, Slerp

        world, before = self._world_from_ego, frame // KEY_STEP
        moved = np.tile(np.eye(4), (self.frames, 1, 1))
        at = np.arange(len(world)) * KEY_STEP
        moved[:, :3, 3] = np.stack([np.interp(frame, at, world[:, axis, 3]) for axis in range(3)], axis=1)
        turns = Rotation.from_matrix(world[:, :3, :3])
        moved[:, :3, :3] = Slerp(at, turns)(frame).as_matrix() if len(world) > 1 else turns.as_matrix()
        moved[at] = world
        cameras, intrinsics = [], []
        for channel in CAMERA_CHANNELS.values():
            then, ego_from_camera = self._poses(channel)
            ego_then = inverses(then @ ego_from_camera) @ world  # the camera's ego is where it was at its own time
            cameras.append(ego_then @ self._ego_from_lidar)
            mounts = [files[channel].calibrated_sensor_token for files in self._files]
            rows = [self._source.row("calibrated_sensor", mount, OF_CAMERAS) for mount in mounts]
            intrinsics.append(np.array([row.camera_intrinsic for row in rows]))
        return Calibs(
            ego_from_lidar=self._ego_from_lidar[before],
            world_from_ego=moved,
            camera_from_lidar=np.stack(cameras, axis=1)[before],
            intrinsic=np.stack(intrinsics, axis=1)[before],
        )

    def _box_columns(self) -> dict[str, Any]:
        """Columns of `Labels` of all boxes; actors are numbered as they appear, ignored ones from `IGNORED_ID` on."""
        boxes, follow, calibs = list(chain(*self._boxes)), self._source.follow, self._calibs
        names = [follow(follow(box, "instance_token"), "category_token").name for box in boxes]
        numbers: dict[str, int] = {}
        ids = [
            numbers.setdefault(box.instance_token, len(numbers) + 1) + (0 if name in CLASSES else IGNORED_ID)
            for box, name in zip(boxes, names, strict=True)
        ]
        lidar_from_world = inverses(calibs.world_from_ego @ calibs.ego_from_lidar)[self._box_frames]
        turn, yaw = (
            lidar_from_world[:, :3, :3],
            _heading(lidar_from_world[:, :3, :3] @ quaternions.to_matrix(self._rotations)),
        )
        center = np.reshape([box.translation for box in boxes], (-1, 3, 1))
        velocity = np.reshape([self._velocity(box) for box in boxes], (-1, 2))
        return {
            "category": np.array([category_of(name) for name in names], dtype=np.int8),
            "center": (turn @ center)[..., 0] + lidar_from_world[:, :3, 3],
            "size": np.reshape([box.size for box in boxes], (-1, 3))[:, [1, 0, 2]],
            "yaw": yaw,
            "velocity": label_from_world_velocity(velocity, yaw),
            "actor_id": np.array(ids, dtype=np.int64),
            "num_lidar_pts": np.array([box.num_lidar_pts for box in boxes], dtype=np.int64),
            "camera_visible": np.array([box.visibility_token != _UNSEEN for box in boxes], dtype=bool),
        }

    def _velocity(self, box: Any) -> FloatArray:
        """The velocity (2,) of a box in the world, m/s, as the nuScenes devkit derives it; NaN where it knows none."""
        first, last = (
            self._source.follow(box, field, "sample_annotation") if getattr(box, field) else box
            for field in ("prev", "next")
        )
        start, now, end = (self._stamps.get(one.sample_token, np.nan) for one in (first, box, last))
        in_order = (start < now or not box.prev) and (now < end or not box.next)
        if not in_order or {first.instance_token, last.instance_token} != {box.instance_token}:
            raise self._source.error(box, "prev, next: expected boxes of its instance before and after it in the scene")
        if not 0 < end - start <= _MOST_GAP * (bool(box.prev) + bool(box.next)):
            return np.full(2, np.nan)
        return np.asarray(np.subtract(last.translation[:2], first.translation[:2]) / (end - start))


def _heading(turn: FloatArray) -> FloatArray:
    """Where x points, about z (N,), of rotations (N, 3, 3)."""
    return np.asarray(np.arctan2(turn[:, 1, 0], turn[:, 0, 0]))


def _about_z(angle: FloatArray) -> FloatArray:
    """Rotations (N, 3, 3) about z."""
    return quaternions.to_matrix(quaternions.from_yaw(angle))
