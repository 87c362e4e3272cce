"""What all readers of a release's files have in common."""

from collections.abc import Callable
from pathlib import Path

import pytest
from refusals import assert_refused

from deepaccident_devkit import release
from deepaccident_devkit.errors import MissingFileError, ReleaseError

READERS = {name: getattr(release, name) for name in release.__all__ if name.startswith("read_")}
SINGLE = {
    name: reader
    if name not in ("read_calibs", "read_labels")
    else lambda path, reader=reader: reader([path])
    for name, reader in READERS.items()
}


@pytest.mark.parametrize("read", SINGLE.values(), ids=SINGLE)
def test_a_missing_file_is_ours_and_pythons_own_error(tmp_path: Path, read: Callable) -> None:
    gone = tmp_path / "gone"
    assert_refused(
        *(
            (lambda: read(gone), kind, f"^{gone}: no such file")
            for kind in (MissingFileError, FileNotFoundError)
        )
    )


@pytest.mark.parametrize("read", SINGLE.values(), ids=SINGLE)
def test_a_folder_in_the_files_place_is_our_error(tmp_path: Path, read: Callable) -> None:
    """As any file that is there and cannot be read."""
    assert_refused((lambda: read(tmp_path), ReleaseError, f"^{tmp_path}"))
