"""The pytest plugin `deepaccident`: fixtures with folders of small releases, healthy and broken.

It adds no options, hooks or markers, and only imports the rest of the devkit when a test uses a
fixture. Turn it off with `-p no:deepaccident`. If you override a fixture in a `conftest.py`, all
other fixtures use your value.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from deepaccident_devkit.taxonomy import Layout
    from deepaccident_devkit.testing.breakages import BrokenRelease
    from deepaccident_devkit.testing.releases import SmallRelease

MakeRelease = Callable[..., Path]
"""Takes options of `SmallRelease`; returns the folder of such a release."""
BreakRelease = Callable[[str], "BrokenRelease"]
"""Takes the name of a breakage; returns a release with this breakage."""


@pytest.fixture(scope="session", params=["A", "B"], ids=["layout_A", "layout_B"])
def deepaccident_layout(request: pytest.FixtureRequest) -> Layout:
    """Return each of the two layouts in turn, so that tests that use a release run twice."""
    layout: Layout = request.param
    return layout


@pytest.fixture(scope="session")
def deepaccident_config(deepaccident_layout: Layout) -> SmallRelease:
    """Return the options of the releases in all other fixtures."""
    from deepaccident_devkit.testing.releases import SmallRelease

    return SmallRelease(layout=deepaccident_layout)


@pytest.fixture(scope="session")
def make_deepaccident_release(tmp_path_factory: pytest.TempPathFactory) -> MakeRelease:
    """Return a factory that takes options of `SmallRelease` and returns a healthy release's folder.

    Equal options return the same folder. `make(config, frames=2)` is like `config`, but with two
    frames. Tests must not change the files, as for `deepaccident_release`.
    """
    from deepaccident_devkit.testing.releases import SmallRelease, write_small_release

    releases: dict[SmallRelease, Path] = {}

    def make(config: SmallRelease | None = None, **options: Any) -> Path:
        full_config = replace(config or SmallRelease(), **options)
        if full_config not in releases:
            path = tmp_path_factory.mktemp("deepaccident") / "release"
            releases[full_config] = write_small_release(path, full_config)
        return releases[full_config]

    return make


@pytest.fixture(scope="session")
def deepaccident_release(
    deepaccident_config: SmallRelease, make_deepaccident_release: MakeRelease
) -> Path:
    """Return the folder of a healthy release, which tests must not change.

    It is made once per session and layout.
    """
    return make_deepaccident_release(deepaccident_config)


@pytest.fixture
def deepaccident_release_copy(
    deepaccident_release: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """Return a copy of `deepaccident_release`, without an index, which the test may change."""
    return _copy_release(deepaccident_release, tmp_path_factory.mktemp("deepaccident") / "copy")


@pytest.fixture
def deepaccident_broken(
    deepaccident_release: Path, tmp_path_factory: pytest.TempPathFactory
) -> BreakRelease:
    """Return a factory that takes a name in `BREAKAGES` and returns a broken copy."""
    from deepaccident_devkit.testing.breakages import break_release, checked_breakage

    def break_copy(name: str) -> BrokenRelease:
        checked_breakage(name)
        path = tmp_path_factory.mktemp("deepaccident") / "broken"
        return break_release(_copy_release(deepaccident_release, path), name)

    return break_copy


def _copy_release(release: Path, root: Path) -> Path:
    return shutil.copytree(release, root, ignore=shutil.ignore_patterns(".deepaccident"))
