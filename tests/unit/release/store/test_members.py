"""Check the lists of stores' files: each file is found at its place."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from deepaccident_devkit.release.store.members import (
    Listing,
    Member,
    Members,
    release_folder,
    write_members,
)

_PARTS = st.text(
    st.characters(exclude_characters="/", exclude_categories=["Cs"]), min_size=1, max_size=9
)
_FRAMES = st.integers(0, 1200).map(lambda number: f"name_{number:03d}.jpg")
_PATHS = st.tuples(st.lists(_PARTS, max_size=3).map("/".join), st.one_of(_FRAMES, _PARTS))


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    files=st.dictionaries(_PATHS, st.integers(0, 1 << 40), max_size=40), archives=st.integers(1, 3)
)
def test_every_file_is_found_and_no_other(
    tmp_path: Path, files: dict[tuple[str, str], int], archives: int
) -> None:
    listings = []
    expected = {}
    for number in range(archives):
        in_archive = [(*path, size) for path, size in files.items() if size % archives == number]
        folders = sorted({folder for folder, _, _ in in_archive})
        sizes = np.array([size for _, _, size in in_archive], np.int64)
        numbers = {
            "offset": sizes * 2,
            "stored": sizes,
            "size": sizes,
            "version": sizes % 7,
            "deflated": sizes % 2,
        }
        listings.append(
            Listing(
                archive=f"{number}.zip",
                folders=folders,
                folder=np.array([folders.index(folder) for folder, _, _ in in_archive], int),
                names=[name for _, name, _ in in_archive],
                numbers=numbers,
            )
        )
        for folder, name, size in in_archive:
            path = f"{folder}/{name}" if folder else name
            expected[path] = Member(number, 2 * size, size, size, size % 7, size % 2)

    write_members(tmp_path / "list.arrow", listings, {"0.zip": (3, "x")})
    members = Members(tmp_path / "list.arrow")

    assert {path: members.find(path) for path in expected} == expected
    assert len(members) == len(files)
    assert members.states == {"0.zip": (3, "x")}
    for folder, name in files:
        longer_path = f"{folder}/{name}x"
        assert members.find(longer_path) in (None, expected.get(longer_path))
        assert members.has_folder(folder)
        assert name in dict(members.files_in(folder))
        if folder:
            parent, _, last_folder = folder.rpartition("/")
            assert last_folder in members.folders_in(parent)


KIND = "type1_subtype2_normal"


@pytest.mark.parametrize(
    ("folders", "expected"),
    [
        (("a", KIND, "meta"), f"{KIND}/meta"),
        (("train", KIND, "meta"), f"train/{KIND}/meta"),
        (("x", "val", "train", "y", KIND), f"train/{KIND}"),
        ((KIND, KIND, "meta"), f"{KIND}/meta"),
        (("DeepAccident_mini", KIND), f"DeepAccident_mini/{KIND}"),
        (("split_txt_files",), ""),
        ((KIND, "..", "meta"), None),
        ((".deepaccident", KIND), None),
    ],
)
def test_folders_of_a_release_by_what_leads_to_them(
    folders: tuple[str, ...], expected: str | None
) -> None:
    assert release_folder(folders) == expected
