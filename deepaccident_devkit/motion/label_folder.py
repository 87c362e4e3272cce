"""The folder of label files, its manifest, and the arrays of one sample."""

from __future__ import annotations

import io
import json
import os
import re
import zipfile
from contextlib import suppress
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Final, get_args

import numpy as np

from deepaccident_devkit.errors import ConfigError, GeometryError, LabelFilesError, shortened
from deepaccident_devkit.geometry.bev_grid import cells_in, vectors_in
from deepaccident_devkit.motion.batch_names import BatchNames
from deepaccident_devkit.motion.config import MotionLabelConfig
from deepaccident_devkit.motion.drawing import CoveredCells, label_maps
from deepaccident_devkit.motion.labels import MotionLabels
from deepaccident_devkit.support.arrays import AnyArray, IntArray, ShortRepr, checked
from deepaccident_devkit.support.files import place_in, temporary_of, write_bytes
from deepaccident_devkit.support.json_text import parsed_json
from deepaccident_devkit.support.parallel import Store
from deepaccident_devkit.support.reading import check_size, fault_text, read_array, read_bytes
from deepaccident_devkit.support.text import PathType, path_of
from deepaccident_devkit.support.values import NamedValues, ReadOnlyValues
from deepaccident_devkit.taxonomy import AGENTS

