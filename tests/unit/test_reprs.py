"""Objects with arrays describe themselves in one short line and never print the numbers."""

import base64
from collections.abc import Callable
from dataclasses import replace
from io import BytesIO
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from matplotlib import pyplot as plt
from support.report_page import ReportPage

import deepaccident_devkit
import deepaccident_devkit.render.notebook
from deepaccident_devkit.evaluation import (
    Accident,
    AccidentEvaluator,
    DetectedBoxes,
    MotionOutput,
)
from deepaccident_devkit.geometry import SE3, BevGrid, Boxes, LidarPointCloud
from deepaccident_devkit.motion import LABEL_PROTOCOLS, MotionHeads, MotionLabelConfig, MotionLabels

GRID = BevGrid((-4.0, 4.0, 0.5), (-3.0, 3.0, 0.25))


def make_heads() -> MotionHeads:
    return MotionHeads(
        segmentation=np.zeros((5, 2, *GRID.shape)),
        centerness=np.zeros((5, 1, *GRID.shape)),
        offset=np.zeros((5, 2, *GRID.shape)),
        flow=np.zeros((5, 2, *GRID.shape)),
    )


def make_labels(**options: Any) -> MotionLabels:
    config = MotionLabelConfig(grid=GRID, **options)
    num_frames = config.label_frames
    return MotionLabels(
        config=config,
        segmentation=np.zeros((num_frames, *GRID.shape), dtype=np.uint8),
        instance=np.zeros((num_frames, *GRID.shape), dtype=np.int32),
        centerness=np.zeros((num_frames, 1, *GRID.shape)),
        offset=np.zeros((num_frames, 2, *GRID.shape)),
        flow=np.zeros((num_frames, 2, *GRID.shape)),
        future_egomotion=np.zeros((config.frames, 6)),
        valid=np.ones(config.frames, dtype=bool),
        id_map={3: 1, 7: 2},
    )


def make_cloud() -> LidarPointCloud:
    points = [[-1, 2, 0.25], [30, -4, 0], [np.nan, 0, 0]]
    return LidarPointCloud(points, np.zeros(3), "ego")  # type: ignore[arg-type]


def make_boxes() -> Boxes:
    return Boxes.from_arrays(
        np.zeros((6, 3)), np.ones((6, 3)), np.zeros(6), category=range(6), frame="Camera_Front_Left"
    )


LABELS_START = "MotionLabels(5 frames of 24 × 16 cells of 0.5 × 0.25 m, 2 actors in id_map, "
OWN_PROTOCOL = replace(LABEL_PROTOCOLS["clean"], half_cell_shift=True)
TEXTS = {
    "LidarPointCloud(3 points in ego: x -1.0 to 30.0 m, y -4.0 to 2.0 m, z 0.0 to 0.2 m)": (
        make_cloud
    ),
    "LidarPointCloud(0 points in ego)": lambda: make_cloud().select([]),
    "MotionHeads(5 frames of 24 × 16 cells, devkit)": make_heads,
    "MotionOutput(2 predictions of 5 frames, 24 × 16 cells of 0.5 × 0.25 m, heads)": lambda: (
        MotionOutput(grid=GRID, heads=(make_heads(), make_heads()))
    ),
    "MotionOutput(1 prediction of 5 frames, 200 × 200 cells of 0.5 m, instances)": lambda: (
        MotionOutput(grid=BevGrid(), instances=np.zeros((1, 5, 200, 200), dtype=np.int32))
    ),
    f"{LABELS_START}released, each frame in its own ego frame)": make_labels,
    f"{LABELS_START}clean, all at the present)": lambda: make_labels(
        protocol=LABEL_PROTOCOLS["clean"]
    ).to_present(),
    f"{LABELS_START}own protocol, each frame in its own ego frame)": lambda: make_labels(
        protocol=OWN_PROTOCOL
    ),
    "DetectedBoxes(boxes=Boxes(2 in Camera_Front_Left: 1 car, 1 "
    "truck), scores=(2,) float64)": lambda: DetectedBoxes(
        boxes=make_boxes()[:2], scores=np.array([0.5, 0.25])
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
    assert repr(result) == (
        "AccidentResult(1,234 samples: apa 0.500, accuracy@5 –, accuracy@10 –, accuracy@15 –, …)"
    )
    page = ReportPage(result._repr_html_())
    assert page.text.startswith("AccidentResult, 1,234 samplesnumbervalue")
    assert page.text.endswith("identity error0.250position error20.000 mtime error1.000 s")


PICTURED_OBJECTS = [
    make_boxes,
    make_cloud,
    make_labels,
    lambda: make_labels().to_present(),
    lambda: make_cloud().transform(SE3.identity(), "world"),
]


@pytest.mark.parametrize("make", PICTURED_OBJECTS)
def test_a_notebook_shows_a_small_picture(make: Callable[[], Any]) -> None:
    page = ReportPage(make()._repr_html_())
    assert page.text == repr(make())
    (image,) = page.all("img")
    kind, _, content = str(image["src"]).partition(",")
    assert kind == "data:image/png;base64"
    assert 1000 < len(content) < 60_000
    assert plt.imread(BytesIO(base64.b64decode(content))).shape == (256, 288, 4)


def test_a_notebook_shows_the_text_where_there_is_no_picture(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for empty in (make_boxes()[:0], make_cloud().select([])):
        assert empty._repr_html_() == f"<pre>{empty!r}</pre>"
    monkeypatch.setattr(
        deepaccident_devkit.render.notebook, "png_of", Mock(side_effect=RuntimeError)
    )
    assert ReportPage(make_labels()._repr_html_()).text == repr(make_labels())
