"""Motion and detection through the protocols: golden predictions, and simple ones of a synthetic release."""

import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.pages.accident import RELEASE
from benchmarks.pages.marks import TESTS, number, put
from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation.detection import (
    DETECTION_PROTOCOLS,
    DetectedBoxes,
    DetectionEvaluator,
    DetectionProtocol,
    DetectionResult,
    detection_truth,
)
from deepaccident_devkit.evaluation.detection.matching import frame_counts
from deepaccident_devkit.evaluation.detection.result import detection_result
from deepaccident_devkit.evaluation.motion import MotionEvaluator
from deepaccident_devkit.evaluation.predictions import MotionOutput, instances_of
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.motion import MotionHeads, MotionLabels
from deepaccident_devkit.synth import make_release

GOLDEN = TESTS / "data" / "golden"
SPLITS = ("train", "val", "test")
METRICS = ("IoU 30x30", "VPQ 30x30", "VPQ 100x100", "minADE (m)", "minFDE (m)", "miss rate", "paths", "accuracy")
Given = tuple[str, MotionOutput, MotionLabels]


def main(_release: Path | None = None) -> None:
    """Write all tables into the page."""
    sys.path.insert(0, str(TESTS))
    put("detection-golden", golden_detection())
    put("motion-attribute", golden_attribute())
    with tempfile.TemporaryDirectory() as folder:
        dataset = DeepAccident("v1", make_release(Path(folder) / "release", RELEASE), verbose=False)
        put("detection-release", release_detection(dataset))
        put("motion-release", motion_table(simple_predictions(dataset)))


def golden_attribute() -> str:
    """VPQ of the golden run (d_accident) by weather: of the right frames, and of those that the released code takes."""
    from parity.conftest import GoldenCase

    counted = MotionEvaluator(trajectories=False)
    for token, output, label in golden_samples():
        counted.update(token, output, label)
    case = GoldenCase(GOLDEN, "d_accident", "attributes_counter", None)
    order = list(counted.counts)
    lines = ["| weather | samples | VPQ 30x30 | as released | VPQ 100x100 | as released |", "|---|---|---|---|---|---|"]
    for value, numbers in case.whole["attributes_counter"]["weather"].items():
        tokens = [str(number) for number in numbers]
        both = [
            each.ranges[name].pq
            for name in ("30x30", "100x100")
            for each in (counted.compute(tokens), counted.selected_as_released(order, tokens))
        ]
        lines.append(f"| {value} | {len(tokens)} | {' | '.join(f'{pq:.1f}' for pq in both)} |")
    return "\n".join(lines)


def golden_samples() -> Iterator[Given]:
    """The samples of the golden run (d_accident)."""
    from parity.conftest import GoldenCase
    from parity.test_motion_end_to_end import Sample

    for index in range(len(GoldenCase(GOLDEN, "d_accident", "samples", None).whole["samples"])):
        sample = Sample(GoldenCase(GOLDEN, "d_accident", "samples", index))
        yield sample.token, sample.prediction, sample.label


def simple_predictions(dataset: DeepAccident) -> dict[str, list[Given]]:
    """Predictions of a release that need no model: the truth, and that everybody stays where it is."""
    samples: dict[str, list[Given]] = {"labels as maps": [], "labels as heads": [], "nobody moves": []}
    for token in _tokens(dataset):
        label = dataset.motion_labels(token).to_present("bilinear")
        right = MotionHeads.from_labels(label)
        there = label.segmentation[0, None] == 1
        still = replace(
            right,
            **{name: _repeated(getattr(right, name)) for name in ("segmentation", "centerness", "offset")},
            flow=_repeated(np.where(there, 0, right.flow[:1])),
        )
        grid = label.config.grid
        samples["labels as maps"].append((token, instances_of(label.instance, grid), label))
        for name, heads in (("labels as heads", right), ("nobody moves", still)):
            samples[name].append((token, MotionOutput(grid=grid, heads=(heads,)), label))
    return samples


def motion_table(samples: Mapping[str, Iterable[Given]]) -> str:
    """A line a set of samples, by the released protocol."""
    head = ["prediction", *METRICS]
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    for kind, given in samples.items():
        evaluator = MotionEvaluator()
        for each in given:
            evaluator.update(*each)
        result = evaluator.compute()
        near, far = result.ranges["30x30"], result.ranges["100x100"]
        percent = [f"{value:.2f}" for value in (near.iou, near.pq, far.pq)]
        errors = [f"{value:.3f}" for value in (result.min_ade, result.min_fde, result.miss_rate)]
        cells = [kind, *percent, *errors, str(result.paths), f"{result.path_accuracy:.3f}"]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def folded(rows: Mapping[str, Sequence[str]]) -> list[str]:
    """Lines of a table; names of rows that are as the first one stand together in the last line."""
    first = list(next(iter(rows.values())))
    same = [name for name, cells in rows.items() if list(cells) == first][1:]
    lines = [f"| {' | '.join([name, *cells])} |" for name, cells in rows.items() if name not in same]
    if same:
        lines.append(f"| no difference: {', '.join(same)} |" + " |" * len(first))
    return lines


