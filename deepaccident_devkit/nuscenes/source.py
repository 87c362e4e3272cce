"""A nuScenes dataroot as a release: each scene is a recording of one agent, at 10 Hz, labelled at its keyframes.

A keyframe is every fifth frame, and the last one, as in our export. Frames between them have poses, interpolated, and
neither labels nor files. The tables are made once from what the nuScenes devkit says, and kept like an index.

The frames are the release's: x forward, y left, the ego's origin on the road. The LiDAR frame is the sensor's, turned
about its z axis until x is forward; where all boxes of a scene stand upright in the world, as nuScenes' do, it is
upright too, so that a yaw says all of a box. A camera's pose is at its own time, seen from the ego at the LiDAR's.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator, Mapping
from pathlib import Path, PurePosixPath
from typing import Any, Final

import numpy as np

from deepaccident_devkit._version import __version__
from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.deepaccident import DeepAccident
from deepaccident_devkit.errors import ConfigError, DatarootError, MissingExtraError, SensorFileError
from deepaccident_devkit.export.frames import KEY_STEP
from deepaccident_devkit.export.nuscenes.scenes import CAMERA_CHANNELS, CHANNEL_NAMES, LIDAR_CHANNEL
from deepaccident_devkit.geometry import SE3, LidarPointCloud, quaternions
from deepaccident_devkit.geometry.conventions import inverses
from deepaccident_devkit.nuscenes.classes import CLASSES, category_of
from deepaccident_devkit.release import Labels, ScenarioFolder
from deepaccident_devkit.release.calib import Calibs
from deepaccident_devkit.release.fingerprints import ScenarioHashes, digest_of
from deepaccident_devkit.release.labels import label_from_world_velocity
from deepaccident_devkit.release.layout import NUSCENES_TABLE, nuscenes_tables
from deepaccident_devkit.release.store import index_places
from deepaccident_devkit.support.arrays import FloatArray, IntArray
from deepaccident_devkit.support.files import is_writable_folder, replacing_folder
from deepaccident_devkit.support.json_text import parsed_json
from deepaccident_devkit.support.reading import mapped_file, read_bytes
from deepaccident_devkit.support.text import path_of
from deepaccident_devkit.tables.arrow_files import Columns
from deepaccident_devkit.tables.build import scenario_rows
from deepaccident_devkit.tables.indexing import join_tables, rows_to_keep
from deepaccident_devkit.tables.records import SCHEMA_VERSION
from deepaccident_devkit.tables.scan import ScenarioFiles, ScenarioScan
from deepaccident_devkit.taxonomy import AGENTS, CHANNELS, FRAME_PERIOD, IGNORED_ID, LIDAR, SPLITS, Frame

AGENT: Final = AGENTS[0]
"""Whose recording a scene is."""
_FILES: Final = "files.arrow"
_LIDAR: Final = CHANNELS.index(LIDAR)
_LEAN: Final = 1e-6
"""Of the x and y of a quaternion: below, it is a turn about z alone."""
_UNSEEN: Final = "1"
"""nuScenes' visibility of a box of which the cameras see less than 40 %; FIERY takes it for unseen."""


