"""A nuScenes dataroot as a release: each scene is a recording of one agent at 10 Hz.

As in our export, the last frame and every fifth one are keyframes; a keyframe has its original
time. Only keyframes are labelled. Frames between them have interpolated poses and times, but
neither labels nor files. The tables are made once from nuScenes' tables and stored like an index:
one set with the boxes of our classes, for all code that learns and counts, and one with all boxes.

Coordinate frames are as in the release: x forward, y left, and the ego's origin on the road. The
LiDAR frame is the frame of the sensor, rotated about its z axis until x is forward. If all boxes of
a scene are upright in the world, as nuScenes' are, the LiDAR frame is upright too, so that only yaw
gives a box's orientation. A camera's pose is its pose at the camera's own time, relative to the ego
pose at the time of the LiDAR.
"""

from __future__ import annotations

import hashlib
import os
from functools import cached_property, partial
from itertools import product
from pathlib import Path
from typing import Annotated, Any, TypedDict

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.deepaccident import DeepAccident
from deepaccident_devkit.errors import (
    ConfigError,
    DatarootError,
    MissingExtraError,
    SensorFileError,
    shortened,
)
from deepaccident_devkit.export.frames import KEY_STEP
from deepaccident_devkit.export.nuscenes.scenes import CHANNEL_NAMES
from deepaccident_devkit.geometry import SE3, LidarPointCloud
from deepaccident_devkit.plugins.nuscenes.scenes import AGENT, NuScenesScene
from deepaccident_devkit.plugins.nuscenes.tables import NUSCENES_REMEDY, NuScenesTables, read_table
from deepaccident_devkit.release.fingerprints import ScenarioHashes, digest_of
from deepaccident_devkit.release.layout import NUSCENES_TABLE, nuscenes_tables
from deepaccident_devkit.release.store import ReleasePath, index_places
from deepaccident_devkit.support.files import is_writable_folder, replacing_folder
from deepaccident_devkit.support.reading import read_bytes
from deepaccident_devkit.support.text import PathType, path_of
from deepaccident_devkit.support.values import ReadOnlyValues
from deepaccident_devkit.support.version import __version__
from deepaccident_devkit.tables.arrow_files import StoredTable, write_table
from deepaccident_devkit.tables.columns import Number, TableSpec, Vector, Word
from deepaccident_devkit.tables.indexing import join_tables, rows_to_keep
from deepaccident_devkit.tables.records import SCHEMA_VERSION, record_columns
from deepaccident_devkit.tables.tables import Tables
from deepaccident_devkit.tables.tokens import ColumnViews, Resolver
from deepaccident_devkit.taxonomy import CHANNELS, LIDAR, SPLITS

# Version of the stored tables, besides the version of their columns.
_FORMAT = 3
# Folder of the tables with the boxes of our classes.
_COUNTED_FOLDER = "counted"
# Folder of the tables with all boxes.
_ALL_FOLDER = "all"
_LIDAR = CHANNELS.index(LIDAR)


class _File(TypedDict):
    """A file of a keyframe."""

    row: Annotated[int, Number(dtype="int64", doc="row of `sample_data`; ascending")]
    filename: Annotated[str, Word(doc="the file, below the dataroot")]
    token: Annotated[str, Word(doc="nuScenes' token of the sample")]
    matrix: Annotated[
        list[list[float]], Vector(shape=(4, 4), doc="`lidar_from_sensor` of the sample's LiDAR")
    ]


_FILES = TableSpec("files", "Files of keyframes.", record_columns(_File))


class _KeyframeResolver(Resolver):
    """A resolver of tokens and paths that takes file names from nuScenes' tables."""

    def __init__(self, views: ColumnViews, files: ReadOnlyValues) -> None:
        """Store the columns of `_FILES`."""
        super().__init__(views)
        self._files = files

    def filename(self, sample_data_row: int) -> str:
        """Return the path of a file below the dataroot; between keyframes no such file exists."""
        row = _find_file_row(self._files, sample_data_row)
        if row is None:
            return super().filename(sample_data_row)
        return str(self._files["filename"][row])


def _find_file_row(files: ReadOnlyValues, sample_data_row: int) -> int | None:
    """Return the row of `_FILES` for a row of `sample_data`; None between keyframes."""
    rows = files["row"]
    row = int(rows.searchsorted(sample_data_row))
    if row < len(rows) and rows[row] == sample_data_row:
        return row
    return None


