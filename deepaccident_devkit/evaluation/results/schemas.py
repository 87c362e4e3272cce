"""JSON Schemas (draft 2020-12) of results files; schema/results holds them as files."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Final, get_args

from deepaccident_devkit.evaluation.results.columns import LARGEST
from deepaccident_devkit.evaluation.results.entries import IGNORED
from deepaccident_devkit.evaluation.results.header import FORMAT, FORMAT_VERSION, WORDS, Stored
from deepaccident_devkit.geometry.bev_grid import ORIENTATIONS
from deepaccident_devkit.motion import LABEL_PROTOCOLS
from deepaccident_devkit.taxonomy import CATEGORIES


def _object(required: Mapping[str, Any], optional: Mapping[str, Any] | None = None) -> dict[str, Any]:
    return {
        "type": "object",
        "additionalProperties": False,
        "required": list(required),
        "properties": {**required, **(optional or {})},
    }


def _list(item: Mapping[str, Any], length: int | None = None) -> dict[str, Any]:
    limits = {} if length is None else {"minItems": length, "maxItems": length}
    return {"type": "array", "items": dict(item), **limits}


def _or_null(schema: Mapping[str, Any]) -> dict[str, Any]:
    return {"anyOf": [dict(schema), {"type": "null"}]}


def _said(description: str, schema: Mapping[str, Any]) -> dict[str, Any]:
    return {"description": description, **schema}


_NUMBER: Final = {"type": "number"}
_MEASURE: Final = {"type": "number", "minimum": -LARGEST, "maximum": LARGEST}
_FROM_ZERO: Final = {"type": "number", "minimum": 0, "maximum": LARGEST}
_WHOLE: Final = {"type": "integer"}
_COUNT: Final = {"type": "integer", "minimum": 1}
_TOKEN: Final = {"type": "string", "pattern": WORDS}
_ACCIDENT: Final = _object(
    {
        "positions": _said(
            "Of the two that collide: x forward, y left, metres, in the present ego frame of the sample's agent.",
            _list(_list(_MEASURE, 2), 2),
        ),
        "time": _said("Seconds after the present.", _FROM_ZERO),
        "score": _said("How sure the model is, the more the higher.", _NUMBER),
    },
    {"ids": _said("Their actor ids, in the order of the positions; null if not known.", _or_null(_list(_WHOLE, 2)))},
)
_BOX: Final = _object(
    {
        "sample_token": _said("The sample's token, under which the box stands.", _TOKEN),
        "translation": _said("Centre x, y, z in the world, right-handed, metres.", _list(_MEASURE, 3)),
        "size": _said("WIDTH, LENGTH, HEIGHT, metres: nuScenes' order.", _list(_FROM_ZERO, 3)),
        "rotation": _said(
            "Unit quaternion w, x, y, z: the box's axes (x along its length) in the world.", _list(_NUMBER, 4)
        ),
        "detection_name": _said("Category.", {"enum": list(CATEGORIES)}),
        "detection_score": _said("How sure the model is, the more the higher.", _NUMBER),
    },
    {
        "velocity": _said(
            "x and y in the world over the ground, m/s; null if not known.", _or_null(_list(_MEASURE, 2))
        ),
        **{name: _said("Ignored.", {}) for name in IGNORED},
    },
)
_FORM: Final = _object(
    {
        "stored": _said("Maps of ids and paths, or a model's own maps.", {"enum": list(get_args(Stored))}),
        "x": _said("Start, end and cell size, metres, x forward in the present ego frame.", _list(_NUMBER, 3)),
        "y": _said("Start, end and cell size, metres, y left in the present ego frame.", _list(_NUMBER, 3)),
        "orientation": _said("How cells lie in the maps.", {"enum": list(ORIENTATIONS)}),
        "predictions": _said("K: how many a sample has at most; the last one is the mean.", _COUNT),
        "frames": _said("T: how many a prediction has, the present one first.", _COUNT),
        "step": _said("Seconds from one frame to the next.", {"type": "number", "exclusiveMinimum": 0}),
        "labels": _said("The label protocol that the model learned from.", {"enum": [*LABEL_PROTOCOLS, None]}),
    }
)
_SHARD: Final = _object(
    {
        "file": _said("Path of the archive in the folder.", {"type": "string", "minLength": 1}),
        "tokens": _said("Its samples.", {**_list(_TOKEN), "minItems": 1, "uniqueItems": True}),
        "bytes": _said("Its size.", {"type": "integer", "minimum": 0}),
        "checksum": _said("BLAKE2b of its bytes, 16 bytes as hexadecimal digits.", {"type": "string"}),
    }
)


def _results(entry: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "description": "Sample token to what is predicted of it; [] for nothing.",
        "type": "object",
        "minProperties": 1,
        "propertyNames": _TOKEN,
        "additionalProperties": _list(entry),
    }


def _schema(task: str, body: Mapping[str, Any]) -> dict[str, Any]:
    header = {
        "format": {"const": FORMAT},
        "version": {"const": FORMAT_VERSION},
        "task": {"const": task},
        "meta": _said("What the author says: the method, its training.", {"type": "object"}),
    }
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": f"{FORMAT}: {task}",
        **_object({**header, **body}),
    }


RESULT_SCHEMAS: Final[Mapping[str, Mapping[str, Any]]] = MappingProxyType(
    {
        "motion": _schema("motion", {"form": _FORM, "shards": {**_list(_SHARD), "minItems": 1}}),
        "accident": _schema("accident", {"results": _results(_ACCIDENT)}),
        "detection": _schema("detection", {"results": _results(_BOX)}),
    }
)
"""Task → schema of its JSON file: for motion that is the manifest.

What a schema cannot say, `read_results` checks too: names that stand twice, NaN, unit quaternions, arrays.
"""
