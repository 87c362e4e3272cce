"""Records of results files, which schema/results is made of, and their strict reader."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from itertools import chain
from operator import attrgetter
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Final, Literal, TypeAlias, TypeVar, get_args

import msgspec
import numpy as np
from msgspec import UNSET, Meta, UnsetType, inspect

from deepaccident_devkit.errors import MOST_TOLD, ResultsError, shortened
from deepaccident_devkit.geometry.bev_grid import Axis, Orientation
from deepaccident_devkit.motion import LABEL_PROTOCOLS
from deepaccident_devkit.support import json_text
from deepaccident_devkit.support.reading import fault_text
from deepaccident_devkit.taxonomy import CATEGORIES

ResultsTask = Literal["motion", "accident", "detection", "planning", "forecasting"]
Stored = Literal["instances", "heads"]
_Format = Literal["DeepAccident results"]
# Incremented when the contents of files change.
Version = Literal[1]
FORMAT: Final = get_args(_Format)[0]
FORMAT_VERSION: Final = get_args(Version)[0]
RESULTS_NAMES: Final[Mapping[ResultsTask, str]] = MappingProxyType(
    {name: name if name == "motion" else f"{name}.json" for name in get_args(ResultsTask)}
)
"""Task → name of its file (for motion a folder), if results of all tasks share a folder."""
# Name of the manifest of motion results in their folder, and of other results in a folder.
RESULTS_FILE: Final = "results.json"
# Regular expression of tokens: words separated by `/`.
WORDS: Final = r"^[^/\\]+(/[^/\\]+)*$"
# Largest value in metres, seconds, or metres a second: larger numbers are mistakes, and squares of
# the largest floats overflow.
MAX_MEASURE: Final = 1e6
_Measure = Annotated[float, Meta(ge=-MAX_MEASURE, le=MAX_MEASURE)]
FromZero = Annotated[float, Meta(ge=0, le=MAX_MEASURE)]
Count = Annotated[int, Meta(ge=1)]
ActorId = Annotated[int, Meta(ge=-(2**63), le=2**63 - 1)]
Token = Annotated[str, Meta(extra_json_schema={"pattern": WORDS})]
# A further field of the nuScenes devkit; this dataset has no attributes.
Ignored = Annotated[msgspec.Raw | UnsetType, Meta(description="Ignored.")]
Kind = TypeVar("Kind")
Entry = TypeVar("Entry", bound=msgspec.Struct)
# Order of axes between nuScenes' width, length, height and the devkit's length, width, height.
LENGTH_FIRST: Final = [1, 0, 2]
# Number of characters of a wrong value that an error shows.
_MAX_VALUE_LENGTH: Final = 80
# The largest depth of nested objects and lists in `meta`, which people and reports read.
_MAX_META_LEVELS: Final = 30
# In characters.
_MAX_TOKEN_LENGTH: Final = 1000


class AccidentEntry(msgspec.Struct, forbid_unknown_fields=True, gc=False):
    """An accident that is foreseen."""

    positions: Annotated[
        tuple[tuple[_Measure, _Measure], tuple[_Measure, _Measure]],
        Meta(
            description="Of the two that collide: x forward, y left, metres, in the present ego "
            "frame of the sample's agent."
        ),
    ]
    time: Annotated[FromZero, Meta(description="Seconds after the present.")]
    score: Annotated[float, Meta(description="How sure the model is, the more the higher.")]
    ids: Annotated[
        tuple[ActorId, ActorId] | UnsetType | None,
        Meta(description="Their actor ids, in the order of the positions; null if not known."),
    ] = UNSET


class BoxEntry(msgspec.Struct, forbid_unknown_fields=True, gc=False):
    """A detected box, with nuScenes' fields."""

    sample_token: Annotated[
        Token, Meta(description="The sample's token, under which the box stands.")
    ]
    translation: Annotated[
        tuple[_Measure, _Measure, _Measure],
        Meta(description="Centre x, y, z in the world, right-handed, metres."),
    ]
    size: Annotated[
        tuple[FromZero, FromZero, FromZero],
        Meta(description="WIDTH, LENGTH, HEIGHT, metres: nuScenes' order."),
    ]
    rotation: Annotated[
        tuple[float, float, float, float],
        Meta(
            description="Unit quaternion w, x, y, z: the box's axes (x along its length) in the "
            "world."
        ),
    ]
    detection_name: Annotated[Literal[CATEGORIES], Meta(description="Category.")]  # type: ignore[valid-type]
    detection_score: Annotated[
        float, Meta(description="How sure the model is, the more the higher.")
    ]
    velocity: Annotated[
        tuple[_Measure, _Measure] | UnsetType | None,
        Meta(description="x and y in the world over the ground, m/s; null if not known."),
    ] = UNSET
    attribute_name: Ignored = UNSET
    ego_translation: Ignored = UNSET
    num_pts: Ignored = UNSET


