"""Fixtures that all tests share: one synthetic release a session, made and indexed once."""

import fcntl
import gc
import importlib
import os
import shutil
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import matplotlib as mpl
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis.strategies import none
from scripts import loaded_script

from deepaccident_devkit import DeepAccident

mpl.use("Agg")
settings.register_profile("repeatable", deadline=None, derandomize=True, max_examples=50)
settings.load_profile("repeatable")

DATA = Path(__file__).parent / "data"
MADE = os.environ.get("DEEPACCIDENT_TEST_RELEASES")
"""The folder of the session's releases, if another session has made them (tests/test_plugins.py).
"""


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--golden",
        type=Path,
        default=DATA / "golden",
        help="folder with inputs and outputs of the released code, for tests/parity",
    )
    parser.addoption(
        "--real",
        type=Path,
        default=os.environ.get("DEEPACCIDENT_REAL") or None,
        help="folder with a real scenario, for tests/real, which are skipped "
        "without [DEEPACCIDENT_REAL]",
    )
    parser.addoption(
        "--pin",
        action="store_true",
        help="write tests/data/pinned.json anew (tests/test_pinned.py)",
    )


def pytest_configure(config: pytest.Config) -> None:
    """A checkout that is on the path, but not installed, has no entry point for the test kit's
    plugin.

    Where a worker crashes, pytest-xdist (3.8) restarts it, and with tests by file then waits for
    ever: the run ends.
    """
    if getattr(config.option, "maxworkerrestart", "") is None:
        config.option.maxworkerrestart = "0"
    manager = config.pluginmanager
    if not manager.has_plugin("deepaccident") and not manager.is_blocked("deepaccident"):
        manager.register(
            importlib.import_module("deepaccident_devkit.testing.plugin"), "deepaccident"
        )


def pytest_collection_finish() -> None:
    """What the collection made stays until the end: the garbage collector need not look at it again
    and again.

    Hypothesis asks the collector once who holds its generator of numbers, and is not told of what
    is frozen.
    """
    given(nothing=none())(lambda nothing: nothing)()
    gc.collect()
    gc.freeze()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Tests of a file run in one process, so that what they share is made once."""
    from xdist.scheduler import LoadFileScheduling

    return LoadFileScheduling(config, log)


def made(name: str, factory: pytest.TempPathFactory, **config: Any) -> Path:
    """A synthetic release of this name with clean accidents, made now unless another session or
    process has.
    """
    if MADE is not None:
        return Path(MADE) / name
    from deepaccident_devkit.plugins.synth import SynthConfig, make_release

    folder = factory.getbasetemp()
    root = (folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder) / "synthetic" / name
    root.parent.mkdir(exist_ok=True)
    with root.with_name(f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        return (
            root
            if root.exists()
            else make_release(root, SynthConfig(designed=True, **config), workers=1)
        )


@pytest.fixture(scope="session")
def release_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A synthetic release in layout A with all sensors; read-only by agreement. The path has a
    blank in it.

    In its accidents ego and other collide, as designed. Its labels count the very points of its
    clouds.
    """
    size = {"scenarios": 4, "frames": 6, "image_size": (64, 36)}
    return made(
        "deep accident", tmp_path_factory, **size, layout="A", seed=3, unplanned=0, exact=True
    )


@pytest.fixture(scope="session")
def made_demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The folder of a demo with few frames and small images, and what `deepaccident demo`
    printed.
    """
    out = tmp_path_factory.mktemp("demo") / "of a reader"
    demo = importlib.import_module("deepaccident_devkit.plugins.synth.demo")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(demo, "RELEASE", replace(demo.RELEASE, frames=12, image_size=(64, 36)))
        result = CliRunner().invoke(demo.demo, [str(out)], catch_exceptions=False)
    assert result.exit_code == 0
    return out, result.output


@pytest.fixture(scope="session")
def release_root_b(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A synthetic release in layout B, labels only; read-only by agreement."""
    return made(
        "layout_b", tmp_path_factory, scenarios=6, frames=4, layout="B", seed=4, sensors=False
    )


@pytest.fixture(scope="session")
def da(release_root: Path) -> DeepAccident:
    """The release of `release_root`, opened."""
    return DeepAccident("v1", release_root, verbose=False)


@pytest.fixture(scope="session")
def da_partial(release_root: Path, tmp_path_factory: pytest.TempPathFactory) -> DeepAccident:
    """`da` as a partial download: no front camera of the ego, no LiDAR of the pole, no
    other_vehicle_behind.
    """
    root = tmp_path_factory.mktemp("synthetic") / "partial"
    shutil.copytree(
        release_root, root, ignore=shutil.ignore_patterns(".deepaccident", "other_vehicle_behind")
    )
    for folder in (
        *root.glob("*/ego_vehicle/Camera_Front"),
        *root.glob("*/infrastructure/lidar01"),
    ):
        shutil.rmtree(folder)
    return DeepAccident("v1", root, verbose=False)


@pytest.fixture(scope="session")
def da_b(release_root_b: Path) -> DeepAccident:
    """The release of `release_root_b`, opened."""
    return DeepAccident("v1", release_root_b, verbose=False)


@pytest.fixture(scope="session")
def motion_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An accident of ego and other and its normal twin of 3.5 s, labels only: with pasts, futures
    and ends.
    """
    return made(
        "motion", tmp_path_factory, scenarios=2, frames=35, seed=5, sensors=False, unplanned=0
    )


@pytest.fixture(scope="session")
def da_motion(motion_root: Path) -> DeepAccident:
    """The release of `motion_root`, opened."""
    return DeepAccident("v1", motion_root, verbose=False)


@pytest.fixture(params=["A", "B"])
def both_layouts(request: pytest.FixtureRequest) -> DeepAccident:
    """Each of the two releases in turn."""
    opened: DeepAccident = request.getfixturevalue("da" if request.param == "A" else "da_b")
    return opened


@pytest.fixture(scope="session")
def schema_generator() -> ModuleType:
    """The script schema/generate.py, whose functions give the files as they should be."""
    return loaded_script("schema/generate.py")


@pytest.fixture
def own_release(release_root_b: Path, tmp_path: Path) -> Path:
    """A copy of the labels-only release that a test may break; without an index."""
    root = tmp_path / "release"
    shutil.copytree(release_root_b, root, ignore=shutil.ignore_patterns(".deepaccident"))
    return root


@pytest.fixture(autouse=True)
def _figures_closed() -> None:
    from matplotlib import pyplot as plt

    plt.close("all")
