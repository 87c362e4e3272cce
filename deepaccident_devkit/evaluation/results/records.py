"""What results files hold: the records, which schema/results is made of, reading them, and how faults are told."""

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
# Counted up with what files hold.
Version = Literal[1]
FORMAT: Final = get_args(_Format)[0]
FORMAT_VERSION: Final = get_args(Version)[0]
RESULTS_NAMES: Final[Mapping[ResultsTask, str]] = MappingProxyType(
    {name: name if name == "motion" else f"{name}.json" for name in get_args(ResultsTask)}
)
"""Task → the name of its file, of motion a folder, where results of all tasks are written into one folder."""
# The manifest of motion results, in their folder; results of the other tasks in a folder are called so too.
RESULTS_FILE: Final = "results.json"
# A regular expression of tokens: words with `/` between.
WORDS: Final = r"^[^/\\]+(/[^/\\]+)*$"
# Metres, seconds, metres a second: larger numbers are mistakes, and squares of the largest floats overflow.
LARGEST: Final = 1e6
_Measure = Annotated[float, Meta(ge=-LARGEST, le=LARGEST)]
FromZero = Annotated[float, Meta(ge=0, le=LARGEST)]
Count = Annotated[int, Meta(ge=1)]
ActorId = Annotated[int, Meta(ge=-(2**63), le=2**63 - 1)]
Token = Annotated[str, Meta(extra_json_schema={"pattern": WORDS})]
# A further field of the nuScenes devkit; this dataset has no attributes.
Ignored = Annotated[msgspec.Raw | UnsetType, Meta(description="Ignored.")]
Kind = TypeVar("Kind")
Entry = TypeVar("Entry", bound=msgspec.Struct)
# From nuScenes' width, length, height to our length, width, height, and back.
LENGTH_FIRST: Final = [1, 0, 2]
# Characters of a wrong value that an error shows.
_SHOWN: Final = 80
# The largest depth of nested objects and lists in `meta`, which people and reports read.
_MOST_LEVELS: Final = 30
# Characters.
_LONGEST_TOKEN: Final = 1000