Place = tuple[_Measure, _Measure]
Times = Annotated[
    list[FromZero], Meta(min_length=1, description="Seconds after the present, ascending.")
]


class PlanEntry(msgspec.Struct, forbid_unknown_fields=True, gc=False):
    """A path that the sample's agent plans to drive."""

    times: Times
    path: Annotated[
        list[Place],
        Meta(
            min_length=1,
            description="Where its ego frame is at these times: x forward, y left, metres, in the "
            "present ego frame.",
        ),
    ]
    score: Annotated[
        float, Meta(description="How good the plan is; the one with the highest is evaluated.")
    ]
    yaw: Annotated[
        list[_Measure] | UnsetType | None,
        Meta(
            description="Its headings at these times, radians, counter-clockwise; null for those "
            "of the steps."
        ),
    ] = UNSET


class ForecastEntry(msgspec.Struct, forbid_unknown_fields=True, gc=False):
    """How an actor may go on."""

    id: Annotated[ActorId, Meta(description="Its actor id.")]
    times: Times
    paths: Annotated[
        list[list[Place]],
        Meta(
            min_length=1,
            description="Of each mode where its box's centre is at these times: x forward, y "
            "left, metres, in the present ego frame of the sample's agent.",
        ),
    ]
    probabilities: Annotated[
        list[Annotated[float, Meta(ge=0, le=1)]],
        Meta(min_length=1, description="Of the modes; not normalised."),
    ]


# Task → record of an entry.
ENTRY_RECORDS: Final[Mapping[str, type[msgspec.Struct]]] = {
    "accident": AccidentEntry,
    "detection": BoxEntry,
    "planning": PlanEntry,
    "forecasting": ForecastEntry,
}


