"""A video shows an accident beside its normal twin, or models, on one clock."""

from collections.abc import Callable
from dataclasses import replace
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
from deepaccident_devkit.evaluation.predictions import Accident
from deepaccident_devkit.evaluation.results import Results, ResultsWriter, read_results
from deepaccident_devkit.plugins.safety import twin_diff
from deepaccident_devkit.render.beside import Beside, beside_models, beside_twin
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
        beside = beside_twin(da_motion, named)
        assert [side.scenario for side in beside.sides] == [accident, twin]
    left, right = beside.sides
    num_frames = len(left.gap)
    assert left.verdict(num_frames).startswith("accident: collision now, 0.0 m apart")
    assert left.verdict(num_frames - 5).startswith("accident: collision in 0.5 s")
    assert left.verdict(num_frames + 1).endswith("recording has ended")
    closest_m = np.nanmin(right.gap)
    assert right.verdict(1).startswith("normal twin: no collision")
    assert f"never closer than {closest_m:.1f} m" in right.verdict(1)
    assert np.nanmin(left.ttc) == pytest.approx(0, abs=1e-3)


def test_twins_that_began_at_other_times_are_aligned(
    da_motion: DeepAccident, accident: str
) -> None:
    """The clock is the accident's, so that the frames before it began are left out."""
    left, right = beside_twin(da_motion, accident).sides
    assert right.shift == twin_diff(da_motion, accident).shift
    late = replace(right, shift=-3)
    beside = Beside(sides=(left, late), curves=(left, late), pair="ego and other")

    assert (late.frame(1), late.frame(4), late.frame(5)) == (1, 1, 2)
    assert late.verdict(3).endswith("recording has not begun")
    assert beside.num_frames == len(late.gap) + 3

    strip = figure_of_pixels(640, 180, dpi=50)
    ax = strip.add_subplot()
    beside.draw_times(ax, len(left.gap) - 5)
    assert ax.get_title(loc="right") == "0.5 s before the impact"


def test_each_picture_shows_both_sides_at_one_time(
    da_motion: DeepAccident, accident: str, twin: str, tmp_path: Path
) -> None:
    drawn_frames = []

    def draw(dataset: Any, frame: Any, fig: Any) -> None:
        drawn_frames.append(frame["token"])
        fig.set_facecolor("red" if frame["scenario_token"] == accident else "blue")

    last = beside_twin(da_motion, accident).num_frames
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
    expected_frames = []
    for number in (1, last):
        for side in beside_twin(da_motion, accident).sides:
            expected_frames.append(f"{side.scenario}/{side.frame(number):03d}")
    assert drawn_frames == expected_frames


@pytest.mark.parametrize("size", [(1280, 180), (640, 90), (1920, 270)])
def test_texts_of_the_strip_are_apart(
    da_motion: DeepAccident, accident: str, size: tuple[int, int]
) -> None:
    beside = beside_twin(da_motion, accident)
    width, height = size
    dpi = 100 * width / 1280
    strip = figure_of_pixels(width, height, dpi=dpi)
    beside.draw_times(strip.add_subplot(), 20)
    verdicts = figure_of_pixels(width, height // 5, dpi=dpi)
    words = [side.verdict(20) for side in beside.sides]
    beside.write_verdicts(verdicts, words)
    assert find_text_faults(strip) == []
    assert find_text_faults(verdicts) == []


def write_results(path: Path, samples: dict[str, float]) -> Results:
    """Write a file of accidents 8 m ahead by the sample and the seconds left."""
    with ResultsWriter(path, "accident") as writer:
        for sample, seconds in samples.items():
            places = np.array([[7.0, 0.0], [9.0, 0.0]])
            writer.add(sample, [Accident(time=seconds, positions=places, score=0.9)])
    return read_results(path)


def test_models_are_beside_the_recording_and_each_other(
    da_motion: DeepAccident, accident: str, tmp_path: Path
) -> None:
    """A model's side shows its last prediction, and another model may predict for another agent."""
    first = write_results(tmp_path / "first.json", {f"{accident}/ego_vehicle/010": 1.5})
    second = write_results(tmp_path / "second.json", {f"{accident}/infrastructure/020": 0.5})

    left, right = beside_models(da_motion, accident, {"A": first}).sides
    assert left.described(da_motion, 12) is None
    words = [right.described(da_motion, number).words for number in (9, 10, 12)]
    assert words[0] == ": no prediction yet"
    assert words[1] == words[2]
    assert "alarm for a collision in 1.5 s" in words[1]

    path = render_scenario_video(
        da_motion,
        accident,
        tmp_path / "v.gif",
        beside={"A": first, "B": second},
        frames=[12],
        size=(640, 360),
        workers=1,
        progress=False,
    )
    assert len(list(decode_video(path))) == 1
    sides = beside_models(da_motion, accident, {"A": first, "B": second}).sides
    assert [(side.name, side.agent) for side in sides] == [
        ("A", "ego_vehicle"),
        ("B", "infrastructure"),
    ]


def test_errors_name_what_is_missing(
    da_motion: DeepAccident,
    accident: str,
    twin: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def write(beside: Any) -> Callable[[], object]:
        path = tmp_path / "v.gif"
        return lambda: render_scenario_video(da_motion, accident, path, beside=beside)

    assert_raises((write("model"), ChoiceError, ("beside", "twin", "'model'")))
    other = write_results(tmp_path / "other.json", {f"{twin}/ego_vehicle/010": 1.5})
    assert_raises(
        (write({}), ChoiceError, ("one or two models", "0")),
        (write({"A": other}), NotAvailableError, ("other.json", "no prediction", accident)),
    )
    monkeypatch.setattr("deepaccident_devkit.collisions.twin_matching.twin_of", lambda *_: None)
    assert_raises((write("twin"), NotAvailableError, (accident, "no twin")))
