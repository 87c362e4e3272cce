"""What is counted side by side: the chosen rules, the task's other protocols, and each choice changed."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final, TypeVar, get_args

from deepaccident_devkit.errors import DeepAccidentError, EvaluationError
from deepaccident_devkit.evaluation.metrics.accident import AccidentContext, accident_context
from deepaccident_devkit.evaluation.metrics.choices import with_others
from deepaccident_devkit.evaluation.metrics.detection import DetectedBoxes, DetectionProtocol, detection_truth
from deepaccident_devkit.evaluation.metrics.evaluator import Counts, Evaluator
from deepaccident_devkit.evaluation.metrics.frames import labels_at_present
from deepaccident_devkit.evaluation.runs.setups import TASK_PROTOCOLS, EvaluationSetup, SampleLoader
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.motion import LabelProtocol, MotionLabelConfig, MotionLabels, motion_labels
from deepaccident_devkit.motion.protocols import DrawnWhen, slip_names


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why an evaluator cannot take a sample, in place of a result or of the arguments of `update`."""

    reason: str


class SideBySide(Evaluator[dict[str, Any]]):
    """The results of several evaluators by their names, or the `Refusal` of one that cannot take some sample.

    Whether a sample can be taken at all is up to the first one: its errors are raised, those of the others kept.
    """

    def __init__(self, evaluators: Mapping[str, Evaluator[Any]]) -> None:
        """Of evaluators without samples; the first one decides what is an error."""
        super().__init__()
        self._evaluators = dict(evaluators)

    @property
    def settings(self) -> dict[str, Any]:
        """Those of each."""
        return {name: each.settings for name, each in self._evaluators.items()}

    def update(self, token: str, arguments: Mapping[str, tuple[Any, ...] | Refusal]) -> None:
        """Count one sample: by each evaluator's name what its `update` takes after the token."""
        main = next(iter(self._evaluators))
        counts: dict[str, Counts] = {}
        for name, evaluator in self._evaluators.items():
            given, one = arguments[name], evaluator.fresh()
            if isinstance(given, Refusal):
                counts[name] = {"refused": given.reason}
                continue
            try:
                one.update(token, *given)
            except DeepAccidentError as error:
                if name == main:
                    raise
                counts[name] = {"refused": str(error)}
            else:
                counts[name] = {"counts": one.counts[token]}
        self.add(token, counts)

    def result_of(self, counts: Collection[Counts]) -> dict[str, Any]:
        """The results of some samples' counts, in any order."""
        return {name: _result(name, evaluator, counts) for name, evaluator in self._evaluators.items()}


def _result(name: str, evaluator: Evaluator[Any], counts: Collection[Counts]) -> Any:
    refused = sorted(each[name]["refused"] for each in counts if "refused" in each[name])
    if refused:
        return Refusal(refused[0])
    return evaluator.result_of([each[name]["counts"] for each in counts])


CHOSEN: Final = "chosen"
"""Name of the rules that are explained."""
_WITHOUT_EFFECT: Final = ("own_box_not_augmented", "ids_kept_between_samples")
"""Quirks that show only in training: nothing is augmented here, and no ids come from another sample."""
_LABEL_CHOICES: Final[Mapping[str, tuple[str, ...]]] = {
    "drawn_when": get_args(DrawnWhen),
    "warp": ("stretched", "exact"),
    "native": ("released", "devkit"),
}
Found = TypeVar("Found")


@dataclass(frozen=True, slots=True)
class Variant:
    """One of the rules that are counted.

    Attributes:
        rules: the protocol.
        labels: what the labels show that are its truth; None where it takes none.
    """

    rules: Any
    labels: MotionLabelConfig | None


@dataclass(frozen=True, slots=True)
class Variants:
    """All that is counted side by side.

    Attributes:
        chosen: the rules that are explained.
        protocols: the task's by name.
        choices: the chosen ones with one choice changed, by `name=value`.
        refused: protocol → why it does not take such results.
    """

    chosen: Variant
    protocols: Mapping[str, Variant]
    choices: Mapping[str, Variant]
    refused: Mapping[str, str]

    def by_name(self) -> dict[str, Variant]:
        """All of them under one name each, the chosen one first."""
        protocols = {f"protocol {name}": each for name, each in self.protocols.items()}
        return {CHOSEN: self.chosen, **protocols, **self.choices}


