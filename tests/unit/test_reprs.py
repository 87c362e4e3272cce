"""Objects that hold arrays say in one short line what they are, and never print the numbers."""

import base64
import inspect
import pkgutil
import re
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass, replace
from enum import Enum
from importlib import import_module
from io import BytesIO
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from interaction_scenes import straight, tracks_of
from matplotlib import pyplot as plt
from report_page import Page

import deepaccident_devkit
import deepaccident_devkit.render.notebook
from deepaccident_devkit.evaluation import (
    Accident,
    AccidentEvaluator,
    DetectedBoxes,
    DetectionEvaluator,
    MotionEvaluator,
    MotionOutput,
    WarningEvaluator,
)
from deepaccident_devkit.evaluation.forecasting import ForecastingEvaluator
from deepaccident_devkit.evaluation.planning import PlanningEvaluator
from deepaccident_devkit.evaluation.runs import EvaluationRun
from deepaccident_devkit.geometry import SE3, BevGrid, Boxes, LidarPointCloud
from deepaccident_devkit.interactions import InteractionConfig, Interactions
from deepaccident_devkit.interactions.scenario import interactions_of_tracks
from deepaccident_devkit.motion import LABEL_PROTOCOLS, MotionHeads, MotionLabelConfig, MotionLabels
from deepaccident_devkit.plugins import PROTOCOL_VERSION, Plugin
from deepaccident_devkit.support.arrays import ShortRepr
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
        contact_frame=None,
        point=np.full(3, -1234.56),
        gap=0.123456789,
        speeds=(12.3, 12.3),
        closing_speed=-12.3,
        impact_angle=3.1,
        sides=("front", "right"),
        disagreements=("a gap of 3.1 m",),
    )


def interactions() -> Interactions:
    tracks = tracks_of({2: straight(3, 0, 0, 10), 1: straight(3, 30, 0, 1, 180)})
    scenario = "type1_subtype1_accident/Town10HD_type001_subtype0001_scenario00024"
    return interactions_of_tracks(scenario, tracks, 3, InteractionConfig())


OWN = {
    "Plugin": lambda: Plugin(name="mine", protocol_version=PROTOCOL_VERSION),
    "Boxes": boxes,
    "Interactions": interactions,
    "AccidentResult": lambda: AccidentEvaluator().compute(),
    "AnticipationResult": lambda: WarningEvaluator("clean").compute(),
    "Contact": contact,
    "DetectionResult": lambda: DetectionEvaluator().compute(),
    "ForecastingResult": lambda: ForecastingEvaluator().compute(),
    "PlanningResult": lambda: PlanningEvaluator().compute(),
    "FieldResult": lambda: WarningEvaluator("field").compute(),
    "LidarPointCloud": cloud,
    "MotionHeads": heads,
    "MotionLabels": labels,
    "MotionResult": lambda: MotionEvaluator().compute(),
    "MotionOutput": lambda: MotionOutput(grid=GRID, heads=(heads(), heads())),
    "SE3": SE3.identity,
}
"""Classes with a text of their own → a maker of one."""


CHOICES = (
    "Config", "Protocol", "Spec", "Quirks", "Reading", "Warnings", "Selection", "Resampling", "PostProcessing", "View",
    "Accidents", "Link", "PoseNoise", "Augmentation", "BevGrid", "Baseline", "Release", "Form",
    "Rules",
)  # fmt: skip
"""Endings of the names of classes that are choices: their text has every field, as one would type it."""


def public_classes() -> dict[str, type]:
    """Name with its package → each public class that is no choice, enum or error; what needs torch is left out."""
    found: dict[type, str] = {}
    for module in pkgutil.walk_packages(deepaccident_devkit.__path__, "deepaccident_devkit."):
        if module.ispkg and not re.search(r"\.(torch|model)\b", module.name) and "._" not in module.name:
            for kind in exported(import_module(module.name)):
                found.setdefault(kind, f"{module.name}.{kind.__name__}")
    return {name: kind for kind, name in found.items()}


def exported(module: Any) -> Iterator[type]:
    for name in getattr(module, "__all__", ()):
        kind = getattr(module, name)
        if inspect.isclass(kind) and not issubclass(kind, BaseException | Enum) and not name.endswith(CHOICES):
            yield kind


PUBLIC = public_classes()


def full(kind: type) -> Any:
    """One whose fields are all large arrays, or collections of them."""
    result = object.__new__(kind)
    for number, field in enumerate(fields(kind)):
        value: Any = np.full((1000, 1000), 0.123456789)
        kinds = [value, {"a": value}, (value, value), dict.fromkeys(range(50), 1.5), "long " * 50, 1 / 3]
        object.__setattr__(result, field.name, value if "rray" in str(field.type) else kinds[number % len(kinds)])
    return result


