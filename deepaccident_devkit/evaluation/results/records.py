"""The records that results files consist of. They check what JSON holds, and schema/results is made of them."""

from __future__ import annotations

from types import MappingProxyType
from typing import Annotated, Any, Final, Literal, TypeAlias, get_args

import msgspec
from msgspec import UNSET, Meta, UnsetType

from deepaccident_devkit.geometry.bev_grid import Axis, Orientation
from deepaccident_devkit.motion import LABEL_PROTOCOLS
from deepaccident_devkit.taxonomy import CATEGORIES

ResultsTask = Literal["motion", "accident", "detection"]
Stored = Literal["instances", "heads"]
Format = Literal["DeepAccident results"]
Version = Literal[1]
"""Counted up with what files hold."""
FORMAT: Final = get_args(Format)[0]
FORMAT_VERSION: Final = get_args(Version)[0]
WORDS: Final = r"^[^/\\]+(/[^/\\]+)*$"
"""A regular expression of tokens: words with `/` between."""
LARGEST: Final = 1e6
"""Metres, seconds, metres a second: larger numbers are mistakes, and squares of the largest floats overflow."""
Measure = Annotated[float, Meta(ge=-LARGEST, le=LARGEST)]
FromZero = Annotated[float, Meta(ge=0, le=LARGEST)]
Count = Annotated[int, Meta(ge=1)]
ActorId = Annotated[int, Meta(ge=-(2**63), le=2**63 - 1)]
Token = Annotated[str, Meta(extra_json_schema={"pattern": WORDS})]
Ignored = Annotated[msgspec.Raw | UnsetType, Meta(description="Ignored.")]
"""A further field of the nuScenes devkit; this dataset has no attributes."""


class AccidentEntry(msgspec.Struct, forbid_unknown_fields=True, gc=False):
    """An accident that is foreseen."""

    positions: Annotated[
        tuple[tuple[Measure, Measure], tuple[Measure, Measure]],
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

    sample_token: Annotated[Token, Meta(description="The sample's token, under which the box stands.")]
    translation: Annotated[
        tuple[Measure, Measure, Measure], Meta(description="Centre x, y, z in the world, right-handed, metres.")
    ]
    size: Annotated[
        tuple[FromZero, FromZero, FromZero], Meta(description="WIDTH, LENGTH, HEIGHT, metres: nuScenes' order.")
    ]
    rotation: Annotated[
        tuple[float, float, float, float],
        Meta(description="Unit quaternion w, x, y, z: the box's axes (x along its length) in the world."),
    ]
    detection_name: Annotated[Literal[CATEGORIES], Meta(description="Category.")]  # type: ignore[valid-type]
    detection_score: Annotated[float, Meta(description="How sure the model is, the more the higher.")]
    velocity: Annotated[
        tuple[Measure, Measure] | UnsetType | None,
        Meta(description="x and y in the world over the ground, m/s; null if not known."),
    ] = UNSET
    attribute_name: Ignored = UNSET
    ego_translation: Ignored = UNSET
    num_pts: Ignored = UNSET


class FormRecord(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """How motion is stored."""

    stored: Annotated[Stored, Meta(description="Maps of ids, or a model's own maps.")]
    x: Annotated[Axis, Meta(description="Start, end and cell size, metres, x forward in the present ego frame.")]
    y: Annotated[Axis, Meta(description="Start, end and cell size, metres, y left in the present ego frame.")]
    orientation: Annotated[Orientation, Meta(description="How cells lie in the maps.")]
    predictions: Annotated[Count, Meta(description="K: how many a sample has at most; the last one is the mean.")]
    frames: Annotated[Count, Meta(description="T: how many a prediction has, the present one first.")]
    step: Annotated[float, Meta(gt=0, description="Seconds from one frame to the next.")]
    labels: Annotated[
        Literal[(*LABEL_PROTOCOLS,)] | None,  # type: ignore[valid-type]
        Meta(description="The label protocol that the model learned from."),
    ]


class Shard(msgspec.Struct, forbid_unknown_fields=True, kw_only=True, frozen=True):
    """An archive of some samples."""

    file: Annotated[str, Meta(min_length=1, description="Path of the archive in the folder.")]
    tokens: Annotated[
        tuple[Token, ...], Meta(min_length=1, description="Its samples.", extra_json_schema={"uniqueItems": True})
    ]
    bytes: Annotated[int, Meta(ge=0, description="Its size.")]
    checksum: Annotated[str, Meta(description="BLAKE2b of its bytes, 16 bytes as hexadecimal digits.")]


class _File(msgspec.Struct, forbid_unknown_fields=True, kw_only=True, tag_field="task"):
    format: Format
    version: Version
    meta: Annotated[
        msgspec.Raw,
        Meta(description="What the author says: the method, its training.", extra_json_schema={"type": "object"}),
    ]

    @property
    def task(self) -> ResultsTask:
        """What its predictions are of."""
        task: ResultsTask = self.__struct_config__.tag  # type: ignore[assignment]  # the class says which
        return task


_BY_TOKEN: Final = Meta(
    min_length=1,
    description="Sample token to what is predicted of it; [] for nothing.",
    extra_json_schema={"propertyNames": {"pattern": WORDS}},  # which msgspec finds itself from 0.22 on
)


class AccidentFile(_File, tag="accident"):
    """Accidents of many samples."""

    results: Annotated[dict[Token, list[AccidentEntry]], _BY_TOKEN]


class DetectionFile(_File, tag="detection"):
    """Detected boxes of many samples."""

    results: Annotated[dict[Token, list[BoxEntry]], _BY_TOKEN]


class MotionFile(_File, tag="motion"):
    """The manifest of motion maps."""

    form: FormRecord
    shards: Annotated[list[Shard], Meta(min_length=1)]


ResultsFile: TypeAlias = MotionFile | AccidentFile | DetectionFile


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
