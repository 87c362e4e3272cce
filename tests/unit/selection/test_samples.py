"""Lists of samples: those that models are trained on, and those that they are evaluated at."""

import re
import shutil
from functools import partial
from pathlib import Path

import pytest
import tiny
from refusals import assert_refused
from written_out import written_out

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, ConfigError, NotAvailableError
from deepaccident_devkit.selection.samples import (
    evaluation_samples,
    no_samples_text,
    samples,
    training_samples,
)
from deepaccident_devkit.taxonomy import AGENTS


def _frames(tokens: list[str], scenario: str, agent: str) -> list[int]:
    return [int(one.rsplit("/", 1)[1]) for one in tokens if one.startswith(f"{scenario}/{agent}/")]


@pytest.fixture
def every_scenario(da_motion: DeepAccident, tmp_path: Path) -> Path:
    split = tmp_path / "mine.txt"
    split.write_text(
        "".join(f"{record['token'].replace('/', ' ')}\n" for record in da_motion.scenario)
    )
    return split


def test_training_takes_a_sample_a_second_counted_from_the_end(
    da_motion: DeepAccident, every_scenario: Path
) -> None:
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


def test_the_paper_leaves_horizon_and_scope_open(
    da_motion: DeepAccident, every_scenario: Path
) -> None:
    tokens = samples(da_motion, every_scenario, "evaluate", "paper", horizon=3.0, scope="all")
    for scenario in da_motion.scenario:
        assert _frames(tokens, scenario["token"], "infrastructure") == [5, 10, 15, 20, 25, 30]
    assert len(samples(da_motion, every_scenario, "all")) == 2 * 5 * 7
    assert samples(da_motion, every_scenario, "Keyframes") == samples(
        da_motion, every_scenario, "all"
    )
    assert samples(da_motion, "all", "all") == samples(da_motion, every_scenario, "all")
    assert samples(da_motion, every_scenario, "every") == [
        sample["token"] for sample in da_motion.sample
    ]
    assert {
        token[-3:]
        for token in samples(
            da_motion, every_scenario, "evaluate", "paper", horizon=0.5, scope="all"
        )
    } == {"030"}


def test_a_split_belongs_to_its_scenarios_alone(da_motion: DeepAccident, tmp_path: Path) -> None:
    one = da_motion.scenario[1]["token"]
    (tmp_path / "one.txt").write_text(one.replace("/", " ") + "\n")
    assert {
        token.rsplit("/", 2)[0] for token in samples(da_motion, tmp_path / "one.txt", "all")
    } == {one}


def test_evaluation_samples_are_those_of_the_purpose_to_evaluate(
    da_motion: DeepAccident, every_scenario: Path
) -> None:
    tokens = samples(da_motion, every_scenario, "evaluate")
    assert tokens
    assert evaluation_samples(da_motion, every_scenario) == tokens
    assert da_motion.evaluation_samples(every_scenario, "released") == tokens
    far = samples(da_motion, every_scenario, "evaluate", "paper", horizon=3.0, scope="all")
    assert da_motion.evaluation_samples(every_scenario, "paper", horizon=3.0, scope="all") == far
    assert_refused(
        (
            lambda: evaluation_samples(da_motion, every_scenario, horizon=3.0),
            ConfigError,
            "protocol='paper'",
        ),
    )


def test_a_split_that_was_not_unpacked_says_so(da_motion: DeepAccident) -> None:
    here = {record["split"] for record in da_motion.scenario}
    [absent] = {"train", "val"} - here
    named = (f"{absent}: no scenario", "unpack", f"{here.pop()}: 2 scenarios")
    assert_refused((lambda: training_samples(da_motion, absent), NotAvailableError, named))


def test_samples_of_a_partial_release_can_be_those_that_have_their_files(
    da: DeepAccident, da_partial: DeepAccident
) -> None:
    """The pole has no LiDAR there, and the ego no front camera."""
    whole = da.samples("train", "every")
    assert da.samples("train", "every", sensors=("Camera_Front", "lidar01")) == whole
    for sensors in ("lidar01", ["Camera_Front"], ("lidar01", "camera_front")):
        channels = [sensors] if isinstance(sensors, str) else sensors
        there = [
            token
            for token in da_partial.samples("train", "every")
            if all(da_partial.sensor_path(token, channel).is_file() for channel in channels)
        ]
        assert da_partial.samples("train", "every", sensors=sensors) == there != whole
    assert da_partial.training_samples("train", sensors="lidar01") == [
        token
        for token in da_partial.training_samples("train")
        if da_partial.sensor_path(token, "lidar01").is_file()
    ]


def test_choices_and_horizons_that_there_are_not(da_motion: DeepAccident) -> None:
    """Horizons are numbers of half seconds, and the released protocol has one."""
    evaluate = partial(samples, da_motion, "train", "evaluate")
    assert_refused(
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
    unlabelled, split = DeepAccident("v1", own_release, verbose=False), own_release / "mine.txt"
    split.write_text(unlabelled.scenario[0]["token"].replace("/", " ") + "\n")
    assert_refused(
        (
            lambda: samples(unlabelled, split, "train"),
            NotAvailableError,
            "none of its samples here has labels",
        ),
    )


def test_every_default_written_out() -> None:
    defaults = written_out("deepaccident_devkit.selection.samples")
    assert defaults == {
        "samples.samples": "protocol='released', horizon=2.0, scope='accident', sensors=()",
        "samples.training_samples": "sensors=()",
        "samples.evaluation_samples": "protocol='released', horizon=2.0, scope='accident'",
    }


def test_a_list_without_samples_says_what_to_do(tmp_path: Path) -> None:
    split = tmp_path / "one.txt"
    for kind, told in (
        ("normal", "leaves out all 1 of its scenarios, .* use scope='all'"),
        ("accident", "^choose others"),
    ):
        scenario_type = f"type1_subtype1_{kind}"
        root = tiny.write_tiny_release(
            tmp_path / kind, frames=1, scenario_type=scenario_type, agents=("ego_vehicle",)
        )
        release = DeepAccident(dataroot=root, verbose=False, workers=1)
        split.write_text(f"{scenario_type} {tiny.NAME}\n")
        assert re.search(told, no_samples_text(release, split, "accident"))
        assert no_samples_text(release, split, "all") == "choose others"