def detection_variants() -> dict[str, dict[str, object]]:
    """Choices of the released protocol, changed one at a time; those of the truth are in `release_detection`."""
    return {
        "single_precision": {"single_precision": False},
        "unknown_velocity_is_zero": {"unknown_velocity_is_zero": False},
        "area": {"area": (-51.2, 51.2, -51.2, 51.2)},
        "area_of": {"area": (-51.2, 51.2, -51.2, 51.2), "area_of": "footprint"},
        "ranges": {"ranges": ((0.0, np.inf),)},
        "range_from_x_alone": {"range_from_x_alone": False},
        "measure": {"measure": "distance_bev"},
        "bottom_taken_as_top": {"bottom_taken_as_top": False},
        "thresholds": {"thresholds": (1.0, 2.0, 4.0)},
        "small_thresholds": {"small_thresholds": (0.25, 0.5, 1.0, 2.0)},
        "threshold_included": {"threshold_included": True},
        "matching": {"matching": "by_score"},
        "curve": {"curve": "nuscenes"},
        "points": {"points": 101},
        "min_recall": {"min_recall": 0.0},
        "error_of_bottoms": {"error_of_bottoms": False},
        "scale_by_overlap": {"scale_by_overlap": False},
        "orientation_unwrapped": {"orientation_unwrapped": False},
        "absent_class_is_zero": {"absent_class_is_zero": False},
        "classes": {"classes": (("vehicle", ("car", "truck", "van")),)},
    }


def golden_detection() -> str:
    """The golden detections (e_detection) through `released`, each choice changed, and the other protocols."""
    from parity.test_detection import frames

    def evaluate(protocol: DetectionProtocol) -> DetectionResult:
        counts = [
            {"token": f"{position:06d}", **frame_counts(*frame, protocol)}
            for position, frame in enumerate(frames(GOLDEN))
        ]
        return detection_result(counts, protocol)

    released = DETECTION_PROTOCOLS["released"]
    protocols = {"**`released`**": released}
    protocols |= {_switched(change): replace(released, **change) for change in detection_variants().values()}  # type: ignore[arg-type]
    opencood = DETECTION_PROTOCOLS["opencood"]
    protocols |= {f"**`{name}`**": DETECTION_PROTOCOLS[name] for name in ("released_iou", "paper", "opencood")}
    protocols["`opencood`, `global_sort=False`"] = replace(opencood, global_sort=False)
    protocols["`paper`, `min_precision=0`"] = replace(DETECTION_PROTOCOLS["paper"], min_precision=0.0)
    return detection_table(protocols, evaluate)


def release_detection(dataset: DeepAccident) -> str:
    """What the choices of the truth make of a detector that finds what is visible, 0.3 m and 0.05 rad off."""
    source, found = np.random.default_rng(0), {}
    for token in _tokens(dataset):
        seen = dataset.boxes(token, "lidar", "released")
        count = len(seen)
        off = source.normal(size=(count, 4)) * (0.3, 0.3, 0.1, 0.05)
        found[token] = DetectedBoxes(
            boxes=Boxes.from_arrays(
                seen.center + off[:, :3],
                seen.size,
                seen.yaw + off[:, 3],
                frame="lidar",
                category=seen.category,
                velocity=np.nan_to_num(seen.velocity),
            ),
            scores=source.uniform(size=count),
        )

    def evaluate(protocol: DetectionProtocol) -> DetectionResult:
        evaluator = DetectionEvaluator(protocol)
        for token, boxes in found.items():
            detected = boxes
            if protocol.frame == "ego":
                moved = boxes.boxes.transform(dataset.ego_from(token, "lidar01"), "ego")
                detected = DetectedBoxes(boxes=moved, scores=boxes.scores)
            evaluator.update(token, detected, detection_truth(dataset, token, protocol))
        return evaluator.compute()

    released = DETECTION_PROTOCOLS["released"]
    protocols = {"**`released`**": released}
    for change in (
        {"truth": "visible"},
        {"truth": "cooperative", "label_velocity": False},
        {"label_velocity": False},
        {"own_box": False},
        {"truth": "visible", "own_box": False},
        {"frame": "ego", "label_velocity": False},
    ):
        protocols[_switched(change)] = replace(released, **change)  # type: ignore[arg-type]
    protocols |= {f"**`{name}`**": DETECTION_PROTOCOLS[name] for name in ("released_iou", "paper", "opencood")}
    return detection_table(protocols, evaluate)


def detection_table(
    protocols: Mapping[str, DetectionProtocol], evaluate: Callable[[DetectionProtocol], DetectionResult]
) -> str:
    """A line a protocol."""
    head = ["protocol", "true boxes", "mAP (%)", "car AP", "pedestrian AP", "ATE (m)", "ASE", "AOE (rad)", "AVE (m/s)"]
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    return "\n".join([*lines, *folded({name: _cells(evaluate(each)) for name, each in protocols.items()})])


def _cells(result: DetectionResult) -> list[str]:
    by_class = result.class_average_precision
    points = [result.mean_average_precision, by_class.get("car", np.nan), by_class.get("pedestrian", np.nan)]
    return [
        str(result.truths.sum()),
        *(number(value, 2) for value in points),
        *(number(value, 3) for value in result.mean_errors.values()),
    ]


def _tokens(dataset: DeepAccident) -> list[str]:
    return [token for split in SPLITS for token in dataset.samples(split, "evaluate")]


def _repeated(maps: np.ndarray) -> np.ndarray:
    return np.repeat(maps[:1], 5, axis=0)


def _switched(change: Mapping[str, object]) -> str:
    return ", ".join(f"`{name}={_text(value)}`" for name, value in change.items())


def _text(value: object) -> str:
    return "∞" if value == np.inf else str(value).replace("inf", "∞")
