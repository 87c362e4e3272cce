"""A source whose axes, ground or cameras are wrong is refused, by the mistake's name, before
anything is trained.
"""

from pathlib import Path

import pytest
from click.testing import CliRunner
from nuscenes_mistakes import MISTAKES, copied

from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.errors import SourceError
from deepaccident_devkit.plugins.nuscenes import open_nuscenes
from deepaccident_devkit.plugins.nuscenes.check import check_source, look_at


def test_a_good_source_passes(pair) -> None:
    found = check_source(pair.road)
    assert [
        words for words in found.unchecked() if not words.startswith("whether the images")
    ] == []


def test_the_release_passes_too(pair) -> None:
    found = look_at(pair.release)
    assert list(found.faults()) == []


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_named(pair, tmp_path: Path, name: str) -> None:
    plant, words = MISTAKES[name]
    folder = copied(pair.folder, tmp_path / "wrong")
    plant(folder)
    with pytest.raises(SourceError, match=words):
        check_source(open_nuscenes(folder))


def test_training_begins_with_it(pair, tmp_path: Path) -> None:
    folder = copied(pair.folder, tmp_path / "wrong")
    MISTAKES["mirrored"][0](folder)
    run = tmp_path / "run"
    for first, others in (
        (folder, ["--agents", "single"]),
        (pair.release.dataroot, ["--also", str(folder)]),
    ):
        words = [
            "train",
            str(first),
            "--preset",
            "tiny",
            "--steps",
            "1",
            "--validation",
            "none",
            "--out",
            str(run),
        ]
        result = CliRunner().invoke(deepaccident, [*words, *others])
        assert isinstance(result.exception, SourceError)
        assert "y is mirrored" in str(result.exception)
        assert not run.exists()