def variants_of(loader: SampleLoader) -> Variants:
    """The variants of a setup that can be counted for results."""
    setup = loader.setup
    chosen = Variant(setup.rules, loader.label_config())
    protocols, refused = {}, {}
    for name in TASK_PROTOCOLS[setup.task]:
        other = EvaluationSetup(task=setup.task, protocol=name, horizon=setup.horizon)
        try:
            labels = SampleLoader(loader.dataset, loader.results, other).label_config()
        except EvaluationError as error:
            refused[name] = str(error)
        else:
            protocols[name] = Variant(other.rules, labels)
    made: Mapping[str, Any] = setup.rules.variants() if hasattr(setup.rules, "variants") else {}
    choices = {name: Variant(rules, chosen.labels) for name, rules in made.items()}
    return Variants(chosen, protocols, choices | _label_variants(chosen), refused)


@dataclass(frozen=True, slots=True)
class VariantsLoader:
    """Makes the arguments of `SideBySide.update` for a sample; shared parts are made once. Cheap to pickle.

    Attributes:
        loader: of the chosen rules.
        variants: by name, the chosen one first.
    """

    loader: SampleLoader
    variants: Mapping[str, Variant]

    def __call__(self, token: str) -> tuple[dict[str, tuple[Any, ...] | Refusal]]:
        """By each variant's name what its evaluator takes of the sample, or why it cannot."""
        prediction = self.loader.results.prediction(token)
        if isinstance(prediction, DetectedBoxes):
            argue: Callable[[Variant], tuple[Any, ...]] = _Detections(self.loader, token, prediction)
        else:
            argue = _Motions(self.loader, token, prediction)
        return ({name: _or_refusal(argue, each, first=name == CHOSEN) for name, each in self.variants.items()},)


def _or_refusal(argue: Callable[[Variant], tuple[Any, ...]], variant: Variant, *, first: bool) -> Any:
    try:
        return argue(variant)
    except DeepAccidentError as error:
        if first:
            raise
        return Refusal(str(error))


class _Detections:
    """What detection metrics take of a sample, by the frame and the truth that they ask for."""

    def __init__(self, loader: SampleLoader, token: str, prediction: DetectedBoxes) -> None:
        self._loader, self._token, self._prediction = loader, token, prediction
        self._found: dict[str, DetectedBoxes] = {}
        self._truth: dict[tuple[Any, ...], Boxes] = {}

    def __call__(self, variant: Variant) -> tuple[Any, ...]:
        rules: DetectionProtocol = variant.rules
        asked = rules.frame, rules.truth, rules.label_velocity, rules.own_box
        dataset, token = self._loader.dataset, self._token
        return (
            _kept(self._found, rules.frame, lambda: self._loader.detected(token, self._prediction, rules.frame)),
            _kept(self._truth, asked, lambda: detection_truth(dataset, token, rules)),
        )


class _Motions:
    """What motion, accident and warning metrics take of a sample, by the labels that they ask for."""

    def __init__(self, loader: SampleLoader, token: str, prediction: Any) -> None:
        self._loader, self._token, self._prediction = loader, token, prediction
        self._labels: dict[MotionLabelConfig, MotionLabels] = {}
        self._contexts: dict[str, AccidentContext] = {}

    def __call__(self, variant: Variant) -> tuple[Any, ...]:
        config, setup = variant.labels, self._loader.setup
        label = None if config is None else _kept(self._labels, config, lambda: self._label(config))
        if setup.task == "motion":
            return self._prediction, label
        dataset, token = self._loader.dataset, self._token
        return (
            self._prediction,
            label,
            _kept(self._contexts, token, lambda: accident_context(dataset, token, setup.horizon)),
        )

    def _label(self, config: MotionLabelConfig) -> MotionLabels:
        return labels_at_present(motion_labels(self._loader.dataset, self._token, config))


def _kept(memory: dict[Any, Found], key: Any, make: Callable[[], Found]) -> Found:
    """What was made before under a key, or is made now."""
    if key not in memory:
        memory[key] = make()
    return memory[key]


def _label_variants(chosen: Variant) -> dict[str, Variant]:
    """The chosen rules with truths of changed label protocols, by `labels.name=value`; of rules that take labels."""
    if chosen.labels is None or not hasattr(chosen.rules, "labels"):
        return {}
    rules = replace(chosen.rules, labels=None)
    others = _other_labels(chosen.labels.rules)
    return {f"labels.{name}": Variant(rules, replace(chosen.labels, protocol=each)) for name, each in others.items()}


def _other_labels(rules: LabelProtocol) -> dict[str, LabelProtocol]:
    """A label protocol with one choice changed, by `name=value`."""
    switches: Mapping[str, tuple[Any, ...]] = {
        **{name: (False, True) for name in slip_names() if name not in _WITHOUT_EFFECT},
        **({} if rules.warp == "fiery" else _LABEL_CHOICES),
    }
    return with_others(rules, switches)
