"""Detections of a nuScenes export, as a nuScenes detector writes them, back under our tokens and classes.

Both formats have the boxes in the right-handed world, with width, length, height and quaternions w, x, y, z
(schema/results/README.md); tokens and classes alone differ.
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
    at,
    entry_place,
    read_entries,
    shown,
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
"""nuScenes' detection classes that this dataset does not have."""
_IGNORED: Final = ("attribute_name", "ego_translation", "num_pts")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NuScenesDetections:
    """What a detector says of samples of a nuScenes export.

    Attributes:
        boxes: token of our sample → its boxes, in the world, in the file's order.
        left_out: class that this dataset does not have → boxes of it, which are left out.
        meta: what the file's author says.
    """

    boxes: Mapping[str, DetectedBoxes]
    left_out: Mapping[str, int]
    meta: Mapping[str, Any]


def results_from_nuscenes(dataset: Dataset, path: str | os.PathLike[str]) -> NuScenesDetections:
    """Read a nuScenes detection file, `{"meta": …, "results": {sample token: [box, …]}}`, of our nuScenes export.

    nuScenes has no class for vans: of its ten classes none becomes `van`. A detector that learned our own classes may
    write those.

    Args:
        dataset: the release that was exported, or one that contains it.
        path: of the file.

    Raises:
        ResultsError: it cannot be read, is no such file, or has a sample that is not of this release's export; the
            message names the first one.
    """
    file = path_of(path).absolute()
    ours = {token("sample", sample): sample for sample in _key_samples(dataset)}
    try:
        return _read(parsed_json(read_bytes(file, "results"), constants=True), ours)
    except (OSError, ValueError) as error:
        remedy = 'give nuScenes detections, {"meta": …, "results": sample token → boxes}, of the nuScenes export of'
        raise ResultsError(f"{file}: {fault_text(error)}; {remedy} {dataset.dataroot}") from error


def _read(document: object, ours: Mapping[str, str]) -> NuScenesDetections:
    """The detections of a document, of nuScenes' tokens → our samples; raises ContentError."""
    if not isinstance(document, dict):
        raise ContentError(f"expected a JSON object, found {shown(document)}")
    if document.get("format") == FORMAT:
        raise ContentError(
            "is in DeepAccident's own format, which `deepaccident evaluate` takes as it is"
        )
    meta, results = document.get("meta", {}), document.get("results")
    if not isinstance(meta, dict):
        raise ContentError(f"meta: expected an object, found {shown(meta)}")
    if not isinstance(results, dict) or not results:
        raise ContentError(
            f"results: expected an object, sample token to list of boxes, found {shown(results)}"
        )
    left_out = _take_our_classes(results)
    records = {}
    for theirs, given in results.items():
        with at(entry_place(theirs)):
            records[theirs] = read_entries(json.dumps(given).encode(), BoxEntry)
    entries = Entries.read(records, detection_columns)
    boxes = {}
    for theirs in entries.number:
        if theirs not in ours:
            raise ContentError(
                f"results: {shortened(theirs)}: is no sample of this release's export"
            )
        found, others = boxes_at(entries, theirs), left_out.get(theirs, {})
        kept = np.array([number not in others for number in range(len(found))], dtype=bool)
        boxes[ours[theirs]] = DetectedBoxes(boxes=found.boxes[kept], scores=found.scores[kept])
    counts = Counter(name for others in left_out.values() for name in others.values())
    return NuScenesDetections(boxes=boxes, left_out=dict(sorted(counts.items())), meta=meta)


def _take_our_classes(results: dict[str, Any]) -> dict[str, dict[int, str]]:
    """Give boxes our classes, those of other classes any, and null for a velocity of NaN; what is wrong stays.

    Returns, by token, the number of each box that is to be left out, and its class.
    """
    left_out: dict[str, dict[int, str]] = {}
    for theirs, given in results.items():
        for number, entry in enumerate(given if isinstance(given, list) else ()):
            if not isinstance(entry, dict):
                continue
            for ignored in _IGNORED:  # NaN may stand there
                entry.pop(ignored, None)
            name, velocity = entry.get("detection_name"), entry.get("velocity")
            if name in OTHER_CLASSES:
                left_out.setdefault(theirs, {})[number] = name
                entry["detection_name"] = CATEGORIES[0]
            elif name == "bicycle":  # the others have our names
                entry["detection_name"] = "cyclist"
            if isinstance(velocity, list) and any(
                isinstance(each, float) and math.isnan(each) for each in velocity
            ):
                entry["velocity"] = None  # the nuScenes devkit writes it so where it is not known
    return left_out


def _key_samples(dataset: Dataset) -> Iterator[str]:
    """The samples that the export has: the keyframes of each agent."""
    samples, scenarios = dataset.columns("sample"), dataset.columns("scenario")
    rows = samples["scenario_row"]
    to_end = scenarios["num_frames"][rows] - (
        samples["frame_row"] - scenarios["first_frame_row"][rows] + 1
    )
    for row in np.flatnonzero(to_end % KEY_STEP == 0).tolist():
        yield dataset.sample[row]["token"]
