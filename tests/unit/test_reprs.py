"""Objects that hold arrays say in one short line what they are, and never print the numbers."""

import inspect
import pkgutil
from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from importlib import import_module
from typing import Any

import numpy as np
import pytest

import deepaccident_devkit
from deepaccident_devkit import DeepAccident
from deepaccident_devkit.arrays import ShortRepr
from deepaccident_devkit.evaluation import Accident, AccidentEvaluator, DetectedBoxes, MotionOutput
from deepaccident_devkit.geometry import SE3, BevGrid, Boxes, LidarPointCloud
from deepaccident_devkit.motion import LABEL_PROTOCOLS, MotionHeads, MotionLabelConfig, MotionLabels
from deepaccident_devkit.v2x import Contact

GRID = BevGrid((-4.0, 4.0, 0.5), (-3.0, 3.0, 0.25))


def heads() -> MotionHeads:
    return MotionHeads(**{name: np.zeros((5, axes, *GRID.shape)) for name, axes in
                          (("segmentation", 2), ("centerness", 1), ("offset", 2), ("flow", 2))})  # fmt: skip


def labels(**changes: Any) -> MotionLabels:
    config = MotionLabelConfig(grid=GRID, **changes)
    shape = config.label_frames, *GRID.shape
    return MotionLabels(
        config=config,
        segmentation=np.zeros(shape, dtype=np.uint8),
        instance=np.zeros(shape, dtype=np.int32),
        centerness=np.zeros((shape[0], 1, *GRID.shape)),
        offset=np.zeros((shape[0], 2, *GRID.shape)),
        flow=np.zeros((shape[0], 2, *GRID.shape)),
        future_egomotion=np.zeros((config.frames, 6)),
        valid=np.ones(config.frames, dtype=bool),
        id_map={3: 1, 7: 2},
    )


def cloud() -> LidarPointCloud:
    return LidarPointCloud([[-1, 2, 0.25], [30, -4, 0], [np.nan, 0, 0]], np.zeros(3), "ego")  # type: ignore[arg-type]


def boxes() -> Boxes:
    return Boxes.from_arrays(
        np.zeros((6, 3)), np.ones((6, 3)), np.zeros(6), category=range(6), frame="Camera_Front_Left"
    )


def contact() -> Contact:
    return Contact(
        instances=("a", "b"),
        actor_ids=(20001, 20002),
        frame="f",
        point=np.full(3, -1234.56),
        gap=0.123456789,
        speeds=(12.3, 12.3),
        closing_speed=-12.3,
        impact_angle=3.1,
        sides=("front", "right"),
        disagreements=("a gap of 3.1 m",),
    )


OWN = {
    "Boxes": boxes,
    "Contact": contact,
    "LidarPointCloud": cloud,
    "MotionHeads": heads,
    "MotionLabels": labels,
    "MotionOutput": lambda: MotionOutput(grid=GRID, heads=(heads(), heads())),
    "SE3": SE3.identity,
}
"""Classes with a text of their own → a maker of one."""


def public_classes() -> dict[str, type]:
    """The public dataclasses with array fields, by name; those of torch's adapter have none."""
    found = {}
    for module in pkgutil.walk_packages(deepaccident_devkit.__path__, "deepaccident_devkit."):
        if module.ispkg and ".torch" not in module.name and "._" not in module.name:
            found |= {kind.__name__: kind for kind in exported(import_module(module.name))}
    return found


def exported(module: Any) -> Iterator[type]:
    for name in getattr(module, "__all__", ()):
        kind = getattr(module, name)
        if inspect.isclass(kind) and is_dataclass(kind) and any("rray" in str(one.type) for one in fields(kind)):
            yield kind


def full(kind: type) -> Any:
    """One whose fields are all large arrays, or collections of them."""
    result = object.__new__(kind)
    for number, field in enumerate(fields(kind)):
        value: Any = np.full((1000, 1000), 0.123456789)
        kinds = [value, {"a": value}, (value, value), dict.fromkeys(range(50), 1.5), "long " * 50, 1 / 3]
        object.__setattr__(result, field.name, value if "rray" in str(field.type) else kinds[number % len(kinds)])
    return result


def test_no_public_class_prints_its_arrays() -> None:
    found = public_classes()
    assert {*OWN, "DetectionResult", "WarningResult", "WarningCurve", "Trajectory", "Labels", "BevImage"} <= set(found)
    assert {name for name, kind in found.items() if kind.__repr__ is not ShortRepr.__repr__} == set(OWN)
    for name, kind in found.items():
        text = repr(OWN[name]() if name in OWN else full(kind))
        assert text.startswith(f"{name}("), text
        assert len(text) < 200, text
        assert "\n" not in text
        assert "0.1234567" not in text, text
        assert "array(" not in text, text


def test_texts() -> None:
    assert repr(cloud()) == "LidarPointCloud(3 points in ego: x -1.0 to 30.0 m, y -4.0 to 2.0 m, z 0.0 to 0.2 m)"
    assert repr(cloud().select([])) == "LidarPointCloud(0 points in ego)"
    assert repr(heads()) == "MotionHeads(5 frames of 24 × 16 cells, devkit)"
    assert (
        repr(OWN["MotionOutput"]()) == "MotionOutput(2 predictions of 5 frames, 24 × 16 cells of 0.5 × 0.25 m, heads)"
    )
    one = MotionOutput(grid=BevGrid(), instances=np.zeros((1, 5, 200, 200), dtype=np.int32))
    assert repr(one) == "MotionOutput(1 prediction of 5 frames, 200 × 200 cells of 0.5 m, instances)"
    start = "MotionLabels(5 frames of 24 × 16 cells of 0.5 × 0.25 m, 2 actors in id_map, "
    assert repr(labels()) == f"{start}released, each frame in its own ego frame)"
    assert repr(labels(protocol=LABEL_PROTOCOLS["clean"]).to_present()) == f"{start}clean, all at the present)"
    mine = replace(LABEL_PROTOCOLS["clean"], half_cell_shift=True)
    assert repr(labels(protocol=mine)) == f"{start}own protocol, each frame in its own ego frame)"
    detected = DetectedBoxes(boxes=boxes()[:2], scores=np.array([0.5, 0.25]))
    assert repr(detected) == "DetectedBoxes(boxes=Boxes(2 in Camera_Front_Left: 1 car, 1 truck), scores=(2,) float64)"
    alarm = Accident(positions=np.zeros((2, 2)), time=1.5, ids=(3, 7))
    assert repr(alarm) == "Accident(positions=(2, 2) float64, time=1.5, score=1, ids=(3, 7))"


def test_evaluators_say_how_many_samples_they_have() -> None:
    evaluator = AccidentEvaluator("paper")
    assert repr(evaluator) == "AccidentEvaluator(0 samples)"
    evaluator.add("a/b/ego_vehicle/001", {})
    assert repr(evaluator) == "AccidentEvaluator(1 sample)"


@pytest.mark.parametrize("frame", ["lidar", "Camera_Back"])
def test_boxes_of_a_release(da: DeepAccident, frame: str) -> None:
    text = repr(da.boxes(da.sample[0], frame))
    assert text.startswith(f"Boxes({da.sample[0]['num_annotations']} in {frame}: ")