class NuScenesRelease(DeepAccident):
    """The scenes of a nuScenes dataroot, opened by `open_nuscenes` and used like any release."""

    def __init__(self, dataroot: ReleasePath, version: str, tables_folder: Path) -> None:
        """Open existing tables; raise IndexStoreError if they cannot be read."""
        self._files = StoredTable(tables_folder.parent, _FILES).views
        Dataset.__init__(
            self,
            dataroot=dataroot,
            version=version,
            layout="nuScenes",
            split_files={},
            tables_folder=tables_folder,
            tables=Tables(tables_folder, partial(_KeyframeResolver, files=self._files)),
        )

    def __reduce__(self) -> tuple[Any, ...]:
        """Return a constructor that opens the same files again."""
        arguments = (self.dataroot, self.version, self.tables_folder)
        return type(self), arguments

    @cached_property
    def with_ignored(self) -> NuScenesRelease:
        """The same release with all boxes, including ignored classes, as in `Dataset`."""
        folder = self.tables_folder.with_name(_ALL_FOLDER)
        return type(self)(self.dataroot, self.version, folder)

    def nuscenes_token(self, sample: RowArgument) -> str:
        """Return nuScenes' token of a sample that is a keyframe.

        Raises TokenError if there is no such sample, and ConfigError if it is not a keyframe.
        """
        row = _find_file_row(self._files, self.getind("sample", sample) * len(CHANNELS) + _LIDAR)
        if row is None:
            raise ConfigError(
                f"{sample}: is between two keyframes; nuScenes has samples only at keyframes"
            )
        return str(self._files["token"][row])

    def sensor_frames(self, scenario: RowArgument) -> dict[tuple[str, str], tuple[int, ...]]:
        """Return the keyframes, at which nuScenes' tables have files, as in `Dataset`."""
        keyframes = tuple(range(1, len(self._find_sample_rows(scenario)) + 1, KEY_STEP))
        return {
            (AGENT, channel): keyframes if channel in CHANNEL_NAMES else () for channel in CHANNELS
        }

    def truth_hashes(self, scenario: str) -> ScenarioHashes:
        """Return the hashes of a scenario's boxes, instead of its label files, and of its poses."""
        rows = self._find_sample_rows(scenario)
        boxes = self.columns("annotation")
        first, end = boxes["sample_row"].searchsorted((rows.start, rows.stop))
        names = ("actor_id", "category", "translation", "size", "yaw")
        label = [boxes[name][first:end].tolist() for name in names]
        poses = self.columns("ego_pose")["matrix"][rows.start : rows.stop].tolist()
        return ScenarioHashes(label=digest_of(label), meta=None, calib=digest_of(poses))

    def _lidar_cloud(self, row: int) -> LidarPointCloud:
        """Return a cloud as in `Dataset`.

        If intensities exceed 1, they are nuScenes' from 0 to 255, and are scaled to 0 to 1.
        """
        path = self._channel_path(row, LIDAR)
        file_row = _find_file_row(self._files, row * len(CHANNELS) + _LIDAR)
        if file_row is None:
            return super()._lidar_cloud(row)  # This raises an error, since there is no file.
        content = np.frombuffer(read_bytes(path, "lidar"), dtype="<f4")
        if len(content) % 5:
            raise SensorFileError(
                f"{path}: expected points of five numbers each, found {len(content)} numbers"
            )
        points = content.reshape(-1, 5)
        intensity = points[:, 3]
        if intensity.max(initial=0) > 1:
            intensity = intensity / 255
        cloud = LidarPointCloud(points[:, :3].astype(np.float64), intensity, "lidar")
        lidar_from_sensor = SE3(self._files["matrix"][file_row].reshape(4, 4))
        return cloud.transform(lidar_from_sensor, "lidar")

    def _find_sample_rows(self, scenario: RowArgument) -> range:
        """Return the rows of a scenario's samples."""
        row = self.getind("scenario", scenario)
        scenario_rows = self.columns("sample")["scenario_row"]
        first, end = scenario_rows.searchsorted((row, row + 1)).tolist()
        return range(first, end)


def open_nuscenes(dataroot: PathType, index_dir: Path | None = None) -> NuScenesRelease:
    """Open a nuScenes dataroot as a release, after making its tables if they are not stored yet.

    Args:
        dataroot: Folder with the tables of one version (`v1.0-mini`, …), or, if it has several
            versions, the folder of one of them.
        index_dir: Folder in which the tables are stored; by default in the dataroot, or in the
            user's cache.

    Raises:
        DatarootError: If there are no nuScenes tables, or one of them is damaged; the message names
            its file, the row and the field.
        VersionError: If the folder holds several versions.
        MissingExtraError: If the scenes of the splits are needed, but the nuScenes devkit, which
            lists them, is not installed.
    """
    tables = nuscenes_tables(path_of(dataroot))
    if tables is None:
        raise DatarootError(
            f"{dataroot}: has no tables of nuScenes, such as v1.0-mini/{NUSCENES_TABLE}"
        )
    folder = _choose_tables_folder(tables, index_dir)
    try:
        if not folder.is_dir():
            with replacing_folder(folder) as new_folder:
                _write_tables(tables, new_folder)
    except OSError:
        if not folder.is_dir():  # Otherwise another process has just made the same tables.
            raise
    return NuScenesRelease(tables.parent, tables.name, folder / _COUNTED_FOLDER)