class NuScenesRelease(DeepAccident):
    """The scenes of a nuScenes dataroot; made by `open_nuscenes`, and used as any release."""

    def __init__(self, dataroot: Path, version: str, tables_folder: Path) -> None:
        """Open tables that were made; raises IndexStoreError if they cannot be read."""
        import pyarrow as pa

        Dataset.__init__(
            self, dataroot=dataroot, version=version, layout="nuScenes", split_files={}, tables_folder=tables_folder
        )
        self._files = pa.ipc.open_file(mapped_file(tables_folder / _FILES)).read_all()
        self._rows = self._files["row"].to_numpy()
        self._plain_filename = self._tables.resolver.filename
        self._tables.resolver.filename = self._filename  # type: ignore[method-assign]

    def __reduce__(self) -> tuple[Any, ...]:
        """The copy opens the same files again."""
        return type(self), (self.dataroot, self.version, self.tables_folder)

    def nuscenes_token(self, sample: RowArgument) -> str:
        """NuScenes' token of a sample that is a keyframe; raises TokenError, and ConfigError for one that is none."""
        place = self._place(self.getind("sample", sample) * len(CHANNELS) + _LIDAR)
        if place is None:
            raise ConfigError(f"{sample}: is between two keyframes, of which alone nuScenes has samples")
        return str(self._files["token"][place])

    def sensor_frames(self, scenario: RowArgument) -> dict[tuple[str, str], tuple[int, ...]]:
        """As of `Dataset`: the keyframes, whose files nuScenes' tables name."""
        rows = self._samples(scenario)
        frame, channel = np.divmod(self._rows - rows.start * len(CHANNELS), len(CHANNELS))
        here = (frame >= 0) & (frame < len(rows))
        return {
            (AGENT, name): tuple((frame[here & (channel == code)] + 1).tolist()) for code, name in enumerate(CHANNELS)
        }

    def truth_hashes(self, scenario: str) -> ScenarioHashes:
        """Hashes of a scenario's boxes, in place of label files, and of its poses."""
        rows, boxes = self._samples(scenario), self.columns("annotation")
        own = slice(*np.searchsorted(boxes["sample_row"], (rows.start, rows.stop)))
        label = [boxes[name][own].tolist() for name in ("actor_id", "category", "translation", "size", "yaw")]
        calib = self.columns("ego_pose")["matrix"][rows.start : rows.stop].tolist()
        return ScenarioHashes(label=digest_of(label), meta=None, calib=digest_of(calib))

    def load_point_cloud(self, sample: RowArgument, frame: Frame = "world") -> LidarPointCloud:
        """As of `Dataset`. Intensities beyond 1 are nuScenes', from 0 to 255, and become those from 0 to 1."""
        row = self.getind("sample", sample) * len(CHANNELS) + _LIDAR
        path, place = self._path(row), self._place(row)
        if place is None:
            return super().load_point_cloud(sample, frame)  # which says that there is no file
        content = np.frombuffer(read_bytes(path, "lidar"), dtype="<f4")
        if len(content) % 5:
            raise SensorFileError(f"{path}: expected points of five numbers each, found {len(content)} numbers")
        points = content.reshape(-1, 5)
        intensity = points[:, 3] / (255 if points[:, 3].max(initial=0) > 1 else 1)
        cloud = LidarPointCloud(points[:, :3].astype(np.float64), intensity, "lidar")
        lidar_from_sensor = SE3(np.reshape(self._files["matrix"][place].as_py(), (4, 4)))
        target = self.world_from(sample, frame).inverse() @ self.world_from(sample, "lidar")
        return cloud.transform(target @ lidar_from_sensor, frame)

    def _samples(self, scenario: RowArgument) -> range:
        """The rows of a scenario's samples."""
        record = self.get("scenario", scenario)
        first = self.getind("sample", f"{record['token']}/{AGENT}/001")
        return range(first, first + record["num_frames"])

    def _filename(self, sample_data_row: int) -> str:
        """As of `tables.tokens.Resolver`; between keyframes a path at which nothing is."""
        place = self._place(sample_data_row)
        return self._plain_filename(sample_data_row) if place is None else str(self._files["filename"][place])

    def _place(self, row: int) -> int | None:
        """Where the file of a row of `sample_data` stands among the files."""
        place = int(np.searchsorted(self._rows, row))
        return place if place < len(self._rows) and self._rows[place] == row else None


def open_nuscenes(dataroot: str | os.PathLike[str], index_dir: Path | None = None) -> NuScenesRelease:
    """Open a nuScenes dataroot as a release, and make its tables where they are not kept yet.

    Args:
        dataroot: the folder that holds the tables of one version (`v1.0-mini`, …); of several, that of one version.
        index_dir: where to keep the tables; by default in the dataroot, or in the user's cache.

    Raises:
        DatarootError: there are no tables of nuScenes, they cannot be read, or a scene lacks something.
        VersionError: the folder holds several versions.
        MissingExtraError: the tables must be made, and the nuScenes devkit is not installed.
    """
    tables = nuscenes_tables(path_of(dataroot))
    if tables is None:
        raise DatarootError(f"{dataroot}: has no tables of nuScenes, such as v1.0-mini/{NUSCENES_TABLE}")
    if (kept := _kept_in(tables, index_dir)).is_dir():
        return NuScenesRelease(tables.parent, tables.name, kept)
    try:
        from nuscenes import NuScenes

        nusc = NuScenes(tables.name, str(tables.parent), verbose=False)
    except ImportError as error:
        raise MissingExtraError(
            f"{tables}: the nuScenes devkit reads these tables, and needs Python 3.10 to 3.12 and numpy 1.26; there: "
            "pip install 'deepaccident_devkit[nuscenes]'"
        ) from error
    except (AssertionError, LookupError, OSError, ValueError) as error:
        raise DatarootError(
            f"{tables}: the nuScenes devkit cannot read them ({type(error).__name__}: {error}); unpack them again"
        ) from error
    return release_of(nusc, index_dir)


def release_of(nusc: Any, index_dir: Path | None = None) -> NuScenesRelease:
    """`open_nuscenes` of what the nuScenes devkit has opened, a `nuscenes.NuScenes`."""
    tables = Path(nusc.table_root).absolute()
    folder = _kept_in(tables, index_dir)
    try:
        if not folder.is_dir():
            with replacing_folder(folder) as made:
                _write(nusc, made)
    except OSError:
        if not folder.is_dir():  # else another process has just made the same
            raise
    return NuScenesRelease(tables.parent, tables.name, folder)