class AccidentEntry(msgspec.Struct, forbid_unknown_fields=True, gc=False):
    """An accident that is foreseen."""

    positions: Annotated[
        tuple[tuple[_Measure, _Measure], tuple[_Measure, _Measure]],
        Meta(
            description="Of the two that collide: x forward, y left, metres, in the present ego frame of the sample's "
            "agent."
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
            description="Unit quaternion w, x, y, z: the box's axes (x along its length) in the world."
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
            description="Where its ego frame is at these times: x forward, y left, metres, in the present ego frame.",
        ),
    ]
    score: Annotated[
        float, Meta(description="How good the plan is; the one with the highest is evaluated.")
    ]
    yaw: Annotated[
        list[_Measure] | UnsetType | None,
        Meta(
            description="Its headings at these times, radians, counter-clockwise; null for those of the steps."
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
            description="Of each mode where its box's centre is at these times: x forward, y left, metres, in the "
            "present ego frame of the sample's agent.",
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
        """What its predictions are of."""
        task: ResultsTask = self.__struct_config__.tag  # type: ignore[assignment]  # the class says which
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


def _schema(kind: type[_File]) -> dict[str, Any]:
    made = msgspec.json.schema(kind)
    title = f"{FORMAT}: {kind.__struct_config__.tag}"
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": title, **made}


RESULT_SCHEMAS: Final = MappingProxyType(
    {str(kind.__struct_config__.tag): _schema(kind) for kind in get_args(ResultsFile)}
)
"""Task → schema of its JSON file: for motion that is the manifest.

What a schema cannot say, `read_results` checks too: names that stand twice, NaN, unit quaternions, arrays.
"""


class ContentError(ValueError):
    """What is wrong, as half a sentence; `fault_of` makes a ResultsError of it."""


@contextmanager
def at(place: str) -> Iterator[None]:
    """Put the place before the message of an error."""
    try:
        yield
    except ContentError as error:
        raise ContentError(f"{place}: {error}") from error


def fault_of(path: Path, error: ContentError | OSError, *places: str) -> ResultsError:
    """The error for what is found wrong at a place in a file, or for one that cannot be read, with the remedy."""
    if isinstance(error, ContentError):
        told = ": ".join(filter(None, (str(path), *places, str(error))))
        return ResultsError(f"{told}; the format is described in schema/results/README.md")
    return ResultsError(f"{path}: {fault_text(error)}; give a results file that can be read")


def shown(value: object) -> str:
    """A value of a JSON file as it stands there, cut if it is long."""
    text = json.dumps(value, ensure_ascii=False, default=repr)
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}…"


def parsed_json(content: bytes, levels: int = json_text.MOST_LEVELS) -> Any:
    """The value of JSON text; raises ContentError that names the place of a fault."""
    try:
        return json_text.parsed_json(content, levels=levels)
    except ValueError as error:
        raise ContentError(str(error)) from error


def decoded(content: bytes, kind: type[Kind]) -> Kind:
    """The record that JSON text describes; raises ContentError that names the place of a fault, and what it found.

    A name that stands twice in an object is not noticed.
    """
    try:
        return msgspec.json.decode(content, type=kind)
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
        value = parsed_json(content)  # it says of NaN where it stands
        said, _, place = str(error).partition(" - at `$")
        place = place.strip(".`")
        told = _told(
            shortened(said[:1].lower() + said[1:], MOST_TOLD), value, inspect.type_info(kind), place
        )
        raise ContentError(f"{place}: {told}" if place else told) from error


def _told(said: str, value: Any, kind: inspect.Type, place: str) -> str:
    """What msgspec says of a value, with what it found at the place, and what it expected or means there."""
    kinds, meaning = _single(kind), ""
    if isinstance(value, dict):
        kinds = [each for each in kinds if getattr(each, "tag", None) == value.get("task")] or kinds
    for part in re.findall(r"\w+|\.\.\.", place):
        if part == "...":  # a name, which msgspec does not tell
            return said
        value = value[int(part) if isinstance(value, list) else part]
        inner = [each for outer in kinds for each in _inner(outer, part)]
        kinds = [each for whole in inner for each in _single(whole)]
        notes = [
            each.extra_json_schema or {} for each in inner if isinstance(each, inspect.Metadata)
        ]
        meaning = next(
            (f" ({note['description']})" for note in notes if "description" in note), meaning
        )
    if said.startswith("object "):  # lacks a field, or has one too many
        names = [
            field.encode_name
            for each in kinds
            if isinstance(each, inspect.StructType)
            for field in each.fields
        ]
        return f"{said} (expected {', '.join(names)})" if "unknown" in said and names else said
    choices = [
        str(word) for each in kinds if isinstance(each, inspect.LiteralType) for word in each.values
    ]
    if choices:
        return (
            f"expected {'one of ' * (len(choices) > 1)}{', '.join(choices)}, found {shown(value)}"
        )
    return f"{said.partition(', got ')[0]}, found {shown(value)}{meaning}"


def _inner(kind: inspect.Type, part: str) -> Sequence[inspect.Type]:
    """The kinds that a field or an entry of a value of a kind may have."""
    if isinstance(kind, inspect.StructType):
        return [each.type for each in kind.fields if each.encode_name == part] or [
            inspect.LiteralType((kind.tag,))
        ]
    if isinstance(kind, inspect.TupleType):
        return [kind.item_types[int(part)]]
    return [kind.item_type] if isinstance(kind, inspect.ListType | inspect.VarTupleType) else []


def _single(kind: inspect.Type) -> list[inspect.Type]:
    """The kinds that a kind joins, without notes on them."""
    if isinstance(kind, inspect.Metadata):
        return _single(kind.type)
    return (
        [part for each in kind.types for part in _single(each)]
        if isinstance(kind, inspect.UnionType)
        else [kind]
    )


def json_meta(meta: object) -> dict[str, Any]:
    """A copy of `meta` as JSON holds it; raises ContentError."""
    if not isinstance(meta, Mapping):
        raise ContentError(
            f"meta: expected a mapping of names to what JSON holds, found {type(meta).__name__}"
        )
    try:
        text = json.dumps(dict(meta), allow_nan=False)
    except (TypeError, ValueError, RecursionError) as error:
        raise ContentError(f"meta: cannot be written as JSON ({error})") from error
    with at("meta"):
        copied: dict[str, Any] = parsed_json(text.encode(), _MOST_LEVELS)
    return copied


def check_token(token: object) -> str:
    """A sample's token, if it could be one: words with `/` between; raises ContentError."""
    if not isinstance(token, str):
        raise ContentError(f"expected a sample's token, a text, found {shown(token)}")
    good = len(token) <= _LONGEST_TOKEN and token.isprintable() and re.fullmatch(WORDS, token)
    if not good or {".", ".."} & set(token.split("/")):
        raise ContentError(
            f"expected a sample's token, <scenario_type>/<name>/<agent>/<NNN>, found {shortened(token)!r}"
        )
    return token


class _Texts(msgspec.Struct):
    """The entries of each sample, not yet read."""

    results: dict[str, msgspec.Raw]


def read_document(content: bytes, path: Path) -> tuple[ResultsFile, dict[str, Any]]:
    """The records of a results file, and its meta; raises ContentError that names token and field, or ResultsError."""
    try:
        document: ResultsFile = decoded(content, ResultsFile)  # type: ignore[arg-type]  # a union is a kind too
    except ContentError:
        _tell(content, path)
        raise
    return document, json_meta(_strict_meta(content, document))


def _strict_meta(content: bytes, document: ResultsFile) -> object:
    """The meta of a document, where no name stands twice, and all that was not read is JSON as `parsed_json` has it.

    The records have as many names as the text has colons outside texts. Where it has more, the strict reader says why;
    it takes four times as long.
    """
    if not isinstance(document, MotionFile):
        record = ENTRY_RECORDS[document.task]
        entries = list(chain.from_iterable(document.results.values()))
        optional = record.__struct_fields__[
            len(record.__struct_fields__) - len(record.__struct_defaults__) :
        ]
        kinds = Counter(
            chain.from_iterable(map(type, map(attrgetter(name), entries)) for name in optional)
        )
        ignored = (
            [getattr(each, name) for each in entries for name in optional]
            if kinds[msgspec.Raw]
            else []
        )
        unread = b"[%s]" % b",".join(
            [document.meta, *(each for each in ignored if isinstance(each, msgspec.Raw))]
        )
        # the file's own names, the task among them, those of samples, and those of entries
        names = (
            len(document.__struct_fields__)
            + 1
            + len(document.results)
            + len(entries) * len(record.__struct_fields__)
        )
        colons = np.count_nonzero(np.frombuffer(content, np.uint8) == ord(":"))
        with suppress(ContentError):
            meta, *_ = parsed_json(unread)
            if names - kinds[msgspec.UnsetType] + unread.count(b":") == colons:
                return meta
    return parsed_json(content)["meta"]


def _tell(content: bytes, path: Path) -> None:
    """Say what is wrong with a results file, by its token or with its remedy, where that is known; raises."""
    told = parsed_json(content)
    if not isinstance(told, dict):
        raise ContentError(f"expected a JSON object, found {shown(told)}")
    if "format" not in told and "results" in told:
        raise ContentError(
            f'has no "format" (a nuScenes results file?); put "format": "{FORMAT}", "version": {FORMAT_VERSION} and '
            '"task": "detection" before its "meta" and "results"'
        )
    version = told.get("version")
    if told.get("format") == FORMAT and type(version) is int and version != FORMAT_VERSION:
        age, remedy = (
            ("a newer", "update the devkit")
            if version > FORMAT_VERSION
            else ("an older", "write it again")
        )
        raise ResultsError(
            f"{path}: version: {age} results format ({shown(version)}, this devkit's is {FORMAT_VERSION}); {remedy}"
        )
    record = ENTRY_RECORDS.get(str(told.get("task")))
    if record is not None and isinstance(told.get("results"), dict):
        for token, entries in decoded(content, _Texts).results.items():
            with at(entry_place(token)):
                read_entries(bytes(entries), record)


def read_entries(content: bytes, record: type[Entry]) -> list[Entry]:
    """A sample's entries; raises ContentError that names the number of the entry and the field."""
    return decoded(content, list[record])  # type: ignore[valid-type]  # msgspec wants it so at run time


def entry_place(token: str, number: int | None = None) -> str:
    """How errors name a sample's entries, or one of them."""
    return f"results of {shortened(token)!r}" + ("" if number is None else f": [{number}]")
