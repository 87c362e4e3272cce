"""Which samples count: one a second to train, the last two seconds of accidents to evaluate."""

import re
from pathlib import Path

import pytest
import tiny
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, ConfigError, NotAvailableError
from deepaccident_devkit.motion import evaluation_samples, samples, training_samples
from deepaccident_devkit.motion.sample_labels import no_samples_text
from deepaccident_devkit.taxonomy import AGENTS


def _frames(tokens: list[str], scenario: str, agent: str) -> list[int]:
    return [int(one.rsplit("/", 1)[1]) for one in tokens if one.startswith(f"{scenario}/{agent}/")]


@pytest.fixture
def every_scenario(da_motion: DeepAccident, tmp_path: Path) -> Path:
    split = tmp_path / "mine.txt"
    split.write_text("".join(f"{record['token'].replace('/', ' ')}\n" for record in da_motion.scenario))
    return split


def test_training_takes_a_sample_a_second_counted_from_the_end(da_motion: DeepAccident, every_scenario: Path) -> None:
    tokens = samples(da_motion, every_scenario, "train")
    for scenario in da_motion.scenario:
        for agent in AGENTS:
            assert _frames(tokens, scenario["token"], agent) == [5, 15, 25, 35]


def test_evaluation_takes_the_last_two_seconds_of_accidents_but_the_end(
    da_motion: DeepAccident, every_scenario: Path
) -> None:
    tokens = samples(da_motion, every_scenario, "evaluate")
    for scenario in da_motion.scenario:
        expected = [15, 20, 25, 30] if scenario["designed_accident"] else []
        for agent in AGENTS:
            assert _frames(tokens, scenario["token"], agent) == expected


def test_the_paper_leaves_horizon_and_scope_open(da_motion: DeepAccident, every_scenario: Path) -> None:
    tokens = samples(da_motion, every_scenario, "evaluate", "paper", horizon=3.0, scope="all")
    for scenario in da_motion.scenario:
        assert _frames(tokens, scenario["token"], "infrastructure") == [5, 10, 15, 20, 25, 30]
    assert len(samples(da_motion, every_scenario, "all")) == 2 * 5 * 7
    assert samples(da_motion, every_scenario, "every") == [sample["token"] for sample in da_motion.sample]
    shortest = samples(da_motion, every_scenario, "evaluate", "paper", horizon=0.5, scope="all")
    assert {token[-3:] for token in shortest} == {"030"}


def test_a_split_belongs_to_its_scenarios_alone(da_motion: DeepAccident, tmp_path: Path) -> None:
    one = da_motion.scenario[1]["token"]
    (tmp_path / "one.txt").write_text(one.replace("/", " ") + "\n")
    assert {token.rsplit("/", 2)[0] for token in samples(da_motion, tmp_path / "one.txt", "all")} == {one}


def test_evaluation_samples_are_those_of_the_purpose_to_evaluate(da_motion: DeepAccident, every_scenario: Path) -> None:
    tokens = samples(da_motion, every_scenario, "evaluate")
    assert tokens
    assert evaluation_samples(da_motion, every_scenario) == tokens
    assert da_motion.evaluation_samples(every_scenario, "released") == tokens
    far = samples(da_motion, every_scenario, "evaluate", "paper", horizon=3.0, scope="all")
    assert da_motion.evaluation_samples(every_scenario, "paper", horizon=3.0, scope="all") == far
    assert_refused(
        (lambda: evaluation_samples(da_motion, every_scenario, horizon=3.0), ConfigError, "protocol='paper'"),
    )


def test_training_samples_are_those_of_the_purpose_to_train(da_motion: DeepAccident, every_scenario: Path) -> None:
    tokens = samples(da_motion, every_scenario, "train")
    assert tokens
    assert training_samples(da_motion, every_scenario) == da_motion.training_samples(every_scenario) == tokens


def test_a_split_that_was_not_unpacked_says_so(da_motion: DeepAccident) -> None:
    here = {record["split"] for record in da_motion.scenario}
    [absent] = {"train", "val"} - here
    with pytest.raises(
        NotAvailableError, match=rf"{absent}: no scenario of this split is in .*; unpack that part.*"
    ) as told:
        training_samples(da_motion, absent)
    assert str(told.value).endswith(f"or choose another split: it has {here.pop()}: 2 scenarios")


@pytest.mark.parametrize("horizon", ["2", None, [2.0]])
def test_a_horizon_is_a_number(da_motion: DeepAccident, horizon: object) -> None:
    with pytest.raises(ConfigError, match="horizon: expected a number of seconds"):
        samples(da_motion, "train", "evaluate", "paper", horizon=horizon)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ({"purpose": "testing"}, "purpose: expected one of train, evaluate, all, every"),
        ({"protocol": "boxes"}, "protocol: expected one of released, paper"),
        ({"protocol": "paper", "scope": "some"}, "scope: expected one of accident, all"),
    ],
)
def test_unknown_choices_name_those_there_are(da_motion: DeepAccident, arguments: dict[str, str], told: str) -> None:
    with pytest.raises(ChoiceError, match=re.escape(told)):
        samples(da_motion, "train", **{"purpose": "train", **arguments})  # type: ignore[arg-type]


@pytest.mark.parametrize("horizon", [0.0, 0.4999, 0.7, -1.0, float("nan"), float("inf")])
def test_a_horizon_is_a_number_of_half_seconds(da_motion: DeepAccident, horizon: float) -> None:
    assert_refused(
        (
            lambda: samples(da_motion, "train", "evaluate", "paper", horizon=horizon),
            ConfigError,
            r"choose 0\.5, 1, 1\.5",
        ),
    )


def test_the_released_protocol_has_one_horizon(da_motion: DeepAccident) -> None:
    assert_refused(
        (lambda: samples(da_motion, "train", "evaluate", horizon=3.0), ConfigError, "protocol='paper'"),
    )


def test_a_split_without_labels_says_so(own_release: Path) -> None:
    for folder in own_release.glob("**/label"):
        for path in folder.rglob("*.txt"):
            path.unlink()
    unlabelled = DeepAccident("v1", own_release, verbose=False)
    split = own_release / "mine.txt"
    split.write_text(unlabelled.scenario[0]["token"].replace("/", " ") + "\n")
    assert_refused(
        (lambda: samples(unlabelled, split, "train"), NotAvailableError, "none of its samples here has labels"),
    )


def test_a_list_without_samples_says_what_to_do(tmp_path: Path) -> None:
    split = tmp_path / "one.txt"
    for kind, told in (
        ("normal", "leaves out all 1 of its scenarios, .* use scope='all'"),
        ("accident", "^choose others"),
    ):
        scenario_type = f"type1_subtype1_{kind}"
        root = tiny.write_tiny_release(tmp_path / kind, frames=1, scenario_type=scenario_type, agents=("ego_vehicle",))
        release = DeepAccident(dataroot=root, verbose=False, workers=1)
        split.write_text(f"{scenario_type} {tiny.NAME}\n")
        assert re.search(told, no_samples_text(release, split, "accident"))
        assert no_samples_text(release, split, "all") == "choose others"
