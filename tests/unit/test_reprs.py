"""Objects that hold arrays say in one short line what they are, and never print the numbers."""

import base64
from collections.abc import Callable
from dataclasses import replace
from io import BytesIO
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from matplotlib import pyplot as plt
from report_page import Page

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


def heads() -> MotionHeads:
    return MotionHeads(**{name: np.zeros((5, axes, *GRID.shape)) for name, axes in
                          (("segmentation", 2), ("centerness", 1), ("offset", 2), ("flow", 2))})  # fmt: skip  # noqa: E501


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


START = "MotionLabels(5 frames of 24 × 16 cells of 0.5 × 0.25 m, 2 actors in id_map, "
MINE = replace(LABEL_PROTOCOLS["clean"], half_cell_shift=True)
TEXTS = {
    "LidarPointCloud(3 points in ego: x -1.0 to 30.0 m, y -4.0 to 2.0 m, z 0.0 to 0.2 m)": cloud,
    "LidarPointCloud(0 points in ego)": lambda: cloud().select([]),
    "MotionHeads(5 frames of 24 × 16 cells, devkit)": heads,
    "MotionOutput(2 predictions of 5 frames, 24 × 16 cells of 0.5 × 0.25 m, heads)": lambda: (
        MotionOutput(grid=GRID, heads=(heads(), heads()))
    ),
    "MotionOutput(1 prediction of 5 frames, 200 × 200 cells of 0.5 m, instances)": lambda: (
        MotionOutput(grid=BevGrid(), instances=np.zeros((1, 5, 200, 200), dtype=np.int32))
    ),
    f"{START}released, each frame in its own ego frame)": labels,
    f"{START}clean, all at the present)": lambda: labels(
        protocol=LABEL_PROTOCOLS["clean"]
    ).to_present(),
    f"{START}own protocol, each frame in its own ego frame)": lambda: labels(protocol=MINE),
    "DetectedBoxes(boxes=Boxes(2 in Camera_Front_Left: 1 car, 1 "
    "truck), scores=(2,) float64)": lambda: DetectedBoxes(
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
    assert repr(result) == (
        "AccidentResult(1,234 samples: apa 0.500, accuracy@5 –, accuracy@10 –, accuracy@15 –, …)"
    )
    page = Page(result._repr_html_())
    assert page.text.startswith("AccidentResult, 1,234 samplesnumbervalue")
    assert page.text.endswith("id_error0.250position_error20.000 mtime_error1.000 s")


PICTURED = [
    boxes,
    cloud,
    labels,
    lambda: labels().to_present(),
    lambda: cloud().transform(SE3.identity(), "world"),
]


@pytest.mark.parametrize("make", PICTURED)
def test_a_notebook_shows_a_small_picture(make: Callable[[], Any]) -> None:
    page = Page(make()._repr_html_())
    [image] = page.all("img")
    kind, _, content = str(image["src"]).partition(",")
    assert (kind, 1000 < len(content) < 60_000, page.text) == (
        "data:image/png;base64",
        True,
        repr(make()),
    )
    assert plt.imread(BytesIO(base64.b64decode(content))).shape == (256, 288, 4)


def test_a_notebook_shows_the_text_where_there_is_no_picture(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for empty in (boxes()[:0], cloud().select([])):
        assert empty._repr_html_() == f"<pre>{empty!r}</pre>"
    monkeypatch.setattr(
        deepaccident_devkit.render.notebook, "png_of", Mock(side_effect=RuntimeError)
    )
    assert Page(labels()._repr_html_()).text == repr(labels())