class FormRecord(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """How motion is stored."""

    stored: Annotated[Stored, Meta(description="Maps of ids, or a model's own maps.")]
    x: Annotated[
        Axis,
        Meta(description="Start, end and cell size, metres, x forward in the present ego frame."),
    ]
    y: Annotated[
        Axis, Meta(description="Start, end and cell size, metres, y left in the present ego frame.")
    ]
    orientation: Annotated[Orientation, Meta(description="How cells lie in the maps.")]
    predictions: Annotated[
        Count, Meta(description="K: how many a sample has at most; the last one is the mean.")
    ]
    frames: Annotated[
        Count, Meta(description="T: how many a prediction has, the present one first.")
    ]
    step: Annotated[float, Meta(gt=0, description="Seconds from one frame to the next.")]
    labels: Annotated[
        Literal[(*LABEL_PROTOCOLS,)] | None,  # type: ignore[valid-type]
        Meta(description="The label protocol that the model learned from."),
    ]


class Shard(msgspec.Struct, forbid_unknown_fields=True, kw_only=True, frozen=True):
    """An archive of some samples."""

    file: Annotated[str, Meta(min_length=1, description="Path of the archive in the folder.")]
    tokens: Annotated[
        tuple[Token, ...],
        Meta(min_length=1, description="Its samples.", extra_json_schema={"uniqueItems": True}),
    ]
    bytes: Annotated[int, Meta(ge=0, description="Its size.")]
    checksum: Annotated[
        str, Meta(description="BLAKE2b of its bytes, 16 bytes as hexadecimal digits.")
    ]


class _File(msgspec.Struct, forbid_unknown_fields=True, kw_only=True, tag_field="task"):
    format: _Format
    version: Version
    meta: Annotated[
        msgspec.Raw,
        Meta(
            description="What the author says: the method, its training.",
            extra_json_schema={"type": "object"},
        ),
    ]

    @property
    def task(self) -> ResultsTask:
        """Kind of its predictions."""
        task: ResultsTask = self.__struct_config__.tag  # type: ignore[assignment]  # the class has it
        return task


_BY_TOKEN: Final = Meta(
    min_length=1,
    description="Sample token to what is predicted of it; [] for nothing.",
    extra_json_schema={
        "propertyNames": {"pattern": WORDS}
    },  # which msgspec finds itself from 0.22 on
)


class AccidentFile(_File, tag="accident"):
    """Accidents of many samples."""

    results: Annotated[dict[Token, list[AccidentEntry]], _BY_TOKEN]


class DetectionFile(_File, tag="detection"):
    """Detected boxes of many samples."""

    results: Annotated[dict[Token, list[BoxEntry]], _BY_TOKEN]


class PlanningFile(_File, tag="planning"):
    """Planned paths of many samples."""

    results: Annotated[dict[Token, list[PlanEntry]], _BY_TOKEN]


class ForecastingFile(_File, tag="forecasting"):
    """Actors' paths of many samples."""

    results: Annotated[dict[Token, list[ForecastEntry]], _BY_TOKEN]


class MotionFile(_File, tag="motion"):
    """The manifest of motion maps."""

    form: FormRecord
    shards: Annotated[list[Shard], Meta(min_length=1)]


ResultsFile: TypeAlias = MotionFile | AccidentFile | DetectionFile | PlanningFile | ForecastingFile


def _schema(file_type: type[_File]) -> dict[str, Any]:
    title = f"{FORMAT}: {file_type.__struct_config__.tag}"
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": title,
        **msgspec.json.schema(file_type),
    }


RESULT_SCHEMAS: Final = MappingProxyType(
    {
        str(file_type.__struct_config__.tag): _schema(file_type)
        for file_type in get_args(ResultsFile)
    }
)
"""Task → schema of its JSON file: for motion that is the manifest.

`read_results` also checks what a schema cannot express: repeated names, NaN, unit quaternions,
arrays.
"""


class ContentError(ValueError):
    """A fault of a file, as half a sentence; `fault_of` makes a ResultsError of it."""


@contextmanager
def locate_errors(location: str) -> Iterator[None]:
    """Put a location before the message of a ContentError."""
    try:
        yield
    except ContentError as error:
        raise ContentError(f"{location}: {error}") from error


def fault_of(path: Path, error: ContentError | OSError, *locations: str) -> ResultsError:
    """Return the ResultsError for a fault at a location in a file, or for an unreadable file.

    Its message includes the remedy.
    """
    if isinstance(error, ContentError):
        message = ": ".join(filter(None, (str(path), *locations, str(error))))
        return ResultsError(f"{message}; the format is described in schema/results/README.md")
    return ResultsError(f"{path}: {fault_text(error)}; give a results file that can be read")


def json_excerpt(value: object) -> str:
    """Return a value as JSON text, cut if it is long."""
    text = json.dumps(value, ensure_ascii=False, default=repr)
    if len(text) <= _MAX_VALUE_LENGTH:
        return text
    return f"{text[:_MAX_VALUE_LENGTH]}…"


def parsed_json(content: bytes, levels: int = json_text.MAX_LEVELS) -> Any:
    """Return the value of JSON text; raises ContentError that names the location of a fault."""
    try:
        return json_text.parsed_json(content, levels=levels)
    except ValueError as error:
        raise ContentError(str(error)) from error


def decode_record(content: bytes, record_type: type[Kind]) -> Kind:
    """Return the record that JSON text describes.

    A name that is repeated in an object is not noticed. A ContentError names the location of a
    fault, and the value there.
    """
    try:
        return msgspec.json.decode(content, type=record_type)
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
        value = parsed_json(content)  # names the location of NaN, which msgspec does not
        text, _, location = str(error).partition(" - at `$")
        location = location.strip(".`")
        fault = shortened(text[:1].lower() + text[1:], MOST_TOLD)
        message = _explain_fault(fault, value, inspect.type_info(record_type), location)
        raise ContentError(f"{location}: {message}" if location else message) from error


