"""What the upper layers see of a release: its opened tables and the sensor files that they name."""

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
# What a caller can call a frame → its one name.
_FRAMES: Final[Mapping[str, str]] = {name: name for name in (*get_args(Frame), *CHANNELS)} | {
    LIDAR: "lidar"
}
VISIBLE: Final = (None, *get_args(Visible))
"""What `visible=` can be."""


class Dataset(OpenTables):
    """One release: its tables (`OpenTables`), poses, boxes and sensor files."""

    if not TYPE_CHECKING:  # which would take every name for a known one

        def __getattr__(self, name: str) -> Any:
            """Say what to use in place of a name of the nuScenes devkit; raises MissingNameError."""
            if name in nuscenes_names.DATASET:
                raise nuscenes_names.missing_name(type(self), name, nuscenes_names.DATASET[name])
            return object.__getattribute__(self, name)  # raises as it did before

    @property
    def with_ignored(self) -> Dataset:
        """This release with the boxes that count nowhere, too: those of classes that the devkit does not have.

        A release of DeepAccident has none, and is its own. Such boxes have ids from `taxonomy.IGNORED_ID` on.
        """
        return self

    # poses

    def world_from(self, sample: RowArgument, frame: str) -> SE3:
        """The transform to world from a frame of a sample: `world`, `ego`, `lidar` or a channel (cameras optical).

        Raises:
            TokenError: no such sample.
            ChoiceError: no such frame.
        """
        return self._world_from(self._sample_row(sample), self.frame_name(frame))

    def ego_from(self, sample: RowArgument, channel: str) -> SE3:
        """The transform to a sample's ego frame from a sensor's, with the exact numbers of the sample's calib file.

        The row of `calibrated_sensor` is the intended value; the files of a scenario differ from it by rounding.

        Raises:
            TokenError: no such sample or sensor.
        """
        row = self.getind("sample_data", f"{token_of(sample)}/{channel}")
        return trusted_se3(stored_transforms(self.columns("sample_data")["matrix"][row]))

    def frame_name(self, frame: str) -> str:
        """The one name of a frame of samples, which results carry: `lidar` for the channel `lidar01`, else its own.

        Raises:
            ChoiceError: no such frame.
        """
        name: str = choice("frame", frame, _FRAMES)
        return _FRAMES[name]

    # boxes

    def boxes(
        self,
        sample: RowArgument,
        frame: str = "world",
        visible: Visible | None = None,
        velocity: VelocitySource = "decoded",
    ) -> Boxes:
        """The annotated boxes of a sample as arrays; 0 rows if it has no label.

        Args:
            sample: token or record.
            frame: frame of the result: `world`, `ego`, `lidar` or a camera channel (then optical axes).
            visible: None for all; `camera` for those that a camera of this agent sees; `released` for those that any
                agent at this moment sees by the released rule (docs/released_code.md, Visibility and attributes; the
                agent itself is not among them).
            velocity: the label's, `decoded` (the column `velocity`; see docs/conventions.md); `derived` from this
                agent's world positions of the actor at 10 Hz, NaN where there are none; or the raw pair of the
                `label`, as if it were in the LiDAR frame (the agent's own in world).

        Raises:
            TokenError: no such sample.
            ChoiceError: no such frame, visibility or velocity.
        """
        token, frame = token_of(sample), self.frame_name(frame)
        row = self._tables.resolver.row("sample", token)
        lidar_boxes = self._lidar_boxes(
            row, choice("velocity", velocity, get_args(VelocitySource)), token
        )
        seen_by = choice("visible", visible, VISIBLE)
        if seen_by is not None:
            lidar_boxes = lidar_boxes.select(self._visible(row, lidar_boxes, seen_by))
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
        """The annotated boxes of a sample, one object each, with their tokens; arguments as of `boxes`.

        Those of `boxes(sample)[i]` are the same except `instance_token`, which only these know.
        """
        row = self._sample_row(sample)
        boxes = self.boxes(sample, frame, visible, velocity)
        instances = self._tables.views["annotation"]["instance_row"][self._annotation_slice(row)][
            boxes.row
        ].tolist()
        token_of_instance = self._tables.resolver.token_makers["instance"]
        result = list(boxes)
        for box, instance in zip(result, instances, strict=True):
            box.instance_token = token_of_instance(instance) if instance >= 0 else None
        return result

    def actor_ids(self, sample: RowArgument) -> IntArray:
        """The CARLA ids (N,) of the actors of a sample's boxes, in the order of its label.

        Unlike `Boxes.actor_id`, the agent's own row has the agent's id. Untracked rows are −1, and so is an own row
        where meta does not say who the agent is.

        Raises:
            TokenError: no such sample.
        """
        instances = self._tables.views["annotation"]["instance_row"][
            self._annotation_slice(self._sample_row(sample))
        ]
        actors = self._tables.views["instance"]["actor_id"]
        known = instances >= 0
        result = np.full(len(instances), UNTRACKED_ID, dtype=np.int64)
        result[known] = actors[instances[known]]
        return result

    def annotation_rows(self, sample: RowArgument) -> slice:
        """Where a sample's boxes are in the annotation table's columns; empty without a label. Raises TokenError."""
        return self._annotation_slice(self._sample_row(sample))

    def recordings(self, scenarios: Iterable[str]) -> dict[str, str]:
        """Scenario token → a hash of how many boxes ego has at each moment, where it has labels here.

        It tells recordings of one name apart: those of the mini release are others than those of the whole one.
        """
        samples, found = self.columns("sample"), {}
        for token in sorted(set(scenarios)):
            with suppress(TokenError):  # the scenario, or its ego, is not here
                ego = self.getind("agent", f"{token}/{AGENTS[0]}")
                first, last = np.searchsorted(samples["agent_row"], (ego, ego + 1))
                counts = samples["num_annotations"][first:last]
                if counts.any():
                    found[token] = digest_of(counts.tolist())
        return found

    # sensor data

    @nuscenes_names.with_keywords_named
    def get_sample_data_path(self, sample_data: RowArgument, channel: str | None = None) -> Path:
        """The path of a sensor file, which need not exist; arguments as of `get_sample_data`.

        Raises:
            TokenError: no such sensor file.
            NotAvailableError: the release lies in archives or at a URL, so that there is no path; `local_path` gives
                one.
        """
        path = self.sensor_path(sample_data, channel)
        if isinstance(path, Path):
            return path
        raise NotAvailableError(
            f"{path}: lies in an archive or at a URL; da.local_path(token) gives a real path"
        )

    def local_path(self, sample_data: RowArgument, channel: str | None = None) -> Path:
        """A real path with the content of a sensor file, for other programs; arguments as of `get_sample_data`.

        What lies in an archive or at a URL is copied into the user's cache, whose size is bounded, so that a copy may
        be gone later (docs/reading.md).

        Raises:
            TokenError: no such sensor file.
            MissingFileError: it was not downloaded.
            SensorFileError: it cannot be read, or there is no room in the cache.
        """
        path = self.sensor_path(sample_data, channel)
        if isinstance(path, StorePath):
            return path.local_path()
        if not path.exists():
            raise MissingFileError(f"{path}: no such file; unpack the archive that holds it")
        return path

    def sensor_path(self, sample_data: RowArgument, channel: str | None = None) -> ReleasePath:
        """Where the devkit's readers find a sensor file, which need not be there; arguments as of `get_sample_data`.

        Raises:
            TokenError: no such sensor file.
        """
        return self._path(self._sensor(sample_data, channel)[0])

    def sensor_frames(self, scenario: RowArgument) -> dict[tuple[str, str], tuple[int, ...]]:
        """Which files of a scenario are here: agent and channel → frame numbers, ascending, without opening any.

        Of each agent that is here and each of `taxonomy.CHANNELS` a folder is listed: `sensor_path` of every file is
        slower. A folder that is not there, or cannot be listed, has none.

        Raises:
            TokenError: no such scenario.
        """
        row = self.getind("scenario", scenario)
        record = self.scenario[row]
        folder = ScenarioFolder(
            self.dataroot, record["folder"], record["scenario_type"], record["name"], AGENTS
        )
        found: dict[tuple[str, str], tuple[int, ...]] = {}
        for agent, channel in product(self._tables.resolver.agents_of(row), CHANNELS):
            found[agent, channel] = ()
            with suppress(ReleaseError):
                here, _ = frame_numbers(folder.kind_folder(agent, channel), CHANNEL_FORMAT[channel])
                found[agent, channel] = tuple(
                    frame for frame in here if frame <= record["num_frames"]
                )
        return found

    @nuscenes_names.with_keywords_named
    def get_sample_data(
        self, sample_data: RowArgument, channel: str | None = None
    ) -> tuple[Path, list[Box], FloatArray | None]:
        """A sensor file's path, all boxes of its sample in the sensor's frame, and K (3, 3) of a camera.

        The path is that of `get_sample_data_path` or, where there is none, that of `local_path`. Boxes are not tested
        against the image: those behind a camera are among them (`camera` finds those in it). K is that of
        calib, for an image of the size that `camera` says: `camera(…).resized(width, height)` has it for another size.

        Args:
            sample_data: token or record of a sensor file; with `channel`, of a sample.
            channel: the sensor, such as `Camera_Front` or `lidar01`; None where `sample_data` names it.

        Raises:
            TokenError: no such sensor file.
            MissingFileError, SensorFileError: as of `local_path`, if the release lies in archives or at a URL.
        """
        row, name = self._sensor(sample_data, channel)
        intrinsic = self._intrinsic(row) if name in CAMERAS else None
        boxes = self.get_boxes(self._tables.resolver.token("sample", row // len(CHANNELS)), name)
        path = self._path(row)
        return path if isinstance(path, Path) else path.local_path(), boxes, intrinsic

    def camera(self, sample_data: RowArgument, channel: str | None = None) -> PinholeCamera:
        """A camera's K and image size as its calib file gives them, which projects points and finds visible boxes.

        Args:
            sample_data: token or record of a camera's sensor file; with `channel`, of a sample.
            channel: the camera, such as `Camera_Front`; None where `sample_data` names it.

        Raises:
            TokenError: no such sensor file.
            ChoiceError: the sensor is no camera.
        """
        row, name = self._sensor(sample_data, channel)
        if name not in CAMERAS:
            raise ChoiceError(f"camera: expected one of {', '.join(CAMERAS)}, found {name}")
        view = self._tables.views["sample_data"]
        return PinholeCamera(
            self._intrinsic(row), view["width"].item(row), view["height"].item(row)
        )

    def load_image(
        self,
        sample_data: RowArgument,
        channel: str | None = None,
        *,
        least: tuple[int, int] | None = None,
        size: tuple[int, int] | None = None,
    ) -> ByteArray:
        """A camera's image (H, W, 3) uint8, RGB.

        Args:
            sample_data: token or record of a camera's sensor file; with `channel`, of a sample.
            channel: the camera, such as `Camera_Front`; None where `sample_data` names it.
            least: a (height, width) that suffices, for speed: a JPEG is decoded at 1/2, 1/4 or 1/8 of its size if that
                is no smaller. None decodes all of it.
            size: (height, width), as of arrays, to which it is resized by Pillow's bilinear filter; None keeps its own.
                Videos (`render_scenario_video`) count the other way round: (width, height).

        Raises:
            TokenError: no such sensor file.
            ChoiceError: the sensor is no camera.
            MissingFileError: the image was not downloaded.
            SensorFileError: it cannot be read.
        """
        _, name = self._sensor(sample_data, channel)
        if name not in CAMERAS:
            raise ChoiceError(f"{name} holds no images; the cameras are {', '.join(CAMERAS)}")
        return read_image(self.sensor_path(sample_data, channel), least=least, size=size)

    def load_point_cloud(self, sample: RowArgument, frame: Frame = "world") -> LidarPointCloud:
        """A sample's LiDAR points in `world`, `ego` or `lidar`.

        Raises:
            TokenError: no such sample.
            ChoiceError: no such frame.
            MissingFileError: the file was not downloaded.
            SensorFileError: it cannot be read.
        """
        row, name = (
            self._sample_row(sample),
            choice("frame", self.frame_name(frame), get_args(Frame)),
        )
        cloud = self._lidar_cloud(row)
        if name == "lidar":
            return cloud
        return cloud.transform(
            self._world_from(row, name).inverse() @ self._world_from(row, "lidar"), name
        )

    def _lidar_cloud(self, row: int) -> LidarPointCloud:
        """Read the points of a row of `sample` in its LiDAR frame."""
        return read_lidar(self._channel_path(row, LIDAR))

    def load_bev(self, sample: RowArgument) -> BevImage:
        """What the BEV instance camera of a sample's agent saw; forward is up (see `BevImage`).

        Raises:
            TokenError: no such sample.
            MissingFileError: the file was not downloaded.
            SensorFileError: it cannot be read.
        """
        return read_bev(self._channel_path(self._sample_row(sample), BEV_CAMERA))

    # rows and columns beneath

    def _sample_row(self, sample: RowArgument) -> int:
        return self._tables.resolver.row("sample", token_of(sample))

    def _sensor(self, sample_data: RowArgument, channel: str | None) -> tuple[int, str]:
        """The row and the channel of a sensor file; arguments as of `get_sample_data`. Raises TokenError."""
        token = token_of(sample_data)
        row = self.sample_data.row(
            token if channel is None else f"{token}/{spelled(channel, CHANNELS)}"
        )
        return row, CHANNELS[row % len(CHANNELS)]

    def _path(self, sample_data_row: int) -> ReleasePath:
        return self.dataroot / self._tables.resolver.filename(sample_data_row)

    def _intrinsic(self, sample_data_row: int) -> FloatArray:
        """K (3, 3) of a camera, the caller's own."""
        calibrated = self._tables.views["sample_data"]["calibrated_sensor_row"].item(
            sample_data_row
        )
        intrinsic: FloatArray = self._tables.views["calibrated_sensor"]["camera_intrinsic"][
            calibrated
        ]
        return intrinsic.reshape(3, 3).copy()

    def _channel_path(self, sample_row: int, channel: str) -> ReleasePath:
        return self._path(sample_row * len(CHANNELS) + CHANNELS.index(channel))

    def _annotation_slice(self, sample_row: int) -> slice:
        view = self._tables.views["sample"]
        first, count = (
            view["first_annotation_row"].item(sample_row),
            view["num_annotations"].item(sample_row),
        )
        rows = slice(max(first, 0), max(first, 0) + count)
        if not rows.start <= rows.stop <= len(self._tables.views["annotation"]["sample_row"]):
            raise damaged_value("sample")
        return rows

    def _lidar_boxes(
        self, sample_row: int, velocity: VelocitySource, token: str | None = None
    ) -> Boxes:
        view, rows = self._tables.views["annotation"], self._annotation_slice(sample_row)
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
            columns["velocity"] = self._label_velocity(
                sample_row, columns["actor_id"], view["velocity_label"][rows]
            )
        elif velocity == "derived":
            columns["velocity"] = self._derived_velocity(sample_row)
        return trusted_boxes("lidar", columns, token)

    def _derived_velocity(self, sample_row: int) -> FloatArray:
        """(N, 3) in the sample's LiDAR frame, by the samples around it."""
        samples, boxes = self._tables.views["sample"], self._tables.views["annotation"]
        around = (
            samples["prev_row"].item(sample_row),
            sample_row,
            samples["next_row"].item(sample_row),
        )
        parts = [
            (row, self._annotation_slice(row), self._world_from(row, "lidar"))
            for row in around
            if row >= 0
        ]
        frame = np.concatenate([np.full(rows.stop - rows.start, row) for row, rows, _ in parts])
        velocity = displacement_velocities(
            np.concatenate([world.apply(boxes["translation"][rows]) for _, rows, world in parts]),
            np.zeros(len(frame), dtype=np.int64),
            np.concatenate([boxes["actor_id"][rows] for _, rows, _ in parts]),
            frame,
        )
        return self._world_from(sample_row, "lidar").inverse().rotate(velocity[frame == sample_row])

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
        masks, ids = [], []
        for other in self._samples_at_once(sample_row):
            seen = self._lidar_boxes(other, "decoded")
            pole = AGENTS[self._tables.views["sample"]["agent"].item(other)] == INFRASTRUCTURE
            masks.append(
                visible_mask(
                    seen.center[:, :2],
                    seen.category,
                    seen.num_lidar_pts,
                    seen.camera_visible,
                    infrastructure=pole,
                )
            )
            ids.append(seen.actor_id)
        return np.isin(boxes.actor_id, visible_ids(masks, ids))

    def _samples_at_once(self, sample_row: int) -> list[int]:
        view = self._tables.views["sample"]
        resolver, scenario = self._tables.resolver, view["scenario_row"].item(sample_row)
        index = sample_row - resolver.sample_at(view["agent_row"].item(sample_row), 1) + 1
        return [resolver.sample_at(agent, index) for agent in resolver.agents_of(scenario).values()]

    def _world_from(self, sample_row: int, frame: str) -> SE3:
        """`world_from` of a frame by the name that `frame_name` gives."""
        if frame == "world":
            return SE3.identity()
        views = self._tables.views
        pose = stored_transforms(views["ego_pose"]["matrix"][sample_row])
        if frame == "ego":
            return trusted_se3(pose)
        channel = LIDAR if frame == "lidar" else frame
        sample_data_row = sample_row * len(CHANNELS) + CHANNELS.index(channel)
        return trusted_se3(
            pose @ stored_transforms(views["sample_data"]["matrix"][sample_data_row])
        )
