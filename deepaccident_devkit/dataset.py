"""`Dataset`: a release's opened tables and their sensor files, for all upper layers."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping
from contextlib import suppress
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, get_args

import numpy as np

from deepaccident_devkit.errors import (
    ChoiceError,
    ImageSizeWarning,
    MissingFileError,
    NotAvailableError,
    ReleaseError,
    TokenError,
    escaped,
)
from deepaccident_devkit.geometry import SE3, Box, Boxes, LidarPointCloud, PinholeCamera
from deepaccident_devkit.geometry.boxes import trusted_boxes
from deepaccident_devkit.geometry.conventions import stored_transforms
from deepaccident_devkit.geometry.se3 import trusted_se3
from deepaccident_devkit.release import BevImage, read_bev, read_image, read_lidar
from deepaccident_devkit.release.fingerprints import digest_of
from deepaccident_devkit.release.images import calib_fault, image_size
from deepaccident_devkit.release.layout import ScenarioFolder, frame_numbers
from deepaccident_devkit.release.store import ReleasePath, StorePath
from deepaccident_devkit.support import nuscenes_names
from deepaccident_devkit.support.arrays import AnyArray, BoolArray, ByteArray, FloatArray, IntArray
from deepaccident_devkit.support.text import choice, match_spelling
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
# Frame name that a caller may pass → canonical name.
_FRAMES: Mapping[str, str] = {name: name for name in (*get_args(Frame), *CHANNELS)} | {
    LIDAR: "lidar"
}
# Annotation columns that have the same name as a field of `Boxes`.
_BOX_COLUMNS = (
    "size",
    "rotation",
    "velocity",
    "category",
    "actor_id",
    "num_lidar_pts",
    "camera_visible",
)
VISIBLE: Final = (None, *get_args(Visible))
"""Values of `visible=`."""


class Dataset(OpenTables):
    """One release: its tables (`OpenTables`), poses, boxes and sensor files."""

    # Whether a camera was found whose images do not have the size that its K is for.
    _has_size_warning = False

    if not TYPE_CHECKING:  # type checkers would accept any name

        def __getattr__(self, name: str) -> Any:
            """Raise MissingNameError with the replacement for a name of the nuScenes devkit."""
            if name in nuscenes_names.DATASET:
                raise nuscenes_names.missing_name(type(self), name, nuscenes_names.DATASET[name])
            # This raises the usual AttributeError.
            return object.__getattribute__(self, name)

    @property
    def with_ignored(self) -> Dataset:
        """This release with the boxes of unknown classes, which are otherwise left out.

        The ids of these boxes start at `taxonomy.IGNORED_ID`. A DeepAccident release has none, so
        the same object is returned.
        """
        return self

    # Poses.

    def world_from(self, sample: RowArgument, frame: str) -> SE3:
        """Return the transform from a frame of a sample to world.

        Args:
            sample: Token or record.
            frame: `world`, `ego`, `lidar` or a channel (cameras have optical axes).

        Raises:
            TokenError: If the sample is unknown.
            ChoiceError: If the frame is unknown.
        """
        row = self._find_sample_row(sample)
        return self._compute_world_from(row, self.frame_name(frame))

    def ego_from(self, sample: RowArgument, channel: str) -> SE3:
        """Return the transform from a sensor's frame to its sample's ego frame.

        The numbers equal the sample's calib file exactly. The table `calibrated_sensor` has
        the nominal values, from which the calib files of a scenario differ by rounding errors.

        Raises:
            TokenError: If the sample or sensor is unknown.
        """
        row = self.getind("sample_data", f"{token_of(sample)}/{channel}")
        matrix = self.columns("sample_data")["matrix"][row]
        return trusted_se3(stored_transforms(matrix))

    def frame_name(self, frame: str) -> str:
        """Return the canonical name of a coordinate frame, which is the `frame` of all results.

        The channel `lidar01` becomes `lidar`; all other names stay as they are.

        Raises:
            ChoiceError: If the frame is unknown.
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
        """Return the annotated boxes of a sample as arrays, which are empty if it is not labelled.

        Args:
            sample: Token or record.
            frame: Frame of the result: `world`, `ego`, `lidar` or a camera channel (then optical
                axes).
            visible: None for all boxes; `camera` for boxes that a camera of this agent sees;
                `released` for boxes that any agent sees at this moment under the released code's
                rule (docs/released_code.md, Visibility and attributes), without the agent's own
                box.
            velocity: `decoded` for the label's velocity (the column `velocity`; see
                docs/conventions.md); `derived` for finite differences, at 10 Hz, of the actor's
                world positions in this agent's labels (NaN if there is no neighbouring frame);
                `label` for the label's two raw numbers, interpreted in the LiDAR frame (in the
                world frame for the agent's own box).

        Raises:
            TokenError: If the sample is unknown.
            ChoiceError: If the frame, visibility or velocity is unknown.
        """
        token = token_of(sample)
        frame = self.frame_name(frame)
        row = self._tables.resolver.row("sample", token)
        source = choice("velocity", velocity, get_args(VelocitySource))
        lidar_boxes = self._make_lidar_boxes(row, source, token)
        visibility = choice("visible", visible, VISIBLE)
        if visibility is not None:
            lidar_boxes = lidar_boxes.select(self._mark_visible(row, lidar_boxes, visibility))
        if frame == "lidar":
            return lidar_boxes
        target_from_lidar = self._compute_world_from(row, "lidar")
        if frame != "world":
            target_from_lidar = self._compute_world_from(row, frame).inverse() @ target_from_lidar
        return lidar_boxes.transform(target_from_lidar, frame)

    @nuscenes_names.with_keywords_named
    def get_boxes(
        self,
        sample: RowArgument,
        frame: str = "world",
        visible: Visible | None = None,
        velocity: VelocitySource = "decoded",
    ) -> list[Box]:
        """Return the annotated boxes of a sample as a list of objects with tokens.

        The arguments are as in `boxes`. Item i equals `boxes(sample)[i]`.
        """
        return list(self.boxes(sample, frame, visible, velocity))

    def actor_ids(self, sample: RowArgument) -> IntArray:
        """Return the CARLA ids (N,) of the actors of a sample's boxes, in the order of its label.

        Unlike in `Boxes.actor_id`, the agent's own row has the agent's CARLA id, or −1 if meta does
        not identify the agent. Untracked actors are −1.

        Raises:
            TokenError: If the sample is unknown.
        """
        rows = self.annotation_rows(sample)
        instance_rows = self._tables.views["annotation"]["instance_row"][rows]
        ids_of_instances = self._tables.views["instance"]["actor_id"]
        is_known = instance_rows >= 0
        actor_ids = np.full(len(instance_rows), UNTRACKED_ID, dtype=np.int64)
        actor_ids[is_known] = ids_of_instances[instance_rows[is_known]]
        return actor_ids

    def annotation_rows(self, sample: RowArgument) -> slice:
        """Return the rows of a sample's boxes in the annotation table; empty if it is not labelled.

        Raises:
            TokenError: If the sample is unknown.
        """
        return self._find_annotation_slice(self._find_sample_row(sample))

    def recordings(self, scenarios: Iterable[str]) -> dict[str, str]:
        """Return scenario token → hash of the ego's box counts by frame, for labelled scenarios.

        The hash distinguishes recordings with the same name: the mini release and the complete
        release have different recordings under one name.
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
        """Return the path where a sensor file should be, whether or not it exists.

        The arguments are as in `get_sample_data`.

        Raises:
            TokenError: If the sensor file is unknown.
            NotAvailableError: If the release is in archives or at a URL, so that there is no path;
                `local_path` returns one.
        """
        path = self.sensor_path(sample_data, channel)
        if isinstance(path, Path):
            return path
        raise NotAvailableError(
            f"{path}: is in an archive or at a URL; da.local_path(token) returns a real path"
        )

    def local_path(self, sample_data: RowArgument, channel: str | None = None) -> Path:
        """Return the path of a real file with a sensor file's content, for other programs.

        The arguments are as in `get_sample_data`. A file in an archive or at a URL is copied
        into the user's cache. The cache has a limited size, so a copy may be deleted later
        (docs/reading.md).

        Raises:
            TokenError: If the sensor file is unknown.
            MissingFileError: If the file was not downloaded.
            SensorFileError: If the file cannot be read, or the cache has no space left.
        """
        path = self.sensor_path(sample_data, channel)
        if isinstance(path, StorePath):
            return path.local_path()
        if not path.exists():
            raise MissingFileError(f"{path}: no such file; unpack the archive that contains it")
        return path

    def sensor_path(self, sample_data: RowArgument, channel: str | None = None) -> ReleasePath:
        """Return where the devkit's readers look for a sensor file, whether or not it exists.

        The arguments are as in `get_sample_data`.

        Raises:
            TokenError: If the sensor file is unknown.
        """
        row, _ = self._find_sensor_file(sample_data, channel)
        return self._join_sensor_path(row)

    def sensor_frames(self, scenario: RowArgument) -> dict[tuple[str, str], tuple[int, ...]]:
        """Return which sensor files of a scenario exist: agent and channel → frame numbers.

        Frame numbers ascend. No file is opened: the folder of each agent and channel
        (`taxonomy.CHANNELS`) is listed once, which is faster than calling `sensor_path` for every
        file. A folder that does not exist, or cannot be listed, counts as empty.

        Raises:
            TokenError: If the scenario is unknown.
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
        """Return a sensor file's path, its sample's boxes, and a camera's K (3, 3), otherwise None.

        The path is as from `get_sample_data_path` or, for a release in archives or at a URL, as
        from `local_path`. Boxes are in the sensor's frame, and include boxes outside the image or
        behind the camera (`camera` finds the visible ones). K is from the calib file, for the image
        size of `camera`; `camera(…).resized(width, height)` has K for another size.

        Args:
            sample_data: Token or record of a sensor file; with `channel`, of a sample.
            channel: The sensor, such as `Camera_Front` or `lidar01`; None if `sample_data` names
                it.

        Raises:
            TokenError: If the sensor file is unknown.
            MissingFileError, SensorFileError: If the release is in archives or at a URL, as
                described in `local_path`.
        """
        row, name = self._find_sensor_file(sample_data, channel)
        intrinsic = None
        if name in CAMERAS:
            intrinsic = self._copy_intrinsic(row)
        sample = self._tables.resolver.token("sample", row // len(CHANNELS))
        boxes = self.get_boxes(sample, name)
        path = self._join_sensor_path(row)
        if not isinstance(path, Path):
            path = path.local_path()
        return path, boxes, intrinsic

    def camera(self, sample_data: RowArgument, channel: str | None = None) -> PinholeCamera:
        """Return a camera with K and the image size from its calib file.

        The camera projects points and finds visible boxes. ImageSizeWarning is issued, once for a
        release, if the first image of the recording has another size.

        Args:
            sample_data: Token or record of a camera's sensor file; with `channel`, of a sample.
            channel: The camera, such as `Camera_Front`; None if `sample_data` names it.

        Raises:
            TokenError: If the sensor file is unknown.
            ChoiceError: If the sensor is not a camera.
        """
        row, name = self._find_sensor_file(sample_data, channel)
        if name not in CAMERAS:
            raise ChoiceError(f"camera: expected one of {', '.join(CAMERAS)}, found {name}")
        return PinholeCamera(self._copy_intrinsic(row), *self._calib_size(row))

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
            min_size: Smallest acceptable height and width, for speed: a JPEG is decoded at 1/2, 1/4
                or 1/8 of its size if the result is at least this large. None decodes the full size.
            size: Height and width (in array order) to which the image is resized with Pillow's
                bilinear filter; None keeps the decoded size. Videos (`render_scenario_video`) use
                the opposite order, width and height.

        Raises:
            TokenError: If the sensor file is unknown.
            ChoiceError: If the sensor is not a camera.
            MissingFileError: If the image was not downloaded.
            SensorFileError: If the file cannot be read.
        """
        _, name = self._find_sensor_file(sample_data, channel)
        if name not in CAMERAS:
            raise ChoiceError(f"{name} has no images; the cameras are {', '.join(CAMERAS)}")
        return read_image(self.sensor_path(sample_data, channel), min_size=min_size, size=size)

    def load_point_cloud(self, sample: RowArgument, frame: Frame = "world") -> LidarPointCloud:
        """Return a sample's LiDAR points in the frame `world`, `ego` or `lidar`.

        Raises:
            TokenError: If the sample is unknown.
            ChoiceError: If the frame is unknown.
            MissingFileError: If the file was not downloaded.
            SensorFileError: If the file cannot be read.
        """
        row = self._find_sample_row(sample)
        name = choice("frame", self.frame_name(frame), get_args(Frame))
        cloud = self._lidar_cloud(row)
        if name == "lidar":
            return cloud
        target_from_world = self._compute_world_from(row, name).inverse()
        return cloud.transform(target_from_world @ self._compute_world_from(row, "lidar"), name)

    def _lidar_cloud(self, row: int) -> LidarPointCloud:
        """Read the points of the sample at index `row`, in its LiDAR frame."""
        return read_lidar(self._channel_path(row, LIDAR))

    def load_bev(self, sample: RowArgument) -> BevImage:
        """Return the image of a sample's BEV camera; forward is up (see `BevImage`).

        Raises:
            TokenError: If the sample is unknown.
            MissingFileError: If the file was not downloaded.
            SensorFileError: If the file cannot be read.
        """
        return read_bev(self._channel_path(self._find_sample_row(sample), BEV_CAMERA))

    # Underlying rows and columns.

    def _find_sample_row(self, sample: RowArgument) -> int:
        return self._tables.resolver.row("sample", token_of(sample))

    def _find_sensor_file(self, sample_data: RowArgument, channel: str | None) -> tuple[int, str]:
        """Return the row and the channel of a sensor file; raise TokenError if it is unknown.

        The arguments are as in `get_sample_data`.
        """
        token = token_of(sample_data)
        if channel is not None:
            token = f"{token}/{match_spelling(channel, CHANNELS)}"
        row = self.sample_data.row(token)
        return row, CHANNELS[row % len(CHANNELS)]

    def _join_sensor_path(self, sample_data_row: int) -> ReleasePath:
        return self.dataroot / self._tables.resolver.filename(sample_data_row)

    def _copy_intrinsic(self, sample_data_row: int) -> FloatArray:
        """Return a copy of a camera's K (3, 3), which the caller may change.

        When a camera is first used, its first image is compared with K.
        """
        views = self._tables.views
        sensor_row = views["sample_data"]["calibrated_sensor_row"].item(sample_data_row)
        if not self._has_size_warning and sensor_row not in self._compared_cameras:
            self._compared_cameras.add(sensor_row)
            self._compare_image_size(sample_data_row)
        intrinsic: FloatArray = views["calibrated_sensor"]["camera_intrinsic"][sensor_row]
        return intrinsic.reshape(3, 3).copy()

    @cached_property
    def _compared_cameras(self) -> set[int]:
        """Rows of `calibrated_sensor` whose images were compared with calib."""
        return set()

    def _compare_image_size(self, sample_data_row: int) -> None:
        """Compare the first image of a recording's camera with the size that its K is for.

        ImageSizeWarning is issued for the first image of the release that has another size.
        """
        sample_row, channel = divmod(sample_data_row, len(CHANNELS))
        agent_row = self._tables.views["sample"]["agent_row"].item(sample_row)
        first_row = self._tables.resolver.sample_at(agent_row, 1) * len(CHANNELS) + channel
        path = self._join_sensor_path(first_row)
        with suppress(ReleaseError):  # the release may have no images
            size = image_size(path)
            fault = calib_fault(size, self._calib_size(first_row))
            if fault is not None and not self._has_size_warning:
                self._has_size_warning = True
                text = (
                    f"{path}: {fault}, so projections into it are wrong; run deepaccident "
                    "validate, which lists all such cameras"
                )
                warnings.warn(escaped(text), ImageSizeWarning, stacklevel=4)

    def _calib_size(self, sample_data_row: int) -> tuple[int, int]:
        """Return the width and height of the images that a camera's K is for."""
        view = self._tables.views["sample_data"]
        return view["width"].item(sample_data_row), view["height"].item(sample_data_row)

    def _channel_path(self, sample_row: int, channel: str) -> ReleasePath:
        first_row = sample_row * len(CHANNELS)
        return self._join_sensor_path(first_row + CHANNELS.index(channel))

    def _find_annotation_slice(self, sample_row: int) -> slice:
        view = self._tables.views["sample"]
        first_row = view["first_annotation_row"].item(sample_row)
        count = view["num_annotations"].item(sample_row)
        start = max(first_row, 0)
        rows = slice(start, start + count)
        if not rows.start <= rows.stop <= len(self._tables.views["annotation"]["sample_row"]):
            raise damaged_value("sample")
        return rows

    def _make_lidar_boxes(
        self, sample_row: int, velocity: VelocitySource, token: str | None = None
    ) -> Boxes:
        view = self._tables.views["annotation"]
        rows = self._find_annotation_slice(sample_row)
        columns: dict[str, AnyArray] = {name: view[name][rows] for name in _BOX_COLUMNS}
        columns["center"] = view["translation"][rows]
        columns["row"] = np.arange(rows.stop - rows.start)
        if velocity == "label":
            columns["velocity"] = self._convert_label_velocity(
                sample_row, columns["actor_id"], view["velocity_label"][rows]
            )
        elif velocity == "derived":
            columns["velocity"] = self._derive_velocity(sample_row)
        scenario = None if token is None else token.rsplit("/", 2)[0]
        own_actor_id = self._tables.views["agent"]["actor_id"].item(
            self._tables.views["sample"]["agent_row"].item(sample_row)
        )
        return trusted_boxes("lidar", columns, token, scenario, own_actor_id)

    def _derive_velocity(self, sample_row: int) -> FloatArray:
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
                rows = self._find_annotation_slice(row)
                world_from_lidar = self._compute_world_from(row, "lidar")
                frames.append(np.full(rows.stop - rows.start, row))
                centers.append(world_from_lidar.apply(boxes["translation"][rows]))
                actor_ids.append(boxes["actor_id"][rows])
        frame = np.concatenate(frames)
        agent = np.zeros(len(frame), dtype=np.int64)
        velocity = displacement_velocities(
            np.concatenate(centers), agent, np.concatenate(actor_ids), frame
        )
        lidar_from_world = self._compute_world_from(sample_row, "lidar").inverse()
        return lidar_from_world.rotate(velocity[frame == sample_row])

    def _convert_label_velocity(
        self, sample_row: int, actor_id: IntArray, velocity_label: FloatArray
    ) -> FloatArray:
        """Return raw label velocities (N, 3), m/s; the agent's own is rotated to LiDAR axes."""
        velocity = np.column_stack([velocity_label, np.zeros(len(velocity_label))])
        is_own = actor_id == OWN_ACTOR_ID
        lidar_from_world = self._compute_world_from(sample_row, "lidar").inverse()
        velocity[is_own] = lidar_from_world.rotate(velocity[is_own])
        return velocity

    def _mark_visible(self, sample_row: int, boxes: Boxes, visible: Visible) -> BoolArray:
        if visible == "camera":
            return boxes.camera_visible
        masks = []
        ids = []
        for row in self._find_simultaneous_samples(sample_row):
            agent_boxes = self._make_lidar_boxes(row, "decoded")
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

    def _find_simultaneous_samples(self, sample_row: int) -> list[int]:
        """Return the sample rows of all agents in the same frame of the scenario."""
        view = self._tables.views["sample"]
        resolver = self._tables.resolver
        first_row = resolver.sample_at(view["agent_row"].item(sample_row), 1)
        index = sample_row - first_row + 1
        agents = resolver.agents_of(view["scenario_row"].item(sample_row))
        return [resolver.sample_at(agent, index) for agent in agents.values()]

    def _compute_world_from(self, sample_row: int, frame: str) -> SE3:
        """Return the transform to world from a frame (canonical name) of a sample."""
        if frame == "world":
            return SE3.identity()
        views = self._tables.views
        pose = stored_transforms(views["ego_pose"]["matrix"][sample_row])
        if frame == "ego":
            return trusted_se3(pose)
        channel = LIDAR if frame == "lidar" else frame
        channel_index = CHANNELS.index(channel)
        sample_data_row = sample_row * len(CHANNELS) + channel_index
        ego_from_sensor = stored_transforms(views["sample_data"]["matrix"][sample_data_row])
        return trusted_se3(pose @ ego_from_sensor)
