"""The samples and rules of an evaluation, and what a loader gives to its evaluator."""

import pickle
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.expected_errors import assert_raises

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, ConfigError, EvaluationError, ResultsError
from deepaccident_devkit.evaluation import (
    Accident,
    AccidentContext,
    DetectedBoxes,
    detection_truth,
    instances_of,
)
from deepaccident_devkit.evaluation.predictions import label_config
from deepaccident_devkit.evaluation.results import Results, ResultsWriter, read_results
from deepaccident_devkit.evaluation.runs import (
    Coverage,
    SampleSelection,
    coverage,
    default_selection,
)
from deepaccident_devkit.evaluation.runs.setups import (
    EvaluationSetup,
    SampleLoader,
    agent_of,
    check_recordings,
    release_note,
)
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import MotionLabels


class TestSetup:
    def test_switches_reach_the_evaluator_and_cannot_be_changed(self) -> None:
        switches = {"reading.danger_distance": 0.5}
        setup = EvaluationSetup(task="accident", protocol="paper", switches=switches)
        switches["reading.danger_distance"] = 2.0

        assert setup.evaluator().settings["choices"]["reading"]["danger_distance"] == 0.5
        assert setup.as_dict()["switches"] == {"reading.danger_distance": 0.5}
        assert pickle.loads(pickle.dumps(setup)) == setup
        with pytest.raises(TypeError):
            setup.switches["x"] = 1  # type: ignore[index]

    @pytest.mark.parametrize(
        ("options", "error", "message"),
        [
            (
                {"task": "motions"},
                ChoiceError,
                (
                    r"task: expected one of motion, accident, detection, tracking, warning, "
                    r"planning, forecasting, segmentation, found 'mo"
                ),
            ),
            (
                {"task": "motion", "protocol": "boxes"},
                ChoiceError,
                r"protocol of motion: expected one of released, paper, found 'boxes'",
            ),
            ({"task": "motion", "horizon": 0.0}, ConfigError, "above 0, at most 100, found 0.0"),
            (
                {"task": "motion", "horizon": float("nan")},
                ConfigError,
                "above 0, at most 100, found nan",
            ),
            (
                {"task": "motion", "switches": {"gap": 1}},
                ChoiceError,
                r"these rules have no switch 'gap'",
            ),
        ],
    )
    def test_wrong_choices_are_refused(
        self, options: dict[str, Any], error: type[Exception], message: str
    ) -> None:
        assert_raises(
            (lambda: EvaluationSetup(**options), error, message),
        )


