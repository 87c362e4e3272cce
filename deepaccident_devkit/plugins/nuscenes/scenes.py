"""One nuScenes scene as rows of our tables: frames at 10 Hz; every fifth is a keyframe."""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from itertools import chain
from operator import attrgetter
from typing import Any, Final

import numpy as np

from deepaccident_devkit.errors import shortened
from deepaccident_devkit.export.frames import KEY_STEP
from deepaccident_devkit.export.nuscenes.scenes import CAMERA_CHANNELS, CHANNEL_NAMES, LIDAR_CHANNEL
from deepaccident_devkit.geometry import quaternions
from deepaccident_devkit.geometry.conventions import inverses
from deepaccident_devkit.plugins.nuscenes.classes import CLASSES, find_category
from deepaccident_devkit.plugins.nuscenes.tables import NuScenesTables
from deepaccident_devkit.release import Labels, ScenarioFolder
from deepaccident_devkit.release.calib import Calibs
from deepaccident_devkit.release.labels import label_from_world_velocity
from deepaccident_devkit.support.arrays import FloatArray, IntArray
from deepaccident_devkit.support.values import NamedValues
from deepaccident_devkit.tables.arrow_files import ColumnArrays
from deepaccident_devkit.tables.build import scenario_rows
from deepaccident_devkit.tables.scan import ScenarioFiles, ScenarioScan
from deepaccident_devkit.taxonomy import AGENTS, CHANNELS, IGNORED_ID

# The agent that records a scene.
AGENT: Final = AGENTS[0]
# Largest x and y of a quaternion that counts as a rotation only about z.
_TILT_TOLERANCE = 1e-6
# nuScenes' visibility of a box that the cameras see to less than 40 %; to FIERY it is unseen.
_UNSEEN_VISIBILITY = "1"
# Smallest time between a keyframe and the next one.
_MIN_GAP_S = 1e-3
# Largest time between two boxes of an object for which nuScenes has a velocity.
_MAX_GAP_S = 1.5
_MIN_FOCAL_LENGTH_PX = 0.5
# Largest deviation of the length of a quaternion from 1.
_UNIT_TOLERANCE = 0.01


