"""The strategies draw what the readers accept."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, find, given, settings

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.release import read_label
from deepaccident_devkit.taxonomy import OWN_ACTOR_ID
from deepaccident_devkit.testing import SmallRelease, write_small_release
from deepaccident_devkit.testing.strategies import label_texts, small_releases

WITHOUT_SHRINKING = settings(phases=[Phase.generate])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("strategies")


@given(label_texts())
def test_a_label_is_read_with_all_its_boxes_and_nothing_else(folder: Path, text: str) -> None:
    (folder / "label.txt").write_text(text, encoding="ascii", newline="")
    labels = read_label(folder / "label.txt")
    assert len(labels) == sum(len(line.split()) == 13 for line in text.splitlines())
    assert labels.actor_id[0] == OWN_ACTOR_ID
    np.testing.assert_array_equal(labels.velocity[0], labels.agent_velocity[0])


@pytest.mark.parametrize("part", ["\r\n", "\ncar\n"])
def test_labels_with_windows_lines_and_with_short_ones_are_drawn(part: str) -> None:
    assert part in find(label_texts(), lambda text: part in text, settings=WITHOUT_SHRINKING)


@given(small_releases())
@settings(max_examples=4, suppress_health_check=[HealthCheck.too_slow])
def test_a_small_release_can_be_written_and_opened(
    tmp_path_factory: pytest.TempPathFactory, config: SmallRelease
) -> None:
    root = write_small_release(tmp_path_factory.mktemp("small") / "release", config)
    da = DeepAccident("v1", root, workers=1, verbose=False)
    assert {agent["name"] for agent in da.agent} == set(config.agents)
    assert {scenario["num_frames"] for scenario in da.scenario} == {config.frames}


def test_without_hypothesis_they_say_what_to_install() -> None:
    code = (
        "import sys; sys.modules['hypothesis'] = None; import "
        "deepaccident_devkit.testing.strategies"
    )
    process = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )
    message = "MissingExtraError: the strategies need hypothesis; run pip install '.[testing]'"
    assert message in process.stderr
