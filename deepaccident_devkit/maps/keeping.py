"""Keeping: a town's map beside the tables that it was made with, so that the next call finds it.

A map lies in the folder of the tables (`town_map-<digest>.npz`), and goes when the tables are made again. The digest is
of all that was asked for. Where nothing can be written, maps are not kept.
"""

from __future__ import annotations

import hashlib
import io
import logging
from collections.abc import Sequence
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from deepaccident_devkit.archives import DAMAGED_ARCHIVE, open_zip, read_array
from deepaccident_devkit.arrays import AnyArray
from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.files import write_bytes
from deepaccident_devkit.maps.counting import GROUND_CLASSES
from deepaccident_devkit.maps.looks import TownMapConfig
from deepaccident_devkit.maps.town_map import TownMap
from deepaccident_devkit.reading import limit_of

logger = logging.getLogger(__name__)

_FORMAT: Final = 1
"""Counts up whenever the same pictures give another map, or the file's form changes."""
_NUMBERS: Final = ("scenarios", "looks", "missing", "damaged")
_PLANES: Final = (*GROUND_CLASSES, "agents")


def map_path(dataset: Dataset, town: str, scenarios: Sequence[str], config: TownMapConfig) -> Path:
    """Where the map of a town, from these scenarios (tokens, in the table's order), is kept."""
    text = repr((_FORMAT, town, tuple(scenarios), config))
    digest = hashlib.blake2b(text.encode(), digest_size=8).hexdigest()
    return dataset.tables_folder / f"town_map-{digest}.npz"


def read_map(path: Path, town: str, resolution: float) -> TownMap | None:
    """The map that is kept there; None if there is none, or if its file is damaged."""
    try:
        state = path.stat()
    except OSError:
        return None
    return _read(path, town, resolution, (state.st_mtime_ns, state.st_size, state.st_ino))


@lru_cache(maxsize=1)  # every picture of a video asks for the same one
def _read(path: Path, town: str, resolution: float, _state: tuple[int, ...]) -> TownMap | None:
    """The map in a file; its state tells it from another that takes its place."""
    try:
        with open_zip(path) as archive:
            arrays = {name: read_array(archive, name, "index") for name in (*_PLANES, "hidden", "origin", "numbers")}
        return _map_of(town, resolution, arrays)
    except DAMAGED_ARCHIVE as error:
        logger.warning("%s: the kept map cannot be used (%s); it is made again", path, error)
        return None


def keep_map(path: Path, made: TownMap) -> None:
    """Keep a map, if its file can be written and would be read again; the same map gives the same bytes."""
    if made.agents.nbytes > limit_of("index"):
        return
    content = io.BytesIO()
    planes: dict[str, Any] = dict(zip(GROUND_CLASSES, made.counts, strict=True))
    numbers = np.array([getattr(made, name) for name in _NUMBERS], dtype=np.int64)
    planes |= {"agents": made.agents, "hidden": made.hidden, "origin": made.origin, "numbers": numbers}
    np.savez_compressed(content, **planes)
    with suppress(OSError):  # a folder that may not be written to, or that another process has just made again
        if path.parent.is_dir():
            write_bytes(path, content.getvalue())


def _map_of(town: str, resolution: float, arrays: dict[str, AnyArray]) -> TownMap:
    planes = [arrays[name] for name in _PLANES]
    rasters = [*planes, arrays["hidden"]]
    types = [np.dtype(np.uint16)] * len(planes) + [np.dtype(np.uint8)]
    if {each.shape for each in rasters} != {planes[0].shape[:2]} or [each.dtype for each in rasters] != types:
        raise ValueError("its rasters differ in shape or type")
    if arrays["origin"].shape != (2,) or arrays["numbers"].shape != (len(_NUMBERS),):
        raise ValueError("it lacks numbers")
    return TownMap(
        town=town,
        resolution=resolution,
        origin=arrays["origin"],
        counts=np.stack(planes[:-1]),
        agents=planes[-1],
        hidden=arrays["hidden"],
        **dict(zip(_NUMBERS, arrays["numbers"].tolist(), strict=True)),
    )
