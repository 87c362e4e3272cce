"""What is evaluated and by which rules, the choices by their names, and what an evaluator is given of a sample."""

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, ConfigError, EvaluationError
from deepaccident_devkit.evaluation import (
    Accident,
    AccidentContext,
    AccidentEvaluator,
    DetectedBoxes,
    DetectionEvaluator,
    MotionEvaluator,
    detection_truth,
    instances_of,
)
from deepaccident_devkit.evaluation.predictions import label_config
from deepaccident_devkit.evaluation.results import Results, ResultsWriter, read_results
from deepaccident_devkit.evaluation.runs.setups import TASK_PROTOCOLS, EvaluationSetup, SampleLoader
from deepaccident_devkit.evaluation.warning import WarningEvaluator
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import MotionLabels

ALL = [(task, protocol) for task, protocols in TASK_PROTOCOLS.items() for protocol in protocols]


class TestSetup:
    @pytest.mark.parametrize(("task", "protocol"), ALL)
    def test_every_task_and_protocol(self, task: Any, protocol: str) -> None:
        kinds = {
            "motion": MotionEvaluator,
            "accident": AccidentEvaluator,
            "detection": DetectionEvaluator,
            "warning": WarningEvaluator,
        }
        setup = EvaluationSetup(task=task, protocol=protocol)
        evaluator = setup.evaluator()
        assert type(evaluator) is kinds[task]
        assert (setup.rules, setup.as_dict()["settings"]) == (TASK_PROTOCOLS[task][protocol], evaluator.settings)
        assert pickle.loads(pickle.dumps(setup)) == setup

    def test_switches_come_to_the_evaluator_and_cannot_be_changed(self) -> None:
        given = {"reading.danger_distance": 0.5}
        setup = EvaluationSetup(task="accident", protocol="paper", switches=given)
        given["reading.danger_distance"] = 2.0
        assert setup.evaluator().settings["choices"]["reading"]["danger_distance"] == 0.5
        assert setup.as_dict()["switches"] == {"reading.danger_distance": 0.5}
        assert pickle.loads(pickle.dumps(setup)) == setup
        with pytest.raises(TypeError):
            setup.switches["x"] = 1  # type: ignore[index]

    @pytest.mark.parametrize(
        ("named", "error", "sentence"),
        [
            (
                {"task": "motions"},
                ChoiceError,
                r"task: expected one of motion, accident, detection, warning, found 'mo",
            ),
            (
                {"task": "motion", "protocol": "boxes"},
                ChoiceError,
                r"protocol of motion: expected one of released, paper, found 'boxes'",
            ),
            ({"task": "motion", "horizon": 0.0}, ConfigError, "above 0, at most 100, found 0.0"),
            ({"task": "motion", "horizon": float("nan")}, ConfigError, "above 0, at most 100, found nan"),
            ({"task": "motion", "switches": {"gap": 1}}, ChoiceError, r"MotionProtocol has no switch 'gap'"),
        ],
    )
    def test_refused(self, named: dict[str, Any], error: type[Exception], sentence: str) -> None:
        assert_refused(
            (lambda: EvaluationSetup(**named), error, sentence),
        )


class TestLoader:
    @pytest.fixture
    def token(self, da_motion: DeepAccident) -> str:
        return da_motion.evaluation_samples("train")[1]

    @pytest.fixture
    def motion(self, token: str, tmp_path: Path) -> Results:
        """Nothing predicted, on cells of 1 m, every second of a second."""
        grid = BevGrid((-50, 50, 1.0), (-50, 50, 1.0), "fiery")
        with ResultsWriter(tmp_path / "motion", "motion", grid=grid, step=1.0, labels="clean") as writer:
            writer.add(token, instances_of(np.zeros((3, *grid.shape), int), grid))
        return read_results(tmp_path / "motion")

    def test_motion_has_labels_of_its_form(self, da_motion: DeepAccident, motion: Results, token: str) -> None:
        setup = EvaluationSetup(task="motion", switches={"labels": "clean"}, horizon=1.0)
        prediction, label = SampleLoader(da_motion, motion, setup)(token)
        assert isinstance(label, MotionLabels)
        config = label.config
        assert (config.grid, config.step, config.future_frames) == (motion.form.grid, 10, 1)
        assert config.grid == prediction.grid

    def test_the_protocol_says_which_labels_and_else_the_results(self, motion: Results) -> None:
        for task, protocol, expected in (("accident", "paper", "released"), ("accident", "boxes", "clean")):
            rules = EvaluationSetup(task=task, protocol=protocol).rules
            assert label_config(rules, motion.form, horizon=2.0).protocol == expected

    def test_accidents_have_their_context(self, da_motion: DeepAccident, token: str, tmp_path: Path) -> None:
        alarm = Accident(positions=np.zeros((2, 2)), time=1.0)
        with ResultsWriter(tmp_path / "accidents.json", "accident") as writer:
            writer.add(token, [alarm])
        loader = SampleLoader(
            da_motion,
            read_results(tmp_path / "accidents.json"),
            EvaluationSetup(task="accident", protocol="boxes", horizon=3.0),
        )
        prediction, label, context = loader(token)
        assert (len(prediction), label) == (1, None)
        assert isinstance(context, AccidentContext)
        assert context.truth is not None

    def test_boxes_come_from_world_into_the_protocols_frame(
        self, da_motion: DeepAccident, token: str, tmp_path: Path
    ) -> None:
        boxes = da_motion.boxes(token)
        with ResultsWriter(tmp_path / "boxes.json", "detection") as writer:
            writer.add(token, DetectedBoxes(boxes=boxes, scores=np.ones(len(boxes))))
        setup = EvaluationSetup(task="detection", protocol="released")
        found, truth = SampleLoader(da_motion, read_results(tmp_path / "boxes.json"), setup)(token)
        assert found.boxes.frame == truth.frame == "lidar"
        np.testing.assert_allclose(found.boxes.center, da_motion.boxes(token, "lidar").center, atol=1e-6)
        assert truth.center.tolist() == detection_truth(da_motion, token, setup.rules).center.tolist()

    def test_explicit_accidents_are_refused_before_any_sample_is_loaded(
        self, da_motion: DeepAccident, token: str, tmp_path: Path
    ) -> None:
        with ResultsWriter(tmp_path / "a.json", "accident") as writer:
            writer.add(token, [])
        assert_refused(
            (
                lambda: SampleLoader(da_motion, read_results(tmp_path / "a.json"), EvaluationSetup(task="accident")),
                EvaluationError,
                r"a.json: holds explicit accidents; the protocol 'released' compares",
            ),
        )

    def test_refused(self, da_motion: DeepAccident, motion: Results) -> None:
        assert_refused(
            (
                lambda: SampleLoader(da_motion, motion, EvaluationSetup(task="detection")),
                EvaluationError,
                r"holds motion results; detection is evaluated from detection results",
            ),
            (
                lambda: SampleLoader(da_motion, motion, EvaluationSetup(task="motion", horizon=2.5)),
                EvaluationError,
                r"look 2 s ahead \(3 frames, 1 s apart, .*, less than the horizon of 2.5 s; add",
            ),
        )
