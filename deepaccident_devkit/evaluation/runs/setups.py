"""`EvaluationSetup`: a task, its protocol and its horizon, and the arguments of its evaluator for a sample."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, Final, Literal, get_args

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import ConfigError, EvaluationError
from deepaccident_devkit.evaluation.accident import PROTOCOLS as ACCIDENT_PROTOCOLS
from deepaccident_devkit.evaluation.accident import AccidentEvaluator, ReleasedAccidents, accident_context
from deepaccident_devkit.evaluation.choices import switched
from deepaccident_devkit.evaluation.detection import (
    DETECTION_PROTOCOLS,
    DetectedBoxes,
    DetectionEvaluator,
    detection_truth,
)
from deepaccident_devkit.evaluation.evaluator import Evaluator
from deepaccident_devkit.evaluation.frozen_mappings import FrozenDict
from deepaccident_devkit.evaluation.motion import MOTION_PROTOCOLS, MotionEvaluator
from deepaccident_devkit.evaluation.results import Results
from deepaccident_devkit.evaluation.warning import WARNING_PROTOCOLS, WarningEvaluator
from deepaccident_devkit.motion import MotionLabelConfig, MotionLabels, motion_labels
from deepaccident_devkit.parallel import Places
from deepaccident_devkit.support.text import choice, settle_choices
from deepaccident_devkit.taxonomy import FRAME_PERIOD

TaskName = Literal["motion", "accident", "detection", "warning"]
TASK_PROTOCOLS: Final[Mapping[str, Mapping[str, Any]]] = MappingProxyType(
    {
        "motion": MOTION_PROTOCOLS,
        "accident": ACCIDENT_PROTOCOLS,
        "detection": DETECTION_PROTOCOLS,
        "warning": WARNING_PROTOCOLS,
    }
)
"""Task → its protocols by name."""
TASK_RESULTS: Final[Mapping[str, tuple[str, ...]]] = MappingProxyType(
    {
        "motion": ("motion",),
        "accident": ("motion", "accident"),
        "detection": ("detection",),
        "warning": ("motion", "accident"),
    }
)
"""Task → the kinds of results that it is evaluated from."""


_LONGEST_HORIZON: Final = 100
"""Seconds; recordings are shorter."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluationSetup:
    """What is evaluated, and by which rules; two of equal ones give comparable numbers.

    Attributes:
        task: `motion`, `accident`, `detection` or `warning`.
        protocol: the name of one of the task's (`TASK_PROTOCOLS`).
        switches: choices of the protocol that are changed, by name (`choices.switch_names`).
        horizon: seconds that the predictions look ahead; detection has none.
    """

    task: TaskName
    protocol: str = "released"
    switches: Mapping[str, Any] = field(default_factory=dict)
    horizon: float = 2.0

    def __post_init__(self) -> None:
        """Check; raises ChoiceError or ConfigError."""
        settle_choices(self, {"task": get_args(TaskName)})
        protocol = choice(f"protocol of {self.task}", self.protocol, TASK_PROTOCOLS[self.task])
        object.__setattr__(self, "protocol", protocol)
        if not 0 < self.horizon <= _LONGEST_HORIZON:
            raise ConfigError(f"horizon: expected seconds above 0, at most {_LONGEST_HORIZON}, found {self.horizon!r}")
        object.__setattr__(self, "switches", FrozenDict(self.switches))
        switched(TASK_PROTOCOLS[self.task][self.protocol], self.switches)  # refuses impossible choices

    @property
    def rules(self) -> Any:
        """The protocol itself, with the switches."""
        return switched(TASK_PROTOCOLS[self.task][self.protocol], self.switches)

    def evaluator(self) -> Evaluator[Any]:
        """A new evaluator of these rules."""
        return _EVALUATORS[self.task](self.rules)

    def as_dict(self) -> dict[str, Any]:
        """All of it, as JSON holds it, with the evaluator's own `settings`: every choice."""
        return {
            "task": self.task,
            "protocol": self.protocol,
            "switches": dict(self.switches),
            "horizon": self.horizon,
            "settings": self.evaluator().settings,
        }


