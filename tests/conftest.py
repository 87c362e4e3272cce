"""Fixtures that all tests share: synthetic releases that are made and indexed once a session."""

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
from support.repository_scripts import load_script

from deepaccident_devkit import DeepAccident

mpl.use("Agg")
settings.register_profile("repeatable", deadline=None, derandomize=True, max_examples=50)
# for further libraries, where each property holds already with others (.ci/steps/oldest.sh)
settings.register_profile("few", deadline=None, derandomize=True, max_examples=10)
settings.load_profile("repeatable")

DATA = Path(__file__).parent / "data"
EXISTING_RELEASES = os.environ.get("DEEPACCIDENT_TEST_RELEASES")
"""Folder with the session's releases, if another session has made them (tests/test_plugins.py)."""


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
    """Register the test kit's plugin, and end the run when a worker crashes.

    A checkout that is on the path, but not installed, has no entry point for the plugin. After a
    crash, pytest-xdist (3.8) would restart the worker and, with tests by file, wait for ever.
    """
    if getattr(config.option, "maxworkerrestart", "") is None:
        config.option.maxworkerrestart = "0"
    manager = config.pluginmanager
    if not manager.has_plugin("deepaccident") and not manager.is_blocked("deepaccident"):
        plugin = importlib.import_module("deepaccident_devkit.testing.plugin")
        manager.register(plugin, "deepaccident")


def pytest_collection_finish() -> None:
    """Freeze the collected objects, which live until the end, to save the garbage collector work.

    Hypothesis asks the collector once what refers to its random generator, and the collector does
    not report frozen objects: so an empty property test runs first.
    """
    given(nothing=none())(lambda nothing: nothing)()
    gc.collect()
    gc.freeze()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Run the tests of a file in one process, so that shared fixtures are made once."""
    from xdist.scheduler import LoadFileScheduling

    return LoadFileScheduling(config, log)


def prepare_release(name: str, factory: pytest.TempPathFactory, **config: Any) -> Path:
    """Return a synthetic release with clean accidents.

    It is made now unless another session or process has made it.
    """
    if EXISTING_RELEASES is not None:
        return Path(EXISTING_RELEASES) / name
    from deepaccident_devkit.plugins.synth import SynthConfig, make_release

    folder = factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent
    root = folder / "synthetic" / name
    root.parent.mkdir(exist_ok=True)
    with root.with_name(f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not root.exists():
            make_release(root, SynthConfig(designed=True, **config), workers=1)
        return root


@pytest.fixture(scope="session")
def release_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A synthetic release in layout A with all sensors; tests must not change it.

    Its path has a blank in it. In its accidents ego and other collide, as designed. Its labels
    count exactly the points of its clouds.
    """
    return prepare_release(
        "deep accident",
        tmp_path_factory,
        scenarios=4,
        frames=6,
        image_size=(64, 36),
        layout="A",
        seed=3,
        unplanned=0,
        exact=True,
    )


@pytest.fixture(scope="session")
def made_demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The folder of a demo with few frames and small images, and the output of the command."""
    out = tmp_path_factory.mktemp("demo") / "of a reader"
    demo = importlib.import_module("deepaccident_devkit.plugins.synth.demo")
    with pytest.MonkeyPatch.context() as patch:
        small_release = replace(demo.RELEASE, frames=12, image_size=(64, 36))
        patch.setattr(demo, "RELEASE", small_release)
        result = CliRunner().invoke(demo.demo, [str(out)], catch_exceptions=False)
    assert result.exit_code == 0
    return out, result.output


@pytest.fixture(scope="session")
def release_root_b(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A synthetic release in layout B with labels only; tests must not change it."""
    return prepare_release(
        "layout_b", tmp_path_factory, scenarios=6, frames=4, layout="B", seed=4, sensors=False
    )


@pytest.fixture(scope="session")
def da(release_root: Path) -> DeepAccident:
    """The release of `release_root`, opened."""
    return DeepAccident("v1", release_root, verbose=False)


@pytest.fixture(scope="session")
def da_partial(release_root: Path, tmp_path_factory: pytest.TempPathFactory) -> DeepAccident:
    """`da` as a partial download.

    It lacks the ego's front camera, the pole's LiDAR and all of other_vehicle_behind.
    """
    root = tmp_path_factory.mktemp("synthetic") / "partial"
    missing = shutil.ignore_patterns(".deepaccident", "other_vehicle_behind")
    shutil.copytree(release_root, root, ignore=missing)
    for pattern in ("*/ego_vehicle/Camera_Front", "*/infrastructure/lidar01"):
        for folder in root.glob(pattern):
            shutil.rmtree(folder)
    return DeepAccident("v1", root, verbose=False)


@pytest.fixture(scope="session")
def da_b(release_root_b: Path) -> DeepAccident:
    """The release of `release_root_b`, opened."""
    return DeepAccident("v1", release_root_b, verbose=False)


@pytest.fixture(scope="session")
def motion_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An accident of ego and other and its normal twin, labels only.

    They last 3.5 s, so that there are samples with a past, with a future and at the end.
    """
    return prepare_release(
        "motion", tmp_path_factory, scenarios=2, frames=35, seed=5, sensors=False, unplanned=0
    )


@pytest.fixture(scope="session")
def da_motion(motion_root: Path) -> DeepAccident:
    """The release of `motion_root`, opened."""
    return DeepAccident("v1", motion_root, verbose=False)


@pytest.fixture(params=["A", "B"])
def both_layouts(request: pytest.FixtureRequest) -> DeepAccident:
    """Each of the two releases in turn."""
    dataset: DeepAccident = request.getfixturevalue("da" if request.param == "A" else "da_b")
    return dataset


@pytest.fixture(scope="session")
def schema_generator() -> ModuleType:
    """The script schema/generate.py; its functions return the files as they should be."""
    return load_script("schema/generate.py")


@pytest.fixture
def own_release(release_root_b: Path, tmp_path: Path) -> Path:
    """A copy of the release with labels only, without an index, that a test may break."""
    root = tmp_path / "release"
    shutil.copytree(release_root_b, root, ignore=shutil.ignore_patterns(".deepaccident"))
    return root


@pytest.fixture(autouse=True)
def _close_figures() -> None:
    from matplotlib import pyplot as plt

    plt.close("all")
