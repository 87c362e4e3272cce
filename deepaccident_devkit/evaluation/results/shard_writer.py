"""Motion predictions into shards: one archive after another, so that memory holds one sample at a time."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Final

from deepaccident_devkit.arrays import AnyArray
from deepaccident_devkit.errors import ResultsError
from deepaccident_devkit.evaluation.predictions import MotionOutput
from deepaccident_devkit.evaluation.results.arrays_in_shards import put_array
from deepaccident_devkit.evaluation.results.form import RESULTS_FILE, MotionForm, Stored
from deepaccident_devkit.evaluation.results.header import Header
from deepaccident_devkit.evaluation.results.manifest import Shard
from deepaccident_devkit.evaluation.results.motion_arrays import head_arrays, instance_arrays
from deepaccident_devkit.files import file_checksum
from deepaccident_devkit.geometry import BevGrid

_MOST_SAMPLES: Final = 64
_MOST_BYTES: Final = 32 * 2**20


class ShardWriter:
    """Writes the folder of motion results, the manifest last."""

    def __init__(
        self, folder: Path, header: Header, *, grid: BevGrid | None, step: float, labels: str | None, store: Stored
    ) -> None:
        """Write into an empty folder; the other arguments are those of ResultsWriter."""
        self._folder, self._header = folder, header
        self._grid, self._step, self._labels, self._store = grid, step, labels, store
        self._frames = self._predictions = 0
        self._shards: list[Shard] = []
        self._archive: zipfile.ZipFile | None = None
        self._in_shard: list[str] = []
        (folder / "shards").mkdir()

    def add(self, token: str, prediction: object) -> None:
        """Write the prediction of a sample; raises ResultsError, and nothing of it is written then."""
        output = self._checked(prediction)
        arrays = self._arrays(output)
        predictions, frames = next(iter(arrays.values())).shape[:2]
        if self._frames not in (0, frames):
            raise ResultsError(f"expected {self._frames} frames as of the samples before, found {frames}")
        self._form(output.grid, predictions, frames)
        self._grid, self._frames = output.grid, frames
        self._predictions = max(self._predictions, predictions)
        if self._archive is None:
            self._archive = zipfile.ZipFile(self._folder / self._file, "w")
        for name, array in arrays.items():
            put_array(self._archive, token, name, array)
        self._in_shard.append(token)
        written = sum(entry.compress_size for entry in self._archive.infolist())
        if len(self._in_shard) >= _MOST_SAMPLES or written >= _MOST_BYTES:
            self._end_shard()

    def finish(self) -> None:
        """Write the manifest; raises ResultsError if nothing was added."""
        self._end_shard()
        if self._grid is None or not self._shards:
            raise ResultsError("no prediction was added; results of no sample cannot be read")
        told = {
            **self._header.as_dict(),
            "form": self._form(self._grid, self._predictions, self._frames).as_dict(),
            "shards": [shard.as_dict() for shard in self._shards],
        }
        (self._folder / RESULTS_FILE).write_bytes(f"{json.dumps(told, indent=1)}\n".encode())

    def close(self) -> None:
        """Close the archive that is being written, if any."""
        archive, self._archive = self._archive, None
        if archive is not None:
            archive.close()

    @property
    def _file(self) -> str:
        return f"shards/{len(self._shards):05d}.npz"

    def _form(self, grid: BevGrid, predictions: int, frames: int) -> MotionForm:
        return MotionForm(
            stored=self._store,
            grid=grid,
            predictions=predictions,
            frames=frames,
            step=self._step,
            labels=self._labels,
        )

    def _checked(self, prediction: object) -> MotionOutput:
        if not isinstance(prediction, MotionOutput):
            raise ResultsError(
                f"expected a MotionOutput, found {type(prediction).__name__}; make one with "
                "MotionOutput.from_arrays(…), or of instance maps with instances_of(…)"
            )
        if self._grid not in (None, prediction.grid):
            raise ResultsError(
                f"expected a prediction on {self._grid}, found one on {prediction.grid}; write others to other results"
            )
        return prediction

    def _arrays(self, output: MotionOutput) -> dict[str, AnyArray]:
        if output.instances is not None and output.instances.min() < 0:
            raise ResultsError(f"instances: expected ids from 1, and 0 elsewhere, found {output.instances.min()}")
        if self._store == "instances":
            return instance_arrays(output, self._labels)
        if output.heads is None:
            raise ResultsError("expected heads, found instance maps; write those with store='instances'")
        if any(heads.ignore_index is not None for heads in output.heads):
            raise ResultsError(
                "expected a model's heads, found those of labels, which hold values to ignore; write them with "
                "store='instances'"
            )
        return head_arrays(output)

    def _end_shard(self) -> None:
        if self._archive is None:
            return
        self.close()
        path = self._folder / self._file
        self._shards.append(
            Shard(
                file=self._file,
                tokens=tuple(self._in_shard),
                bytes=path.stat().st_size,
                checksum=file_checksum(path),
            )
        )
        self._in_shard = []