_EVALUATORS: Final[Mapping[str, Callable[[Any], Evaluator[Any]]]] = {
    "motion": MotionEvaluator,
    "accident": AccidentEvaluator,
    "detection": DetectionEvaluator,
    "warning": WarningEvaluator,
}


@dataclass(frozen=True, slots=True)
class SampleLoader:
    """Makes the arguments of a setup's evaluator for a sample, except the token; cheap to pickle.

    Attributes:
        dataset: where the truth is.
        results: where the predictions are; of a kind that the task is evaluated from.
        setup: the rules.
    """

    dataset: Dataset
    results: Results
    setup: EvaluationSetup

    def __post_init__(self) -> None:
        """Check that the results are of a kind that the rules take, and look far enough; raises EvaluationError."""
        kinds = TASK_RESULTS[self.setup.task]
        if self.results.task not in kinds:
            raise EvaluationError(
                f"{self.results.path}: holds {self.results.task} results; {self.setup.task} is evaluated from "
                f"{' or '.join(kinds)} results"
            )
        if self.results.task == "accident" and isinstance(self.setup.rules, ReleasedAccidents):
            raise EvaluationError(
                f"{self.results.path}: holds explicit accidents; the protocol {self.setup.protocol!r} compares motion: "
                "give motion results, or choose protocol 'paper' or 'boxes'"
            )
        form = self.results.form
        if form is not None and (form.frames - 1) * form.step < self.setup.horizon - FRAME_PERIOD / 2:
            raise EvaluationError(
                f"{self.results.path}: its predictions look {(form.frames - 1) * form.step:g} s ahead "
                f"({form.frames} frames, {form.step:g} s apart, from the present on), less than the horizon of "
                f"{self.setup.horizon:g} s; add the present frame if it is missing, or evaluate with a shorter horizon"
            )

    @property
    def places(self) -> Places:
        """What workers must see."""
        return Places(reads=(*self.dataset.places, self.results.path))

    def __call__(self, token: str) -> tuple[Any, ...]:
        """Prediction, truth and other arguments of the evaluator."""
        prediction, rules = self.results.prediction(token), self.setup.rules
        if isinstance(prediction, DetectedBoxes):
            return self.detected(token, prediction, rules.frame), detection_truth(self.dataset, token, rules)
        if self.setup.task == "motion":
            return prediction, self.label(token)
        context = accident_context(self.dataset, token, self.setup.horizon, references=self.setup.task == "warning")
        return prediction, self.label(token), context

    def label_config(self) -> MotionLabelConfig | None:
        """What the labels show that motion results are compared with; None for explicit accidents of other setups."""
        form = self.results.form
        labels = getattr(self.setup.rules, "labels", None)
        if form is None:
            if not hasattr(self.setup.rules, "labels"):
                return None
            return _reaching(MotionLabelConfig(protocol=labels or "released"), self.setup.horizon)
        config = MotionLabelConfig(
            grid=form.grid, step=round(form.step / FRAME_PERIOD), protocol=labels or form.labels or "clean"
        )
        return _reaching(config, self.setup.horizon)

    def label(self, token: str) -> MotionLabels | None:
        """The sample's motion labels as `label_config` says; None where there is none to compare with."""
        config = self.label_config()
        return None if config is None else motion_labels(self.dataset, token, config)

    def detected(self, token: str, prediction: DetectedBoxes, frame: str) -> DetectedBoxes:
        """A sample's boxes, which results hold in the world, in a frame of its agent."""
        boxes = prediction.boxes.transform(self.dataset.world_from(token, frame).inverse(), frame)
        return DetectedBoxes(boxes=boxes, scores=prediction.scores)


def _reaching(config: MotionLabelConfig, horizon: float) -> MotionLabelConfig:
    """Labels that look as far ahead."""
    return replace(config, future_frames=round(horizon / (config.step * FRAME_PERIOD)))