def _kept_in(tables: Path, index_dir: Path | None) -> Path:
    """Where the tables made of these are kept, or will be: another folder for each content."""
    key = hashlib.blake2b(f"{__version__} {SCHEMA_VERSION}".encode(), digest_size=8)
    for path in sorted(tables.glob("*.json")):
        state = path.stat()
        key.update(f"{path.name} {state.st_size} {state.st_mtime_ns} ".encode())
    places = [place / tables.name / key.hexdigest() for place in index_places(tables.parent, index_dir)]
    return next((each for each in places if each.is_dir() or is_writable_folder(each.parent)), places[-1])


def _write(nusc: Any, folder: Path) -> None:
    """Make the tables of all scenes."""
    import pyarrow as pa

    splits, kept, names = _splits(nusc), [], ("row", "filename", "token", "matrix")
    files: dict[str, list[Any]] = {name: [] for name in names}
    first = 0
    for number, scene in enumerate(nusc.scene):
        one = _Scene(nusc, scene)
        kept.append(folder / f"{number}.kept")
        kept[-1].write_bytes(rows_to_keep(one.rows(), ""))
        for row, *rest in one.files():
            for name, value in zip(names, (first * len(CHANNELS) + row, *rest), strict=True):
                files[name].append(value)
        first += one.frames
    join_tables(folder, kept, [splits.get(scene["name"]) for scene in nusc.scene])
    for path in kept:
        path.unlink()
    table = pa.table(files)
    with pa.OSFile(str(folder / _FILES), "wb") as file, pa.ipc.new_file(file, table.schema) as writer:
        writer.write_table(table)


def _splits(nusc: Any) -> dict[str, str]:
    """Scene → split: nuScenes' own, of the small version's its two, or those of the tables' `splits.json`."""
    from nuscenes.utils.splits import create_splits_scenes

    listed = Path(nusc.table_root) / "splits.json"
    named = parsed_json(read_bytes(listed, "meta")) if listed.is_file() else create_splits_scenes()
    small = "mini_" if "mini" in nusc.version else ""
    return {
        scene: split
        for split in SPLITS
        for name, scenes in named.items()
        if name in (f"{small}{split}", f"deepaccident_{split}")
        for scene in scenes
    }


