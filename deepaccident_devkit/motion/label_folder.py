"""The folder of label files, and one file of it."""

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

NOWHERE: Final = -32768
"""Centre and flow of an instance that a frame does not show."""
NOBODY: Final = -(2**63)
"""Actor of an id that is no actor's: the background's, and those of untracked rows that are each their own instance."""
_FIRST_DATE: Final = (1980, 1, 1, 0, 0, 0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StoredLabels(ShortRepr):
    """The arrays of one sample, in the configuration's orientation; K = highest id.

    Attributes:
        instance: (T, H, W) uint8 or uint16; 0 in missing frames.
        center: (T, 1 + K, 2) int16 row and column of each instance's centre, `NOWHERE` if the frame does not show it.
        flow: (T, 1 + K, 2) int16 rows and columns that it moves up to the next frame; `NOWHERE` if unknown.
        actor: (1 + K,) int64 actor ids, `NOBODY` without one; −101 for the ego's own box, and −1 for all untracked
            rows where they are one instance.
        future_egomotion: (R, 6) float32.
        valid: (R,) bool.
    """

    instance: AnyArray
    center: AnyArray
    flow: AnyArray
    actor: AnyArray
    future_egomotion: AnyArray
    valid: AnyArray

    @classmethod
    def of(cls, labels: MotionLabels) -> StoredLabels:
        """The stored arrays of labels whose frames are in their own ego frames."""
        instance, cells = labels.instance, labels.config.grid.cells
        if not labels.label_valid.all():
            instance = np.where(labels.label_valid[:, None, None], instance, 0)
        flat = np.flatnonzero(instance != 0)
        identity = instance.reshape(-1)[flat]
        highest = max(int(identity.max(initial=0)), *labels.id_map.values(), 0)
        # all cells of an instance have the same centre and flow: one cell is enough
        one = np.full(len(instance) * (1 + highest), -1)
        one[flat // cells * (1 + highest) + identity] = flat
        shown = np.flatnonzero(one >= 0)
        frame, cell = np.divmod(one[shown], cells)
        row, column = np.divmod(cell, instance.shape[2])
        center = np.full((len(instance), 1 + highest, 2), NOWHERE, dtype=np.int16)
        flow = center.copy()
        center.reshape(-1, 2)[shown] = (
            np.stack([row, column], axis=1) + labels.offset[frame, :, row, column]
        )
        vectors = labels.flow[frame, :, row, column]
        known = (vectors != labels.config.ignore_index).any(axis=1)
        flow.reshape(-1, 2)[shown[known]] = vectors[known]
        actor = np.full(1 + highest, NOBODY, dtype=np.int64)
        actor[list(labels.id_map.values())] = list(labels.id_map)
        return cls(
            instance=instance.astype(np.uint8 if highest < 256 else np.uint16),
            center=center,
            flow=flow,
            actor=actor,
            future_egomotion=labels.future_egomotion,
            valid=labels.valid,
        )

    def labels(self, config: MotionLabelConfig) -> MotionLabels:
        """The labels with all their maps; raises GeometryError if the arrays do not fit the configuration."""
        self._check(config)
        shape, given = config.grid.shape, config.grid.orientation
        native = config.rules.native
        flat = np.flatnonzero(self.instance)
        frame, cell = np.divmod(flat, config.grid.cells)
        row, column = cells_in(cell // shape[1], cell % shape[1], shape, given, native)
        identity: IntArray = self.instance.reshape(-1)[flat].astype(np.int64)
        covered = CoveredCells(
            frame=frame,
            row=row,
            column=column,
            identity=identity,
            frames=len(self.instance),
            ids=len(self.actor) - 1,
        )
        center, flow = (
            np.where(table == NOWHERE, np.float32(np.nan), table.astype(np.float32))
            for table in (self.center, self.flow)
        )
        center = np.stack(cells_in(center[..., 0], center[..., 1], shape, given, native), axis=-1)
        flow = np.stack(vectors_in(flow[..., 0], flow[..., 1], given, native), axis=-1)
        missing = ~self.valid[config.receptive_field - 1 :]
        maps = label_maps(covered, center, center + flow, missing, config)
        known = np.flatnonzero(self.actor != NOBODY)
        id_map = dict(zip(self.actor[known].tolist(), known.tolist(), strict=True))
        return maps.labels(config, self.future_egomotion, self.valid, id_map)

    def _check(self, config: MotionLabelConfig) -> None:
        frames, ids = config.label_frames, len(self.actor)
        checked("instance", self.instance, (frames, *config.grid.shape), self.instance.dtype)
        for name in ("center", "flow"):
            checked(name, getattr(self, name), (frames, ids, 2), np.int16)
        checked("future_egomotion", self.future_egomotion, (config.frames, 6), np.float32)
        checked("valid", self.valid, (config.frames,), np.bool_)
        if self.instance.max() >= ids:
            raise GeometryError(f"instance: expected ids below {ids}, found {self.instance.max()}")

    def write(self, archive: zipfile.ZipFile, folder: str) -> None:
        """Add the arrays to an archive, as `<folder>/<name>.npy`."""
        for field in fields(self):
            write_array(archive, f"{folder}/{field.name}", getattr(self, field.name))

    @classmethod
    def read(cls, archive: zipfile.ZipFile, folder: str) -> StoredLabels:
        """The arrays of a folder of an archive; raises what zipfile and numpy raise for damaged ones."""
        return cls(
            **{
                each.name: read_array(archive, f"{folder}/{each.name}", "motion_labels")
                for each in fields(cls)
            }
        )


def write_array(archive: zipfile.ZipFile, name: str, array: AnyArray) -> None:
    """Add `<name>.npy` to an archive that numpy can load; the bytes do not depend on the date."""
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, np.asarray(array, order="C"), allow_pickle=False)
    entry = zipfile.ZipInfo(f"{name}.npy", _FIRST_DATE)
    entry.external_attr = 0o644 << 16
    archive.writestr(entry, buffer.getvalue(), zipfile.ZIP_DEFLATED, compresslevel=1)


LABEL_FORMAT: Final = "DeepAccident motion labels"
LABEL_FORMAT_VERSION: Final = 1
"""Increased when the files' contents change, or the labels of the same configuration and release."""
MANIFEST: Final = "manifest.json"
# Of the maps of a sample, in memory, at least.
_CELL_BYTES: Final = 16
_UNFINISHED: Final = ".unfinished"
_WRITTEN: Final = re.compile(rf"{re.escape(MANIFEST)}|({'|'.join(AGENTS)}|\d{{3}})\.npz")
_RECORDING: Final = re.compile(
    rf"(?!\.)[^/\\\0]{{1,255}}/(?!\.)[^/\\\0]{{1,255}}/({'|'.join(AGENTS)})"
)


@dataclass(frozen=True, slots=True)
class LabelManifest:
    """The manifest of a folder of labels.

    Attributes:
        config: what its labels show.
        samples: scenario and agent → numbers of the frames whose labels are there for sure; none until the first call
            that writes there has finished.
        names: the code whose batches they are; None for the devkit's own label files.
    """

    config: MotionLabelConfig
    samples: dict[str, list[int]]
    names: BatchNames | None = None

    @classmethod
    def of(
        cls, root: Path, config: MotionLabelConfig, names: BatchNames | None = None
    ) -> LabelManifest:
        """The manifest of a folder into which labels of a configuration will be written; changes nothing.

        Raises:
            ConfigError: the folder holds labels of another configuration, or with other names.
            LabelFilesError: the folder holds something else, is a file, or cannot be read.
        """
        try:
            if root.exists() and not root.is_dir():
                raise LabelFilesError(f"{root}: is a file; give a folder")
            # before the manifest is looked for: other calls, which may be at work, write it first
            there = [path.name for path in root.iterdir()] if root.is_dir() else []
            if (root / MANIFEST).exists():
                manifest = cls.read(root)
                manifest.check(root, config, names)
                return manifest
            if not all(map(_is_own, there)):
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
        """The manifest that a folder has; raises LabelFilesError."""
        path = root / MANIFEST
        if not path.exists():
            raise LabelFilesError(
                f"{root}: holds no motion labels (no {MANIFEST}); make them with `deepaccident labels`"
            )
        try:
            told = parsed_json(read_bytes(path, "bundle"))
            _check_version(path, told["format"], told["version"])
            config, samples = MotionLabelConfig.from_dict(told["config"]), _samples(told["samples"])
            names = told.get("names")  # absent in folders of 0.1
            if names not in (None, *get_args(BatchNames)):
                raise ValueError(
                    f"names: expected one of {', '.join(get_args(BatchNames))}, or null, found {names!r}"
                )
            if config.digest != told["config_digest"]:
                raise ValueError("its digest is not that of its configuration")
            check_size(
                config.grid.cells * config.label_frames * _CELL_BYTES, "motion_labels", "a sample"
            )
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            if isinstance(error, LabelFilesError):
                raise
            told = (
                fault_text(error)
                if isinstance(error, OSError)
                else f"cannot be read ({shortened(str(error), 600)})"
            )
            raise LabelFilesError(
                f"{path}: {told}; make the labels again in an empty folder"
            ) from error
        return cls(config, samples, names)

    def check(self, root: Path, config: MotionLabelConfig, names: BatchNames | None = None) -> None:
        """Refuse another configuration or other names; raises ConfigError that says what differs."""
        mine, others = (
            _flat({**one.as_dict(), "names": own})
            for one, own in ((self.config, self.names), (config, names))
        )
        changed = sorted(name for name in {*mine, *others} if mine.get(name) != others.get(name))
        if changed:
            text = "; ".join(
                f"{name}: {mine.get(name)!r}, asked for {others.get(name)!r}" for name in changed
            )
            raise ConfigError(
                f"{root}: holds labels of another configuration ({text}); choose another folder"
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
        lists_in_a_line = re.sub(r"\[[^][{}]*\]", lambda found: " ".join(found[0].split()), text)
        write_bytes(root / MANIFEST, f"{lists_in_a_line}\n".encode())


def label_store(root: Path, command: str) -> Store:
    """What keeps others from writing the same labels into a folder; `command` says which labels are written."""
    return Store(
        place_in(root, _UNFINISHED, opened=True), root, "writes labels", LabelFilesError, command
    )


def folder_path(folder: str | os.PathLike[str]) -> Path:
    """The absolute path of a given folder; raises LabelFilesError if it is no path."""
    return path_of(folder, "expected a folder of motion labels", error=LabelFilesError).absolute()


def label_path(root: Path, recording: str) -> Path:
    """The label file of a scenario and agent."""
    return root / f"{recording}.npz"


def batch_path(root: Path, recording: str, frame: int) -> Path:
    """The file of a sample in the names of another code."""
    return root / recording / f"{frame:03d}.npz"


def remove_half_written(root: Path) -> None:
    """Remove the temporary files of stopped processes, on whatever host; what cannot be removed stays.

    The caller has the store alone.
    """
    for folder, _, names in os.walk(root):  # follows no link
        for name in filter(_is_half_written, names):
            with suppress(OSError):
                Path(folder, name).unlink()


def _is_own(name: str) -> bool:
    """Whether a call may have made a file of this name before it wrote a manifest, or has written it just now."""
    return name in (_UNFINISHED, MANIFEST) or _is_half_written(name)


def _is_half_written(name: str) -> bool:
    return _WRITTEN.fullmatch(temporary_of(name) or "") is not None


def _check_version(path: Path, form: object, version: object) -> None:
    if form != LABEL_FORMAT or not isinstance(version, int):
        raise ValueError(
            f"expected a manifest of {LABEL_FORMAT}, found one of {form!r}, version {version!r}"
        )
    if version != LABEL_FORMAT_VERSION:
        kind, remedy = (
            ("a newer", "update the devkit, or")
            if version > LABEL_FORMAT_VERSION
            else ("an older", "use that devkit, or")
        )
        raise LabelFilesError(
            f"{path}: {kind} devkit's labels (format version {version}, this devkit's is {LABEL_FORMAT_VERSION}); "
            f"{remedy} make the labels again in an empty folder"
        )


def _samples(read: Mapping[str, Any]) -> dict[str, list[int]]:
    """Scenario and agent → frame numbers; raises ValueError."""
    for recording, frames in read.items():
        good = _RECORDING.fullmatch(recording) and isinstance(frames, list)
        if not good or not all(type(frame) is int and frame > 0 for frame in frames):
            raise ValueError(
                f"samples of {shortened(recording)!r}: expected a scenario, agent and frame numbers"
            )
    return {recording: list(frames) for recording, frames in read.items()}


def _flat(described: Mapping[str, Any]) -> dict[str, Any]:
    """A configuration's description with the switches of its protocol beside the other settings."""
    return {**described, **described["protocol"], "protocol": None}