@pytest.mark.parametrize("name", PUBLIC)
def test_every_public_class_prints_in_a_line(name: str) -> None:
    """By `ShortRepr`, by a text of its own, or as a dataclass with a few plain fields."""
    kind = PUBLIC[name]
    assert kind.__repr__ is not object.__repr__
    if kind.__name__ in OWN or kind.__repr__ is ShortRepr.__repr__:
        text = repr(OWN[kind.__name__]() if kind.__name__ in OWN else full(kind))
        assert text.startswith(f"{kind.__name__}("), text
        assert (len(text) < 200, [each for each in ("\n", "0.1234567", "array(") if each in text]) == (True, []), text
    elif is_dataclass(kind) and kind is not EvaluationRun:  # its test is beside those of runs
        assert len(fields(kind)) < 8
        assert not [field.name for field in fields(kind) if re.search("rray|Mapping|Sequence", str(field.type))]


def test_no_public_class_is_left_out() -> None:
    names = {kind.__name__ for kind in PUBLIC.values()}
    assert {"Labels", "BevImage", "Verification", "CountTable", "ResultsWriter", *OWN} <= names


START = "MotionLabels(5 frames of 24 × 16 cells of 0.5 × 0.25 m, 2 actors in id_map, "
MINE = replace(LABEL_PROTOCOLS["clean"], half_cell_shift=True)
TEXTS = {
    "LidarPointCloud(3 points in ego: x -1.0 to 30.0 m, y -4.0 to 2.0 m, z 0.0 to 0.2 m)": cloud,
    "LidarPointCloud(0 points in ego)": lambda: cloud().select([]),
    "MotionHeads(5 frames of 24 × 16 cells, devkit)": heads,
    "MotionOutput(2 predictions of 5 frames, 24 × 16 cells of 0.5 × 0.25 m, heads)": OWN["MotionOutput"],
    "MotionOutput(1 prediction of 5 frames, 200 × 200 cells of 0.5 m, instances)": lambda: MotionOutput(
        grid=BevGrid(), instances=np.zeros((1, 5, 200, 200), dtype=np.int32)
    ),
    f"{START}released, each frame in its own ego frame)": labels,
    f"{START}clean, all at the present)": lambda: labels(protocol=LABEL_PROTOCOLS["clean"]).to_present(),
    f"{START}own protocol, each frame in its own ego frame)": lambda: labels(protocol=MINE),
    "DetectedBoxes(boxes=Boxes(2 in Camera_Front_Left: 1 car, 1 truck), scores=(2,) float64)": lambda: DetectedBoxes(
        boxes=boxes()[:2], scores=np.array([0.5, 0.25])
    ),
    "Accident(positions=(2, 2) float64, time=1.5, score=1, ids=(3, 7))": lambda: Accident(
        positions=np.zeros((2, 2)), time=1.5, ids=(3, 7)
    ),
}


@pytest.mark.parametrize("text", TEXTS)
def test_texts(text: str) -> None:
    assert repr(TEXTS[text]()) == text


def test_results_print_their_first_headlines() -> None:
    result = replace(AccidentEvaluator().compute(), samples=1234, apa=0.5, id_error=0.25)
    assert repr(result) == ("AccidentResult(1,234 samples: apa 0.500, accuracy@5 –, accuracy@10 –, accuracy@15 –, …)")
    page = Page(result._repr_html_())
    assert page.text.startswith("AccidentResult, 1,234 samplesnumbervalue")
    assert page.text.endswith("id_error0.250position_error20.000 mtime_error1.000 s")


PICTURED = [boxes, cloud, labels, lambda: labels().to_present(), lambda: cloud().transform(SE3.identity(), "world")]


@pytest.mark.parametrize("make", PICTURED)
def test_a_notebook_shows_a_small_picture(make: Callable[[], Any]) -> None:
    page = Page(make()._repr_html_())
    [image] = page.all("img")
    kind, _, content = str(image["src"]).partition(",")
    assert (kind, 1000 < len(content) < 60_000, page.text) == ("data:image/png;base64", True, repr(make()))
    assert plt.imread(BytesIO(base64.b64decode(content))).shape == (256, 288, 4)


def test_a_notebook_shows_the_text_where_there_is_no_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    for empty in (boxes()[:0], cloud().select([])):
        assert empty._repr_html_() == f"<pre>{empty!r}</pre>"
    monkeypatch.setattr(deepaccident_devkit.render.notebook, "png_of", Mock(side_effect=RuntimeError))
    assert Page(labels()._repr_html_()).text == repr(labels())


def test_evaluators_say_how_many_samples_they_have() -> None:
    evaluator = AccidentEvaluator("paper")
    assert repr(evaluator) == "AccidentEvaluator(0 samples)"
    evaluator.add("a/b/ego_vehicle/001", {})
    assert repr(evaluator) == "AccidentEvaluator(1 sample)"