LABEL_FORMAT: Final = "DeepAccident motion labels"
LABEL_FORMAT_VERSION: Final = 1
"""Version of the format.

It increases when the files' layout changes, or when the same configuration and release give other
labels.
"""
MANIFEST: Final = "manifest.json"
NO_CELL: Final = -32768
"""Stored as the centre and flow of an instance that is absent from a frame."""
NO_ACTOR: Final = -(2**63)
"""Stored as the actor of an id that belongs to no actor.

These are the background's id, and the ids of untracked rows if each row is an instance of its own.
"""
# The earliest date that a zip entry can have.
_ZIP_EPOCH = (1980, 1, 1, 0, 0, 0)
# The maps of a sample take at least this much memory.
_MIN_BYTES_PER_CELL = 16
_STORE_FOLDER = ".unfinished"
_LABEL_FILE_PATTERN = re.compile(rf"{re.escape(MANIFEST)}|({'|'.join(AGENTS)}|\d{{3}})\.npz")
_RECORDING_PATTERN = re.compile(
    rf"(?!\.)[^/\\\0]{{1,255}}/(?!\.)[^/\\\0]{{1,255}}/({'|'.join(AGENTS)})"
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StoredLabels(ShortRepr):
    """Stored arrays of one sample, in the configuration's orientation, with ids up to K.

    Attributes:
        instance: Instance ids, shape (T, H, W), uint8 or uint16; 0 in missing frames.
        center: Row and column of each instance's centre, shape (T, 1 + K, 2), int16; `NO_CELL` if
            the instance is absent from the frame.
        flow: Rows and columns by which each instance moves until the next frame, shape (T, 1 + K,
            2), int16; `NO_CELL` if unknown.
        actor: Actor id of each instance, shape (1 + K,), int64; `NO_ACTOR` if it has none, −101 for
            the ego's own box, −1 for all untracked rows if they are one instance.
        future_egomotion: Motion of the ego from each frame to the next, shape (R, 6), float32.
        valid: Whether each frame exists, shape (R,), bool.
    """

    instance: AnyArray
    center: AnyArray
    flow: AnyArray
    actor: AnyArray
    future_egomotion: AnyArray
    valid: AnyArray

    @classmethod
    def of(cls, labels: MotionLabels) -> StoredLabels:
        """Return the arrays to store for labels that have each frame in its own ego frame."""
        instance = labels.instance
        cells = labels.config.grid.cells
        if not labels.label_valid.all():
            instance = np.where(labels.label_valid[:, None, None], instance, 0)
        flat = np.flatnonzero(instance != 0)
        identity = instance.reshape(-1)[flat]
        max_id = max(int(identity.max(initial=0)), *labels.id_map.values(), 0)
        num_ids = 1 + max_id
        # All cells of an instance have the same centre and flow, so one cell is enough.
        instance_cells = np.full(len(instance) * num_ids, -1)
        instance_cells[flat // cells * num_ids + identity] = flat
        visible = np.flatnonzero(instance_cells >= 0)
        frame, cell = np.divmod(instance_cells[visible], cells)
        row, column = np.divmod(cell, instance.shape[2])
        center = np.full((len(instance), num_ids, 2), NO_CELL, dtype=np.int16)
        flow = center.copy()
        positions = np.stack([row, column], axis=1)
        offsets = labels.offset[frame, :, row, column]
        center.reshape(-1, 2)[visible] = positions + offsets
        vectors = labels.flow[frame, :, row, column]
        known = (vectors != labels.config.ignore_index).any(axis=1)
        flow.reshape(-1, 2)[visible[known]] = vectors[known]
        actor = np.full(num_ids, NO_ACTOR, dtype=np.int64)
        for actor_id, label_id in labels.id_map.items():
            actor[label_id] = actor_id
        id_dtype = np.uint8 if max_id < 256 else np.uint16
        return cls(
            instance=instance.astype(id_dtype),
            center=center,
            flow=flow,
            actor=actor,
            future_egomotion=labels.future_egomotion,
            valid=labels.valid,
        )

    def labels(self, config: MotionLabelConfig) -> MotionLabels:
        """Return the labels with all their maps.

        Raise GeometryError if the arrays do not fit the configuration.
        """
        self._check(config)
        shape = config.grid.shape
        orientation = config.grid.orientation
        native = config.rules.native
        flat = np.flatnonzero(self.instance)
        frame, cell = np.divmod(flat, config.grid.cells)
        row, column = np.divmod(cell, shape[1])
        row, column = cells_in(row, column, shape, orientation, native)
        identity: IntArray = self.instance.reshape(-1)[flat].astype(np.int64)
        covered = CoveredCells(
            frame=frame,
            row=row,
            column=column,
            identity=identity,
            frames=len(self.instance),
            ids=len(self.actor) - 1,
        )
        center_row, center_column = _replace_no_cell(self.center)
        flow_row, flow_column = _replace_no_cell(self.flow)
        native_center = cells_in(center_row, center_column, shape, orientation, native)
        native_flow = vectors_in(flow_row, flow_column, orientation, native)
        center = np.stack(native_center, axis=-1)
        next_center = center + np.stack(native_flow, axis=-1)
        missing = ~self.valid[config.receptive_field - 1 :]
        maps = label_maps(covered, center, next_center, missing, config)
        id_map = {}
        for label_id, actor_id in enumerate(self.actor.tolist()):
            if actor_id != NO_ACTOR:
                id_map[actor_id] = label_id
        return maps.labels(config, self.future_egomotion, self.valid, id_map)

    def _check(self, config: MotionLabelConfig) -> None:
        """Raise GeometryError if the arrays do not fit the configuration."""
        frames = config.label_frames
        ids = len(self.actor)
        checked("instance", self.instance, (frames, *config.grid.shape), self.instance.dtype)
        for name in ("center", "flow"):
            checked(name, getattr(self, name), (frames, ids, 2), np.int16)
        checked("future_egomotion", self.future_egomotion, (config.frames, 6), np.float32)
        checked("valid", self.valid, (config.frames,), np.bool_)
        if self.instance.max() >= ids:
            raise GeometryError(f"instance: expected ids below {ids}, found {self.instance.max()}")

    def write(self, archive: zipfile.ZipFile, folder: str) -> None:
        """Write the arrays into an archive, as `<folder>/<name>.npy`."""
        for field in fields(self):
            write_array(archive, f"{folder}/{field.name}", getattr(self, field.name))

    @classmethod
    def read(cls, archive: zipfile.ZipFile, folder: str) -> StoredLabels:
        """Read the arrays from a folder of an archive.

        Damaged archives raise the errors of zipfile and numpy.
        """
        arrays = {}
        for field in fields(cls):
            name = f"{folder}/{field.name}"
            arrays[field.name] = read_array(archive, name, "motion_labels")
        return cls(**arrays)


def _replace_no_cell(table: AnyArray) -> AnyArray:
    """Split a table (T, 1 + K, 2) into rows and columns, shape (2, T, 1 + K), float32.

    Values are NaN where the table has `NO_CELL`.
    """
    values = table.astype(np.float32)
    is_missing = table == NO_CELL
    values[is_missing] = np.nan
    return np.moveaxis(values, -1, 0)


def write_array(archive: zipfile.ZipFile, name: str, array: AnyArray) -> None:
    """Write `<name>.npy` into an archive, which numpy can then load.

    The bytes do not depend on the date.
    """
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, np.asarray(array, order="C"), allow_pickle=False)
    entry = zipfile.ZipInfo(f"{name}.npy", _ZIP_EPOCH)
    entry.external_attr = 0o644 << 16
    archive.writestr(entry, buffer.getvalue(), zipfile.ZIP_DEFLATED, compresslevel=1)


@dataclass(frozen=True, slots=True)
class LabelManifest:
    """The manifest of a folder of labels.

    Attributes:
        config: Configuration of the labels.
        samples: Scenario and agent → numbers of the frames with complete labels; empty until the
            first call that writes into the folder has finished.
        names: Code base whose key names the batches use; None for the devkit's own label files.
    """

    config: MotionLabelConfig
    samples: dict[str, list[int]]
    names: BatchNames | None = None

    @classmethod
    def of(
        cls, root: Path, config: MotionLabelConfig, names: BatchNames | None = None
    ) -> LabelManifest:
        """Return the manifest for a folder that labels will be written into; nothing is changed.

        Args:
            root: The folder.
            config: Configuration of the labels to write.
            names: Code base whose key names the batches use; None for the devkit's own label files.

        Raises:
            ConfigError: The folder holds labels made with another configuration, or batches with
                other names.
            LabelFilesError: The folder holds something other than labels, is a file, or cannot be
                read.
        """
        try:
            if root.exists() and not root.is_dir():
                raise LabelFilesError(f"{root}: is a file; give a folder")
            # List the files before looking for the manifest: concurrent calls write it first.
            file_names = []
            if root.is_dir():
                file_names = [path.name for path in root.iterdir()]
            if (root / MANIFEST).exists():
                manifest = cls.read(root)
                manifest.check(root, config, names)
                return manifest
            if not all(map(_is_own_file, file_names)):
                raise LabelFilesError(
                    f"{root}: is not empty and contains no motion labels; choose a new folder"
                )
        except OSError as error:
            if isinstance(error, LabelFilesError):
                raise
            raise LabelFilesError(
                f"{root}: cannot be read ({error}); choose another folder"
            ) from error
        return cls(config, {}, names)

    @classmethod
    def read(cls, root: Path) -> LabelManifest:
        """Read a folder's manifest; raise LabelFilesError if it is missing or not valid."""
        path = root / MANIFEST
        if not path.exists():
            raise LabelFilesError(
                f"{root}: contains no motion labels (no {MANIFEST}); "
                "make them with `deepaccident labels`"
            )
        try:
            payload = parsed_json(read_bytes(path, "bundle"))
            _check_version(path, payload["format"], payload["version"])
            config = MotionLabelConfig.from_dict(payload["config"])
            samples = _check_samples(payload["samples"])
            names = payload.get("names")  # absent in folders of 0.1
            if names not in (None, *get_args(BatchNames)):
                known_names = ", ".join(get_args(BatchNames))
                raise ValueError(f"names: expected one of {known_names}, or null, found {names!r}")
            if config.digest != payload["config_digest"]:
                raise ValueError("its digest does not match its configuration")
            num_cells = config.grid.cells * config.label_frames
            check_size(num_cells * _MIN_BYTES_PER_CELL, "motion_labels", "a sample")
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            if isinstance(error, LabelFilesError):
                raise
            if isinstance(error, OSError):
                message = fault_text(error)
            else:
                message = f"cannot be read ({shortened(str(error), 600)})"
            raise LabelFilesError(
                f"{path}: {message}; make the labels again in an empty folder"
            ) from error
        return cls(config, samples, names)

    def check(self, root: Path, config: MotionLabelConfig, names: BatchNames | None = None) -> None:
        """Raise a ConfigError that lists the differences unless configuration and names match."""
        stored = _list_settings(self.config, self.names)
        requested = _list_settings(config, names)
        differences = []
        for name in sorted({*stored, *requested}):
            stored_value = stored.get(name)
            requested_value = requested.get(name)
            if stored_value != requested_value:
                differences.append(f"{name}: {stored_value!r}, asked for {requested_value!r}")
        if differences:
            raise ConfigError(
                f"{root}: contains labels with other settings ({'; '.join(differences)}); "
                "choose another folder"
            )

    def write(self, root: Path) -> None:
        """Write the manifest into its folder."""
        manifest = {
            "format": LABEL_FORMAT,
            "version": LABEL_FORMAT_VERSION,
            "config_digest": self.config.digest,
            "config": self.config.as_dict(),
            "names": self.names,
            "samples": dict(sorted(self.samples.items())),
        }
        text = json.dumps(manifest, indent=1)
        text = re.sub(r"\[[^][{}]*\]", _join_lines, text)
        write_bytes(root / MANIFEST, f"{text}\n".encode())


def _join_lines(match: re.Match[str]) -> str:
    """Join the lines of a matched text into one."""
    return " ".join(match[0].split())


def label_store(root: Path, command: str) -> Store:
    """Return the store through which processes share the work of writing labels into a folder.

    Args:
        root: The folder.
        command: Digest of the labels to write.
    """
    folder = place_in(root, _STORE_FOLDER, opened=True)
    return Store(folder, root, "is writing labels", LabelFilesError, command)


def folder_path(folder: PathType) -> Path:
    """Return the absolute path of a folder; raise LabelFilesError if it is not a path."""
    path = path_of(folder, "expected a folder of motion labels", error=LabelFilesError)
    return path.absolute()


def label_path(root: Path, recording: str) -> Path:
    """Return the path of the label file of a scenario and agent."""
    return root / f"{recording}.npz"


def batch_path(root: Path, recording: str, frame: int) -> Path:
    """Return the path of a sample's batch, written with another code base's key names."""
    name = f"{frame:03d}.npz"
    return root / recording / name


def remove_half_written(root: Path) -> None:
    """Remove the temporary files that stopped processes on any host left.

    Files that cannot be removed are left in place. No other process may use the store meanwhile.
    """
    for folder, _, names in os.walk(root):  # does not follow links
        for name in filter(_is_half_written, names):
            with suppress(OSError):
                Path(folder, name).unlink()


def _is_own_file(name: str) -> bool:
    """Return whether a call may have written this file before or along with the manifest."""
    if name in (_STORE_FOLDER, MANIFEST):
        return True
    return _is_half_written(name)


def _is_half_written(name: str) -> bool:
    """Return whether this is the name of a temporary label file."""
    final_name = temporary_of(name)
    return final_name is not None and _LABEL_FILE_PATTERN.fullmatch(final_name) is not None


def _check_version(path: Path, file_format: object, version: object) -> None:
    """Raise ValueError for another format, and LabelFilesError for another version of it."""
    if file_format != LABEL_FORMAT or not isinstance(version, int):
        raise ValueError(
            f"expected a manifest of {LABEL_FORMAT}, found one of {file_format!r}, version "
            f"{version!r}"
        )
    if version != LABEL_FORMAT_VERSION:
        age = "an older"
        remedy = "use that devkit, or"
        if version > LABEL_FORMAT_VERSION:
            age = "a newer"
            remedy = "update the devkit, or"
        raise LabelFilesError(
            f"{path}: {age} devkit's labels (format version {version}, this devkit's is "
            f"{LABEL_FORMAT_VERSION}); {remedy} make the labels again in an empty folder"
        )


def _check_samples(samples: ReadOnlyValues) -> dict[str, list[int]]:
    """Return scenario and agent → frame numbers; raise ValueError if a value is not such a list."""
    for recording, frames in samples.items():
        is_valid = _RECORDING_PATTERN.fullmatch(recording) and isinstance(frames, list)
        if not is_valid or not all(type(frame) is int and frame > 0 for frame in frames):
            raise ValueError(
                f"samples of {shortened(recording)!r}: expected a scenario, agent and frame numbers"
            )
    return dict(samples)


def _list_settings(config: MotionLabelConfig, names: BatchNames | None) -> NamedValues:
    """Return a configuration's settings, including its protocol's, and the code base's name."""
    settings = config.as_dict()
    settings.update(settings["protocol"])
    settings.update(protocol=None, names=names)
    return settings