class TestLoader:
    @pytest.fixture
    def token(self, da_motion: DeepAccident) -> str:
        return da_motion.evaluation_samples("train")[1]

    @pytest.fixture
    def motion(self, token: str, tmp_path: Path) -> Results:
        """Write motion that predicts nothing, on cells of 1 m and once a second."""
        grid = BevGrid((-50, 50, 1.0), (-50, 50, 1.0), "fiery")
        path = tmp_path / "motion"
        with ResultsWriter(path, "motion", grid=grid, step=1.0, labels="clean") as writer:
            writer.add(token, instances_of(np.zeros((3, *grid.shape), int), grid))
        return read_results(path)

    def test_motion_has_labels_of_its_form(
        self, da_motion: DeepAccident, motion: Results, token: str
    ) -> None:
        setup = EvaluationSetup(task="motion", switches={"labels": "clean"}, horizon=1.0)
        prediction, label = SampleLoader(da_motion, motion, setup)(token)

        assert isinstance(label, MotionLabels)

        config = label.config
        assert (config.grid, config.step, config.future_frames) == (motion.form.grid, 10, 1)
        assert config.grid == prediction.grid

    def test_labels_are_chosen_by_the_protocol_or_otherwise_by_the_results(
        self, motion: Results
    ) -> None:
        for protocol, labels in (("paper", "released"), ("boxes", "clean")):
            rules = EvaluationSetup(task="accident", protocol=protocol).rules
            assert label_config(rules, motion.form, horizon=2.0).protocol == labels

    def test_accidents_have_their_context(
        self, da_motion: DeepAccident, token: str, tmp_path: Path
    ) -> None:
        path = tmp_path / "accidents.json"
        with ResultsWriter(path, "accident") as writer:
            writer.add(token, [Accident(positions=np.zeros((2, 2)), time=1.0)])

        setup = EvaluationSetup(task="accident", protocol="boxes", horizon=3.0)

        prediction, label, context = SampleLoader(da_motion, read_results(path), setup)(token)
        assert (len(prediction), label) == (1, None)
        assert isinstance(context, AccidentContext)
        assert context.truth is not None

    def test_boxes_come_from_world_into_the_protocols_frame(
        self, da_motion: DeepAccident, token: str, tmp_path: Path
    ) -> None:
        path = tmp_path / "boxes.json"
        boxes = da_motion.boxes(token)
        with ResultsWriter(path, "detection") as writer:
            writer.add(token, DetectedBoxes(boxes=boxes, scores=np.ones(len(boxes))))

        setup = EvaluationSetup(task="detection", protocol="released")
        detected, truth = SampleLoader(da_motion, read_results(path), setup)(token)

        assert detected.boxes.frame == truth.frame == "lidar"

        lidar_boxes = da_motion.boxes(token, "lidar")
        np.testing.assert_allclose(detected.boxes.center, lidar_boxes.center, atol=1e-6)

        expected_truth = detection_truth(da_motion, token, setup.rules)
        assert truth.center.tolist() == expected_truth.center.tolist()

    def test_results_of_another_kind_or_shorter_horizon_are_refused(
        self, da_motion: DeepAccident, motion: Results, token: str, tmp_path: Path
    ) -> None:
        with ResultsWriter(tmp_path / "a.json", "accident") as writer:
            writer.add(token, [])

        accidents = read_results(tmp_path / "a.json")

        assert_raises(
            (
                lambda: SampleLoader(da_motion, accidents, EvaluationSetup(task="accident")),
                EvaluationError,
                ("a.json: contains explicit accidents", "protocol 'released'"),
            ),
            (
                lambda: SampleLoader(da_motion, motion, EvaluationSetup(task="detection")),
                EvaluationError,
                r"contains motion results; detection is evaluated from detection results",
            ),
            (
                lambda: SampleLoader(
                    da_motion, motion, EvaluationSetup(task="motion", horizon=2.5)
                ),
                EvaluationError,
                r"look 2 s ahead \(3 frames, 1 s apart, .*, less than the horizon of 2.5 s; add",
            ),
        )


def test_scope_agents_and_horizon_choose_samples(da_motion: DeepAccident) -> None:
    selection = SampleSelection(split="train", scope="all", agents=("infrastructure",), horizon=1.0)
    tokens = selection.tokens(da_motion)

    kinds = {token.split("/")[0] for token in tokens}
    assert kinds == {"type1_subtype1_accident", "type1_subtype1_normal"}
    assert {agent_of(token) for token in tokens} == {"infrastructure"}
    assert [int(token[-3:]) for token in tokens] == [25, 30] * 2


def test_only_whole_scenarios_of_accidents(da_motion: DeepAccident) -> None:
    every = SampleSelection(split="train", samples="all", scope="all", horizon=0.3)
    every_token = every.tokens(da_motion)
    accident_tokens = replace(every, scope="accident").tokens(da_motion)

    assert accident_tokens == [token for token in every_token if "_accident/" in token]
    assert len(every_token) == 2 * len(accident_tokens) == 2 * 5 * 7


def test_defaults_by_task() -> None:
    motion = EvaluationSetup(task="motion", protocol="paper", horizon=3.0)
    assert default_selection(motion) == SampleSelection(split="val", horizon=3.0)

    warning = EvaluationSetup(task="warning", protocol="clean", horizon=3.0)
    assert default_selection(warning) == SampleSelection(
        split="val", samples="all", scope="all", horizon=3.0
    )


def test_agents_are_put_in_order() -> None:
    selection = SampleSelection(split="val", agents=("infrastructure", "ego_vehicle"))
    assert selection.agents == ("ego_vehicle", "infrastructure")


