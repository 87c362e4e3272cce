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
import json
import logging
import os
from collections.abc import Iterator
from dataclasses import asdict
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any, Final, get_args

import numpy as np

from deepaccident_devkit._version import __version__
from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.deepaccident import DeepAccident
from deepaccident_devkit.errors import ConfigError, DatarootError, MissingExtraError, SensorFileError, shortened
from deepaccident_devkit.export.frames import KEY_STEP
from deepaccident_devkit.export.nuscenes.scenes import CHANNEL_NAMES
from deepaccident_devkit.geometry import SE3, LidarPointCloud
from deepaccident_devkit.nuscenes.scenes import AGENT, SceneTables
from deepaccident_devkit.nuscenes.tables import REMEDY, Tables, read_table
from deepaccident_devkit.release.fingerprints import ScenarioHashes, digest_of
from deepaccident_devkit.release.layout import NUSCENES_TABLE, nuscenes_tables
from deepaccident_devkit.release.store import index_places
from deepaccident_devkit.support.files import is_writable_folder, replacing_folder
from deepaccident_devkit.support.reading import mapped_file, read_bytes
from deepaccident_devkit.support.text import choice, path_of
from deepaccident_devkit.tables.index import Problem
from deepaccident_devkit.tables.indexing import join_tables, rows_to_keep
from deepaccident_devkit.tables.records import SCHEMA_VERSION
from deepaccident_devkit.taxonomy import CHANNELS, LIDAR, SPLITS, Frame, OnError

logger = logging.getLogger(__name__)

_FORMAT: Final = 2
"""Of the kept tables, beside that of their columns."""
_FILES: Final = "files.arrow"
_PROBLEMS: Final = "problems.json"
_SETS: Final = ("counted", "all")
"""Folders of the tables with the boxes of our classes, and with all boxes."""
_LIDAR: Final = CHANNELS.index(LIDAR)


class NuScenesRelease(DeepAccident):
    """The scenes of a nuScenes dataroot; made by `open_nuscenes`, and used as any release."""

    def __init__(self, dataroot: Path, version: str, tables_folder: Path, boxes: str = "counted") -> None:
        """Open one of the sets of tables in a folder; raises IndexStoreError if they cannot be read."""
        import pyarrow as pa

        problems = [Problem(**each) for each in json.loads((tables_folder / _PROBLEMS).read_bytes())]
        Dataset.__init__(
            self,
            dataroot=dataroot,
            version=version,
            layout="nuScenes",
            split_files={},
            tables_folder=tables_folder / boxes,
            problems=tuple(problems),
        )
        self._files = pa.ipc.open_file(mapped_file(tables_folder / _FILES)).read_all()
        self._rows = self._files["row"].to_numpy()
        self._plain_filename = self._tables.resolver.filename
        self._tables.resolver.filename = self._filename  # type: ignore[method-assign]

    def __reduce__(self) -> tuple[Any, ...]:
        """The copy opens the same files again."""
        return type(self), (self.dataroot, self.version, self.tables_folder.parent, self.tables_folder.name)

    @cached_property
    def with_ignored(self) -> NuScenesRelease:
        """As of `Dataset`: with the boxes of classes that are not ours."""
        _, (dataroot, version, made, _) = self.__reduce__()
        return type(self)(dataroot, version, made, _SETS[1])

    def nuscenes_token(self, sample: RowArgument) -> str:
        """NuScenes' token of a sample that is a keyframe; raises TokenError, and ConfigError for one that is none."""
        place = self._place(self.getind("sample", sample) * len(CHANNELS) + _LIDAR)
        if place is None:
            raise ConfigError(f"{sample}: is between two keyframes, of which alone nuScenes has samples")
        return str(self._files["token"][place])

    def sensor_frames(self, scenario: RowArgument) -> dict[tuple[str, str], tuple[int, ...]]:
        """As of `Dataset`: the keyframes, whose files nuScenes' tables name."""
        keyframes = tuple(range(1, len(self._samples(scenario)) + 1, KEY_STEP))
        return {(AGENT, channel): keyframes if channel in CHANNEL_NAMES else () for channel in CHANNELS}

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


