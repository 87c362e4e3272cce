"""A source with wrong axes, ground or cameras is refused before training, and the error names the
mistake.
"""

from pathlib import Path

import pytest
from click.testing import CliRunner
from support.nuscenes_mistakes import MISTAKES, copy_dataroot

from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.errors import SourceError
from deepaccident_devkit.plugins.nuscenes import open_nuscenes
from deepaccident_devkit.plugins.nuscenes.check import check_source, look_at


def test_a_good_source_passes(pair) -> None:
    unchecked = check_source(pair.road).unchecked()
    assert all(sentence.startswith("whether the images") for sentence in unchecked)


def test_the_release_passes_too(pair) -> None:
    assert list(look_at(pair.release).faults()) == []


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_named(pair, tmp_path: Path, name: str) -> None:
    plant_mistake, message = MISTAKES[name]
    folder = copy_dataroot(pair.folder, tmp_path / "wrong")
    plant_mistake(folder)
    with pytest.raises(SourceError, match=message):
        check_source(open_nuscenes(folder))


def test_training_begins_with_the_check(pair, tmp_path: Path) -> None:
    folder = copy_dataroot(pair.folder, tmp_path / "wrong")
    plant_mistake, _ = MISTAKES["mirrored"]
    plant_mistake(folder)
    run = tmp_path / "run"
    options = ["--preset", "tiny", "--steps", "1", "--validation", "none", "--out", str(run)]
    for sources in (
        [str(folder), "--agents", "single"],
        [str(pair.release.dataroot), "--also", str(folder)],
    ):
        result = CliRunner().invoke(deepaccident, ["train", *sources, *options])
        assert isinstance(result.exception, SourceError)
        assert "y is mirrored" in str(result.exception)
        assert not run.exists()
