"""A nuScenes dataroot as a release: each scene is a recording of one agent at 10 Hz.

A keyframe is every fifth frame, and the last one, as in our export; its time is its own. Only
keyframes are labelled. Frames between them have poses and times, interpolated, and neither labels
nor files. The tables are made once from nuScenes', and stored like an index: one set with the boxes
of our classes, for all code that learns and counts, and one with all boxes.

The frames are the release's: x forward, y left, the ego's origin on the road. The LiDAR frame is
the sensor's, turned about its z axis until x is forward; where all boxes of a scene stand upright
in the world, as nuScenes' do, it is upright too, so that a yaw describes a box completely. A
camera's pose is at its own time, seen from the ego at the LiDAR's.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from functools import cached_property, partial
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Final, TypedDict

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
from deepaccident_devkit.support.text import path_of
from deepaccident_devkit.support.version import __version__
from deepaccident_devkit.tables.arrow_files import StoredTable, write_table
from deepaccident_devkit.tables.columns import Number, TableSpec, Vector, Word
from deepaccident_devkit.tables.indexing import join_tables, rows_to_keep
from deepaccident_devkit.tables.records import SCHEMA_VERSION, record_columns
from deepaccident_devkit.tables.tables import Tables
from deepaccident_devkit.tables.tokens import ColumnViews, Resolver
from deepaccident_devkit.taxonomy import CHANNELS, LIDAR, SPLITS

# Version of the stored tables, besides the version of their columns.
_FORMAT: Final = 3
# Folders of the tables with the boxes of our classes, and with all boxes.
_COUNTED_FOLDER, _ALL_FOLDER = "counted", "all"
_LIDAR: Final = CHANNELS.index(LIDAR)


class _File(TypedDict):
    """A file of a keyframe."""

    row: Annotated[int, Number(dtype="int64", doc="row of `sample_data`; ascending")]
    filename: Annotated[str, Word(doc="the file, below the dataroot")]
    token: Annotated[str, Word(doc="nuScenes' token of the sample")]
    matrix: Annotated[
        list[list[float]], Vector(shape=(4, 4), doc="`lidar_from_sensor` of the sample's LiDAR")
    ]


_FILES: Final = TableSpec("files", "Files of keyframes.", record_columns(_File))


class _KeyframeResolver(Resolver):
    """A resolver of the file names in nuScenes' tables."""

    def __init__(self, views: ColumnViews, files: Mapping[str, Any]) -> None:
        """Store the columns of `_FILES`."""
        super().__init__(views)
        self._files = files

    def filename(self, sample_data_row: int) -> str:
        """Return the path of a file below the dataroot; between keyframes no such file exists."""
        row = _file_row(self._files, sample_data_row)
        if row is None:
            return super().filename(sample_data_row)
        return str(self._files["filename"][row])


def _file_row(files: Mapping[str, Any], sample_data_row: int) -> int | None:
    """Return the row of `_FILES` for a row of `sample_data`; None between keyframes."""
    rows = files["row"]
    row = int(rows.searchsorted(sample_data_row))
    if row < len(rows) and rows[row] == sample_data_row:
        return row
    return None


class NuScenesRelease(DeepAccident):
    """The scenes of a nuScenes dataroot, opened by `open_nuscenes` and used as any release."""

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
        return type(self), (self.dataroot, self.version, self.tables_folder)

    @cached_property
    def with_ignored(self) -> NuScenesRelease:
        """The release with the boxes of classes that are not ours, as in `Dataset`."""
        return type(self)(self.dataroot, self.version, self.tables_folder.with_name(_ALL_FOLDER))

    def nuscenes_token(self, sample: RowArgument) -> str:
        """Return nuScenes' token of a sample that is a keyframe.

        Raises TokenError, and ConfigError for a sample that is no keyframe.
        """
        row = _file_row(self._files, self.getind("sample", sample) * len(CHANNELS) + _LIDAR)
        if row is None:
            raise ConfigError(
                f"{sample}: is between two keyframes, of which alone nuScenes has samples"
            )
        return str(self._files["token"][row])

    def sensor_frames(self, scenario: RowArgument) -> dict[tuple[str, str], tuple[int, ...]]:
        """Return the keyframes, which have files in nuScenes' tables, as in `Dataset`."""
        keyframes = tuple(range(1, len(self._samples(scenario)) + 1, KEY_STEP))
        return {
            (AGENT, channel): keyframes if channel in CHANNEL_NAMES else () for channel in CHANNELS
        }

    def truth_hashes(self, scenario: str) -> ScenarioHashes:
        """Return hashes of a scenario's boxes, instead of label files, and of its poses."""
        rows, boxes = self._samples(scenario), self.columns("annotation")
        box_rows = slice(*boxes["sample_row"].searchsorted((rows.start, rows.stop)))
        columns = ("actor_id", "category", "translation", "size", "yaw")
        label = [boxes[name][box_rows].tolist() for name in columns]
        calib = self.columns("ego_pose")["matrix"][rows.start : rows.stop].tolist()
        return ScenarioHashes(label=digest_of(label), meta=None, calib=digest_of(calib))

    def _lidar_cloud(self, row: int) -> LidarPointCloud:
        """Return a cloud as in `Dataset`.

        Intensities beyond 1 are nuScenes', from 0 to 255, and are scaled to the range from 0 to 1.
        """
        path = self._channel_path(row, LIDAR)
        file_row = _file_row(self._files, row * len(CHANNELS) + _LIDAR)
        if file_row is None:
            return super()._lidar_cloud(row)  # raises, since there is no file
        content = np.frombuffer(read_bytes(path, "lidar"), dtype="<f4")
        if len(content) % 5:
            raise SensorFileError(
                f"{path}: expected points of five numbers each, found {len(content)} numbers"
            )
        points = content.reshape(-1, 5)
        intensity = points[:, 3] / (255 if points[:, 3].max(initial=0) > 1 else 1)
        cloud = LidarPointCloud(points[:, :3].astype(np.float64), intensity, "lidar")
        lidar_from_sensor = SE3(self._files["matrix"][file_row].reshape(4, 4))
        return cloud.transform(lidar_from_sensor, "lidar")

    def _samples(self, scenario: RowArgument) -> range:
        """Return the rows of a scenario's samples."""
        row = self.getind("scenario", scenario)
        return range(*self.columns("sample")["scenario_row"].searchsorted((row, row + 1)).tolist())


