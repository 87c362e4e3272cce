"""What callers give as paths: what is none is refused by the devkit's own errors."""

from pathlib import Path
from typing import Any

import pytest
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ConfigError, DatarootError, DeepAccidentError
from deepaccident_devkit.evaluation.results import ResultsWriter, read_results
from deepaccident_devkit.evaluation.runs import read_bundle
from deepaccident_devkit.motion import write_label_files
from deepaccident_devkit.plugins.synth import make_release
from deepaccident_devkit.support.files import writable_folder
from deepaccident_devkit.support.text import path_of
from deepaccident_devkit.validation import validate_release


class Named:
    """A path object of anything."""

    def __init__(self, path: object) -> None:
        self._path = path

    def __fspath__(self) -> object:
        return self._path


@pytest.mark.parametrize(
    "given",
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
        Named(b"a"),
    ],
)
def test_what_is_no_path_is_refused(given: Any, da: DeepAccident) -> None:
    assert_refused(
        (lambda: path_of(given), ConfigError, r"^expected a path, found "),
        (
            lambda: DeepAccident("v1", given, verbose=False),
            DatarootError,
            r"^dataroot: expected a path or a URL, found ",
        ),
    )
    for refused in (
        lambda: DeepAccident(
            "v1", da.dataroot, index_dir=given if given is not None else "", verbose=False
        ),
        lambda: read_results(given),
        lambda: ResultsWriter(given, "detection"),
        lambda: read_bundle(given),
        lambda: validate_release(given, workers=1),
        lambda: make_release(given),
        lambda: writable_folder(given),
        lambda: write_label_files(da, given, []),
        lambda: da.split_scenarios(given),
        lambda: da.render_replay(None, given),
    ):
        with pytest.raises(DeepAccidentError, match=r"expected|found"):
            refused()


def test_paths_are_texts_and_path_objects() -> None:
    assert path_of("~/a\nb") == Path.home() / "a\nb"
    assert path_of(Path("a")) == path_of(Named("a")) == Path("a")
