"""Records of results files, and their strict reader; schema/results is generated from them."""

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

from deepaccident_devkit.errors import MAX_REASON_LENGTH, ResultsError, shortened
from deepaccident_devkit.geometry.bev_grid import Axis, Orientation
from deepaccident_devkit.motion import LABEL_PROTOCOLS
from deepaccident_devkit.support import json_text
from deepaccident_devkit.support.reading import fault_text
from deepaccident_devkit.support.values import NamedValues
from deepaccident_devkit.taxonomy import CATEGORIES

ResultsTask = Literal[
    "motion",
    "accident",
    "detection",
    "tracking",
    "planning",
    "forecasting",
    "segmentation",
]
# Tasks whose results are arrays in a folder.
FOLDER_TASKS: Final[tuple[ResultsTask, ...]] = ("motion", "segmentation")
Stored = Literal["instances", "heads"]
StoredLayers = Literal["masks", "scores"]
_Format = Literal["DeepAccident results"]
# Incremented when the contents of files change.
Version = Literal[1]
FORMAT: Final = get_args(_Format)[0]
FORMAT_VERSION: Final = get_args(Version)[0]
RESULTS_NAMES: Final[Mapping[ResultsTask, str]] = MappingProxyType(
    {name: name if name in FOLDER_TASKS else f"{name}.json" for name in get_args(ResultsTask)}
)
"""Task → name of its file (or of its folder) if results of all tasks share a folder."""
# Name of the JSON file in a folder: the manifest of arrays, or results of another task.
RESULTS_FILE: Final = "results.json"
# Template of an array's path in the archive, from the sample token and the name of the array.
MEMBER: Final = "{}/{}.npy"
# Largest number of cells of a sample, summed over all maps: twenty times the number in ten released
# predictions of motion. A small archive can hold more, but memory cannot.
MAX_CELLS: Final = 2**26
# Regular expression that tokens match: words separated by `/`.
WORDS: Final = r"^[^/\\]+(/[^/\\]+)*$"
# Largest value in metres, seconds, or metres per second. Larger numbers are mistakes, and the
# squares of very large floats would overflow.
MAX_MEASURE: Final = 1e6
_Measure = Annotated[float, Meta(ge=-MAX_MEASURE, le=MAX_MEASURE)]
FromZero = Annotated[float, Meta(ge=0, le=MAX_MEASURE)]
Count = Annotated[int, Meta(ge=1)]
ActorId = Annotated[int, Meta(ge=-(2**63), le=2**63 - 1)]
Token = Annotated[str, Meta(extra_json_schema={"pattern": WORDS})]
# Type of fields that the nuScenes devkit writes but this dataset does not use.
Ignored = Annotated[msgspec.Raw | UnsetType, Meta(description="Ignored.")]
Kind = TypeVar("Kind")
Entry = TypeVar("Entry", bound=msgspec.Struct)
# Indices that reorder nuScenes' width, length, height to the devkit's length, width, height, or
# vice versa.
LENGTH_FIRST: Final = [1, 0, 2]
# Errors show at most this many characters of an invalid value.
_MAX_VALUE_LENGTH = 80
# Largest nesting depth of objects and lists in `meta`, which people and reports read.
_MAX_META_LEVELS = 30
# Largest number of characters of a token.
_MAX_TOKEN_LENGTH = 1000


class AccidentEntry(msgspec.Struct, forbid_unknown_fields=True, gc=False):
    """An accident that is foreseen."""

    positions: Annotated[
        tuple[tuple[_Measure, _Measure], tuple[_Measure, _Measure]],
        Meta(
            description="Positions of the two colliders: x forward, y left, metres, in the "
            "present ego frame of the sample's agent."
        ),
    ]
    time: Annotated[FromZero, Meta(description="Seconds after the present.")]
    score: Annotated[float, Meta(description="How sure the model is; higher means surer.")]
    ids: Annotated[
        tuple[ActorId, ActorId] | UnsetType | None,
        Meta(description="Actor ids of the two, in the order of the positions; null if unknown."),
    ] = UNSET