def test_wrong_choices_and_a_horizon_between_samples(da_b: DeepAccident) -> None:
    select = partial(SampleSelection, split="val")
    assert_raises(
        (
            partial(select, samples="some"),
            ChoiceError,
            ("samples: expected one of evaluate, all", "'some'"),
        ),
        (
            partial(select, scope="normal"),
            ChoiceError,
            ("scope: expected one of accident, all", "'normal'"),
        ),
        (
            partial(select, agents=("ego",)),
            ChoiceError,
            ("agents: expected one of", "did you mean 'ego_vehicle'"),
        ),
        (
            partial(select, agents=()),
            ChoiceError,
            (
                "agents: expected some of ego_vehicle",
                "found none",
            ),
        ),
        (
            lambda: select(horizon=1.2).tokens(da_b),
            ConfigError,
            ("horizon: ", "multiple of 0.5 s", "1.2 s"),
        ),
    )


def test_a_horizon_may_be_rounded_a_little(da_motion: DeepAccident) -> None:
    exact = SampleSelection(split="train", horizon=1.5)
    rounded = SampleSelection(split="train", horizon=1.5 - 1e-9)
    assert rounded.tokens(da_motion) == exact.tokens(da_motion)


MISSING, EXTRA, UNKNOWN = ({"missing": ("a", "b")}, {"extra": ("c",)}, {"unknown": ("d", "e", "f")})


@pytest.mark.parametrize(
    ("parts", "messages"),
    [
        ([], ["all 6 samples have a prediction, and no others do"]),
        ([MISSING], ["without a prediction: 2 of 6 samples (a, b)"]),
        (
            [EXTRA],
            [
                "1 prediction for samples that are not evaluated (c)",
                "ignore them with --allow-partial",
            ],
        ),
        ([UNKNOWN], ["3 predictions for samples that are not in this release (d, e, f)"]),
        (
            [MISSING, EXTRA],
            ["without a prediction: 2 of 6", "1 prediction for samples that are not evaluated (c)"],
        ),
        ([EXTRA, UNKNOWN], ["1 prediction for samples", "3 predictions for samples"]),
        ([{"missing": tuple("abcd")}], ["without a prediction: 4 of 6 samples (a, b, c, …)"]),
        (
            [MISSING, {"splits": ("train", "val"), "agents": ("ego_vehicle",)}],
            [
                "without a prediction: 2",
                "the predictions cover --split train, val --agents ego_vehicle",
            ],
        ),
    ],
)
def test_coverage_lists_missing_and_extra_samples(
    parts: list[dict[str, Any]], messages: list[str]
) -> None:
    fields = {name: value for part in parts for name, value in part.items()}
    samples = Coverage(expected=6, **fields)
    assert samples.is_complete is (parts == [])

    texts = samples.to_text().replace("all; every", "all, every").split("; ")
    for text, message in zip(texts, messages, strict=True):
        assert text.startswith(message)


@pytest.fixture(scope="module")
def expected_tokens(da_b: DeepAccident, selection: SampleSelection) -> list[str]:
    return selection.tokens(da_b)


def test_missing_extra_and_unknown_three_of_each(
    da_b: DeepAccident, selection: SampleSelection, expected_tokens: list[str]
) -> None:
    extra = replace(selection, agents=("ego_vehicle_behind",)).tokens(da_b)
    unknown = ["mine/1", "mine/2", "mine/3", "mine/4"]
    samples = coverage(da_b, [*expected_tokens[4:], *extra, *unknown], selection)

    assert samples.expected == 6
    assert samples.missing == tuple(expected_tokens[:4])
    assert samples.extra == tuple(sorted(extra))
    assert samples.unknown == tuple(unknown)


