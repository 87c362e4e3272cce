"""What a replay says of predictions."""

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from refusals import assert_refused
from replay_page import accident, data_of, normal

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import EvaluationError, NotAvailableError
from deepaccident_devkit.evaluation import Accident, instances_of
from deepaccident_devkit.evaluation.detection.boxes import DetectedBoxes
from deepaccident_devkit.evaluation.predictions import labels_at_present
from deepaccident_devkit.evaluation.results import ResultsWriter, read_results
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.motion import OWN_BOX_ID, MotionLabelConfig, motion_labels
from deepaccident_devkit.render.replay import render_replay


def test_each_sample_has_its_verdict(
    da_motion: DeepAccident, predictions: dict[str, list[Accident]], tmp_path: Path
) -> None:
    data = data_of(render_replay(da_motion, None, tmp_path / "a.html", prediction=predictions))
    samples = data["prediction"]["samples"]
    assert [(each["frame"], each["agent"], each["verdict"]) for each in samples] == [
        (19, 0, "TP"),
        (24, 0, "FP + FN"),
        (29, 0, "FN"),
        (29, 4, "4 FP + FN"),
    ]
    right, far, missed, many = samples
    assert [alarm["right"] for alarm in (*right["alarms"], *far["alarms"])] == [True, False]
    assert right["alarms"][0]["text"] == (
        "foreseen in 1.5 s, score 0.75: places off by 0.0 m, time by +0.0 s; names "
        f"{' and '.join(str(each) for each in da_motion.get('scenario', accident(da_motion))['collision']['ids'])}"
        ", who collide"
    )
    assert "places off by 40.0 m" in far["alarms"][0]["text"]
    assert missed["text"] == "ego at frame 30: an accident comes in 0.5 s"
    assert (len(many["alarms"]), many["more"]) == (3, 1)
    assert "names an unknown actor" in many["alarms"][0]["text"]
    # the foreseen places are those of the pair at the end, in the page's own ground: centimetres; a slope takes a few
    pair = [actor["states"][-1][:2] for actor in data["actors"] if actor["role"] == "pair"]
    assert_allclose(sorted(right["alarms"][0]["places"]), sorted(pair), atol=8)
    assert right["alarms"][0]["time"] == 1.5


def test_alarms_without_an_accident_are_false_or_not_judged(da_motion: DeepAccident, tmp_path: Path) -> None:
    ego = f"{normal(da_motion)}/ego_vehicle"
    anywhere = np.array([[1.0, 2.0], [3.0, 4.0]])
    given = {
        f"{ego}/010": [Accident(positions=anywhere, time=1.0)],
        f"{ego}/030": [Accident(positions=anywhere, time=1.9)],
        f"{ego}/031": [],
    }
    path = render_replay(da_motion, normal(da_motion), tmp_path / "a.html", prediction=given)
    samples = data_of(path)["prediction"]["samples"]
    assert [each["verdict"] for each in samples] == ["FP", "not judged", "TN"]
    assert samples[1]["alarms"][0]["text"].startswith(
        "foreseen in 1.9 s, score 1: it would be after the end of the recording"
    )


def test_results_files_give_the_same_page(
    da_motion: DeepAccident, predictions: dict[str, list[Accident]], tmp_path: Path
) -> None:
    with ResultsWriter(tmp_path / "results.json", "accident") as writer:
        for token, alarms in predictions.items():
            writer.add(token, alarms)
    by_token = render_replay(da_motion, None, tmp_path / "a.html", prediction=predictions)
    by_file = render_replay(da_motion, None, tmp_path / "b.html", prediction=read_results(tmp_path / "results.json"))
    assert by_file.read_bytes() == by_token.read_bytes()


def test_motion_is_read_for_accidents(da_motion: DeepAccident, tmp_path: Path) -> None:
    """The pair as the labels draw it, and nobody else, as prediction: the true accident is foreseen."""
    config = MotionLabelConfig()
    ego = f"{accident(da_motion)}/ego_vehicle"
    (other,) = set(da_motion.get("scenario", accident(da_motion))["collision"]["ids"]) - {
        da_motion.get("agent", ego)["actor_id"]
    }
    given = {}
    with ResultsWriter(tmp_path / "motion", "motion", grid=config.grid) as writer:
        for frame in (20, 30):
            token = f"{ego}/{frame:03d}"
            label = labels_at_present(motion_labels(da_motion, token, config))
            pair = np.isin(label.instance, [label.id_map[OWN_BOX_ID], label.id_map[other]])
            given[token] = instances_of(np.where(pair, label.instance, 0), config.grid)
            writer.add(token, given[token])
    by_token = render_replay(da_motion, None, tmp_path / "a.html", prediction=given)
    by_file = render_replay(da_motion, None, tmp_path / "b.html", prediction=read_results(tmp_path / "motion"))
    assert [each["verdict"] for each in data_of(by_token)["prediction"]["samples"]] == ["TP", "TP"]
    assert by_file.read_bytes() == by_token.read_bytes()


def test_predictions_of_something_else_are_refused(
    da_motion: DeepAccident, predictions: dict[str, list[Accident]], tmp_path: Path
) -> None:
    with pytest.raises(NotAvailableError, match=r"prediction: has no sample of .* and ego_vehicle, ego_vehicle_b"):
        render_replay(da_motion, normal(da_motion), tmp_path / "a.html", prediction=predictions)
    token = next(iter(predictions))
    boxes = Boxes.from_arrays(np.zeros((0, 3)), np.zeros((0, 3)), [], frame="world")
    with ResultsWriter(tmp_path / "boxes.json", "detection") as writer:
        writer.add(token, DetectedBoxes(boxes=boxes, scores=np.zeros(0)))
    assert_refused(
        (
            lambda: render_replay(
                da_motion, None, tmp_path / "a.html", prediction=read_results(tmp_path / "boxes.json")
            ),
            EvaluationError,
            "holds detection results; accident is evaluated from motion or accident",
        ),
        (
            lambda: render_replay(da_motion, None, tmp_path / "a.html", prediction={token: [7]}),
            EvaluationError,
            "expected a MotionOutput or a list of Accidents, found list with int",
        ),
    )