def open_nuscenes(
    dataroot: str | os.PathLike[str], index_dir: Path | None = None, on_error: OnError = "raise"
) -> NuScenesRelease:
    """Open a nuScenes dataroot as a release, and make its tables where they are not kept yet.

    Args:
        dataroot: the folder that holds the tables of one version (`v1.0-mini`, …); of several, that of one version.
        index_dir: where to keep the tables; by default in the dataroot, or in the user's cache.
        on_error: `raise` for the first fault of a table; `skip` leaves out the scenes that a damaged row belongs to,
            and says so.

    Raises:
        DatarootError: there are no tables of nuScenes, or one of them is damaged; the message names its file, the
            row's token and the field. With `skip`, no scene is left, or nobody knows whose scene a row belongs to.
        VersionError: the folder holds several versions.
        MissingExtraError: the scenes of the splits are needed, and the nuScenes devkit, which lists them, is not
            installed.
    """
    tables = nuscenes_tables(path_of(dataroot))
    if tables is None:
        raise DatarootError(f"{dataroot}: has no tables of nuScenes, such as v1.0-mini/{NUSCENES_TABLE}")
    skip = choice("on_error", on_error, get_args(OnError)) == "skip"
    folder = _kept_in(tables, index_dir, skip=skip)
    try:
        if not folder.is_dir():
            with replacing_folder(folder) as made:
                _write(tables, made, skip=skip)
    except OSError as error:
        if isinstance(error, DatarootError) or not folder.is_dir():  # else another process has just made the same
            raise
    release = NuScenesRelease(tables.parent, tables.name, folder)
    for problem in release.problems:
        logger.warning("left out %s: %s", problem.scenario, " | ".join(problem.messages))
    return release


def release_of(nusc: Any, index_dir: Path | None = None) -> NuScenesRelease:
    """Open the tables of a `nuscenes.NuScenes`; raises as `open_nuscenes` does."""
    return open_nuscenes(nusc.table_root, index_dir)


def _kept_in(tables: Path, index_dir: Path | None, *, skip: bool) -> Path:
    """Where the tables made of these are kept, or will be: another folder for each content."""
    key = hashlib.blake2b(f"{__version__} {SCHEMA_VERSION} {_FORMAT} {skip}".encode(), digest_size=8)
    for path in sorted(tables.glob("*.json")):
        state = path.lstat()
        key.update(os.fsencode(path.name) + f" {state.st_size} {state.st_mtime_ns} {state.st_ctime_ns} ".encode())
    places = [place / tables.name / key.hexdigest() for place in index_places(tables.parent, index_dir)]
    return next((each for each in places if each.is_dir() or is_writable_folder(each.parent)), places[-1])


def _write(folder: Path, made: Path, *, skip: bool) -> None:
    """Make the tables of all scenes, or with `skip` of those that are not damaged."""
    import pyarrow as pa

    tables, splits = Tables(folder), _splits(folder)
    split_of: list[str | None] = []
    files: list[tuple[Any, ...]] = []
    problems: list[Problem] = []
    first = 0
    for scene in _scenes(tables, problems if skip else None):
        for name, rows in zip(_SETS, scene.tables.values(), strict=True):
            (made / f"{len(split_of)}.{name}").write_bytes(rows_to_keep(rows, ""))
        files += [(first * len(CHANNELS) + place, *others) for place, *others in scene.files()]
        first += scene.frames
        split_of.append(splits.get(scene.name))
    if not split_of:
        raise DatarootError(problems[0].messages[0] if problems else f"{folder}: has no scenes; {REMEDY}")
    for name in _SETS:
        kept = [made / f"{number}.{name}" for number in range(len(split_of))]
        (made / name).mkdir()
        join_tables(made / name, kept, split_of)
        for path in kept:
            path.unlink()
    (made / _PROBLEMS).write_text(json.dumps([asdict(problem) for problem in problems]), encoding="utf-8")
    table = pa.table(list(zip(*files, strict=True)), names=["row", "filename", "token", "matrix"])
    with pa.OSFile(str(made / _FILES), "wb") as file, pa.ipc.new_file(file, table.schema) as writer:
        writer.write_table(table)


def _scenes(tables: Tables, problems: list[Problem] | None) -> Iterator[SceneTables]:
    """The scenes in the table's order; with a list of problems, damaged ones are noted there and left out."""
    names = set()
    for token in tables.entries["scene"]:
        try:
            scene = SceneTables(tables, token)
            if scene.name in names:
                raise tables.error(scene.row, "name: another scene has it, too")
        except DatarootError as error:  # noqa: PERF203 - which scene it is
            if problems is None:
                raise
            problems.append(Problem(scenario=token, messages=(str(error),)))
        else:
            names.add(scene.name)
            yield scene


def _splits(folder: Path) -> dict[str, str]:
    """Scene → split: nuScenes' own, of the small version its two, or those of the tables' `splits.json`."""
    listed = folder / "splits.json"
    is_own = os.path.lexists(listed)  # a link to nothing is refused, too
    named = read_table(listed, dict[str, list[str]]) if is_own else _official_splits(folder)
    small = "mini_" if "mini" in folder.name else ""
    splits: dict[str, str] = {}
    for split in SPLITS:
        for scene in chain(named.get(f"{small}{split}", ()), named.get(f"deepaccident_{split}", ())):
            if splits.setdefault(scene, split) != split:
                raise DatarootError(
                    f"{listed}: {shortened(scene)} is in {splits[scene]} and in {split}; remove it from one"
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
