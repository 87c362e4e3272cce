"""A nuScenes dataroot as a release: each scene is a recording of one agent, at 10 Hz, labelled at its keyframes.

A keyframe is every fifth frame, and the last one, as in our export; its time is its own. Frames between them have poses
and times, interpolated, and neither labels nor files. The tables are made once from nuScenes', and kept like an index:
one set with the boxes of our classes, which all that learns and counts reads, and one with all boxes.

The frames are the release's: x forward, y left, the ego's origin on the road. The LiDAR frame is the sensor's, turned
about its z axis until x is forward; where all boxes of a scene stand upright in the world, as nuScenes' do, it is
upright too, so that a yaw says all of a box. A camera's pose is at its own time, seen from the ego at the LiDAR's.
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

# Of the kept tables, beside that of their columns.
_FORMAT: Final = 3
# Folders of the tables with the boxes of our classes, and with all boxes.
_COUNTED, _ALL = "counted", "all"
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
    """Finds files where nuScenes' tables say that they are."""

    def __init__(self, views: ColumnViews, files: Mapping[str, Any]) -> None:
        """Note the columns of `_FILES`."""
        super().__init__(views)
        self._files = files

    def filename(self, sample_data_row: int) -> str:
        """Return the path of a file below the dataroot; between keyframes a path at which there is no file."""
        place = _place(self._files, sample_data_row)
        return (
            super().filename(sample_data_row)
            if place is None
            else str(self._files["filename"][place])
        )


def _place(files: Mapping[str, Any], sample_data_row: int) -> int | None:
    """Return the row of `_FILES` for a row of `sample_data`; None between keyframes."""
    rows = files["row"]
    place = int(rows.searchsorted(sample_data_row))
    return place if place < len(rows) and rows[place] == sample_data_row else None


class NuScenesRelease(DeepAccident):
    """The scenes of a nuScenes dataroot; made by `open_nuscenes`, and used as any release."""

    def __init__(self, dataroot: ReleasePath, version: str, tables_folder: Path) -> None:
        """Open tables that were made; raises IndexStoreError if they cannot be read."""
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
        """The copy opens the same files again."""
        return type(self), (self.dataroot, self.version, self.tables_folder)

    @cached_property
    def with_ignored(self) -> NuScenesRelease:
        """As of `Dataset`: with the boxes of classes that are not ours."""
        return type(self)(self.dataroot, self.version, self.tables_folder.with_name(_ALL))

    def nuscenes_token(self, sample: RowArgument) -> str:
        """NuScenes' token of a sample that is a keyframe; raises TokenError, and ConfigError for one that is none."""
        place = _place(self._files, self.getind("sample", sample) * len(CHANNELS) + _LIDAR)
        if place is None:
            raise ConfigError(
                f"{sample}: is between two keyframes, of which alone nuScenes has samples"
            )
        return str(self._files["token"][place])

    def sensor_frames(self, scenario: RowArgument) -> dict[tuple[str, str], tuple[int, ...]]:
        """As of `Dataset`: the keyframes, whose files nuScenes' tables name."""
        keyframes = tuple(range(1, len(self._samples(scenario)) + 1, KEY_STEP))
        return {
            (AGENT, channel): keyframes if channel in CHANNEL_NAMES else () for channel in CHANNELS
        }

    def truth_hashes(self, scenario: str) -> ScenarioHashes:
        """Hashes of a scenario's boxes, in place of label files, and of its poses."""
        rows, boxes = self._samples(scenario), self.columns("annotation")
        own = slice(*boxes["sample_row"].searchsorted((rows.start, rows.stop)))
        label = [
            boxes[name][own].tolist()
            for name in ("actor_id", "category", "translation", "size", "yaw")
        ]
        calib = self.columns("ego_pose")["matrix"][rows.start : rows.stop].tolist()
        return ScenarioHashes(label=digest_of(label), meta=None, calib=digest_of(calib))

    def _lidar_cloud(self, row: int) -> LidarPointCloud:
        """As of `Dataset`. Intensities beyond 1 are nuScenes', from 0 to 255, and become those from 0 to 1."""
        path, place = (
            self._channel_path(row, LIDAR),
            _place(self._files, row * len(CHANNELS) + _LIDAR),
        )
        if place is None:
            return super()._lidar_cloud(row)  # which says that there is no file
        content = np.frombuffer(read_bytes(path, "lidar"), dtype="<f4")
        if len(content) % 5:
            raise SensorFileError(
                f"{path}: expected points of five numbers each, found {len(content)} numbers"
            )
        points = content.reshape(-1, 5)
        intensity = points[:, 3] / (255 if points[:, 3].max(initial=0) > 1 else 1)
        cloud = LidarPointCloud(points[:, :3].astype(np.float64), intensity, "lidar")
        return cloud.transform(SE3(self._files["matrix"][place].reshape(4, 4)), "lidar")

    def _samples(self, scenario: RowArgument) -> range:
        """The rows of a scenario's samples."""
        row = self.getind("scenario", scenario)
        return range(*self.columns("sample")["scenario_row"].searchsorted((row, row + 1)).tolist())


