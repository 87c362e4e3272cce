"""Small results files for the labels-only release, and runs of them."""

from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path

import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation import Accident, accident_context, instances_of
from deepaccident_devkit.evaluation.results import Results, ResultsWriter, read_results
from deepaccident_devkit.evaluation.runs import EvaluationRun, SampleSelection, evaluate_results
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.plugins.synth import SynthConfig, make_release

WriteAccidents = Callable[..., Results]
WriteMotion = Callable[..., Results]
SETUP = EvaluationSetup(task="accident", protocol="boxes")


@pytest.fixture(scope="session")
def release_root_b(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make the labels-only release with half a second more.

    At the impact itself nothing can be foreseen.
    """
    root = tmp_path_factory.mktemp("runs") / "layout_b"
    config = SynthConfig(scenarios=6, frames=6, layout="B", seed=4, sensors=False, designed=True)
    return make_release(root, config, workers=1)


@pytest.fixture(scope="session")
def da_b(release_root_b: Path) -> DeepAccident:
    return DeepAccident(dataroot=release_root_b)


@pytest.fixture(scope="session")
def selection() -> SampleSelection:
    """Select an accident and its normal twin, as three agents see them: six samples."""
    return SampleSelection(
        split="val",
        samples="evaluate",
        scope="all",
        agents=("ego_vehicle", "other_vehicle", "infrastructure"),
    )


@pytest.fixture(scope="session")
def write_accidents(da_b: DeepAccident) -> WriteAccidents:
    """Write the true accidents of samples, moved in metres: `(path, tokens, moved=0.1)`."""
    return partial(_write_accidents, da_b)


@pytest.fixture(scope="session")
def write_motion(da_b: DeepAccident) -> WriteMotion:
    """Write the labels of samples as motion, moved by some columns: `(path, tokens, moved=1)`."""
    return partial(_write_motion, da_b)


@pytest.fixture
def results(
    da_b: DeepAccident, selection: SampleSelection, tmp_path: Path, write_accidents: WriteAccidents
) -> Results:
    """Write accidents of exactly the samples of `selection`."""
    return write_accidents(tmp_path / "accidents.json", selection.tokens(da_b))


@pytest.fixture
def run(da_b: DeepAccident, results: Results, selection: SampleSelection) -> EvaluationRun:
    """Evaluate `results`."""
    return evaluate_results(da_b, results, SETUP, selection, workers=1)


def _write_accidents(
    dataset: DeepAccident, path: Path, tokens: Iterable[str], moved: float = 0.1
) -> Results:
    with ResultsWriter(path, "accident", meta={"method": "truth", "moved": moved}) as writer:
        for token in tokens:
            truth = accident_context(dataset, token, 2.0).truth
            predictions = []
            if truth is not None and truth.accident is not None:
                accident = truth.accident
                positions = accident.positions + moved
                predictions = [Accident(positions=positions, time=accident.time, ids=accident.ids)]
            writer.add(token, predictions)
    return read_results(path)


def _write_motion(
    dataset: DeepAccident, path: Path, tokens: Iterable[str], moved: int = 1
) -> Results:
    with ResultsWriter(path, "motion", meta={"moved": moved}) as writer:
        for token in tokens:
            label = dataset.motion_labels(token).to_present("bilinear")
            maps = label.instance.copy()
            maps[:, :, moved:] = label.instance[:, :, : maps.shape[-1] - moved]
            writer.add(token, instances_of(maps, label.config.grid))
    return read_results(path)
