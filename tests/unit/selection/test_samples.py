"""The lists of samples that models are trained and evaluated on."""

import re
import shutil
from functools import partial
from pathlib import Path

import pytest
from support import tiny_release
from support.default_values import package_values
from support.expected_errors import assert_raises

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, ConfigError, NotAvailableError
from deepaccident_devkit.selection.samples import (
    evaluation_samples,
    no_samples_text,
    samples,
    training_samples,
)
from deepaccident_devkit.taxonomy import AGENTS


def select_frames(tokens: list[str], scenario_token: str, agent: str) -> list[int]:
    agent_tokens = [token for token in tokens if token.startswith(f"{scenario_token}/{agent}/")]
    return [int(token.rsplit("/", 1)[1]) for token in agent_tokens]


@pytest.fixture
def every_scenario(da_motion: DeepAccident, tmp_path: Path) -> Path:
    split_file = tmp_path / "mine.txt"
    lines = [record["token"].replace("/", " ") for record in da_motion.scenario]
    split_file.write_text("\n".join(lines))
    return split_file


def test_training_takes_a_sample_a_second_counted_from_the_end(
    da_motion: DeepAccident, every_scenario: Path
) -> None:
    tokens = samples(da_motion, every_scenario, "train")
    for scenario in da_motion.scenario:
        for agent in AGENTS:
            assert select_frames(tokens, scenario["token"], agent) == [5, 15, 25, 35]


def test_evaluation_takes_the_last_two_seconds_of_accidents_but_the_end(
    da_motion: DeepAccident, every_scenario: Path
) -> None:
    tokens = samples(da_motion, every_scenario, "evaluate")
    for scenario in da_motion.scenario:
        expected = [15, 20, 25, 30] if scenario["designed_accident"] else []
        for agent in AGENTS:
            assert select_frames(tokens, scenario["token"], agent) == expected


def test_the_paper_leaves_horizon_and_scope_open(
    da_motion: DeepAccident, every_scenario: Path
) -> None:
    tokens = samples(da_motion, every_scenario, "evaluate", "paper", horizon=3.0, scope="all")
    for scenario in da_motion.scenario:
        assert select_frames(tokens, scenario["token"], "infrastructure") == [5, 10, 15, 20, 25, 30]

    tokens = samples(da_motion, every_scenario, "evaluate", "paper", horizon=0.5, scope="all")
    assert {token[-3:] for token in tokens} == {"030"}

    tokens = samples(da_motion, every_scenario, "all")
    assert len(tokens) == 2 * 5 * 7
    assert samples(da_motion, every_scenario, "Keyframes") == tokens
    assert samples(da_motion, "all", "all") == tokens
    every_token = [sample["token"] for sample in da_motion.sample]
    assert samples(da_motion, every_scenario, "every") == every_token


def test_a_split_has_only_samples_of_its_scenarios(da_motion: DeepAccident, tmp_path: Path) -> None:
    scenario_token = da_motion.scenario[1]["token"]
    split_file = tmp_path / "one.txt"
    split_file.write_text(scenario_token.replace("/", " ") + "\n")
    tokens = samples(da_motion, split_file, "all")
    assert {token.rsplit("/", 2)[0] for token in tokens} == {scenario_token}


def test_evaluation_samples_are_those_of_the_purpose_to_evaluate(
    da_motion: DeepAccident, every_scenario: Path
) -> None:
    tokens = samples(da_motion, every_scenario, "evaluate")
    assert tokens
    assert evaluation_samples(da_motion, every_scenario) == tokens
    assert da_motion.evaluation_samples(every_scenario, "released") == tokens
    tokens = samples(da_motion, every_scenario, "evaluate", "paper", horizon=3.0, scope="all")
    assert da_motion.evaluation_samples(every_scenario, "paper", horizon=3.0, scope="all") == tokens
    assert_raises(
        (
            lambda: evaluation_samples(da_motion, every_scenario, horizon=3.0),
            ConfigError,
            "protocol='paper'",
        ),
    )


def test_a_split_that_was_not_unpacked_says_so(da_motion: DeepAccident) -> None:
    (split,) = {record["split"] for record in da_motion.scenario}
    absent_split = "val" if split == "train" else "train"
    message = (f"{absent_split}: no scenario", "unpack", f"{split}: 2 scenarios")
    assert_raises((lambda: training_samples(da_motion, absent_split), NotAvailableError, message))