_Category = Annotated[Literal[CATEGORIES], Meta(description="Category.")]  # type: ignore[valid-type]
_Score = Annotated[float, Meta(description="How sure the model is; higher means surer.")]
_Velocity = Annotated[
    tuple[_Measure, _Measure] | UnsetType | None,
    Meta(description="Velocity over the ground in the world, x and y, m/s; null if unknown."),
]


class PlacedBox(msgspec.Struct, forbid_unknown_fields=True, gc=False):
    """Sample, place and size of a box, with nuScenes' fields."""

    sample_token: Annotated[Token, Meta(description="Token of the sample that contains the box.")]
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


class BoxEntry(PlacedBox, forbid_unknown_fields=True, gc=False):
    """A detected box, with nuScenes' fields."""

    detection_name: _Category
    detection_score: _Score
    velocity: _Velocity = UNSET
    attribute_name: Ignored = UNSET
    ego_translation: Ignored = UNSET
    num_pts: Ignored = UNSET


class TrackEntry(PlacedBox, forbid_unknown_fields=True, gc=False):
    """The box of a track, with nuScenes' fields."""

    tracking_id: Annotated[
        str,
        Meta(
            min_length=1,
            max_length=100,
            description="Id of the track, the same in all samples of a scenario and agent.",
        ),
    ]
    tracking_name: _Category
    tracking_score: _Score
    velocity: _Velocity = UNSET
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
            description="Origin of the agent's ego frame at these times: x forward, y left, "
            "metres, in the present ego frame.",
        ),
    ]
    score: Annotated[
        float,
        Meta(description="How good the plan is; the plan with the highest score is evaluated."),
    ]
    yaw: Annotated[
        list[_Measure] | UnsetType | None,
        Meta(
            description="Headings at these times, radians, counter-clockwise; null to use the "
            "headings of the steps."
        ),
    ] = UNSET


class ForecastEntry(msgspec.Struct, forbid_unknown_fields=True, gc=False):
    """How an actor may go on."""

    id: Annotated[ActorId, Meta(description="Actor id.")]
    times: Times
    paths: Annotated[
        list[list[Place]],
        Meta(
            min_length=1,
            description="For each mode, the centre of the actor's box at these times: x "
            "forward, y left, metres, in the present ego frame of the sample's "
            "agent.",
        ),
    ]
    probabilities: Annotated[
        list[Annotated[float, Meta(ge=0, le=1)]],
        Meta(min_length=1, description="Probabilities of the modes; not normalised."),
    ]


# Task → record of an entry.
ENTRY_RECORDS: Final[Mapping[str, type[msgspec.Struct]]] = {
    "accident": AccidentEntry,
    "detection": BoxEntry,
    "tracking": TrackEntry,
    "planning": PlanEntry,
    "forecasting": ForecastEntry,
}