def open_nuscenes(
    dataroot: str | os.PathLike[str], index_dir: Path | None = None
) -> NuScenesRelease:
    """Open a nuScenes dataroot as a release, and make its tables if they are not stored yet.

    Args:
        dataroot: Folder that holds the tables of one version (`v1.0-mini`, …); if it holds several,
            the folder of one version.
        index_dir: Where to store the tables; by default in the dataroot, or in the user's cache.

    Raises:
        DatarootError: There are no tables of nuScenes, or one of them is damaged; the message names
            its file, the row and the field.
        VersionError: The folder holds several versions.
        MissingExtraError: The scenes of the splits are needed, and the nuScenes devkit, which lists
            them, is not installed.
    """
    tables = nuscenes_tables(path_of(dataroot))
    if tables is None:
        raise DatarootError(
            f"{dataroot}: has no tables of nuScenes, such as v1.0-mini/{NUSCENES_TABLE}"
        )
    folder = _tables_folder(tables, index_dir)
    try:
        if not folder.is_dir():
            with replacing_folder(folder) as new_folder:
                _write_tables(tables, new_folder)
    except OSError:
        if not folder.is_dir():  # otherwise another process has just made the same tables
            raise
    return NuScenesRelease(tables.parent, tables.name, folder / _COUNTED_FOLDER)


def release_of(nusc: Any, index_dir: Path | None = None) -> NuScenesRelease:
    """Open the tables of a `nuscenes.NuScenes`; raise the errors of `open_nuscenes`."""
    return open_nuscenes(nusc.table_root, index_dir)


def _tables_folder(tables: Path, index_dir: Path | None) -> Path:
    """Return the folder of the tables made from these: another one for each content."""
    key = hashlib.blake2b(f"{__version__} {SCHEMA_VERSION} {_FORMAT}".encode(), digest_size=8)
    for path in sorted(tables.glob("*.json")):
        state = path.lstat()
        key.update(repr((path.name, state.st_size, state.st_mtime_ns, state.st_ctime_ns)).encode())
    roots = index_places(tables.parent, index_dir)
    folders = [root / tables.name / key.hexdigest() for root in roots]
    for folder in folders:
        if folder.is_dir() or is_writable_folder(folder.parent):
            return folder
    return folders[-1]


def _write_tables(folder: Path, new_folder: Path) -> None:
    """Write the tables of all scenes."""
    tables, splits = NuScenesTables(folder), _splits(folder)
    split_by_scene: dict[str, str | None] = {}
    part_paths: dict[str, list[Path]] = {_COUNTED_FOLDER: [], _ALL_FOLDER: []}
    files: list[tuple[Any, ...]] = []
    first_row = 0
    for row in tables.rows["scene"].values():
        if row.name in split_by_scene:
            raise tables.error(row, "name: another scene has it, too")
        scene = NuScenesScene(tables, row)
        for name, paths in part_paths.items():
            paths.append(new_folder / f"{len(paths)}.{name}")
            rows = scene.rows(every_class=name == _ALL_FOLDER)
            paths[-1].write_bytes(rows_to_keep(rows, ""))
        files += scene.files(first_row)
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


def _splits(folder: Path) -> dict[str, str]:
    """Return scene → split.

    The splits are nuScenes' own (the small version has two of its own), or come from the tables'
    `splits.json`.
    """
    path = folder / "splits.json"
    has_file = os.path.lexists(path)  # a link to nothing is refused, too
    scenes_by_split = (
        read_table(path, dict[str, list[str]]) if has_file else _official_splits(folder)
    )
    own_names = ("mini_" if "mini" in folder.name else "", "deepaccident_")
    splits: dict[str, str] = {}
    for split, prefix in product(SPLITS, own_names):
        for scene in scenes_by_split.get(f"{prefix}{split}", ()):
            known_split = splits.setdefault(scene, split)
            if known_split != split:
                raise DatarootError(
                    f"{path}: {shortened(scene)} is in {known_split} and in {split}; remove it "
                    "from one"
                )
    return splits


def _official_splits(folder: Path) -> dict[str, list[str]]:
    try:
        from nuscenes.utils.splits import create_splits_scenes
    except ImportError as error:
        raise MissingExtraError(
            f"{folder}: the nuScenes devkit knows the scenes of its splits, and needs Python 3.10 "
            "to 3.12 and numpy 1.26; there: pip install 'deepaccident_devkit[nuscenes]'; or write "
            "them into splits.json beside the tables"
        ) from error
    scenes_by_split: dict[str, list[str]] = create_splits_scenes()
    return scenes_by_split