def _explain_fault(fault: str, value: Any, value_type: inspect.Type, location: str) -> str:
    """Return the fault as msgspec reports it, with the value, and its expected values or meaning.

    Args:
        fault: Message of msgspec.
        value: The parsed JSON.
        value_type: Its expected type.
        location: Location in the value, as in the message of msgspec.
    """
    types, meaning = _single_types(value_type), ""
    if isinstance(value, dict):
        tagged = [kind for kind in types if getattr(kind, "tag", None) == value.get("task")]
        types = tagged or types
    for part in re.findall(r"\w+|\.\.\.", location):
        if part == "...":  # a name, which msgspec does not report
            return fault
        value = value[int(part) if isinstance(value, list) else part]
        inner_types = [inner for outer in types for inner in _inner_types(outer, part)]
        types = [single for inner in inner_types for single in _single_types(inner)]
        meaning = _meaning(inner_types) or meaning
    if fault.startswith("object "):  # lacks a field, or has one too many
        names = _field_names(types)
        if "unknown" in fault and names:
            return f"{fault} (expected {', '.join(names)})"
        return fault
    choices: list[str] = []
    for kind in types:
        if isinstance(kind, inspect.LiteralType):
            choices += map(str, kind.values)
    if choices:
        one_of = ""
        if len(choices) > 1:
            one_of = "one of "
        return f"expected {one_of}{', '.join(choices)}, found {json_excerpt(value)}"
    return f"{fault.partition(', got ')[0]}, found {json_excerpt(value)}{meaning}"


def _meaning(types: Sequence[inspect.Type]) -> str:
    """Return the first description of types, in brackets; empty without any."""
    for kind in types:
        if isinstance(kind, inspect.Metadata):
            schema = kind.extra_json_schema or {}
            if "description" in schema:
                return f" ({schema['description']})"
    return ""


def _field_names(types: Sequence[inspect.Type]) -> list[str]:
    """Return the names of all fields of records."""
    names = []
    for kind in types:
        if isinstance(kind, inspect.StructType):
            names += [field.encode_name for field in kind.fields]
    return names


def _inner_types(outer: inspect.Type, part: str) -> Sequence[inspect.Type]:
    """Return the possible types of a field, or of an entry, of a value of a type."""
    if isinstance(outer, inspect.StructType):
        types = [field.type for field in outer.fields if field.encode_name == part]
        return types or [inspect.LiteralType((outer.tag,))]
    if isinstance(outer, inspect.TupleType):
        return [outer.item_types[int(part)]]
    if isinstance(outer, inspect.ListType | inspect.VarTupleType):
        return [outer.item_type]
    return []


def _single_types(joined: inspect.Type) -> list[inspect.Type]:
    """Return the members of a union, without metadata."""
    if isinstance(joined, inspect.Metadata):
        return _single_types(joined.type)
    if not isinstance(joined, inspect.UnionType):
        return [joined]
    members = []
    for member in joined.types:
        members += _single_types(member)
    return members


def json_meta(meta: object) -> dict[str, Any]:
    """Return a copy of `meta` in JSON form; raises ContentError."""
    if not isinstance(meta, Mapping):
        raise ContentError(
            f"meta: expected a mapping of names to what JSON holds, found {type(meta).__name__}"
        )
    try:
        text = json.dumps(dict(meta), allow_nan=False)
    except (TypeError, ValueError, RecursionError) as error:
        raise ContentError(f"meta: cannot be written as JSON ({error})") from error
    with locate_errors("meta"):
        copied: dict[str, Any] = parsed_json(text.encode(), _MAX_META_LEVELS)
    return copied


def check_token(token: object) -> str:
    """Return a sample's token; raises ContentError unless it is words separated by `/`."""
    if not isinstance(token, str):
        raise ContentError(f"expected a sample's token, a text, found {json_excerpt(token)}")
    is_short = len(token) <= _MAX_TOKEN_LENGTH
    has_words = is_short and token.isprintable() and re.fullmatch(WORDS, token)
    if not has_words or {".", ".."} & set(token.split("/")):
        raise ContentError(
            "expected a sample's token, <scenario_type>/<name>/<agent>/<NNN>, found "
            f"{shortened(token)!r}"
        )
    return token