class _GridRecord(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    x: Annotated[
        Axis,
        Meta(description="Start, end and cell size, metres, x forward in the present ego frame."),
    ]
    y: Annotated[
        Axis, Meta(description="Start, end and cell size, metres, y left in the present ego frame.")
    ]
    orientation: Annotated[Orientation, Meta(description="Orientation of the cells in the maps.")]


class MotionFormRecord(_GridRecord, kw_only=True):
    """How motion is stored."""

    stored: Annotated[Stored, Meta(description="Maps of ids, or a model's own maps.")]
    predictions: Annotated[
        Count, Meta(description="K: most predictions of a sample; the last prediction is the mean.")
    ]
    frames: Annotated[
        Count, Meta(description="T: number of frames of a prediction, the present frame first.")
    ]
    step: Annotated[float, Meta(gt=0, description="Seconds from one frame to the next.")]
    labels: Annotated[
        Literal[(*LABEL_PROTOCOLS,)] | None,  # type: ignore[valid-type]
        Meta(description="The label protocol that the model learned from."),
    ]


class SegmentationFormRecord(_GridRecord, kw_only=True):
    """How segmented maps are stored."""

    stored: Annotated[StoredLayers, Meta(description="Masks, or scores from 0 to 1.")]
    classes: Annotated[
        tuple[str, ...],
        Meta(min_length=1, description="Names of the classes, in the order of the layers."),
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
        str, Meta(description="BLAKE2b of the archive's bytes, 16 bytes as hexadecimal digits.")
    ]


class _File(msgspec.Struct, forbid_unknown_fields=True, kw_only=True, tag_field="task"):
    format: _Format
    version: Version
    meta: Annotated[
        msgspec.Raw,
        Meta(
            description="Notes of the author, such as the method and its training.",
            extra_json_schema={"type": "object"},
        ),
    ]

    @property
    def task(self) -> ResultsTask:
        """Kind of the file's predictions."""
        task: ResultsTask = self.__struct_config__.tag  # type: ignore[assignment]  # the class has it
        return task


_BY_TOKEN = Meta(
    min_length=1,
    description="Sample token → predictions for this sample; [] for nothing.",
    extra_json_schema={"propertyNames": {"pattern": WORDS}},  # msgspec adds this itself since 0.22
)


class AccidentFile(_File, tag="accident"):
    """Accidents of many samples."""

    results: Annotated[dict[Token, list[AccidentEntry]], _BY_TOKEN]


class DetectionFile(_File, tag="detection"):
    """Detected boxes of many samples."""

    results: Annotated[dict[Token, list[BoxEntry]], _BY_TOKEN]


class TrackingFile(_File, tag="tracking"):
    """Boxes of tracks of many samples."""

    results: Annotated[dict[Token, list[TrackEntry]], _BY_TOKEN]


class PlanningFile(_File, tag="planning"):
    """Planned paths of many samples."""

    results: Annotated[dict[Token, list[PlanEntry]], _BY_TOKEN]


class ForecastingFile(_File, tag="forecasting"):
    """Actors' paths of many samples."""

    results: Annotated[dict[Token, list[ForecastEntry]], _BY_TOKEN]


class MotionFile(_File, tag="motion"):
    """The manifest of motion maps."""

    form: MotionFormRecord
    shards: Annotated[list[Shard], Meta(min_length=1)]


class SegmentationFile(_File, tag="segmentation"):
    """The manifest of segmented maps."""

    form: SegmentationFormRecord
    shards: Annotated[list[Shard], Meta(min_length=1)]


ResultsFile: TypeAlias = (
    MotionFile
    | AccidentFile
    | DetectionFile
    | TrackingFile
    | PlanningFile
    | ForecastingFile
    | SegmentationFile
)


def _schema(file_type: type[_File]) -> NamedValues:
    """Build the JSON schema of a type of file."""
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
"""Task → schema of its JSON file (of the manifest for arrays).

`read_results` also checks what a schema cannot express: repeated names, NaN, unit quaternions,
arrays.
"""


class ContentError(ValueError):
    """A fault in a file, described by half a sentence; `fault_of` turns it into a ResultsError."""


@contextmanager
def locate_errors(location: str) -> Iterator[None]:
    """Prefix the location to the message of each ContentError that is raised in the block."""
    try:
        yield
    except ContentError as error:
        raise ContentError(f"{location}: {error}") from error


def fault_of(path: Path, error: ContentError | OSError, *locations: str) -> ResultsError:
    """Build a ResultsError for a fault in a file, or for a file that cannot be read.

    The message explains where the fault is and how to fix it.
    """
    if isinstance(error, ContentError):
        message = ": ".join(filter(None, (str(path), *locations, str(error))))
        return ResultsError(f"{message}; the format is described in schema/results/README.md")
    return ResultsError(f"{path}: {fault_text(error)}; give a readable results file")


def json_excerpt(value: object) -> str:
    """Format a value as JSON text, and truncate it if it is long."""
    text = json.dumps(value, ensure_ascii=False, default=repr)
    if len(text) <= _MAX_VALUE_LENGTH:
        return text
    return f"{text[:_MAX_VALUE_LENGTH]}…"


def parsed_json(content: bytes, levels: int = json_text.MAX_LEVELS) -> Any:
    """Parse JSON text; raise a ContentError that locates the fault if it is invalid."""
    try:
        return json_text.parsed_json(content, levels=levels)
    except ValueError as error:
        raise ContentError(str(error)) from error


def decode_record(content: bytes, record_type: type[Kind]) -> Kind:
    """Decode JSON text to a record.

    Repeated names in an object are not detected. If the text is invalid, raise a ContentError that
    locates the fault and shows the value there.
    """
    try:
        return msgspec.json.decode(content, type=record_type)
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
        value = parsed_json(content)  # raises for NaN with its location, which msgspec omits
        text, _, location = str(error).partition(" - at `$")
        location = location.strip(".`")
        fault = shortened(text[:1].lower() + text[1:], MAX_REASON_LENGTH)
        message = _explain_fault(fault, value, inspect.type_info(record_type), location)
        raise ContentError(f"{location}: {message}" if location else message) from error


def _explain_fault(fault: str, value: Any, value_type: inspect.Type, location: str) -> str:
    """Describe a fault that msgspec reports, with the invalid value and what was expected.

    Args:
        fault: msgspec's message.
        value: The parsed JSON.
        value_type: Expected type of `value`.
        location: Location of the fault in `value`, as in msgspec's message.
    """
    types = _single_types(value_type)
    meaning = ""
    if isinstance(value, dict):
        task = value.get("task")
        types = [kind for kind in types if getattr(kind, "tag", None) == task] or types
    for part in re.findall(r"\w+|\.\.\.", location):
        if part == "...":  # replaces a name that msgspec does not report
            return fault
        value = value[int(part) if isinstance(value, list) else part]
        inner_types: list[inspect.Type] = []
        for outer_type in types:
            inner_types += _inner_types(outer_type, part)
        types = []
        for inner_type in inner_types:
            types += _single_types(inner_type)
        meaning = _describe_types(inner_types) or meaning
    if fault.startswith("object "):  # a field is missing or unknown
        names = _field_names(types)
        if "unknown" in fault and names:
            return f"{fault} (expected {', '.join(names)})"
        return fault
    choices = _literal_values(types)
    if choices:
        one_of = ""
        if len(choices) > 1:
            one_of = "one of "
        return f"expected {one_of}{', '.join(choices)}, found {json_excerpt(value)}"
    return f"{fault.partition(', got ')[0]}, found {json_excerpt(value)}{meaning}"


def _literal_values(types: Sequence[inspect.Type]) -> list[str]:
    """Return, as text, all values that the literal types among `types` allow."""
    values: list[str] = []
    for kind in types:
        if isinstance(kind, inspect.LiteralType):
            values += map(str, kind.values)
    return values


def _describe_types(types: Sequence[inspect.Type]) -> str:
    """Return the first description of any of the types, in brackets; empty if none has one."""
    for kind in types:
        if isinstance(kind, inspect.Metadata):
            schema = kind.extra_json_schema or {}
            if "description" in schema:
                return f" ({schema['description']})"
    return ""


def _field_names(types: Sequence[inspect.Type]) -> list[str]:
    """Return the field names of all record types among `types`."""
    names = []
    for kind in types:
        if isinstance(kind, inspect.StructType):
            names += [field.encode_name for field in kind.fields]
    return names


def _inner_types(outer: inspect.Type, part: str) -> Sequence[inspect.Type]:
    """Return the types that a part of a value can have.

    Args:
        outer: Type of the value.
        part: Field name, or index of an entry.
    """
    if isinstance(outer, inspect.StructType):
        types = [field.type for field in outer.fields if field.encode_name == part]
        return types or [inspect.LiteralType((outer.tag,))]
    if isinstance(outer, inspect.TupleType):
        return [outer.item_types[int(part)]]
    if isinstance(outer, inspect.ListType | inspect.VarTupleType):
        return [outer.item_type]
    return []


def _single_types(joined: inspect.Type) -> list[inspect.Type]:
    """Split a union into its types, without their metadata."""
    if isinstance(joined, inspect.Metadata):
        return _single_types(joined.type)
    if not isinstance(joined, inspect.UnionType):
        return [joined]
    members = []
    for member in joined.types:
        members += _single_types(member)
    return members


def json_meta(meta: object) -> NamedValues:
    """Copy the notes `meta` as JSON values; raise ContentError if they cannot be stored as JSON."""
    if not isinstance(meta, Mapping):
        raise ContentError(
            f"meta: expected a mapping of names to JSON values, found {type(meta).__name__}"
        )
    try:
        text = json.dumps(dict(meta), allow_nan=False)
    except (TypeError, ValueError, RecursionError) as error:
        raise ContentError(f"meta: cannot be written as JSON ({error})") from error
    with locate_errors("meta"):
        copied: NamedValues = parsed_json(text.encode(), _MAX_META_LEVELS)
    return copied


def check_token(token: object) -> str:
    """Return a sample's token; raise ContentError unless it consists of words separated by `/`."""
    if not isinstance(token, str):
        raise ContentError(f"expected a sample token (text), found {json_excerpt(token)}")
    is_short = len(token) <= _MAX_TOKEN_LENGTH
    has_words = is_short and token.isprintable() and re.fullmatch(WORDS, token)
    if not has_words or {".", ".."} & set(token.split("/")):
        raise ContentError(
            "expected a sample token <scenario_type>/<name>/<agent>/<NNN>, found "
            f"{shortened(token)!r}"
        )
    return token


class _Texts(msgspec.Struct):
    """The raw entries of each sample."""

    results: dict[str, msgspec.Raw]


def read_document(content: bytes, path: Path) -> tuple[ResultsFile, NamedValues]:
    """Decode a results file to its records and its notes `meta`.

    If the content is invalid, raise a ContentError that names token and field, or a ResultsError.
    """
    try:
        document: ResultsFile = decode_record(content, ResultsFile)  # type: ignore[arg-type]  # a union is a type too
    except ContentError:
        _raise_located_fault(content, path)
        raise
    return document, json_meta(_read_meta(content, document))


def _read_meta(content: bytes, document: ResultsFile) -> object:
    """Return the notes of a document, and check the parts of it that were not decoded.

    No name may be repeated, and these parts must be JSON that `parsed_json` accepts. Repeated names
    are found by counting: without them, the text has as many colons as the records have names and
    the raw parts have colons. If the numbers differ, the strict reader locates the fault, which
    takes four times as long.
    """
    if not isinstance(document, MotionFile | SegmentationFile):
        record_type = ENTRY_RECORDS[document.task]
        fields = record_type.__struct_fields__
        optional_fields = fields[len(fields) - len(record_type.__struct_defaults__) :]
        entries = list(chain.from_iterable(document.results.values()))
        type_counts: Counter[type] = Counter()
        for field in optional_fields:
            type_counts.update(map(type, map(attrgetter(field), entries)))
        raw_parts = [document.meta]
        if type_counts[msgspec.Raw]:
            for entry in entries:
                values = [getattr(entry, field) for field in optional_fields]
                raw_parts += [value for value in values if isinstance(value, msgspec.Raw)]
        raw_text = b"[%s]" % b",".join(raw_parts)
        file_names = len(document.__struct_fields__) + 1  # including the task
        entry_names = len(entries) * len(fields) - type_counts[msgspec.UnsetType]
        name_count = file_names + len(document.results) + entry_names
        colon_count = np.count_nonzero(np.frombuffer(content, np.uint8) == ord(":"))
        with suppress(ContentError):
            meta, *_ = parsed_json(raw_text)
            if name_count + raw_text.count(b":") == colon_count:
                return meta
    return parsed_json(content)["meta"]


def _raise_located_fault(content: bytes, path: Path) -> None:
    """Raise the fault of a results file with its token, or with a way to fix it.

    Return if neither is known.
    """
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
        age = "an older"
        remedy = "write it again"
        if version > FORMAT_VERSION:
            age = "a newer"
            remedy = "update the devkit"
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
    """Decode a sample's entries; raise a ContentError with entry number and field on a fault."""
    return decode_record(content, list[record_type])  # type: ignore[valid-type]  # a type at run time


def entry_place(token: str, number: int | None = None) -> str:
    """Return how errors refer to a sample's entries, or to the entry with a number."""
    suffix = ""
    if number is not None:
        suffix = f": [{number}]"
    return f"results of {shortened(token)!r}{suffix}"