@pytest.mark.parametrize(
    ("predicted_by", "selected_by", "options"),
    [
        ({"scope": "all"}, {}, "--scope all"),
        ({"horizon": 3.0}, {}, "--horizon 3.0"),
        ({"horizon": 1.0, "scope": "all"}, {"horizon": 2.0}, "--horizon 1.0 --scope all"),
        ({"samples": "all", "scope": "all"}, {}, "--samples all --scope all"),
        ({}, {"samples": "all", "scope": "all"}, "--samples evaluate --scope accident"),
        (
            {"horizon": 3.0},
            {"samples": "all", "scope": "all"},
            "--horizon 3.0 --samples evaluate --scope accident",
        ),
        ({}, {"scope": "all"}, "--scope accident"),
        ({"agents": ("ego_vehicle",)}, {}, "--agents ego_vehicle"),
        (
            {"agents": ("ego_vehicle", "infrastructure"), "scope": "all", "horizon": 1.0},
            {},
            "--agents ego_vehicle,infrastructure --horizon 1.0 --scope all",
        ),
        (
            {},
            {"agents": ("ego_vehicle",)},
            (
                "--agents "
                "ego_vehicle,ego_vehicle_behind,other_vehicle,other_vehicle_behind,infrastructure"
            ),
        ),
        ({"agents": ("ego_vehicle",), "scope": "all"}, {"agents": ("ego_vehicle",)}, "--scope all"),
    ],
)
def test_coverage_names_the_options_of_the_predictions(
    da_motion: DeepAccident,
    predicted_by: dict[str, Any],
    selected_by: dict[str, Any],
    options: str,
) -> None:
    selection = SampleSelection(**{"split": "train", **selected_by})
    predicted = SampleSelection(**{"split": "train", **predicted_by}).tokens(da_motion)
    samples = coverage(da_motion, predicted, selection)

    assert (samples.options, samples.is_complete) == (options, False)

    start = f"the predictions were made with {options}: "
    assert samples.to_text().startswith(start) == bool(options)

    # no options give exactly these samples
    gap = coverage(da_motion, [*predicted[:1], *predicted[2:]], selection)
    assert (gap.options, gap.is_complete) == ("", False)


def test_coverage_names_the_split_of_the_predictions(
    da_b: DeepAccident, selection: SampleSelection
) -> None:
    other = replace(selection, split="train")
    assert coverage(da_b, other.tokens(da_b), selection).options == "--split train"
    assert coverage(da_b, [], selection).options == ""


def write_noted_results(dataset: DeepAccident, path: Path, note: object) -> Results:
    with ResultsWriter(path, "accident", meta={"release": note}) as writer:
        writer.add(dataset.sample[0]["token"], [])
    return read_results(path)


def test_other_recordings_of_the_same_names_are_refused(
    da_b: DeepAccident, own_release: Path, tmp_path: Path
) -> None:
    scenarios = [scenario["token"] for scenario in da_b.scenario]
    note = release_note(da_b, scenarios)
    assert {*note["recordings"]} == {*scenarios}
    assert len({*note["recordings"].values()}) == len(scenarios)

    results = write_noted_results(da_b, tmp_path / "whole.json", note)
    check_recordings(results, da_b)

    label = min(own_release.rglob(f"ego_vehicle/label/{da_b.scenario[0]['name']}/*_002.txt"))
    lines = label.read_text().splitlines(keepends=True)
    label.write_text("".join(lines[:-1]))  # one box fewer
    other_release = DeepAccident("v1", own_release, verbose=False)
    assert_raises(
        (
            lambda: check_recordings(results, other_release),
            ResultsError,
            (str(results.path), "1 of 6", scenarios[0], "check index DATAROOT"),
        )
    )

    unchanged_note = release_note(da_b, [scenarios[1]])
    unchanged_results = write_noted_results(da_b, tmp_path / "second.json", unchanged_note)
    check_recordings(unchanged_results, other_release)


def test_unknown_recordings_are_not_compared(da_b: DeepAccident, tmp_path: Path) -> None:
    notes = ({}, None, "v1", {"version": "v1"}, {"recordings": {"elsewhere/x": "0"}})
    for number, note in enumerate(notes):
        check_recordings(write_noted_results(da_b, tmp_path / f"{number}.json", note), da_b)
