"""Check what all readers of a release's files have in common."""

from collections.abc import Callable
from pathlib import Path

import pytest
from support.expected_errors import assert_raises

from deepaccident_devkit import release
from deepaccident_devkit.errors import MissingFileError, ReleaseError

READERS = {name: getattr(release, name) for name in release.__all__ if name.startswith("read_")}
SINGLE = {
    **READERS,
    "read_calibs": lambda path: release.read_calibs([path]),
    "read_labels": lambda path: release.read_labels([path]),
}


@pytest.mark.parametrize("read", SINGLE.values(), ids=SINGLE)
def test_a_missing_file_is_ours_and_pythons_own_error(tmp_path: Path, read: Callable) -> None:
    path = tmp_path / "gone"
    message = f"^{path}: no such file"
    assert_raises(
        (lambda: read(path), MissingFileError, message),
        (lambda: read(path), FileNotFoundError, message),
    )


@pytest.mark.parametrize("read", SINGLE.values(), ids=SINGLE)
def test_a_folder_in_place_of_the_file_is_our_error(tmp_path: Path, read: Callable) -> None:
    """The error is the same as for any file that exists but cannot be read."""
    assert_raises(
        (lambda: read(tmp_path), ReleaseError, f"^{tmp_path}"),
    )