def open_nuscenes(
    dataroot: str | os.PathLike[str], index_dir: Path | None = None
) -> NuScenesRelease:
    """Open a nuScenes dataroot as a release, and make its tables where they are not kept yet.

    Args:
        dataroot: the folder that holds the tables of one version (`v1.0-mini`, …); of several, that of one version.
        index_dir: where to keep the tables; by default in the dataroot, or in the user's cache.

    Raises:
        DatarootError: there are no tables of nuScenes, or one of them is damaged; the message names its file, the row
            and the field.
        VersionError: the folder holds several versions.
        MissingExtraError: the scenes of the splits are needed, and the nuScenes devkit, which lists them, is not
            installed.
    """
    tables = nuscenes_tables(path_of(dataroot))
    if tables is None:
        raise DatarootError(
            f"{dataroot}: has no tables of nuScenes, such as v1.0-mini/{NUSCENES_TABLE}"
        )
    folder = _kept_in(tables, index_dir)
    try:
        if not folder.is_dir():
            with replacing_folder(folder) as made:
                _write(tables, made)
    except OSError:
        if not folder.is_dir():  # else another process has just made the same
            raise
    return NuScenesRelease(tables.parent, tables.name, folder / _COUNTED)


def release_of(nusc: Any, index_dir: Path | None = None) -> NuScenesRelease:
    """Open the tables of a `nuscenes.NuScenes`; raises as `open_nuscenes` does."""
    return open_nuscenes(nusc.table_root, index_dir)


def _kept_in(tables: Path, index_dir: Path | None) -> Path:
    """Return where the tables made of these are kept, or will be: another folder for each content."""
    key = hashlib.blake2b(f"{__version__} {SCHEMA_VERSION} {_FORMAT}".encode(), digest_size=8)
    for path in sorted(tables.glob("*.json")):
        state = path.lstat()
        key.update(repr((path.name, state.st_size, state.st_mtime_ns, state.st_ctime_ns)).encode())
    places = [
        place / tables.name / key.hexdigest() for place in index_places(tables.parent, index_dir)
    ]
    return next(
        (each for each in places if each.is_dir() or is_writable_folder(each.parent)), places[-1]
    )


def _write(folder: Path, made: Path) -> None:
    """Make the tables of all scenes."""
    tables, splits = NuScenesTables(folder), _splits(folder)
    split_of: dict[str, str | None] = {}
    kept: dict[str, list[Path]] = {_COUNTED: [], _ALL: []}
    files: list[tuple[Any, ...]] = []
    first = 0
    for row in tables.rows["scene"].values():
        if row.name in split_of:
            raise tables.error(row, "name: another scene has it, too")
        scene = NuScenesScene(tables, row)
        for boxes, paths in kept.items():
            paths.append(made / f"{len(paths)}.{boxes}")
            paths[-1].write_bytes(rows_to_keep(scene.rows(every_class=boxes == _ALL), ""))
        files += scene.files(first)
        first += scene.frames
        split_of[row.name] = splits.get(row.name)
    if not split_of:
        raise DatarootError(f"{folder / NUSCENES_TABLE}: has no scenes; {NUSCENES_REMEDY}")
    for boxes, paths in kept.items():
        (made / boxes).mkdir()
        join_tables(made / boxes, paths, [*split_of.values()])
        for path in paths:
            path.unlink()
    write_table(
        made, _FILES, dict(zip(_File.__annotations__, zip(*files, strict=True), strict=True))
    )


def _splits(folder: Path) -> dict[str, str]:
    """Scene → split: nuScenes' own, of the small version its two, or those of the tables' `splits.json`."""
    listed = folder / "splits.json"
    is_own = os.path.lexists(listed)  # a link to nothing is refused, too
    named = read_table(listed, dict[str, list[str]]) if is_own else _official_splits(folder)
    own_names = ("mini_" if "mini" in folder.name else "", "deepaccident_")
    splits: dict[str, str] = {}
    for split, prefix in product(SPLITS, own_names):
        for scene in named.get(f"{prefix}{split}", ()):
            other = splits.setdefault(scene, split)
            if other != split:
                raise DatarootError(
                    f"{listed}: {shortened(scene)} is in {other} and in {split}; remove it from one"
                )
    return splits


def _official_splits(folder: Path) -> dict[str, list[str]]:
    try:
        from nuscenes.utils.splits import create_splits_scenes
    except ImportError as error:
        raise MissingExtraError(
            f"{folder}: the nuScenes devkit knows the scenes of its splits, and needs Python 3.10 to 3.12 and numpy "
            "1.26; there: pip install 'deepaccident_devkit[nuscenes]'; or write them into splits.json beside the tables"
        ) from error
    named: dict[str, list[str]] = create_splits_scenes()
    return named
