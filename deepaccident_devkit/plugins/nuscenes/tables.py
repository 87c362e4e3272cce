"""nuScenes' tables as records, checked as they are read; an error names the table and the row.

Only the fields that keyframes need are read, and no other tables.
"""

from collections import Counter, defaultdict
from pathlib import Path
from typing import Annotated, Any, Final

import msgspec
from msgspec import Meta

from deepaccident_devkit.errors import DatarootError, shortened
from deepaccident_devkit.support.json_text import as_record, parsed_json
from deepaccident_devkit.support.reading import fault_text, read_bytes
from deepaccident_devkit.support.values import NamedValues, ReadOnlyValues

NUSCENES_REMEDY: Final = "unpack the tables again, or correct what wrote them"
_COORDINATE = Annotated[float, Meta(ge=-1e8, le=1e8)]
_LENGTH = Annotated[float, Meta(gt=0, le=1e3)]
_QUATERNION_PART = Annotated[float, Meta(ge=-1.1, le=1.1)]
_PIXELS = Annotated[int, Meta(ge=0, le=65535)]
_NAME = Annotated[str, Meta(pattern=r"\A[^/\x00-\x1f\x7f]+\Z", max_length=200)]
_VECTOR = tuple[_COORDINATE, _COORDINATE, _COORDINATE]
_FIELD_TYPES: ReadOnlyValues = {
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
"""Type of the values of each field; all other fields are texts.

Units are metres and microseconds. Quaternions are w, x, y, z; sizes are width, length, height. A
file name may not lead out of the dataroot.
"""
# Fields that are read from each table, apart from the token.
_FIELDS = {
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
# For each table, the field with the token of the row that owns a row.
_OWNERS = {
    "sample": "scene_token",
    "sample_data": "sample_token",
    "sample_annotation": "sample_token",
}


class NuScenesTables:
    """The tables of a version of nuScenes.

    Attributes:
        folder: Folder of the tables.
        rows: Rows of each table by token, in the table's order, by table.
    """

    def __init__(self, folder: Path) -> None:
        """Read the tables; raise DatarootError if a row is damaged or its owner is missing."""
        self.folder = folder
        self.rows = {
            table: self._read_rows(table, fields.split()) for table, fields in _FIELDS.items()
        }
        self._rows_by_owner: dict[tuple[str, str], list[Any]] = defaultdict(list)
        for table, field in _OWNERS.items():
            for row in self.rows[table].values():
                owner = self.follow(row, field)
                self._rows_by_owner[table, owner.token].append(row)

    def follow(self, row: Any, field: str) -> Any:
        """Return the row that a field such as `scene_token` refers to.

        Raises DatarootError if there is no such row.
        """
        token = getattr(row, field)
        table = field.removesuffix("_token")
        if token not in self.rows[table]:
            raise self.make_error(row, f"{field}: {table}.json has no {shortened(token)!r}")
        return self.rows[table][token]

    def find_rows(self, table: str, owner: Any) -> list[Any]:
        """Return the rows of a table that belong to a scene or sample, in the table's order."""
        return self._rows_by_owner[table, owner.token]

    def make_error(self, row: Any, fault: str) -> DatarootError:
        """Make the error for a faulty row; `fault` is a text that begins with a field name."""
        return DatarootError(
            f"{self.folder / type(row).__name__}.json: {shortened(row.token)}: {fault}; "
            f"{NUSCENES_REMEDY}"
        )

    def _read_rows(self, table: str, fields: list[str]) -> NamedValues:
        """Return the rows of a table by token."""
        field_types = [(field, _FIELD_TYPES.get(field, str)) for field in ("token", *fields)]
        row_type = msgspec.defstruct(table, field_types)
        rows = read_table(self.folder / f"{table}.json", list[row_type])  # type: ignore[valid-type]
        by_token = {row.token: row for row in rows}
        if len(by_token) < len(rows):
            [(token, _)] = Counter(row.token for row in rows).most_common(1)
            raise self.make_error(by_token[token], "token: two rows have it")
        return by_token


def read_table(path: Path, kind: Any) -> Any:
    """Read a table from a JSON file.

    Raises DatarootError if the file cannot be read, or its content has another type.
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