class _Texts(msgspec.Struct):
    """The raw entries of each sample."""

    results: dict[str, msgspec.Raw]


def read_document(content: bytes, path: Path) -> tuple[ResultsFile, dict[str, Any]]:
    """Return the records of a results file, and its meta.

    Raises ContentError that names token and field, or ResultsError.
    """
    try:
        document: ResultsFile = decode_record(content, ResultsFile)  # type: ignore[arg-type]  # a union is a type too
    except ContentError:
        _raise_located_fault(content, path)
        raise
    return document, json_meta(_strict_meta(content, document))


def _strict_meta(content: bytes, document: ResultsFile) -> object:
    """Return the meta of a document.

    No name in the document may be repeated, and all parts that were not decoded must be JSON for
    `parsed_json`. The records have as many names as the text has colons outside texts. If the text
    has more, the strict reader finds the fault; it takes four times as long.
    """
    if not isinstance(document, MotionFile):
        record_type = ENTRY_RECORDS[document.task]
        fields = record_type.__struct_fields__
        optional = fields[len(fields) - len(record_type.__struct_defaults__) :]
        entries = list(chain.from_iterable(document.results.values()))
        values_by_field = (map(attrgetter(name), entries) for name in optional)
        type_counts = Counter(chain.from_iterable(map(type, values) for values in values_by_field))
        parts = [document.meta]
        if type_counts[msgspec.Raw]:
            optional_values = (getattr(entry, name) for entry in entries for name in optional)
            parts += [value for value in optional_values if isinstance(value, msgspec.Raw)]
        unread = b"[%s]" % b",".join(parts)
        # the file's own names, the task among them, those of samples, and those of entries
        names = (
            len(document.__struct_fields__) + 1 + len(document.results) + len(entries) * len(fields)
        )
        present_names = names - type_counts[msgspec.UnsetType] + unread.count(b":")
        colons = np.count_nonzero(np.frombuffer(content, np.uint8) == ord(":"))
        with suppress(ContentError):
            meta, *_ = parsed_json(unread)
            if present_names == colons:
                return meta
    return parsed_json(content)["meta"]


def _raise_located_fault(content: bytes, path: Path) -> None:
    """Raise the fault of a results file with its token or its remedy, where one is known."""
    payload = parsed_json(content)
    if not isinstance(payload, dict):
        raise ContentError(f"expected a JSON object, found {json_excerpt(payload)}")
    if "format" not in payload and "results" in payload:
        raise ContentError(
            f'has no "format" (a nuScenes results file?); put "format": "{FORMAT}", "version": '
            f'{FORMAT_VERSION} and "task": "detection" before its "meta" and "results"'
        )
    version = payload.get("version")
    if payload.get("format") == FORMAT and type(version) is int and version != FORMAT_VERSION:
        age, remedy = "an older", "write it again"
        if version > FORMAT_VERSION:
            age, remedy = "a newer", "update the devkit"
        raise ResultsError(
            f"{path}: version: {age} results format ({json_excerpt(version)}, this devkit's is "
            f"{FORMAT_VERSION}); {remedy}"
        )
    record_type = ENTRY_RECORDS.get(str(payload.get("task")))
    if record_type is not None and isinstance(payload.get("results"), dict):
        for token, entries in decode_record(content, _Texts).results.items():
            with locate_errors(entry_place(token)):
                read_entries(bytes(entries), record_type)


def read_entries(content: bytes, record_type: type[Entry]) -> list[Entry]:
    """Return a sample's entries; raises ContentError that names entry number and field."""
    return decode_record(content, list[record_type])  # type: ignore[valid-type]  # a type at run time


def entry_place(token: str, number: int | None = None) -> str:
    """Return how errors name a sample's entries, or one of them."""
    suffix = "" if number is None else f": [{number}]"
    return f"results of {shortened(token)!r}{suffix}"
