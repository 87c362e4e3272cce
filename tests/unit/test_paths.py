"""What callers pass as paths; the devkit's own errors refuse what is not a path."""

from pathlib import Path
from typing import Any

import pytest
from support.expected_errors import assert_raises

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ConfigError, DatarootError, DeepAccidentError
from deepaccident_devkit.evaluation.results import ResultsWriter, read_results
from deepaccident_devkit.evaluation.runs import read_bundle
from deepaccident_devkit.motion import write_label_files
from deepaccident_devkit.plugins.synth import make_release
from deepaccident_devkit.support.files import writable_folder
from deepaccident_devkit.support.text import path_of
from deepaccident_devkit.validation import validate_release


class PathOfAnything:
    """A path object that returns any object as its path."""

    def __init__(self, path: object) -> None:
        self._path = path

    def __fspath__(self) -> object:
        return self._path


@pytest.mark.parametrize(
    "path",
    [
        None,
        b"/data",
        3,
        3.5,
        True,
        [],
        "",
        "a\0b",
        "\ud800",
        "~nobody-of-this-name/x",
        Path("a\0b"),
        PathOfAnything(b"a"),
    ],
)
def test_what_is_no_path_is_refused(path: Any, da: DeepAccident) -> None:
    assert_raises(
        (lambda: path_of(path), ConfigError, r"^expected a path, found "),
        (
            lambda: DeepAccident("v1", path, verbose=False),
            DatarootError,
            r"^dataroot: expected a path or a URL, found ",
        ),
    )
    index_dir = "" if path is None else path
    for call in (
        lambda: DeepAccident("v1", da.dataroot, index_dir=index_dir, verbose=False),
        lambda: read_results(path),
        lambda: ResultsWriter(path, "detection"),
        lambda: read_bundle(path),
        lambda: validate_release(path, workers=1),
        lambda: make_release(path),
        lambda: writable_folder(path),
        lambda: write_label_files(da, path, []),
        lambda: da.split_scenarios(path),
        lambda: da.render_replay(None, path),
    ):
        with pytest.raises(DeepAccidentError, match=r"expected|found"):
            call()


def test_paths_are_texts_and_path_objects() -> None:
    assert path_of("~/a\nb") == Path.home() / "a\nb"
    assert path_of(Path("a")) == path_of(PathOfAnything("a")) == Path("a")
