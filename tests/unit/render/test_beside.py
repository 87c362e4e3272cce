"""A video shows an accident beside its normal twin, on one clock."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.expected_errors import assert_raises
from support.figure_texts import find_text_faults
from support.replay_page import accident_scenario
from support.video_views import decode_video

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.collisions.twins import twin_of
from deepaccident_devkit.errors import ChoiceError, NotAvailableError
from deepaccident_devkit.render.beside import BesideTwin
from deepaccident_devkit.render.figures import figure_of_pixels
from deepaccident_devkit.render.video import render_scenario_video


@pytest.fixture(scope="module")
def accident(da_motion: DeepAccident) -> str:
    return accident_scenario(da_motion)


@pytest.fixture(scope="module")
def twin(da_motion: DeepAccident, accident: str) -> str:
    record = twin_of(da_motion, accident)
    assert record is not None
    return record["token"]


def test_the_accident_is_on_the_left_whichever_is_named(
    da_motion: DeepAccident, accident: str, twin: str
) -> None:
    for named in (accident, twin):
        twins = BesideTwin.of(da_motion, named)
        assert [side.scenario for side in twins.sides] == [accident, twin]
    left, right = twins.sides
    num_frames = len(left.gap)
    assert left.verdict(num_frames).startswith("accident: collision now, 0.0 m apart")
    assert left.verdict(num_frames - 5).startswith("accident: collision in 0.5 s")
    closest_m = np.nanmin(right.gap)
    assert right.verdict(1).startswith("normal twin: no collision")
    assert right.verdict(1).endswith(f"never closer than {closest_m:.1f} m")
    assert right.verdict(len(right.gap) + 1).endswith("recording has ended")
    assert np.nanmin(left.ttc) == pytest.approx(0, abs=1e-3)


def test_each_picture_shows_both_sides_at_one_time(
    da_motion: DeepAccident, accident: str, twin: str, tmp_path: Path
) -> None:
    drawn_frames = []

    def draw(dataset: Any, frame: Any, fig: Any) -> None:
        drawn_frames.append(frame["token"])
        fig.set_facecolor("red" if frame["scenario_token"] == accident else "blue")

    last = BesideTwin.of(da_motion, accident).num_frames
    path = render_scenario_video(
        da_motion,
        accident,
        tmp_path / "v.gif",
        views=draw,
        beside="twin",
        frames=[1, last],
        size=(400, 200),
        workers=1,
        progress=False,
    )

    (first, _) = decode_video(path)
    np.testing.assert_allclose(first[60, 100], (255, 0, 0), atol=20)
    np.testing.assert_allclose(first[60, 300], (0, 0, 255), atol=20)
    ends = [da_motion.get("scenario", token)["num_frames"] for token in (accident, twin)]
    assert drawn_frames == [
        f"{accident}/001",
        f"{twin}/001",
        f"{accident}/{ends[0]:03d}",
        f"{twin}/{ends[1]:03d}",
    ]


@pytest.mark.parametrize("size", [(1280, 180), (640, 90), (1920, 270)])
def test_texts_of_the_strip_are_apart(
    da_motion: DeepAccident, accident: str, size: tuple[int, int]
) -> None:
    twins = BesideTwin.of(da_motion, accident)
    width, height = size
    dpi = 100 * width / 1280
    strip = figure_of_pixels(width, height, dpi=dpi)
    twins.draw_times(strip.add_subplot(), 20)
    verdicts = figure_of_pixels(width, height // 5, dpi=dpi)
    twins.write_verdicts(verdicts, 20)
    assert find_text_faults(strip) == []
    assert find_text_faults(verdicts) == []


def test_errors_name_what_is_missing(
    da_motion: DeepAccident, accident: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def write(beside: Any) -> Callable[[], object]:
        path = tmp_path / "v.gif"
        return lambda: render_scenario_video(da_motion, accident, path, beside=beside)

    assert_raises((write("model"), ChoiceError, ("beside", "twin", "'model'")))
    monkeypatch.setattr("deepaccident_devkit.render.beside.twin_of", lambda *_: None)
    assert_raises((write("twin"), NotAvailableError, (accident, "no twin")))
