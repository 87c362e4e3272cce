"""What is evaluated and by which rules: choices by their names, the samples, and what an evaluator
is given.
"""

import pickle
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from refusals import assert_refused

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
                (
                    r"task: expected one of motion, accident, detection, warning, "
                    r"planning, forecasting, found 'mo"
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
        with ResultsWriter(
            tmp_path / "motion", "motion", grid=grid, step=1.0, labels="clean"
        ) as writer:
            writer.add(token, instances_of(np.zeros((3, *grid.shape), int), grid))
        return read_results(tmp_path / "motion")

    def test_motion_has_labels_of_its_form(
        self, da_motion: DeepAccident, motion: Results, token: str
    ) -> None:
        setup = EvaluationSetup(task="motion", switches={"labels": "clean"}, horizon=1.0)
        prediction, label = SampleLoader(da_motion, motion, setup)(token)
        assert isinstance(label, MotionLabels)
        config = label.config
        assert (config.grid, config.step, config.future_frames) == (motion.form.grid, 10, 1)
        assert config.grid == prediction.grid

    def test_the_protocol_says_which_labels_and_else_the_results(self, motion: Results) -> None:
        for task, protocol, expected in (
            ("accident", "paper", "released"),
            ("accident", "boxes", "clean"),
        ):
            assert (
                label_config(
                    EvaluationSetup(task=task, protocol=protocol).rules, motion.form, horizon=2.0
                ).protocol
                == expected
            )

    def test_accidents_have_their_context(
        self, da_motion: DeepAccident, token: str, tmp_path: Path
    ) -> None:
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
        np.testing.assert_allclose(
            found.boxes.center, da_motion.boxes(token, "lidar").center, atol=1e-6
        )
        assert (
            truth.center.tolist() == detection_truth(da_motion, token, setup.rules).center.tolist()
        )

    def test_refused(
        self, da_motion: DeepAccident, motion: Results, token: str, tmp_path: Path
    ) -> None:
        with ResultsWriter(tmp_path / "a.json", "accident") as writer:
            writer.add(token, [])
        assert_refused(
            (
                lambda: SampleLoader(
                    da_motion, read_results(tmp_path / "a.json"), EvaluationSetup(task="accident")
                ),
                EvaluationError,
                ("a.json: holds explicit accidents", "protocol 'released'"),
            ),
            (
                lambda: SampleLoader(da_motion, motion, EvaluationSetup(task="detection")),
                EvaluationError,
                r"holds motion results; detection is evaluated from detection results",
            ),
            (
                lambda: SampleLoader(
                    da_motion, motion, EvaluationSetup(task="motion", horizon=2.5)
                ),
                EvaluationError,
                r"look 2 s ahead \(3 frames, 1 s apart, .*, less than the horizon of 2.5 s; add",
            ),
        )


def test_scope_agents_and_horizon_choose(da_motion: DeepAccident) -> None:
    one = SampleSelection(
        split="train", scope="all", agents=("infrastructure",), horizon=1.0
    ).tokens(da_motion)
    both = {f"type1_subtype1_{end}" for end in ("accident", "normal")}
    assert ({token.split("/")[0] for token in one}, {agent_of(token) for token in one}) == (
        both,
        {"infrastructure"},
    )
    assert [int(token[-3:]) for token in one] == [25, 30] * 2


def test_whole_scenarios_of_accidents_alone(da_motion: DeepAccident) -> None:
    every, accidents = (
        SampleSelection(split="train", samples="all", scope=scope, horizon=0.3).tokens(da_motion)
        for scope in ("all", "accident")
    )
    assert accidents == [token for token in every if "_accident/" in token]
    assert len(every) == 2 * len(accidents) == 2 * 5 * 7


def test_defaults_by_task() -> None:
    motion, warning = (
        default_selection(EvaluationSetup(task=task, protocol=protocol, horizon=3.0))
        for task, protocol in (("motion", "paper"), ("warning", "clean"))
    )
    assert motion == SampleSelection(split="val", horizon=3.0)
    assert warning == SampleSelection(split="val", samples="all", scope="all", horizon=3.0)


def test_agents_are_put_in_order() -> None:
    given = SampleSelection(split="val", agents=("infrastructure", "ego_vehicle"))
    assert given.agents == ("ego_vehicle", "infrastructure")


def test_wrong_choices_and_a_horizon_between_samples(da_b: DeepAccident) -> None:
    chosen = partial(SampleSelection, split="val")
    assert_refused(
        (
            partial(chosen, samples="some"),
            ChoiceError,
            ("samples: expected one of evaluate, all", "'some'"),
        ),
        (
            partial(chosen, scope="normal"),
            ChoiceError,
            ("scope: expected one of accident, all", "'normal'"),
        ),
        (
            partial(chosen, agents=("ego",)),
            ChoiceError,
            ("agents: expected one of", "did you mean 'ego_vehicle'"),
        ),
        (
            partial(chosen, agents=()),
            ChoiceError,
            (
                "agents: expected some of ego_vehicle",
                "found none",
            ),
        ),
        (
            lambda: chosen(horizon=1.2).tokens(da_b),
            ConfigError,
            ("horizon: ", "0.5 s apart", "1.2 s"),
        ),
    )


def test_a_horizon_may_be_rounded_a_little(da_motion: DeepAccident) -> None:
    exact = SampleSelection(split="train", horizon=1.5).tokens(da_motion)
    assert SampleSelection(split="train", horizon=1.5 - 1e-9).tokens(da_motion) == exact


MISSING, EXTRA, UNKNOWN = ({"missing": ("a", "b")}, {"extra": ("c",)}, {"unknown": ("d", "e", "f")})


@pytest.mark.parametrize(
    ("parts", "told"),
    [
        ([], ["all 6 samples have a prediction, and nothing else has"]),
        ([MISSING], ["without a prediction: 2 of 6 samples (a, b)"]),
        (
            [EXTRA],
            [
                "1 prediction of samples that are not evaluated (c)",
                "leave them out with --allow-partial",
            ],
        ),
        ([UNKNOWN], ["3 predictions of no sample of this release (d, e, f)"]),
        (
            [MISSING, EXTRA],
            ["without a prediction: 2 of 6", "1 prediction of samples that are not evaluated (c)"],
        ),
        ([EXTRA, UNKNOWN], ["1 prediction of samples", "3 predictions of no sample"]),
        ([{"missing": tuple("abcd")}], ["without a prediction: 4 of 6 samples (a, b, c, …)"]),
        (
            [MISSING, {"splits": ("train", "val"), "agents": ("ego_vehicle",)}],
            [
                "without a prediction: 2",
                "the predictions are of --split train, val --agents ego_vehicle",
            ],
        ),
    ],
)
def test_what_is_told_of_the_coverage(parts: list[dict[str, Any]], told: list[str]) -> None:
    found = Coverage(expected=6, **{name: each for part in parts for name, each in part.items()})
    assert found.is_complete is (parts == [])
    texts = found.to_text().replace("all; no", "all, no").split("; ")
    assert [text[: len(start)] for text, start in zip(texts, told, strict=True)] == told


@pytest.fixture(scope="module")
def expected(da_b: DeepAccident, selection: SampleSelection) -> list[str]:
    return selection.tokens(da_b)


def test_missing_extra_and_unknown_three_of_each(
    da_b: DeepAccident, selection: SampleSelection, expected: list[str]
) -> None:
    extra = replace(selection, agents=("ego_vehicle_behind",)).tokens(da_b)
    found = coverage(
        da_b, [*expected[4:], *extra, "mine/1", "mine/2", "mine/3", "mine/4"], selection
    )
    assert (found.expected, found.missing, found.extra) == (
        6,
        tuple(expected[:4]),
        tuple(sorted(extra)),
    )
    assert found.unknown == ("mine/1", "mine/2", "mine/3", "mine/4")


@pytest.mark.parametrize(
    ("made", "asked", "options"),
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
def test_the_options_that_are_missing(
    da_motion: DeepAccident, made: dict[str, Any], asked: dict[str, Any], options: str
) -> None:
    selection = SampleSelection(**{"split": "train", **asked})
    predicted = SampleSelection(**{"split": "train", **made}).tokens(da_motion)
    found = coverage(da_motion, predicted, selection)
    assert (found.options, found.is_complete) == (options, False)
    assert found.to_text().startswith(f"the predictions are of the samples of {options}: ") == bool(
        options
    )
    some = coverage(da_motion, [*predicted[:1], *predicted[2:]], selection)  # of no list of options
    assert (some.options, some.is_complete) == ("", False)


def test_the_split_that_is_missing(da_b: DeepAccident, selection: SampleSelection) -> None:
    other = replace(selection, split="train")
    assert coverage(da_b, other.tokens(da_b), selection).options == "--split train"
    assert coverage(da_b, [], selection).options == ""


def results_of(dataset: DeepAccident, path: Path, note: object) -> Results:
    with ResultsWriter(path, "accident", meta={"release": note}) as writer:
        writer.add(dataset.sample[0]["token"], [])
    return read_results(path)


def test_other_recordings_of_the_same_names_are_refused(
    da_b: DeepAccident, own_release: Path, tmp_path: Path
) -> None:
    first, second, *_ = tokens = [each["token"] for each in da_b.scenario]
    note = release_note(da_b, tokens)
    assert {*note["recordings"]} == {*tokens}
    assert len({*note["recordings"].values()}) == len(tokens)
    results = results_of(da_b, tmp_path / "whole.json", note)
    check_recordings(results, da_b)
    label = min(own_release.rglob(f"ego_vehicle/label/{da_b.scenario[0]['name']}/*_002.txt"))
    label.write_text("".join(label.read_text().splitlines(keepends=True)[:-1]))  # one box fewer
    other = DeepAccident("v1", own_release, verbose=False)
    assert_refused(
        (
            lambda: check_recordings(results, other),
            ResultsError,
            (str(results.path), "1 of 6", first, "check index DATAROOT"),
        )
    )
    check_recordings(
        results_of(da_b, tmp_path / "second.json", release_note(da_b, [second])), other
    )


def test_what_is_not_known_is_not_compared(da_b: DeepAccident, tmp_path: Path) -> None:
    for number, note in enumerate(
        ({}, None, "v1", {"version": "v1"}, {"recordings": {"elsewhere/x": "0"}})
    ):
        check_recordings(results_of(da_b, tmp_path / f"{number}.json", note), da_b)
