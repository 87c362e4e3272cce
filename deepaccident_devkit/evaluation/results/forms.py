"""What the forms of results in shards share: their records, and the layouts of their arrays."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import msgspec

from deepaccident_devkit.errors import DeepAccidentError
from deepaccident_devkit.evaluation.results.records import ContentError
from deepaccident_devkit.geometry import BevGrid

if TYPE_CHECKING:
    from typing_extensions import Self


@dataclass(frozen=True, slots=True, kw_only=True)
class ArrayLayout:
    """What a stored array must be like.

    Attributes:
        shape: Shape of the array.
        kinds: Letters of the numpy dtype kinds that it may have.
        min_length: Smallest length of the first axis, whose largest one is in `shape`.
    """

    shape: tuple[int, ...]
    kinds: str
    min_length: int


class MapsForm:
    """Base of the forms, frozen dataclasses with a field `grid`."""

    __slots__ = ()

    grid: BevGrid

    def as_dict(self) -> dict[str, Any]:
        """Convert the form to JSON-compatible values."""
        values = asdict(self)  # type: ignore[call-overload]  # its subclasses are dataclasses
        del values["grid"]
        axes = {"x": list(self.grid.x), "y": list(self.grid.y)}
        return {**values, **axes, "orientation": self.grid.orientation}

    @classmethod
    def from_record(cls, record: msgspec.Struct) -> Self:
        """Build the form from a record; raise a ContentError that names the first invalid field."""
        values = msgspec.structs.asdict(record)
        axes = [values.pop(name) for name in ("x", "y", "orientation")]
        try:
            return cls(grid=BevGrid(*axes), **values)  # type: ignore[call-arg]  # of a subclass
        except DeepAccidentError as error:
            raise ContentError(str(error)) from error
