"""The folder of label files, its manifest, and the arrays of one sample."""

from __future__ import annotations

import io
import json
import os
import re
import zipfile
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Final, get_args

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
from deepaccident_devkit.support.text import path_of
from deepaccident_devkit.taxonomy import AGENTS

LABEL_FORMAT: Final = "DeepAccident motion labels"
LABEL_FORMAT_VERSION: Final = 1
"""Version of the format.

It increases when the files' contents change, or the labels of the same configuration and release.
"""
MANIFEST: Final = "manifest.json"
NO_CELL: Final = -32768
"""Centre and flow of an instance that a frame does not show."""
NO_ACTOR: Final = -(2**63)
"""Actor of an id that belongs to no actor.

These are the id of the background, and ids of untracked rows if each row is an instance of its own.
"""
# The smallest date of a zip entry.
_ZIP_EPOCH: Final = (1980, 1, 1, 0, 0, 0)
# The maps of a sample take at least this memory.
_MIN_BYTES_PER_CELL: Final = 16
_STORE_FOLDER: Final = ".unfinished"
_LABEL_FILE_PATTERN: Final = re.compile(rf"{re.escape(MANIFEST)}|({'|'.join(AGENTS)}|\d{{3}})\.npz")
_RECORDING_PATTERN: Final = re.compile(
    rf"(?!\.)[^/\\\0]{{1,255}}/(?!\.)[^/\\\0]{{1,255}}/({'|'.join(AGENTS)})"
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StoredLabels(ShortRepr):
    """Arrays of one sample, in the configuration's orientation, with ids up to K.

    Attributes:
        instance: Instance ids, shape (T, H, W), uint8 or uint16; 0 in missing frames.
        center: Row and column of each instance's centre, shape (T, 1 + K, 2), int16; `NO_CELL` if
            the frame does not show the instance.
        flow: Rows and columns that each instance moves up to the next frame, shape (T, 1 + K, 2),
            int16; `NO_CELL` if unknown.
        actor: Actor ids, shape (1 + K,), int64; `NO_ACTOR` without one, −101 for the ego's own box,
            and −1 for all untracked rows if they are one instance.
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
        """Return the stored arrays of labels with each frame in its own ego frame."""
        instance = labels.instance
        cells = labels.config.grid.cells
        if not labels.label_valid.all():
            instance = np.where(labels.label_valid[:, None, None], instance, 0)
        flat = np.flatnonzero(instance != 0)
        identity = instance.reshape(-1)[flat]
        max_id = max(int(identity.max(initial=0)), *labels.id_map.values(), 0)
        num_ids = 1 + max_id
        # All cells of an instance have the same centre and flow: one cell is enough.
        sample_cells = np.full(len(instance) * num_ids, -1)
        sample_cells[flat // cells * num_ids + identity] = flat
        visible = np.flatnonzero(sample_cells >= 0)
        frame, cell = np.divmod(sample_cells[visible], cells)
        row, column = np.divmod(cell, instance.shape[2])
        center = np.full((len(instance), num_ids, 2), NO_CELL, dtype=np.int16)
        flow = center.copy()
        positions = np.stack([row, column], axis=1)
        center.reshape(-1, 2)[visible] = positions + labels.offset[frame, :, row, column]
        vectors = labels.flow[frame, :, row, column]
        known = (vectors != labels.config.ignore_index).any(axis=1)
        flow.reshape(-1, 2)[visible[known]] = vectors[known]
        actor = np.full(num_ids, NO_ACTOR, dtype=np.int64)
        actor[list(labels.id_map.values())] = list(labels.id_map)
        return cls(
            instance=instance.astype(np.uint8 if max_id < 256 else np.uint16),
            center=center,
            flow=flow,
            actor=actor,
            future_egomotion=labels.future_egomotion,
            valid=labels.valid,
        )

    def labels(self, config: MotionLabelConfig) -> MotionLabels:
        """Return the labels with all their maps.

        Raises GeometryError if the arrays do not fit the configuration.
        """
        self._check(config)
        shape = config.grid.shape
        orientation = config.grid.orientation
        native = config.rules.native
        flat = np.flatnonzero(self.instance)
        frame, cell = np.divmod(flat, config.grid.cells)
        row, column = cells_in(cell // shape[1], cell % shape[1], shape, orientation, native)
        identity: IntArray = self.instance.reshape(-1)[flat].astype(np.int64)
        covered = CoveredCells(
            frame=frame,
            row=row,
            column=column,
            identity=identity,
            frames=len(self.instance),
            ids=len(self.actor) - 1,
        )
        center = _with_nan(self.center)
        flow = _with_nan(self.flow)
        native_center = cells_in(center[..., 0], center[..., 1], shape, orientation, native)
        center = np.stack(native_center, axis=-1)
        flow = np.stack(vectors_in(flow[..., 0], flow[..., 1], orientation, native), axis=-1)
        missing = ~self.valid[config.receptive_field - 1 :]
        maps = label_maps(covered, center, center + flow, missing, config)
        known = np.flatnonzero(self.actor != NO_ACTOR)
        id_map = dict(zip(self.actor[known].tolist(), known.tolist(), strict=True))
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
        """Read the arrays of a folder of an archive.

        Raises the errors of zipfile and numpy for damaged archives.
        """
        arrays = {}
        for field in fields(cls):
            arrays[field.name] = read_array(archive, f"{folder}/{field.name}", "motion_labels")
        return cls(**arrays)


def _with_nan(table: AnyArray) -> AnyArray:
    """Return a table of cells as float32, with NaN instead of `NO_CELL`."""
    return np.where(table == NO_CELL, np.float32(np.nan), table.astype(np.float32))


def write_array(archive: zipfile.ZipFile, name: str, array: AnyArray) -> None:
    """Write `<name>.npy` into an archive that numpy can load.

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
        names: Code that the batches are for; None for the devkit's own label files.
    """

    config: MotionLabelConfig
    samples: dict[str, list[int]]
    names: BatchNames | None = None

    @classmethod
    def of(
        cls, root: Path, config: MotionLabelConfig, names: BatchNames | None = None
    ) -> LabelManifest:
        """Return the manifest of a folder to write labels into; changes nothing.

        Args:
            root: The folder.
            config: Configuration of the labels to write.
            names: Code to write batches for, or None.

        Raises:
            ConfigError: The folder holds labels of another configuration, or with other names.
            LabelFilesError: The folder holds something else, is a file, or cannot be read.
        """
        try:
            if root.exists() and not root.is_dir():
                raise LabelFilesError(f"{root}: is a file; give a folder")
            # List the files before looking for the manifest: concurrent calls write it first.
            file_names = [path.name for path in root.iterdir()] if root.is_dir() else []
            if (root / MANIFEST).exists():
                manifest = cls.read(root)
                manifest.check(root, config, names)
                return manifest
            if not all(map(_is_own_file, file_names)):
                raise LabelFilesError(
                    f"{root}: is not empty and holds no motion labels; choose a new folder"
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
        """Read the manifest of a folder; raises LabelFilesError."""
        path = root / MANIFEST
        if not path.exists():
            raise LabelFilesError(
                f"{root}: holds no motion labels (no {MANIFEST}); "
                "make them with `deepaccident labels`"
            )
        try:
            payload = parsed_json(read_bytes(path, "bundle"))
            _check_version(path, payload["format"], payload["version"])
            config = MotionLabelConfig.from_dict(payload["config"])
            samples = _checked_samples(payload["samples"])
            names = payload.get("names")  # absent in folders of 0.1
            if names not in (None, *get_args(BatchNames)):
                known_names = ", ".join(get_args(BatchNames))
                raise ValueError(f"names: expected one of {known_names}, or null, found {names!r}")
            if config.digest != payload["config_digest"]:
                raise ValueError("its digest is not that of its configuration")
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
        """Raise ConfigError with the differences to another configuration or other names."""
        stored = _flat({**self.config.as_dict(), "names": self.names})
        requested = _flat({**config.as_dict(), "names": names})
        differences = []
        for name in sorted({*stored, *requested}):
            stored_value = stored.get(name)
            requested_value = requested.get(name)
            if stored_value != requested_value:
                differences.append(f"{name}: {stored_value!r}, asked for {requested_value!r}")
        if differences:
            raise ConfigError(
                f"{root}: holds labels of another configuration ({'; '.join(differences)}); "
                "choose another folder"
            )

    def write(self, root: Path) -> None:
        """Write the manifest into its folder."""
        text = json.dumps(
            {
                "format": LABEL_FORMAT,
                "version": LABEL_FORMAT_VERSION,
                "config_digest": self.config.digest,
                "config": self.config.as_dict(),
                "names": self.names,
                "samples": dict(sorted(self.samples.items())),
            },
            indent=1,
        )
        with_short_lists = re.sub(r"\[[^][{}]*\]", lambda match: " ".join(match[0].split()), text)
        write_bytes(root / MANIFEST, f"{with_short_lists}\n".encode())


def label_store(root: Path, command: str) -> Store:
    """Return the store by which processes share the writing of labels into a folder.

    Args:
        root: The folder.
        command: Digest of the labels to write.
    """
    folder = place_in(root, _STORE_FOLDER, opened=True)
    return Store(folder, root, "writes labels", LabelFilesError, command)


def folder_path(folder: str | os.PathLike[str]) -> Path:
    """Return the absolute path of a folder; raises LabelFilesError if it is no path."""
    return path_of(folder, "expected a folder of motion labels", error=LabelFilesError).absolute()


def label_path(root: Path, recording: str) -> Path:
    """Return the label file of a scenario and agent."""
    return root / f"{recording}.npz"


def batch_path(root: Path, recording: str, frame: int) -> Path:
    """Return the file of a sample in the names of another code."""
    return root / recording / f"{frame:03d}.npz"


def remove_half_written(root: Path) -> None:
    """Remove the temporary files of stopped processes, on any host.

    Files that cannot be removed stay. No other process may use the store in the meantime.
    """
    for folder, _, names in os.walk(root):  # follows no link
        for name in filter(_is_half_written, names):
            with suppress(OSError):
                Path(folder, name).unlink()


def _is_own_file(name: str) -> bool:
    """Return whether a call may have written a file of this name before or with the manifest."""
    return name in (_STORE_FOLDER, MANIFEST) or _is_half_written(name)


def _is_half_written(name: str) -> bool:
    """Return whether a name is that of a temporary file of labels."""
    return _LABEL_FILE_PATTERN.fullmatch(temporary_of(name) or "") is not None


def _check_version(path: Path, form: object, version: object) -> None:
    """Raise ValueError for another format, LabelFilesError for another version of it."""
    if form != LABEL_FORMAT or not isinstance(version, int):
        raise ValueError(
            f"expected a manifest of {LABEL_FORMAT}, found one of {form!r}, version {version!r}"
        )
    if version != LABEL_FORMAT_VERSION:
        if version > LABEL_FORMAT_VERSION:
            age, remedy = "a newer", "update the devkit, or"
        else:
            age, remedy = "an older", "use that devkit, or"
        raise LabelFilesError(
            f"{path}: {age} devkit's labels (format version {version}, this devkit's is "
            f"{LABEL_FORMAT_VERSION}); {remedy} make the labels again in an empty folder"
        )


def _checked_samples(samples: Mapping[str, Any]) -> dict[str, list[int]]:
    """Return scenario and agent → frame numbers; raises ValueError."""
    for recording, frames in samples.items():
        valid = _RECORDING_PATTERN.fullmatch(recording) and isinstance(frames, list)
        if not valid or not all(type(frame) is int and frame > 0 for frame in frames):
            raise ValueError(
                f"samples of {shortened(recording)!r}: expected a scenario, agent and frame numbers"
            )
    return {recording: list(frames) for recording, frames in samples.items()}


def _flat(description: Mapping[str, Any]) -> dict[str, Any]:
    """Return a configuration's description, with its protocol's options as settings."""
    return {**description, **description["protocol"], "protocol": None}
