"""Which samples an evaluation is of."""

from pathlib import Path
from typing import Any

import pytest
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, ConfigError, NotAvailableError
from deepaccident_devkit.evaluation.runs import Coverage, SampleSelection, default_selection
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup, agent_of, scenario_of
from deepaccident_devkit.synth import SynthConfig, make_release


def test_the_released_list(da_motion: DeepAccident) -> None:
    assert SampleSelection(split="train").tokens(da_motion) == da_motion.evaluation_samples("train")


def test_scope_agents_and_horizon_choose(da_motion: DeepAccident) -> None:
    one = SampleSelection(split="train", scope="all", agents=("infrastructure",), horizon=1.0).tokens(da_motion)
    both = {f"type1_subtype1_{end}" for end in ("accident", "normal")}
    assert ({token.split("/")[0] for token in one}, {agent_of(token) for token in one}) == (both, {"infrastructure"})
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
    assert given.text() == (
        "split val, samples evaluate (the last 2 s), scope accident, agents ego_vehicle, infrastructure"
    )


def test_parts_of_tokens() -> None:
    scenario = "type1_subtype1_accident/Town01_type001_subtype0001_scenario00001"
    sample = f"{scenario}/ego_vehicle/003"
    assert (scenario_of(sample), agent_of(sample), agent_of("nonsense")) == (scenario, "ego_vehicle", "")


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"samples": "some"}, r"samples: expected one of evaluate, all, found 'some'"),
        ({"scope": "normal"}, r"scope: expected one of accident, all, found 'normal'"),
        ({"agents": ("ego",)}, r"agents: expected one of ego_vehicle, .*found 'ego'; did you mean 'ego_vehicle'"),
        ({"agents": ()}, r"agents: expected at least one agent, or None for all, found none"),
    ],
)
def test_wrong_choices(changes: dict[str, object], sentence: str) -> None:
    assert_refused(
        (lambda: SampleSelection(split="val", **changes), ChoiceError, sentence),
    )


def test_a_horizon_between_samples(da_b: DeepAccident) -> None:
    assert_refused(
        (
            lambda: SampleSelection(split="val", horizon=1.2).tokens(da_b),
            ConfigError,
            r"horizon: samples to evaluate are 0.5 s apart, so that 1.2 s does not say",
        ),
    )


@pytest.mark.slow
def test_nothing_to_evaluate(tmp_path: Path) -> None:
    short = make_release(tmp_path / "release", SynthConfig(scenarios=6, frames=4, layout="B", seed=4, sensors=False))
    assert_refused(
        (
            lambda: SampleSelection(split="val", agents=("ego_vehicle",)).tokens(
                DeepAccident("v1", short, verbose=False)
            ),
            NotAvailableError,
            r"val: this release has no labelled samples of ego_vehicle there",
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
        ([MISSING], ["2 of 6 samples have no prediction (a, b)"]),
        ([EXTRA], ["1 predictions are of samples that are not evaluated (c)", "leave them out with --allow-partial"]),
        ([UNKNOWN], ["3 predictions are of no sample of this release (d, e, f)"]),
        ([MISSING, EXTRA], ["2 of 6 samples have no", "1 predictions are of samples that are not evaluated (c)"]),
        ([EXTRA, UNKNOWN], ["1 predictions are of samples", "3 predictions are of no sample"]),
        ([{"missing": tuple("abcd")}], ["4 of 6 samples have no prediction (a, b, c, …)"]),
        (
            [MISSING, {"splits": ("train", "val"), "agents": ("ego_vehicle",)}],
            ["2 of 6 samples", "the predictions are of the splits train, val and the agents ego_vehicle"],
        ),
    ],
)
def test_what_is_told_of_the_coverage(parts: list[dict[str, Any]], told: list[str]) -> None:
    found = Coverage(expected=6, **{name: each for part in parts for name, each in part.items()})
    assert found.is_complete is (parts == [])
    texts = found.to_text().replace("True); no", "True), no").split("; ")
    assert [text[: len(start)] for text, start in zip(texts, told, strict=True)] == told