class _Scene:
    """One scene, read."""

    def __init__(self, nusc: Any, scene: Mapping[str, Any]) -> None:
        """Read its keyframes; raises DatarootError if a sensor's are not all there."""
        self._nusc, self._scene = nusc, scene
        self._samples = [nusc.get("sample", scene["first_sample_token"])]
        while following := self._samples[-1]["next"]:
            self._samples.append(nusc.get("sample", following))
        for sample in self._samples:
            if lacking := CHANNEL_NAMES.values() - sample["data"].keys():
                raise DatarootError(f"{nusc.table_root}: sample {sample['token']} has no {', '.join(sorted(lacking))}")
        self._boxes = [[nusc.get("sample_annotation", each) for each in sample["anns"]] for sample in self._samples]
        self.frames = KEY_STEP * (len(self._samples) - 1) + 1
        self._world_from_ego, self._ego_from_sensor = self._poses(LIDAR_CHANNEL)
        flat = np.reshape([box["rotation"] for boxes in self._boxes for box in boxes], (-1, 4))[:, 1:3]
        self._ego_from_lidar = self._turned(upright=bool((np.abs(flat) < _LEAN).all()))

    def _poses(self, channel: str) -> tuple[FloatArray, FloatArray]:
        """`world_from_ego` and `ego_from_sensor` (K, 4, 4) of a sensor at its keyframes."""
        files = [self._nusc.get("sample_data", sample["data"][channel]) for sample in self._samples]
        return tuple(  # type: ignore[return-value]
            np.stack([_matrix(self._nusc.get(table, file[f"{table}_token"])) for file in files])
            for table in ("ego_pose", "calibrated_sensor")
        )

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
        for number, sample in enumerate(self._samples):
            for code, channel in enumerate(CHANNELS):
                if channel in CHANNEL_NAMES:
                    file = self._nusc.get("sample_data", sample["data"][CHANNEL_NAMES[channel]])["filename"]
                    if PurePosixPath(file).is_absolute() or ".." in PurePosixPath(file).parts:
                        raise DatarootError(f"{self._nusc.table_root}: sample_data: {file!r} leads out of the dataroot")
                    matrix = lidar_from_sensor[number].ravel().tolist() if channel == LIDAR else None
                    yield KEY_STEP * number * len(CHANNELS) + code, file, sample["token"], matrix

    def rows(self) -> dict[str, Columns]:
        """The rows of all tables."""
        place = ScenarioFolder(Path(self._nusc.dataroot), "", "nuscenes", self._scene["name"], (AGENT,))
        scan = ScenarioScan(
            agents=(AGENT,), has_meta=False, labelled=(AGENT,), num_frames=self.frames, problems=(), notices=()
        )
        calibs = self._calibs(np.arange(self.frames))
        rows = scenario_rows(
            ScenarioFiles(scenario=place, scan=scan, meta=None, calibs=calibs, labels=self._labels(calibs))
        )
        images = [self._nusc.get("sample_data", self._samples[0]["data"][name]) for name in CAMERA_CHANNELS.values()]
        for side in ("width", "height"):  # K says only where their middle may be
            values = np.array(rows["sample_data"][side]).reshape(self.frames, -1)
            values[:, : len(images)] = [image[side] for image in images]
            rows["sample_data"] = {**rows["sample_data"], side: values.ravel()}
        return {
            **rows,
            "scenario": {**rows["scenario"], "town": [self._nusc.get("log", self._scene["log_token"])["location"]]},
            "sample": {**rows["sample"], "labelled": np.arange(self.frames) % KEY_STEP == 0},
        }

    def _calibs(self, frame: IntArray) -> Calibs:
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
            tokens = [self._nusc.get("sample_data", one["data"][channel]) for one in self._samples]
            rows = [self._nusc.get("calibrated_sensor", one["calibrated_sensor_token"]) for one in tokens]
            intrinsics.append(np.array([row["camera_intrinsic"] for row in rows]))
        return Calibs(
            ego_from_lidar=self._ego_from_lidar[before],
            world_from_ego=moved,
            camera_from_lidar=np.stack(cameras, axis=1)[before],
            intrinsic=np.stack(intrinsics, axis=1)[before],
        )

    def _labels(self, calibs: Calibs) -> Labels:
        """Boxes at keyframes; actors are numbered as they appear, those of ignored classes from `IGNORED_ID` on."""
        boxes = [box for of_sample in self._boxes for box in of_sample]
        number = np.zeros(self.frames, dtype=np.int64)
        number[::KEY_STEP] = [len(of_sample) for of_sample in self._boxes]
        numbers: dict[str, int] = {}
        names = [box["category_name"] for box in boxes]
        ids = [
            numbers.setdefault(box["instance_token"], len(numbers) + 1) + (0 if name in CLASSES else IGNORED_ID)
            for box, name in zip(boxes, names, strict=True)
        ]
        lidar_from_world = inverses(calibs.world_from_ego @ calibs.ego_from_lidar)
        lidar_from_world = lidar_from_world[np.repeat(np.arange(self.frames), number)]
        turned = quaternions.to_matrix(np.reshape([box["rotation"] for box in boxes], (-1, 4)))
        yaw = _heading(lidar_from_world[:, :3, :3] @ turned)
        center = np.reshape([box["translation"] for box in boxes], (-1, 3))
        velocity = np.reshape([self._nusc.box_velocity(box["token"])[:2] for box in boxes], (-1, 2))
        moved = np.diff(calibs.world_from_ego[:, :2, 3], axis=0, append=np.nan) / FRAME_PERIOD
        return Labels(
            raw=False,
            num_boxes=number,
            agent_velocity=moved,
            category=np.array([category_of(name) for name in names], dtype=np.int8),
            center=(lidar_from_world[:, :3, :3] @ center[:, :, None])[..., 0] + lidar_from_world[:, :3, 3],
            size=np.reshape([box["size"] for box in boxes], (-1, 3))[:, [1, 0, 2]],
            yaw=yaw,
            velocity=label_from_world_velocity(velocity, yaw),
            actor_id=np.array(ids, dtype=np.int64),
            num_lidar_pts=np.array([box["num_lidar_pts"] for box in boxes], dtype=np.int64),
            camera_visible=np.array([box["visibility_token"] != _UNSEEN for box in boxes], dtype=bool),
        )


def _matrix(row: Mapping[str, Any]) -> FloatArray:
    """The transform (4, 4) of a row with translation and rotation."""
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = quaternions.to_matrix(row["rotation"]), row["translation"]
    return result


def _heading(turn: FloatArray) -> FloatArray:
    """Where x points, about z (N,), of rotations (N, 3, 3)."""
    return np.asarray(np.arctan2(turn[:, 1, 0], turn[:, 0, 0]))


def _about_z(angle: FloatArray) -> FloatArray:
    """Rotations (N, 3, 3) about z."""
    return quaternions.to_matrix(quaternions.from_yaw(angle))
