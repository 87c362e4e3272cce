"""nuScenes' tables as records, read and checked at once; an error names the table and the row.

Only the fields that keyframes use are read, and other tables are not.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Final

import msgspec
from msgspec import Meta

from deepaccident_devkit.errors import DatarootError, shortened
from deepaccident_devkit.support.json_text import as_record, parsed_json
from deepaccident_devkit.support.reading import fault_text, read_bytes

NUSCENES_REMEDY: Final = "unpack the tables again, or correct what wrote them"
_COORDINATE = Annotated[float, Meta(ge=-1e8, le=1e8)]
_LENGTH = Annotated[float, Meta(gt=0, le=1e3)]
_QUATERNION_PART = Annotated[float, Meta(ge=-1.1, le=1.1)]
_PIXELS = Annotated[int, Meta(ge=0, le=65535)]
_NAME = Annotated[str, Meta(pattern=r"\A[^/\x00-\x1f\x7f]+\Z", max_length=200)]
_VECTOR = tuple[_COORDINATE, _COORDINATE, _COORDINATE]
_FIELD_TYPES: Final[Mapping[str, Any]] = {
    "name": _NAME,
    "location": _NAME,
    "timestamp": Annotated[float, Meta(ge=0, le=1 << 53)],
    "translation": _VECTOR,
    "rotation": tuple[_QUATERNION_PART, _QUATERNION_PART, _QUATERNION_PART, _QUATERNION_PART],
    "size": tuple[_LENGTH, _LENGTH, _LENGTH],
    "camera_intrinsic": Annotated[list[_VECTOR], Meta(max_length=3)],
    "is_key_frame": bool,
    "filename": Annotated[
        str, Meta(pattern=r"(?s)\A(?!/)(?!(.*/)?\.\.(/|\Z))[^\x00]+\Z", max_length=4096)
    ],
    "width": _PIXELS,
    "height": _PIXELS,
    "num_lidar_pts": Annotated[int, Meta(ge=0, le=1 << 31)],
}
"""Field → type of its values; all other fields are texts.

Metres, microseconds, quaternions w, x, y, z, sizes width, length, height. A file name leads to
nothing above the dataroot.
"""
# Table → the fields that are read, besides the token.
_FIELDS: Final = {
    "scene": "name log_token first_sample_token",
    "log": "location",
    "sample": "scene_token timestamp next",
    "sensor": "channel",
    "calibrated_sensor": "sensor_token translation rotation camera_intrinsic",
    "ego_pose": "translation rotation",
    "category": "name",
    "instance": "category_token",
    "sample_data": "sample_token ego_pose_token calibrated_sensor_token filename is_key_frame "
    "width height",
    "sample_annotation": "sample_token instance_token visibility_token translation rotation size "
    "num_lidar_pts",
}
# Table → the field with the owner of its rows.
_OWNERS: Final = {
    "sample": "scene_token",
    "sample_data": "sample_token",
    "sample_annotation": "sample_token",
}


class NuScenesTables:
    """The tables of a version of nuScenes.

    Attributes:
        folder: Folder of the tables.
        rows: Table → token → row, in the order of the table.
    """

    def __init__(self, folder: Path) -> None:
        """Read the tables; raise DatarootError for a damaged row, and for one without an owner."""
        self.folder = folder
        self.rows = {table: self._read(table, fields.split()) for table, fields in _FIELDS.items()}
        self._rows_by_owner: dict[tuple[str, str], list[Any]] = defaultdict(list)
        for table, field in _OWNERS.items():
            for row in self.rows[table].values():
                owner = self.follow(row, field)
                self._rows_by_owner[table, owner.token].append(row)

    def follow(self, row: Any, field: str) -> Any:
        """Return the row that a field such as `scene_token` leads to; raise DatarootError."""
        token, table = getattr(row, field), field.removesuffix("_token")
        if token not in self.rows[table]:
            raise self.error(row, f"{field}: {table}.json has no {shortened(token)!r}")
        return self.rows[table][token]

    def rows_of(self, table: str, owner: Any) -> list[Any]:
        """Return the rows of a table that belong to a scene or sample, in the table's order."""
        return self._rows_by_owner[table, owner.token]

    def error(self, row: Any, fault: str) -> DatarootError:
        """Return the error of a row; the fault begins with a field."""
        return DatarootError(
            f"{self.folder / type(row).__name__}.json: {shortened(row.token)}: {fault}; "
            f"{NUSCENES_REMEDY}"
        )

    def _read(self, table: str, fields: list[str]) -> dict[str, Any]:
        """Return the rows of a table by their tokens."""
        kind = msgspec.defstruct(
            table, [(field, _FIELD_TYPES.get(field, str)) for field in ("token", *fields)]
        )
        rows = read_table(self.folder / f"{table}.json", list[kind])  # type: ignore[valid-type]
        by_token = {row.token: row for row in rows}
        if len(by_token) < len(rows):
            [(token, _)] = Counter(row.token for row in rows).most_common(1)
            raise self.error(by_token[token], "token: two rows have it")
        return by_token


def read_table(path: Path, kind: Any) -> Any:
    """Return the content of a table's JSON.

    Raises DatarootError if it cannot be read, or is of another kind.
    """
    try:
        content = read_bytes(path, "tables")
        try:
            return msgspec.json.decode(content, type=kind)
        except (msgspec.DecodeError, RecursionError, UnicodeDecodeError):
            # The slow parser also accepts NaN, which Python writes.
            return as_record(parsed_json(content, constants=True), kind)
    except (OSError, ValueError) as error:
        raise DatarootError(f"{path}: {fault_text(error)}; {NUSCENES_REMEDY}") from error