def test_samples_of_a_partial_release_can_be_those_that_have_their_files(
    da: DeepAccident, da_partial: DeepAccident
) -> None:
    """In the partial release the infrastructure has no LiDAR, and the ego no front camera."""

    def keep_with_files(tokens: list[str], *channels: str) -> list[str]:
        for channel in channels:
            tokens = [token for token in tokens if da_partial.sensor_path(token, channel).is_file()]
        return tokens

    complete_tokens = da.samples("train", "every")
    assert da.samples("train", "every", sensors=("Camera_Front", "lidar01")) == complete_tokens
    for sensors in ("lidar01", ["Camera_Front"], ("lidar01", "camera_front")):
        channels = [sensors] if isinstance(sensors, str) else sensors
        expected = keep_with_files(da_partial.samples("train", "every"), *channels)
        tokens = da_partial.samples("train", "every", sensors=sensors)
        assert tokens == expected != complete_tokens
    expected = keep_with_files(da_partial.training_samples("train"), "lidar01")
    assert da_partial.training_samples("train", sensors="lidar01") == expected


def test_choices_and_horizons_that_there_are_not(da_motion: DeepAccident) -> None:
    """Horizons are multiples of half a second, and the released protocol has only one."""
    evaluate = partial(samples, da_motion, "train", "evaluate")
    assert_raises(
        (
            lambda: samples(da_motion, "train", "testing"),
            ChoiceError,
            ("purpose", "train, evaluate, all, keyframes, every"),
        ),
        (
            lambda: samples(da_motion, "train", "all", sensors=["lidar"]),
            ChoiceError,
            ("sensors: expected", "lidar01"),
        ),
        (
            lambda: samples(da_motion, "train", "all", sensors=["lidar01"]),
            NotAvailableError,
            ("none of the", "lidar01", "unpack"),
        ),
        (partial(evaluate, "boxes"), ChoiceError, ("protocol: expected one of released, paper",)),
        (
            partial(evaluate, "paper", scope="some"),
            ChoiceError,
            ("scope: expected one of accident, all",),
        ),
        (partial(evaluate, horizon=3.0), ConfigError, ("protocol='paper'",)),
        *[
            (
                partial(evaluate, "paper", horizon=horizon),
                ConfigError,
                ("horizon: expected a number of seconds",),
            )
            for horizon in ("2", None, [2.0])
        ],
        *[
            (partial(evaluate, "paper", horizon=horizon), ConfigError, ("choose 0.5, 1, 1.5",))
            for horizon in (0.0, 0.4999, 0.7, -1.0, float("nan"), float("inf"))
        ],
    )


def test_a_split_without_labels_says_so(own_release: Path) -> None:
    for folder in own_release.glob("**/label"):
        shutil.rmtree(folder)
    unlabelled = DeepAccident("v1", own_release, verbose=False)
    split_file = own_release / "mine.txt"
    split_file.write_text(unlabelled.scenario[0]["token"].replace("/", " ") + "\n")
    assert_raises(
        (
            lambda: samples(unlabelled, split_file, "train"),
            NotAvailableError,
            "no sample of this split has labels",
        ),
    )


def test_every_default_written_out() -> None:
    defaults = package_values("deepaccident_devkit.selection.samples")
    assert defaults == {
        "samples.samples": "protocol='released', horizon=2.0, scope='accident', sensors=()",
        "samples.training_samples": "sensors=()",
        "samples.evaluation_samples": "protocol='released', horizon=2.0, scope='accident'",
    }


def test_a_list_without_samples_says_what_to_do(tmp_path: Path) -> None:
    split_file = tmp_path / "one.txt"
    for kind, message in (
        ("normal", "excludes every scenario of this split, .* use scope='all'"),
        ("accident", "^choose other samples"),
    ):
        scenario_type = f"type1_subtype1_{kind}"
        root = tiny_release.write_tiny_release(
            tmp_path / kind, frames=1, scenario_type=scenario_type, agents=("ego_vehicle",)
        )
        release = DeepAccident(dataroot=root, verbose=False, workers=1)
        split_file.write_text(f"{scenario_type} {tiny_release.SCENARIO_NAME}\n")
        assert re.search(message, no_samples_text(release, split_file, "accident"))
        assert no_samples_text(release, split_file, "all") == "choose other samples"
