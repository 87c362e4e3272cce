"""The pytest plugin `deepaccident`: fixtures that give small releases, healthy and broken, as folders.

It adds no options, hooks or marks, and imports the rest of the devkit only when a test uses a fixture. Turn it off with
`-p no:deepaccident`. Override a fixture in a `conftest.py`, and all others use your value.
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
"""Options of `SmallRelease` → the folder of such a release."""
BreakRelease = Callable[[str], "BrokenRelease"]
"""The name of a breakage → a release with this breakage."""


@pytest.fixture(scope="session", params=["A", "B"], ids=["layout_A", "layout_B"])
def deepaccident_layout(request: pytest.FixtureRequest) -> Layout:
    """Each of the two layouts in turn: a test that uses it, or a release, runs twice."""
    layout: Layout = request.param
    return layout


@pytest.fixture(scope="session")
def deepaccident_config(deepaccident_layout: Layout) -> SmallRelease:
    """The options of the releases of all other fixtures."""
    from deepaccident_devkit.testing.releases import SmallRelease

    return SmallRelease(layout=deepaccident_layout)


@pytest.fixture(scope="session")
def make_deepaccident_release(tmp_path_factory: pytest.TempPathFactory) -> MakeRelease:
    """A factory: options of `SmallRelease` → the folder of a healthy release; the same options give the same folder.

    `make(config, frames=2)` is like `config`, but with two frames. Tests must not change the files, as with
    `deepaccident_release`.
    """
    from deepaccident_devkit.testing.releases import SmallRelease, write_small_release

    made: dict[SmallRelease, Path] = {}

    def make(config: SmallRelease | None = None, **options: Any) -> Path:
        wanted = replace(config or SmallRelease(), **options)
        if wanted not in made:
            made[wanted] = write_small_release(
                tmp_path_factory.mktemp("deepaccident") / "release", wanted
            )
        return made[wanted]

    return make


@pytest.fixture(scope="session")
def deepaccident_release(
    deepaccident_config: SmallRelease, make_deepaccident_release: MakeRelease
) -> Path:
    """The folder of a healthy release, one for each session and layout; tests must not change it."""
    return make_deepaccident_release(deepaccident_config)


@pytest.fixture
def deepaccident_release_copy(
    deepaccident_release: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """A copy of `deepaccident_release`, without an index, that the test may change."""
    return _copied(deepaccident_release, tmp_path_factory.mktemp("deepaccident") / "copy")


@pytest.fixture
def deepaccident_broken(
    deepaccident_release: Path, tmp_path_factory: pytest.TempPathFactory
) -> BreakRelease:
    """A factory: a name of `BREAKAGES` → a copy of `deepaccident_release` with this breakage."""
    from deepaccident_devkit.testing.breakages import break_release, checked_breakage

    def broken(name: str) -> BrokenRelease:
        checked_breakage(name)
        return break_release(
            _copied(deepaccident_release, tmp_path_factory.mktemp("deepaccident") / "broken"), name
        )

    return broken


def _copied(release: Path, root: Path) -> Path:
    return shutil.copytree(release, root, ignore=shutil.ignore_patterns(".deepaccident"))
