"""`BEV_instance_camera/*.npz`: the top-down instance segmentation camera (docs/format.md, BEV camera)."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, overload

import numpy as np
from numpy.typing import NDArray

from deepaccident_devkit.arrays import ByteArray, ShortRepr, readonly
from deepaccident_devkit.errors import SensorFileError
from deepaccident_devkit.release._content import REMEDY
from deepaccident_devkit.release.npz import FAST, read_npz, write_npz
from deepaccident_devkit.release.store import ReleasePath
from deepaccident_devkit.taxonomy import BEV_RESOLUTION, BEV_SHAPE

TAGS: dict[str, int] = {"pedestrian": 4, "road_line": 6, "road": 7, "sidewalk": 8, "vehicle": 10}
"""The CARLA semantic tags that the reference renderer uses."""


@dataclass(frozen=True, slots=True, eq=False)
class BevImage(ShortRepr):
    """What lies around an agent, seen from above; as stored, forward is up and left is left.

    A point x forward, y left of the agent, metres, is at row 599.5 − x / resolution, column 599.5 − y / resolution.

    Attributes:
        semantic: (1200, 1200) uint8, CARLA's semantic tag (`TAGS`), read-only.
        instance: (1200, 1200) uint16, the simulator's own object id (not the label's actor id), read-only.
        resolution: metres a pixel.
    """

    semantic: ByteArray
    instance: NDArray[np.uint16]
    resolution: float = BEV_RESOLUTION

    def __post_init__(self) -> None:
        """Freeze the arrays."""
        object.__setattr__(self, "semantic", readonly(self.semantic))
        object.__setattr__(self, "instance", readonly(self.instance))


@overload
def read_bev(path: ReleasePath, *, raw: Literal[False] = False) -> BevImage: ...
@overload
def read_bev(path: ReleasePath, *, raw: Literal[True]) -> ByteArray: ...
def read_bev(path: ReleasePath, *, raw: bool = False) -> BevImage | ByteArray:
    """The BEV camera's array.

    Args:
        path: the file.
        raw: return the file's own array (1200, 1200, 3) uint8 instead; channel 2 is the tag, 1 and 0 the id's low
            and high byte.

    Raises:
        MissingFileError: there is no such file.
        SensorFileError: the archive cannot be read or its array has another shape or type.
    """
    data = read_npz(path, "bev")
    if data.shape != (*BEV_SHAPE, 3) or data.dtype != np.uint8:
        raise SensorFileError(
            f"{path}: expected shape {(*BEV_SHAPE, 3)} of uint8, found {data.shape} of {data.dtype}; {REMEDY}"
        )
    if raw:
        return data
    instance = data[..., 1] + data[..., 0].astype(np.uint16) * 256
    return BevImage(data[..., 2].copy(), instance)


def write_bev(path: Path, semantic: ByteArray, instance: NDArray[np.uint16], *, level: int = FAST) -> None:
    """Write tags and object ids, both (1200, 1200), forward up; `level` is that of `npz.write_npz`."""
    high, low = instance >> 8, instance & 255
    write_npz(path, np.stack([high, low, semantic], axis=-1).astype(np.uint8), level=level)