class NuScenesScene:
    """A scene that has been read and checked.

    Attributes:
        frames: Number of frames.
    """

    def __init__(self, source: NuScenesTables, row: Any) -> None:
        """Read the scene of a row; raise DatarootError if a row that it refers to is wrong."""
        self._source = source
        self._row = row
        self._samples = self._order_samples()
        self.frames = KEY_STEP * (len(self._samples) - 1) + 1
        boxes = [source.find_rows("sample_annotation", sample) for sample in self._samples]
        self._boxes = list(chain(*boxes))
        self._keyframes = np.repeat(np.arange(len(boxes)), list(map(len, boxes)))
        self._rotations = self._read_quaternions(self._boxes)
        self._files = [self._find_files(sample) for sample in self._samples]
        self._world_from_ego, self._ego_from_sensor = self._read_poses(LIDAR_CHANNEL)
        is_upright = bool((np.abs(self._rotations[:, 1:3]) < _TILT_TOLERANCE).all())
        self._ego_from_lidar = self._turn_lidar(upright=is_upright)
        self._calibs = self._interpolate_calibs()
        self._columns = self._make_box_columns()

    def _order_samples(self) -> list[Any]:
        """Return the samples in order of time; check that each is linked to the next one."""
        source = self._source
        scene = self._row
        samples = sorted(source.find_rows("sample", scene), key=lambda sample: sample.timestamp)
        tokens = [*(sample.token for sample in samples), ""]
        links = [scene.first_sample_token, *(sample.next for sample in samples)]
        for row, link, token in zip([scene, *samples], links, tokens, strict=True):
            if link != token or not samples:
                raise source.make_error(
                    row,
                    f"next sample: expected {token!r} as the next one in time, found "
                    f"{shortened(link)!r}",
                )
        self._stamps = 1e-6 * np.array([sample.timestamp for sample in samples])
        gaps = np.diff(self._stamps, append=np.inf)
        if gaps.min() < _MIN_GAP_S:
            raise source.make_error(
                samples[gaps.argmin()], "timestamp: expected the next sample to be later"
            )
        return samples

    def _find_files(self, sample: Any) -> NamedValues:
        """Return the row of each channel's file at a keyframe, by channel."""
        follow = self._source.follow
        files = {}
        for file in self._source.find_rows("sample_data", sample):
            if file.is_key_frame:
                sensor = follow(follow(file, "calibrated_sensor_token"), "sensor_token")
                files[sensor.channel] = file
        missing = sorted(CHANNEL_NAMES.values() - files.keys())
        if missing:
            raise self._source.make_error(
                sample, f"token: sample_data.json has no {', '.join(missing)} for this sample"
            )
        return files

    def _read_poses(self, channel: str) -> list[FloatArray]:
        """Return `world_from_ego` and `ego_from_sensor` (K, 4, 4) of a sensor at all keyframes."""
        files = [sample_files[channel] for sample_files in self._files]
        poses = []
        for field in ("ego_pose_token", "calibrated_sensor_token"):
            poses.append(self._read_matrices([self._source.follow(file, field) for file in files]))
        return poses

    def _read_matrices(self, rows: Sequence[Any]) -> FloatArray:
        """Return the transforms (N, 4, 4) of rows that have a translation and a rotation."""
        result = np.tile(np.eye(4), (len(rows), 1, 1))
        result[:, :3, :3] = quaternions.to_matrix(self._read_quaternions(rows))
        result[:, :3, 3] = [row.translation for row in rows]
        return result

    def _read_quaternions(self, rows: Sequence[Any]) -> FloatArray:
        """Return the rotations (N, 4) of rows; raise DatarootError if one is invalid."""
        rotations = np.reshape([row.rotation for row in rows], (-1, 4))
        errors = np.abs(np.linalg.norm(rotations, axis=1) - 1)
        if errors.max(initial=0) > _UNIT_TOLERANCE:
            row = rows[errors.argmax()]
            raise self._source.make_error(
                row, f"rotation: expected a unit quaternion, found {row.rotation}"
            )
        return rotations

    def _turn_lidar(self, *, upright: bool) -> FloatArray:
        """Return `ego_from_lidar` (K, 4, 4), rotated about z until x is forward.

        Args:
            upright: Whether to use the world's z axis for the LiDAR frame.
        """
        result = self._ego_from_sensor.copy()
        rotation = result[:, :3, :3]
        if upright:
            world_from_ego = self._world_from_ego[:, :3, :3]
            ego_from_world = np.swapaxes(world_from_ego, 1, 2)
            rotation[:] = ego_from_world @ _rotate_about_z(_measure_heading(world_from_ego))
        else:
            rotation[:] = rotation @ _rotate_about_z(-_measure_heading(rotation))
        return result

    def list_files(self, first_row: int) -> Iterator[tuple[int, str, str, list[float]]]:
        """Yield the files of keyframes as rows of `_FILES`.

        Each has the row number in `sample_data`, the file name, nuScenes' token of the sample, and
        `lidar_from_sensor`.

        Args:
            first_row: Row of the scene's first sample.
        """
        lidar_from_sensor = inverses(self._ego_from_lidar) @ self._ego_from_sensor
        matrices = lidar_from_sensor.reshape(-1, 16).tolist()
        keyframes = zip(self._samples, self._files, matrices, strict=True)
        for number, (sample, files, matrix) in enumerate(keyframes):
            for channel, name in CHANNEL_NAMES.items():
                sample_row = first_row + KEY_STEP * number
                row = sample_row * len(CHANNELS) + CHANNELS.index(channel)
                yield row, files[name].filename, sample.token, matrix

    def make_rows(self, *, every_class: bool) -> dict[str, ColumnArrays]:
        """Return the rows of all tables.

        Args:
            every_class: Whether to include boxes of all classes instead of only ours.
        """
        folder = self._source.folder.parent
        scenario = ScenarioFolder(folder, "", "nuscenes", self._row.name, (AGENT,))
        scan = ScenarioScan(
            agents=(AGENT,),
            has_meta=False,
            labelled=(AGENT,),
            num_frames=self.frames,
            problems=(),
            notices=(),
        )
        frames = np.arange(self.frames)
        is_key = frames % KEY_STEP == 0
        key_times = self._stamps - self._stamps[0]
        times = np.interp(frames, np.flatnonzero(is_key), key_times).round(6)
        is_included = (self._columns["actor_id"] < IGNORED_ID) | every_class
        steps = np.diff(self._calibs.world_from_ego[:, :2, 3], axis=0, append=np.nan)
        box_frames = KEY_STEP * self._keyframes[is_included]
        labels = Labels(
            raw=False,
            num_boxes=np.bincount(box_frames, minlength=self.frames),
            agent_velocity=steps / np.diff(times, append=np.nan)[:, None],
            **{name: column[is_included] for name, column in self._columns.items()},
        )
        rows = scenario_rows(
            ScenarioFiles(
                scenario=scenario, scan=scan, meta=None, calibs=self._calibs, labels=labels
            )
        )
        own_columns: dict[str, ColumnArrays] = {
            "scenario": {"town": [self._source.follow(self._row, "log_token").location]},
            "frame": {"timestamp": times},
            "sample": {
                "timestamp": times,
                "time_to_end": times[-1] - times,
                "labelled": is_key & bool(self._boxes),
            },
            "sample_data": self._read_image_sizes(rows["sample_data"]),
            "ego_pose": {"timestamp": times},
        }
        return {table: {**columns, **own_columns.get(table, {})} for table, columns in rows.items()}

    def _read_image_sizes(self, sample_data: ColumnArrays) -> NamedValues:
        """Return the width and height of the rows of `sample_data`, with the true sizes of images.

        The intrinsic matrix only shows where the middle of an image may be.
        """
        images = [self._files[0][channel] for channel in CAMERA_CHANNELS.values()]
        sizes = {}
        for side in ("width", "height"):
            image_sizes = map(attrgetter(side), images)
            other_sizes = sample_data[side][len(images) : len(CHANNELS)]
            sizes[side] = np.tile([*image_sizes, *other_sizes], self.frames)
        return sizes

    def _interpolate_calibs(self) -> Calibs:
        """Return the calibrations of all frames.

        Between keyframes, poses are interpolated, and sensors stay as at the keyframe before.
        """
        from scipy.spatial.transform import Rotation

        key_poses = self._world_from_ego
        before, step = np.divmod(np.arange(self.frames), KEY_STEP)
        after = before + (step > 0)
        share = step[:, None] / KEY_STEP
        rotations = Rotation.from_matrix(key_poses[:, :3, :3])
        turn = rotations[before].inv() * rotations[after]
        turned_share = Rotation.from_rotvec(share * turn.as_rotvec())
        poses = key_poses[before]
        poses[:, :3, 3] += share * (key_poses[after] - poses)[:, :3, 3]
        poses[:, :3, :3] = (rotations[before] * turned_share).as_matrix()
        poses[step == 0] = key_poses
        cameras = []
        intrinsics = []
        for channel in CAMERA_CHANNELS.values():
            # A camera's ego pose is that at the camera's own time.
            world_from_camera_ego, ego_from_camera = self._read_poses(channel)
            camera_from_ego = inverses(world_from_camera_ego @ ego_from_camera) @ key_poses
            cameras.append(camera_from_ego @ self._ego_from_lidar)
            intrinsics.append(
                np.stack([self._read_intrinsic(files[channel]) for files in self._files])
            )
        return Calibs(
            ego_from_lidar=self._ego_from_lidar[before],
            world_from_ego=poses,
            camera_from_lidar=np.stack(cameras, axis=1)[before],
            intrinsic=np.stack(intrinsics, axis=1)[before],
        )

    def _read_intrinsic(self, image: Any) -> FloatArray:
        """Return the intrinsic matrix (3, 3) of an image.

        Raises DatarootError if the matrix or the size of the image is invalid.
        """
        mount = self._source.follow(image, "calibrated_sensor_token")
        matrix = np.array(mount.camera_intrinsic)
        if matrix.shape != (3, 3) or matrix.diagonal().min() < _MIN_FOCAL_LENGTH_PX:
            raise self._source.make_error(
                mount, "camera_intrinsic: expected 3 x 3 numbers with focal lengths in pixels"
            )
        if min(image.width, image.height) < 1:
            raise self._source.make_error(
                image, "width, height: expected the pixels of an image, found 0"
            )
        return matrix

    def _make_box_columns(self) -> NamedValues:
        """Return the columns of `Labels` for all boxes."""
        boxes = self._boxes
        follow = self._source.follow
        calibs = self._calibs
        names = [follow(follow(box, "instance_token"), "category_token").name for box in boxes]
        world_from_lidar = calibs.world_from_ego @ calibs.ego_from_lidar
        lidar_from_world = inverses(world_from_lidar)[KEY_STEP * self._keyframes]
        rotation = lidar_from_world[:, :3, :3]
        yaw = _measure_heading(rotation @ quaternions.to_matrix(self._rotations))
        center = np.reshape([box.translation for box in boxes], (-1, 3))
        ids, velocity = self._number_tracks(center[:, :2])
        is_ignored = np.array([name not in CLASSES for name in names], dtype=bool)
        ids += is_ignored * IGNORED_ID
        is_seen = [box.visibility_token != _UNSEEN_VISIBILITY for box in boxes]
        return {
            "category": np.array([find_category(name) for name in names], dtype=np.int8),
            "center": (rotation @ center[:, :, None])[..., 0] + lidar_from_world[:, :3, 3],
            "size": np.reshape([box.size for box in boxes], (-1, 3))[:, [1, 0, 2]],
            "yaw": yaw,
            "velocity": label_from_world_velocity(velocity, yaw),
            "actor_id": ids,
            "num_lidar_pts": np.array([box.num_lidar_pts for box in boxes], dtype=np.int64),
            "camera_visible": np.array(is_seen, dtype=bool),
        }

    def _number_tracks(self, positions: FloatArray) -> tuple[IntArray, FloatArray]:
        """Return a number for the actor of each box, and the velocities of the boxes.

        Actors are numbered as they appear. As in nuScenes, a velocity is taken from the actor's
        previous box to its next box, and is NaN if these are too far apart in time. Raises
        DatarootError if an actor has two boxes at a keyframe.

        Args:
            positions: Positions of boxes in the world, shape (N, 2).

        Returns:
            Numbers, shape (N,), and velocities in the world in m/s, shape (N, 2).
        """
        times = self._stamps[self._keyframes]
        ids = np.zeros(len(times), dtype=np.int64)
        velocity = np.full((len(times), 2), np.nan)
        tracks = defaultdict(list)
        for row, box in enumerate(self._boxes):
            tracks[box.instance_token].append(row)
        for number, rows in enumerate(tracks.values(), start=1):
            ids[rows] = number
            rows_before = [rows[0], *rows[:-1]]
            rows_after = [*rows[1:], rows[-1]]
            for before, row, after in zip(rows_before, rows, rows_after, strict=True):
                if before < row and times[before] == times[row]:
                    raise self._source.make_error(
                        self._boxes[row],
                        "instance_token: two boxes of the sample have the same one",
                    )
                seconds = times[after] - times[before]
                num_gaps = (before < row) + (row < after)
                if 0 < seconds <= _MAX_GAP_S * num_gaps:
                    velocity[row] = (positions[after] - positions[before]) / seconds
        return ids, velocity


def _measure_heading(rotation: FloatArray) -> FloatArray:
    """Return the angles about z, shape (N,), to which rotations (N, 3, 3) turn the x axis."""
    x_axis = rotation[:, :, 0]
    angles = np.arctan2(x_axis[:, 1], x_axis[:, 0])
    return np.asarray(angles)


def _rotate_about_z(angle: FloatArray) -> FloatArray:
    """Return rotations (N, 3, 3) about z by angles (N,) in radians."""
    rotation = quaternions.from_yaw(angle)
    return quaternions.to_matrix(rotation)
