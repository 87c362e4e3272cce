"""Detections that a nuScenes detector made on a nuScenes export, converted back to DeepAccident.

Tokens and classes are converted. Boxes need no conversion: both formats have them in the
right-handed world, with width, length, height and quaternions w, x, y, z
(schema/results/README.md).
"""

from __future__ import annotations

import json
import math
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
from deepaccident_devkit.support.text import PathType, path_of
from deepaccident_devkit.support.values import NamedValues
from deepaccident_devkit.taxonomy import CATEGORIES

if TYPE_CHECKING:
    from deepaccident_devkit.dataset import Dataset

OTHER_CLASSES: Final = ("bus", "trailer", "construction_vehicle", "barrier", "traffic_cone")
"""Detection classes of nuScenes that this dataset does not have."""
_IGNORED_FIELDS = ("attribute_name", "ego_translation", "num_pts")
_REMEDY = (
    'give nuScenes detections, {"meta": …, "results": sample token → boxes}, of the nuScenes '
    "export of"
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NuScenesDetections:
    """Boxes that a detector found in samples of a nuScenes export.

    Attributes:
        boxes: Boxes of each sample, in the world frame and in the file's order, by the devkit's
            sample token.
        left_out: Number of boxes that are left out, by class; DeepAccident does not have these
            classes.
        meta: Notes of the file's author.
    """

    boxes: Mapping[str, DetectedBoxes]
    left_out: Mapping[str, int]
    meta: Mapping[str, Any]


def results_from_nuscenes(dataset: Dataset, path: PathType) -> NuScenesDetections:
    """Read a nuScenes detection file that was made on the devkit's nuScenes export.

    Its format is `{"meta": …, "results": {sample token: [box, …]}}`. nuScenes has no class for
    vans, so none of its ten classes becomes `van`; but a detector that was trained on
    DeepAccident's classes may write `van`.

    Args:
        dataset: The release that was exported, or one that contains it.
        path: Path of the file.

    Raises:
        ResultsError: If the file cannot be read, is not a nuScenes detection file, or has a sample
            that is not in the export of this release; the message names the first such sample.
    """
    file = path_of(path).absolute()
    samples = {token("sample", sample): sample for sample in _find_keyframes(dataset)}
    try:
        document = parsed_json(read_bytes(file, "results"), constants=True)
        return _convert_document(document, samples)
    except (OSError, ValueError) as error:
        fault = fault_text(error)
        raise ResultsError(f"{file}: {fault}; {_REMEDY} {dataset.dataroot}") from error


def _convert_document(document: object, samples: Mapping[str, str]) -> NuScenesDetections:
    """Convert a parsed file to detections; raise ContentError if its content is invalid.

    Args:
        document: The parsed file.
        samples: The devkit's token of each sample, by the sample's token in the nuScenes export.
    """
    if not isinstance(document, dict):
        raise ContentError(f"expected a JSON object, found {json_excerpt(document)}")
    if document.get("format") == FORMAT:
        raise ContentError(
            "is in DeepAccident's own format, which `deepaccident evaluate` takes as it is"
        )
    meta = document.get("meta", {})
    results = document.get("results")
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
            raise ContentError(
                f"results: {shortened(key)}: is not a sample of the release's export"
            )
        detected = boxes_at(entries, key)
        is_retained = np.ones(len(detected), dtype=bool)
        is_retained[list(left_out.get(key, ()))] = False
        boxes[samples[key]] = DetectedBoxes(
            boxes=detected.boxes[is_retained], scores=detected.scores[is_retained]
        )
    counts: Counter[str] = Counter()
    for names in left_out.values():
        counts.update(names.values())
    return NuScenesDetections(boxes=boxes, left_out=dict(sorted(counts.items())), meta=meta)


def _convert_classes(results: NamedValues) -> dict[str, dict[int, str]]:
    """Convert boxes to DeepAccident's classes in place, and unknown velocities to null.

    Boxes of classes that DeepAccident does not have get an arbitrary class. Invalid entries stay
    unchanged.

    Returns:
        Classes of the boxes to leave out, by token, then by the box's index.
    """
    left_out: dict[str, dict[int, str]] = {}
    for key, sample_entries in results.items():
        if not isinstance(sample_entries, list):
            continue
        for number, entry in enumerate(sample_entries):
            if not isinstance(entry, dict):
                continue
            for field in _IGNORED_FIELDS:  # Their values may be NaN.
                entry.pop(field, None)
            name = entry.get("detection_name")
            if name in OTHER_CLASSES:
                left_out.setdefault(key, {})[number] = name
                entry["detection_name"] = CATEGORIES[0]
            elif name == "bicycle":  # The other classes have the same names in both.
                entry["detection_name"] = "cyclist"
            if _has_nan(entry.get("velocity")):
                # The nuScenes devkit writes NaN where the velocity is unknown.
                entry["velocity"] = None
    return left_out


def _has_nan(velocity: object) -> bool:
    """Return whether a velocity is a list that contains NaN."""
    if not isinstance(velocity, list):
        return False
    return any(isinstance(value, float) and math.isnan(value) for value in velocity)


def _find_keyframes(dataset: Dataset) -> Iterator[str]:
    """Yield the tokens of the exported samples, which are the keyframes of each agent."""
    samples = dataset.columns("sample")
    scenarios = dataset.columns("scenario")
    rows = samples["scenario_row"]
    frame_numbers = samples["frame_row"] - scenarios["first_frame_row"][rows] + 1
    frames_to_end = scenarios["num_frames"][rows] - frame_numbers
    for row in np.flatnonzero(frames_to_end % KEY_STEP == 0).tolist():
        yield dataset.sample[row]["token"]
