"""Detections of a nuScenes export, by a nuScenes detector, converted to DeepAccident's tokens.

Classes are converted as well. Both formats have the boxes in the right-handed world, with width,
length, height and quaternions w, x, y, z (schema/results/README.md); only tokens and classes
differ.
"""

from __future__ import annotations

import json
import math
import os
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.errors import ResultsError, shortened
from deepaccident_devkit.evaluation import DetectedBoxes
from deepaccident_devkit.evaluation.results.reader import Entries, boxes_at, detection_columns
from deepaccident_devkit.evaluation.results.records import (
    FORMAT,
    BoxEntry,
    ContentError,
    entry_place,
    json_excerpt,
    locate_errors,
    read_entries,
)
from deepaccident_devkit.export.frames import KEY_STEP
from deepaccident_devkit.export.nuscenes.scenes import token
from deepaccident_devkit.support.json_text import parsed_json
from deepaccident_devkit.support.reading import fault_text, read_bytes
from deepaccident_devkit.support.text import path_of
from deepaccident_devkit.taxonomy import CATEGORIES

if TYPE_CHECKING:
    from deepaccident_devkit.dataset import Dataset

OTHER_CLASSES: Final = ("bus", "trailer", "construction_vehicle", "barrier", "traffic_cone")
"""Detection classes of nuScenes that this dataset does not have."""
_IGNORED_FIELDS: Final = ("attribute_name", "ego_translation", "num_pts")
_REMEDY: Final = (
    'give nuScenes detections, {"meta": …, "results": sample token → boxes}, of the nuScenes '
    "export of"
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NuScenesDetections:
    """A detector's boxes in samples of a nuScenes export.

    Attributes:
        boxes: Token of the devkit's sample → its boxes, in the world frame, in the file's order.
        left_out: Class that this dataset does not have → number of its boxes, which are left out.
        meta: Notes of the file's author.
    """

    boxes: Mapping[str, DetectedBoxes]
    left_out: Mapping[str, int]
    meta: Mapping[str, Any]


def results_from_nuscenes(dataset: Dataset, path: str | os.PathLike[str]) -> NuScenesDetections:
    """Read a nuScenes detection file of the devkit's nuScenes export.

    Its form is `{"meta": …, "results": {sample token: [box, …]}}`. nuScenes has no class for vans:
    none of its ten classes becomes `van`. A detector that learned DeepAccident's classes may write
    them.

    Args:
        dataset: The release that was exported, or one that contains it.
        path: Path of the file.

    Raises:
        ResultsError: it cannot be read, is no such file, or has a sample that is not of this
            release's export; the message names the first one.
    """
    file = path_of(path).absolute()
    samples = {token("sample", sample): sample for sample in _key_samples(dataset)}
    try:
        return _read(parsed_json(read_bytes(file, "results"), constants=True), samples)
    except (OSError, ValueError) as error:
        fault = fault_text(error)
        raise ResultsError(f"{file}: {fault}; {_REMEDY} {dataset.dataroot}") from error


def _read(document: object, samples: Mapping[str, str]) -> NuScenesDetections:
    """Return the detections of a document; raises ContentError.

    Args:
        document: The parsed file.
        samples: Token in nuScenes' format → token of the devkit's sample.
    """
    if not isinstance(document, dict):
        raise ContentError(f"expected a JSON object, found {json_excerpt(document)}")
    if document.get("format") == FORMAT:
        raise ContentError(
            "is in DeepAccident's own format, which `deepaccident evaluate` takes as it is"
        )
    meta, results = document.get("meta", {}), document.get("results")
    if not isinstance(meta, dict):
        raise ContentError(f"meta: expected an object, found {json_excerpt(meta)}")
    if not isinstance(results, dict) or not results:
        raise ContentError(
            "results: expected an object, sample token to list of boxes, found "
            f"{json_excerpt(results)}"
        )
    left_out = _convert_classes(results)
    records = {}
    for key, sample_entries in results.items():
        with locate_errors(entry_place(key)):
            records[key] = read_entries(json.dumps(sample_entries).encode(), BoxEntry)
    entries = Entries.read(records, detection_columns)
    boxes = {}
    for key in entries.number:
        if key not in samples:
            raise ContentError(f"results: {shortened(key)}: is no sample of this release's export")
        detected = boxes_at(entries, key)
        left_out_numbers = left_out.get(key, {})
        retained = [number not in left_out_numbers for number in range(len(detected))]
        rows = np.array(retained, dtype=bool)
        boxes[samples[key]] = DetectedBoxes(
            boxes=detected.boxes[rows], scores=detected.scores[rows]
        )
    counts = Counter(name for numbers in left_out.values() for name in numbers.values())
    return NuScenesDetections(boxes=boxes, left_out=dict(sorted(counts.items())), meta=meta)


def _convert_classes(results: dict[str, Any]) -> dict[str, dict[int, str]]:
    """Convert boxes to DeepAccident's classes in place, and unknown velocities to null.

    Boxes of other classes get any class. Invalid entries stay unchanged.

    Returns:
        Token → number of each box that is to be left out → its class.
    """
    left_out: dict[str, dict[int, str]] = {}
    for key, sample_entries in results.items():
        for number, entry in enumerate(sample_entries if isinstance(sample_entries, list) else ()):
            if not isinstance(entry, dict):
                continue
            for field in _IGNORED_FIELDS:  # they may be NaN
                entry.pop(field, None)
            name = entry.get("detection_name")
            if name in OTHER_CLASSES:
                left_out.setdefault(key, {})[number] = name
                entry["detection_name"] = CATEGORIES[0]
            elif name == "bicycle":  # the other classes have the same names
                entry["detection_name"] = "cyclist"
            if _has_nan(entry.get("velocity")):
                # the nuScenes devkit writes NaN where the velocity is unknown
                entry["velocity"] = None
    return left_out


def _has_nan(velocity: object) -> bool:
    """Return whether a velocity is a list with a NaN."""
    if not isinstance(velocity, list):
        return False
    return any(isinstance(value, float) and math.isnan(value) for value in velocity)


def _key_samples(dataset: Dataset) -> Iterator[str]:
    """Yield the samples of the export: the keyframes of each agent."""
    samples, scenarios = dataset.columns("sample"), dataset.columns("scenario")
    rows = samples["scenario_row"]
    frame_numbers = samples["frame_row"] - scenarios["first_frame_row"][rows] + 1
    frames_to_end = scenarios["num_frames"][rows] - frame_numbers
    for row in np.flatnonzero(frames_to_end % KEY_STEP == 0).tolist():
        yield dataset.sample[row]["token"]
