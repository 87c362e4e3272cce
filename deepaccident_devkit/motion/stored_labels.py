"""The stored part of one sample's motion labels, from which all maps are made again (schema/motion_labels.md)."""

from __future__ import annotations

import io
import zipfile
from dataclasses import dataclass, fields
from typing import Final

import numpy as np

from deepaccident_devkit.archives import read_array
from deepaccident_devkit.arrays import AnyArray, IntArray, ShortRepr, checked
from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.motion.config import MotionLabelConfig
from deepaccident_devkit.motion.drawing.label_maps import CoveredCells, label_maps
from deepaccident_devkit.motion.labels import MotionLabels
from deepaccident_devkit.motion.orientations import cells_in, vectors_in

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
        center.reshape(-1, 2)[shown] = np.stack([row, column], axis=1) + labels.offset[frame, :, row, column]
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
            frame=frame, row=row, column=column, identity=identity, frames=len(self.instance), ids=len(self.actor) - 1
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
        return MotionLabels(
            config=config,
            segmentation=maps.segmentation,
            instance=maps.instance,
            centerness=maps.centerness,
            offset=maps.offset,
            flow=maps.flow,
            future_egomotion=self.future_egomotion,
            valid=self.valid,
            id_map=dict(zip(self.actor[known].tolist(), known.tolist(), strict=True)),
        )

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
        names = [field.name for field in fields(cls)]
        return cls(**{name: read_array(archive, f"{folder}/{name}", "motion_labels") for name in names})


def write_array(archive: zipfile.ZipFile, name: str, array: AnyArray) -> None:
    """Add `<name>.npy` to an archive that numpy can load; the bytes do not depend on the date."""
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, np.asarray(array, order="C"), allow_pickle=False)
    entry = zipfile.ZipInfo(f"{name}.npy", _FIRST_DATE)
    entry.external_attr = 0o644 << 16
    archive.writestr(entry, buffer.getvalue(), zipfile.ZIP_DEFLATED, compresslevel=1)