def release_of(nusc: Any, index_dir: Path | None = None) -> NuScenesRelease:
    """Open the tables of a `nuscenes.NuScenes`; raise the errors of `open_nuscenes`."""
    return open_nuscenes(nusc.table_root, index_dir)


def _choose_tables_folder(tables: Path, index_dir: Path | None) -> Path:
    """Return the folder of the tables, which depends on the content of nuScenes' tables."""
    version = f"{__version__} {SCHEMA_VERSION} {_FORMAT}"
    digest = hashlib.blake2b(version.encode(), digest_size=8)
    for path in sorted(tables.glob("*.json")):
        state = path.lstat()
        identity = (path.name, state.st_size, state.st_mtime_ns, state.st_ctime_ns)
        digest.update(repr(identity).encode())
    name = digest.hexdigest()
    roots = index_places(tables.parent, index_dir)
    folders = [root / tables.name / name for root in roots]
    for folder in folders:
        if folder.is_dir() or is_writable_folder(folder.parent):
            return folder
    return folders[-1]


def _write_tables(folder: Path, new_folder: Path) -> None:
    """Write the tables of all scenes into a new folder."""
    tables = NuScenesTables(folder)
    splits = _read_splits(folder)
    split_by_scene: dict[str, str | None] = {}
    part_paths: dict[str, list[Path]] = {_COUNTED_FOLDER: [], _ALL_FOLDER: []}
    files: list[tuple[Any, ...]] = []
    first_row = 0
    for row in tables.rows["scene"].values():
        if row.name in split_by_scene:
            raise tables.make_error(row, "name: another scene has the same name")
        scene = NuScenesScene(tables, row)
        for name, paths in part_paths.items():
            paths.append(new_folder / f"{len(paths)}.{name}")
            rows = scene.make_rows(every_class=name == _ALL_FOLDER)
            paths[-1].write_bytes(rows_to_keep(rows, ""))
        files += scene.list_files(first_row)
        first_row += scene.frames
        split_by_scene[row.name] = splits.get(row.name)
    if not split_by_scene:
        raise DatarootError(f"{folder / NUSCENES_TABLE}: has no scenes; {NUSCENES_REMEDY}")
    for name, paths in part_paths.items():
        (new_folder / name).mkdir()
        join_tables(new_folder / name, paths, [*split_by_scene.values()])
        for path in paths:
            path.unlink()
    columns = zip(_File.__annotations__, zip(*files, strict=True), strict=True)
    write_table(new_folder, _FILES, dict(columns))


def _read_splits(folder: Path) -> dict[str, str]:
    """Return the split of each scene, by scene name.

    The splits are nuScenes' official ones (the small version has its own two), or the ones of
    `splits.json` next to the tables.
    """
    path = folder / "splits.json"
    if os.path.lexists(path):  # A link to nothing exists too, and is refused.
        scenes_by_split = read_table(path, dict[str, list[str]])
    else:
        scenes_by_split = _read_official_splits(folder)
    prefixes = ("mini_" if "mini" in folder.name else "", "deepaccident_")
    splits: dict[str, str] = {}
    for split, prefix in product(SPLITS, prefixes):
        for scene in scenes_by_split.get(f"{prefix}{split}", ()):
            known_split = splits.setdefault(scene, split)
            if known_split != split:
                raise DatarootError(
                    f"{path}: {shortened(scene)} is in {known_split} and in {split}; remove it "
                    "from one"
                )
    return splits


def _read_official_splits(folder: Path) -> dict[str, list[str]]:
    try:
        from nuscenes.utils.splits import create_splits_scenes
    except ImportError as error:
        raise MissingExtraError(
            f"{folder}: the splits come from the nuScenes devkit, which needs Python 3.10 to "
            "3.12 and numpy 1.26; in such an environment, run pip install "
            "'deepaccident_devkit[nuscenes]'; or write the splits into splits.json in the "
            "folder of the tables"
        ) from error
    scenes_by_split: dict[str, list[str]] = create_splits_scenes()
    return scenes_by_split
