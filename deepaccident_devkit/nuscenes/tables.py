"""nuScenes' tables as records, read once and checked: an error names the table, the row's token and the field.

Only what keyframes use is checked. Rows that none of them leads to need the right types, and other tables are not read.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Final

import msgspec
from msgspec import Meta

from deepaccident_devkit.errors import DatarootError, shortened
from deepaccident_devkit.support.json_text import as_record, parsed_json
from deepaccident_devkit.support.reading import fault_text, read_bytes

REMEDY: Final = "unpack the tables again, or correct what wrote them"
_COORDINATE = Annotated[float, Meta(ge=-1e8, le=1e8)]
_LENGTH = Annotated[float, Meta(gt=0, le=1e3)]
_TURN = Annotated[float, Meta(ge=-1.1, le=1.1)]
_MICROSECONDS = Annotated[float, Meta(ge=0, le=1 << 53)]
_FOCAL = Annotated[float, Meta(ge=1, le=1e6)]
_PIXELS = Annotated[int, Meta(ge=1, le=65535)]
_NAME = Annotated[str, Meta(pattern=r"^[^/\x00-\x1f\x7f]+$", max_length=200)]
_PLACE = tuple[_COORDINATE, _COORDINATE, _COORDINATE]
_POSE: Final = {"translation": _PLACE, "rotation": tuple[_TURN, _TURN, _TURN, _TURN]}
_FIELDS: Final[Mapping[str, Mapping[str, Any]]] = {
    "scene": {"name": _NAME, "log_token": str, "first_sample_token": str},
    "log": {"location": _NAME},
    "sample": {"scene_token": str, "timestamp": _MICROSECONDS, "next": str},
    "sensor": {"channel": str},
    "calibrated_sensor": {**_POSE, "sensor_token": str},
    "ego_pose": _POSE,
    "category": {"name": str},
    "instance": {"category_token": str},
    "sample_data": {
        **dict.fromkeys(("sample_token", "ego_pose_token", "calibrated_sensor_token", "filename"), str),
        "is_key_frame": bool,
    },
    "sample_annotation": {
        **_POSE,
        **dict.fromkeys(("sample_token", "instance_token", "visibility_token", "prev", "next"), str),
        "size": tuple[_LENGTH, _LENGTH, _LENGTH],
        "num_lidar_pts": Annotated[int, Meta(ge=0, le=1 << 31)],
    },
}
"""Table → field → what it holds. Metres; quaternions w, x, y, z; sizes are width, length, height."""
_INTRINSIC = tuple[tuple[_FOCAL, _COORDINATE, _COORDINATE], tuple[_COORDINATE, _FOCAL, _COORDINATE], _PLACE]


def _kinds(fields: Mapping[str, Mapping[str, Any]]) -> Mapping[str, Any]:
    return {table: msgspec.defstruct(table, [("token", str), *own.items()]) for table, own in fields.items()}


_ROWS: Final = _kinds(_FIELDS)
OF_CAMERAS: Final = _kinds(
    {"calibrated_sensor": {"camera_intrinsic": _INTRINSIC}, "sample_data": {"width": _PIXELS, "height": _PIXELS}}
)
"""Table → what rows of cameras have, too."""
_OWNERS: Final = {"sample": "scene_token", "sample_data": "sample_token", "sample_annotation": "sample_token"}
"""Table → field that says to what its rows belong."""


class Tables:
    """The tables of a version of nuScenes; a row is checked when it is asked for.

    Attributes:
        folder: of the tables.
        entries: table → token → what the file says of the row; None where two rows have the token.
        belonging: table → token of a scene or sample → tokens of the rows that belong to it, in the order of the table.
    """

    def __init__(self, folder: Path) -> None:
        """Read the tables; raises DatarootError for one that cannot be read, and for a row of an unknown sample."""
        self.folder = folder
        self.entries: dict[str, dict[str, Any]] = {}
        self.belonging: dict[str, dict[str, list[str]]] = {}
        for table in _ROWS:
            self._read(table)
        for table in ("sample_data", "sample_annotation"):
            for sample, tokens in self.belonging[table].items():
                if sample not in self.entries["sample"]:
                    fault = f"sample_token: sample.json has no {shortened(sample)!r}"
                    raise DatarootError(self._sentence(table, tokens[0], fault))

    def row(self, table: str, token: str, kinds: Mapping[str, Any] = _ROWS) -> Any:
        """Return the row of a known token as one of the kinds; raises DatarootError if it is damaged."""
        entry = self.entries[table][token]
        try:
            if entry is None:
                raise ValueError("token: two rows have it")
            return as_record(entry, kinds[table])
        except ValueError as error:
            raise DatarootError(self._sentence(table, token, str(error))) from error

    def follow(self, row: Any, field: str, table: str = "") -> Any:
        """Return the row that a field leads to, in the table of the field's own name if no other is given.

        Raises:
            DatarootError: there is none, or it is damaged.
        """
        token, table = getattr(row, field), table or field.removesuffix("_token")
        if token not in self.entries[table]:
            raise self.error(row, f"{field}: {table}.json has no {shortened(token)!r}")
        return self.row(table, token)

    def rows_of(self, table: str, owner: Any) -> list[Any]:
        """Return the rows that belong to a scene or sample, in the order of the table; raises DatarootError."""
        return [self.row(table, token) for token in self.belonging[table].get(owner.token, ())]

    def error(self, row: Any, fault: str) -> DatarootError:
        """Return the error of a row; the fault begins with a field."""
        return DatarootError(self._sentence(type(row).__name__, row.token, fault))

    def _sentence(self, table: str, token: str, fault: str) -> str:
        return f"{self.folder / table}.json: {shortened(token)}: {fault}; {REMEDY}"

    def _read(self, table: str) -> None:
        """Enter the rows of a table."""
        path, owner = self.folder / f"{table}.json", _OWNERS.get(table)
        entries = self.entries[table] = {}
        groups = self.belonging[table] = {}
        for number, entry in enumerate(read_table(path, list[Any])):
            token = entry.get("token") if isinstance(entry, dict) else None
            if not isinstance(token, str):
                raise DatarootError(f"{path}: entry {number}: expected a row with a token; {REMEDY}")
            entries[token] = None if token in entries else entry
            if owner is not None:
                groups.setdefault(str(entry.get(owner)), []).append(token)


def read_table(path: Path, kind: Any) -> Any:
    """Return what the JSON of a table says; raises DatarootError if it cannot be read, or is of another kind."""
    try:
        content = read_bytes(path, "tables")
        try:
            return msgspec.json.decode(content, type=kind)
        except (msgspec.DecodeError, RecursionError, UnicodeDecodeError):  # NaN, too, which Python writes
            return as_record(parsed_json(content, constants=True), kind)
    except (OSError, ValueError) as error:
        raise DatarootError(f"{path}: {fault_text(error)}; {REMEDY}") from error
