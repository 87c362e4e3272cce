"""`Dataset`: a release's opened tables and their sensor files, for all upper layers."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, get_args

import numpy as np

from deepaccident_devkit.errors import (
    ChoiceError,
    MissingFileError,
    NotAvailableError,
    ReleaseError,
    TokenError,
)
from deepaccident_devkit.geometry import SE3, Box, Boxes, LidarPointCloud, PinholeCamera
from deepaccident_devkit.geometry.boxes import trusted_boxes
from deepaccident_devkit.geometry.conventions import stored_transforms
from deepaccident_devkit.geometry.se3 import trusted_se3
from deepaccident_devkit.release import BevImage, read_bev, read_image, read_lidar
from deepaccident_devkit.release.fingerprints import digest_of
from deepaccident_devkit.release.layout import ScenarioFolder, frame_numbers
from deepaccident_devkit.release.store import ReleasePath, StorePath
from deepaccident_devkit.support import nuscenes_names
from deepaccident_devkit.support.arrays import AnyArray, BoolArray, ByteArray, FloatArray, IntArray
from deepaccident_devkit.support.text import choice, spelled
from deepaccident_devkit.tables import (
    OpenTables,
    RowArgument,
    displacement_velocities,
    visible_ids,
    visible_mask,
)
from deepaccident_devkit.tables.arrow_files import damaged_value
from deepaccident_devkit.tables.tables import token_of
from deepaccident_devkit.taxonomy import (
    AGENTS,
    BEV_CAMERA,
    CAMERAS,
    CHANNEL_FORMAT,
    CHANNELS,
    INFRASTRUCTURE,
    LIDAR,
    OWN_ACTOR_ID,
    UNTRACKED_ID,
    Frame,
)

__all__ = ["VISIBLE", "Dataset", "RowArgument", "VelocitySource", "Visible"]

Visible = Literal["camera", "released"]
VelocitySource = Literal["decoded", "derived", "label"]
# Name of a frame for callers → its canonical name.
_FRAMES: Final[Mapping[str, str]] = {name: name for name in (*get_args(Frame), *CHANNELS)} | {
    LIDAR: "lidar"
}
VISIBLE: Final = (None, *get_args(Visible))
"""Values of `visible=`."""


class Dataset(OpenTables):
    """One release: its tables (`OpenTables`), poses, boxes and sensor files."""

    if not TYPE_CHECKING:  # Type checkers would take every name for a known one.

        def __getattr__(self, name: str) -> Any:
            """Name the replacement for a name of the nuScenes devkit; raises MissingNameError."""
            if name in nuscenes_names.DATASET:
                raise nuscenes_names.missing_name(type(self), name, nuscenes_names.DATASET[name])
            # This raises the usual AttributeError.
            return object.__getattribute__(self, name)

    @property
    def with_ignored(self) -> Dataset:
        """This release with the boxes of unknown classes, too, which count nowhere else.

        A release of DeepAccident has none, and is returned itself. Such boxes have ids from
        `taxonomy.IGNORED_ID` on.
        """
        return self

    # Poses.

    def world_from(self, sample: RowArgument, frame: str) -> SE3:
        """Return the transform to world from a frame of a sample.

        Args:
            sample: Token or record.
            frame: `world`, `ego`, `lidar` or a channel (cameras optical).

        Raises:
            TokenError: The sample is unknown.
            ChoiceError: The frame is unknown.
        """
        return self._world_from(self._sample_row(sample), self.frame_name(frame))

    def ego_from(self, sample: RowArgument, channel: str) -> SE3:
        """Return the transform to a sample's ego frame from a sensor's frame.

        It has the exact numbers of the sample's calib file. The row of `calibrated_sensor` is the
        intended value; the files of a scenario differ from it by rounding.

        Raises:
            TokenError: The sample or sensor is unknown.
        """
        row = self.getind("sample_data", f"{token_of(sample)}/{channel}")
        matrix = self.columns("sample_data")["matrix"][row]
        return trusted_se3(stored_transforms(matrix))

    def frame_name(self, frame: str) -> str:
        """Return the canonical name of a frame of samples, which results carry.

        It is `lidar` for the channel `lidar01`, and the frame's own name for all others.

        Raises:
            ChoiceError: The frame is unknown.
        """
        name: str = choice("frame", frame, _FRAMES)
        return _FRAMES[name]

    # Boxes.

    def boxes(
        self,
        sample: RowArgument,
        frame: str = "world",
        visible: Visible | None = None,
        velocity: VelocitySource = "decoded",
    ) -> Boxes:
        """Return the annotated boxes of a sample as arrays; 0 rows if it has no label.

        Args:
            sample: Token or record.
            frame: Frame of the result: `world`, `ego`, `lidar` or a camera channel (then optical
                axes).
            visible: None for all boxes; `camera` for boxes that a camera of this agent sees;
                `released` for boxes that any agent at this moment sees by the released rule
                (docs/released_code.md, Visibility and attributes), without the agent itself.
            velocity: `decoded` for the label's velocity (the column `velocity`; see
                docs/conventions.md); `derived` from this agent's world positions of the actor at
                10 Hz, NaN without any; `label` for the raw pair of the label, as if it were in the
                LiDAR frame (the agent's own in world).

        Raises:
            TokenError: The sample is unknown.
            ChoiceError: The frame, visibility or velocity is unknown.
        """
        token = token_of(sample)
        frame = self.frame_name(frame)
        row = self._tables.resolver.row("sample", token)
        source = choice("velocity", velocity, get_args(VelocitySource))
        lidar_boxes = self._lidar_boxes(row, source, token)
        visibility = choice("visible", visible, VISIBLE)
        if visibility is not None:
            lidar_boxes = lidar_boxes.select(self._visible(row, lidar_boxes, visibility))
        if frame == "lidar":
            return lidar_boxes
        target_from_lidar = self._world_from(row, "lidar")
        if frame != "world":
            target_from_lidar = self._world_from(row, frame).inverse() @ target_from_lidar
        return lidar_boxes.transform(target_from_lidar, frame)

    @nuscenes_names.with_keywords_named
    def get_boxes(
        self,
        sample: RowArgument,
        frame: str = "world",
        visible: Visible | None = None,
        velocity: VelocitySource = "decoded",
    ) -> list[Box]:
        """Return the annotated boxes of a sample, one object each, with their tokens.

        Arguments are as in `boxes`. Boxes of `boxes(sample)[i]` are the same except
        `instance_token`, which only these have.
        """
        row = self._sample_row(sample)
        boxes = self.boxes(sample, frame, visible, velocity)
        instance_rows = self._tables.views["annotation"]["instance_row"]
        instances = instance_rows[self._annotation_slice(row)][boxes.row].tolist()
        token_of_instance = self._tables.resolver.token_makers["instance"]
        result = list(boxes)
        for box, instance in zip(result, instances, strict=True):
            box.instance_token = token_of_instance(instance) if instance >= 0 else None
        return result

    def actor_ids(self, sample: RowArgument) -> IntArray:
        """Return the CARLA ids (N,) of the actors of a sample's boxes, in the order of its label.

        Unlike in `Boxes.actor_id`, the agent's own row has the agent's id. Untracked rows are −1,
        and so is an own row if meta does not identify the agent.

        Raises:
            TokenError: The sample is unknown.
        """
        rows = self._annotation_slice(self._sample_row(sample))
        instances = self._tables.views["annotation"]["instance_row"][rows]
        actors = self._tables.views["instance"]["actor_id"]
        known = instances >= 0
        result = np.full(len(instances), UNTRACKED_ID, dtype=np.int64)
        result[known] = actors[instances[known]]
        return result

    def annotation_rows(self, sample: RowArgument) -> slice:
        """Return the rows of a sample's boxes in the annotation table; empty without a label.

        Raises TokenError.
        """
        return self._annotation_slice(self._sample_row(sample))

    def recordings(self, scenarios: Iterable[str]) -> dict[str, str]:
        """Return scenario token → a hash of ego's number of boxes at each moment, if it has labels.

        It distinguishes recordings of one name: recordings of the mini release differ from the
        complete one's.
        """
        samples = self.columns("sample")
        hashes = {}
        for token in sorted(set(scenarios)):
            # The scenario, or its ego, may be missing.
            with suppress(TokenError):
                ego = self.getind("agent", f"{token}/{AGENTS[0]}")
                start, stop = np.searchsorted(samples["agent_row"], (ego, ego + 1))
                counts = samples["num_annotations"][start:stop]
                if counts.any():
                    hashes[token] = digest_of(counts.tolist())
        return hashes

    # Sensor data.

    @nuscenes_names.with_keywords_named
    def get_sample_data_path(self, sample_data: RowArgument, channel: str | None = None) -> Path:
        """Return the path of a sensor file, which need not exist; see `get_sample_data`.

        Raises:
            TokenError: The sensor file is unknown.
            NotAvailableError: The release lies in archives or at a URL, so that there is no path;
                `local_path` returns one.
        """
        path = self.sensor_path(sample_data, channel)
        if isinstance(path, Path):
            return path
        raise NotAvailableError(
            f"{path}: lies in an archive or at a URL; da.local_path(token) gives a real path"
        )

    def local_path(self, sample_data: RowArgument, channel: str | None = None) -> Path:
        """Return a real path with the content of a sensor file, for other programs.

        Arguments are as in `get_sample_data`. A file in an archive or at a URL is copied into the
        user's cache, which has a limited size, so that a copy may disappear later
        (docs/reading.md).

        Raises:
            TokenError: The sensor file is unknown.
            MissingFileError: It was not downloaded.
            SensorFileError: It cannot be read, or there is no space in the cache.
        """
        path = self.sensor_path(sample_data, channel)
        if isinstance(path, StorePath):
            return path.local_path()
        if not path.exists():
            raise MissingFileError(f"{path}: no such file; unpack the archive that holds it")
        return path

    def sensor_path(self, sample_data: RowArgument, channel: str | None = None) -> ReleasePath:
        """Return where the devkit's readers find a sensor file, which need not exist.

        Arguments are as in `get_sample_data`.

        Raises:
            TokenError: The sensor file is unknown.
        """
        return self._path(self._sensor(sample_data, channel)[0])

    def sensor_frames(self, scenario: RowArgument) -> dict[tuple[str, str], tuple[int, ...]]:
        """Return which files of a scenario exist, without opening any.

        The result is agent and channel → frame numbers, ascending. A folder is listed for each
        agent of the scenario and each of `taxonomy.CHANNELS`: `sensor_path` of every file is
        slower. A folder that does not exist, or cannot be listed, has no frames.

        Raises:
            TokenError: The scenario is unknown.
        """
        row = self.getind("scenario", scenario)
        record = self.scenario[row]
        folder = ScenarioFolder(
            self.dataroot, record["folder"], record["scenario_type"], record["name"], AGENTS
        )
        frames: dict[tuple[str, str], tuple[int, ...]] = {}
        for agent, channel in product(self._tables.resolver.agents_of(row), CHANNELS):
            frames[agent, channel] = ()
            with suppress(ReleaseError):
                channel_folder = folder.kind_folder(agent, channel)
                numbers, _ = frame_numbers(channel_folder, CHANNEL_FORMAT[channel])
                recorded = [number for number in numbers if number <= record["num_frames"]]
                frames[agent, channel] = tuple(recorded)
        return frames

    @nuscenes_names.with_keywords_named
    def get_sample_data(
        self, sample_data: RowArgument, channel: str | None = None
    ) -> tuple[Path, list[Box], FloatArray | None]:
        """Return a sensor file's path, all boxes of its sample, and K (3, 3) of a camera.

        The path is that of `get_sample_data_path` or, without one, that of `local_path`. Boxes are
        in the sensor's frame, and not tested against the image: boxes behind a camera are among
        them (`camera` finds visible ones). K is from calib, for an image of the size that `camera`
        has: `camera(…).resized(width, height)` has it for another size.

        Args:
            sample_data: Token or record of a sensor file; with `channel`, of a sample.
            channel: The sensor, such as `Camera_Front` or `lidar01`; None if `sample_data` names
                it.

        Raises:
            TokenError: The sensor file is unknown.
            MissingFileError, SensorFileError: As in `local_path`, if the release lies in archives
                or at a URL.
        """
        row, name = self._sensor(sample_data, channel)
        intrinsic = self._intrinsic(row) if name in CAMERAS else None
        boxes = self.get_boxes(self._tables.resolver.token("sample", row // len(CHANNELS)), name)
        path = self._path(row)
        return path if isinstance(path, Path) else path.local_path(), boxes, intrinsic

    def camera(self, sample_data: RowArgument, channel: str | None = None) -> PinholeCamera:
        """Return a camera with K and image size from its calib file.

        It projects points and finds visible boxes.

        Args:
            sample_data: Token or record of a camera's sensor file; with `channel`, of a sample.
            channel: The camera, such as `Camera_Front`; None if `sample_data` names it.

        Raises:
            TokenError: The sensor file is unknown.
            ChoiceError: The sensor is no camera.
        """
        row, name = self._sensor(sample_data, channel)
        if name not in CAMERAS:
            raise ChoiceError(f"camera: expected one of {', '.join(CAMERAS)}, found {name}")
        view = self._tables.views["sample_data"]
        width = view["width"].item(row)
        height = view["height"].item(row)
        return PinholeCamera(self._intrinsic(row), width, height)

    def load_image(
        self,
        sample_data: RowArgument,
        channel: str | None = None,
        *,
        min_size: tuple[int, int] | None = None,
        size: tuple[int, int] | None = None,
    ) -> ByteArray:
        """Return a camera's image, shape (H, W, 3), uint8, RGB.

        Args:
            sample_data: Token or record of a camera's sensor file; with `channel`, of a sample.
            channel: The camera, such as `Camera_Front`; None if `sample_data` names it.
            min_size: A (height, width) that suffices, for speed: a JPEG is decoded at 1/2, 1/4 or
                1/8 of its size if that is no smaller. None decodes all of it.
            size: The (height, width), as of arrays, to which it is resized by Pillow's bilinear
                filter; None keeps its own. Videos (`render_scenario_video`) have the other order:
                (width, height).

        Raises:
            TokenError: The sensor file is unknown.
            ChoiceError: The sensor is no camera.
            MissingFileError: The image was not downloaded.
            SensorFileError: It cannot be read.
        """
        _, name = self._sensor(sample_data, channel)
        if name not in CAMERAS:
            raise ChoiceError(f"{name} holds no images; the cameras are {', '.join(CAMERAS)}")
        return read_image(self.sensor_path(sample_data, channel), min_size=min_size, size=size)

    def load_point_cloud(self, sample: RowArgument, frame: Frame = "world") -> LidarPointCloud:
        """Return a sample's LiDAR points in `world`, `ego` or `lidar`.

        Raises:
            TokenError: The sample is unknown.
            ChoiceError: The frame is unknown.
            MissingFileError: The file was not downloaded.
            SensorFileError: It cannot be read.
        """
        row = self._sample_row(sample)
        name = choice("frame", self.frame_name(frame), get_args(Frame))
        cloud = self._lidar_cloud(row)
        if name == "lidar":
            return cloud
        target_from_world = self._world_from(row, name).inverse()
        return cloud.transform(target_from_world @ self._world_from(row, "lidar"), name)

    def _lidar_cloud(self, row: int) -> LidarPointCloud:
        """Read the points of a row of `sample` in its LiDAR frame."""
        return read_lidar(self._channel_path(row, LIDAR))

    def load_bev(self, sample: RowArgument) -> BevImage:
        """Return the BEV camera's arrays of a sample; forward is up (see `BevImage`).

        Raises:
            TokenError: The sample is unknown.
            MissingFileError: The file was not downloaded.
            SensorFileError: It cannot be read.
        """
        return read_bev(self._channel_path(self._sample_row(sample), BEV_CAMERA))

    # Underlying rows and columns.

    def _sample_row(self, sample: RowArgument) -> int:
        return self._tables.resolver.row("sample", token_of(sample))

    def _sensor(self, sample_data: RowArgument, channel: str | None) -> tuple[int, str]:
        """Return the row and the channel of a sensor file; see `get_sample_data`.

        Raises TokenError.
        """
        token = token_of(sample_data)
        if channel is not None:
            token = f"{token}/{spelled(channel, CHANNELS)}"
        row = self.sample_data.row(token)
        return row, CHANNELS[row % len(CHANNELS)]

    def _path(self, sample_data_row: int) -> ReleasePath:
        return self.dataroot / self._tables.resolver.filename(sample_data_row)

    def _intrinsic(self, sample_data_row: int) -> FloatArray:
        """Return K (3, 3) of a camera, which belongs to the caller."""
        views = self._tables.views
        sensor_row = views["sample_data"]["calibrated_sensor_row"].item(sample_data_row)
        intrinsic: FloatArray = views["calibrated_sensor"]["camera_intrinsic"][sensor_row]
        return intrinsic.reshape(3, 3).copy()

    def _channel_path(self, sample_row: int, channel: str) -> ReleasePath:
        first_row = sample_row * len(CHANNELS)
        return self._path(first_row + CHANNELS.index(channel))

    def _annotation_slice(self, sample_row: int) -> slice:
        view = self._tables.views["sample"]
        first_row = view["first_annotation_row"].item(sample_row)
        count = view["num_annotations"].item(sample_row)
        start = max(first_row, 0)
        rows = slice(start, start + count)
        if not rows.start <= rows.stop <= len(self._tables.views["annotation"]["sample_row"]):
            raise damaged_value("sample")
        return rows

    def _lidar_boxes(
        self, sample_row: int, velocity: VelocitySource, token: str | None = None
    ) -> Boxes:
        view = self._tables.views["annotation"]
        rows = self._annotation_slice(sample_row)
        columns: dict[str, AnyArray] = {
            "center": view["translation"][rows],
            "size": view["size"][rows],
            "rotation": view["rotation"][rows],
            "velocity": view["velocity"][rows],
            "category": view["category"][rows],
            "actor_id": view["actor_id"][rows],
            "num_lidar_pts": view["num_lidar_pts"][rows],
            "camera_visible": view["camera_visible"][rows],
            "row": np.arange(rows.stop - rows.start),
        }
        if velocity == "label":
            raw_velocity = view["velocity_label"][rows]
            columns["velocity"] = self._label_velocity(
                sample_row, columns["actor_id"], raw_velocity
            )
        elif velocity == "derived":
            columns["velocity"] = self._derived_velocity(sample_row)
        return trusted_boxes("lidar", columns, token)

    def _derived_velocity(self, sample_row: int) -> FloatArray:
        """Return velocities (N, 3) in the sample's LiDAR frame, m/s, from neighbouring samples."""
        samples = self._tables.views["sample"]
        boxes = self._tables.views["annotation"]
        previous = samples["prev_row"].item(sample_row)
        following = samples["next_row"].item(sample_row)
        frames = []
        centers = []
        actor_ids = []
        for row in (previous, sample_row, following):
            if row >= 0:
                rows = self._annotation_slice(row)
                world_from_lidar = self._world_from(row, "lidar")
                frames.append(np.full(rows.stop - rows.start, row))
                centers.append(world_from_lidar.apply(boxes["translation"][rows]))
                actor_ids.append(boxes["actor_id"][rows])
        frame = np.concatenate(frames)
        agent = np.zeros(len(frame), dtype=np.int64)
        velocity = displacement_velocities(
            np.concatenate(centers), agent, np.concatenate(actor_ids), frame
        )
        lidar_from_world = self._world_from(sample_row, "lidar").inverse()
        return lidar_from_world.rotate(velocity[frame == sample_row])

    def _label_velocity(
        self, sample_row: int, actor_id: IntArray, velocity_label: FloatArray
    ) -> FloatArray:
        velocity = np.column_stack([velocity_label, np.zeros(len(velocity_label))])
        own = actor_id == OWN_ACTOR_ID
        velocity[own] = self._world_from(sample_row, "lidar").inverse().rotate(velocity[own])
        return velocity

    def _visible(self, sample_row: int, boxes: Boxes, visible: Visible) -> BoolArray:
        if visible == "camera":
            return boxes.camera_visible
        masks = []
        ids = []
        for row in self._samples_at_once(sample_row):
            agent_boxes = self._lidar_boxes(row, "decoded")
            agent = AGENTS[self._tables.views["sample"]["agent"].item(row)]
            mask = visible_mask(
                agent_boxes.center[:, :2],
                agent_boxes.category,
                agent_boxes.num_lidar_pts,
                agent_boxes.camera_visible,
                infrastructure=agent == INFRASTRUCTURE,
            )
            masks.append(mask)
            ids.append(agent_boxes.actor_id)
        return np.isin(boxes.actor_id, visible_ids(masks, ids))

    def _samples_at_once(self, sample_row: int) -> list[int]:
        view = self._tables.views["sample"]
        resolver = self._tables.resolver
        scenario = view["scenario_row"].item(sample_row)
        index = sample_row - resolver.sample_at(view["agent_row"].item(sample_row), 1) + 1
        return [resolver.sample_at(agent, index) for agent in resolver.agents_of(scenario).values()]

    def _world_from(self, sample_row: int, frame: str) -> SE3:
        """Return `world_from` of a frame, by its canonical name."""
        if frame == "world":
            return SE3.identity()
        views = self._tables.views
        pose = stored_transforms(views["ego_pose"]["matrix"][sample_row])
        if frame == "ego":
            return trusted_se3(pose)
        channel = LIDAR if frame == "lidar" else frame
        sample_data_row = sample_row * len(CHANNELS) + CHANNELS.index(channel)
        ego_from_sensor = stored_transforms(views["sample_data"]["matrix"][sample_data_row])
        return trusted_se3(pose @ ego_from_sensor)
