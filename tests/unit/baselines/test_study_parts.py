"""The study in parts, and after an interruption: the very tables of one calm run."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.baselines import StudyConfig, V2XStudy, conditions, study_parts, v2x_study
from deepaccident_devkit.baselines.counting import CountJob, count_samples
from deepaccident_devkit.baselines.study_parts import StudyInParts
from deepaccident_devkit.errors import ConfigError, EvaluationError, SomeFailedError, UnfinishedError
from deepaccident_devkit.evaluation import Resampling

pytestmark = pytest.mark.slow

CONFIG = StudyConfig(quick=True, scope="all", seeds=[3, 5])


@pytest.fixture(scope="module", autouse=True)
def _few_conditions() -> Any:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(conditions, "_QUICK_HORIZONS", (2.0,))
        patch.setattr(conditions, "_QUICK_STEPS", (0.0, 0.5))
        patch.setattr(study_parts, "BATCH", 2)
        yield


@pytest.fixture(scope="module")
def whole(da_motion: DeepAccident) -> V2XStudy:
    """Counted in memory."""
    return v2x_study(da_motion, "train", CONFIG, workers=1)


def study_of(dataset: DeepAccident, out: Path, config: StudyConfig = CONFIG) -> StudyInParts:
    return StudyInParts(dataset, out, "train", config)


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The samples that are counted, in order."""
    done: list[str] = []

    def count(job: CountJob) -> Any:
        done.extend(token for token, _ in job.samples)
        return count_samples(job)

    monkeypatch.setattr(study_parts, "count_samples", count)
    return done


def failing_at(number: int, error: BaseException) -> Callable[[CountJob], Any]:
    """A function that counts nothing, and fails when it is called for the last time of so many."""
    calls: list[CountJob] = []

    def count(job: CountJob) -> Any:
        calls.append(job)
        if len(calls) == number:
            raise error
        return {}

    return count


@pytest.mark.parametrize("count", [1, 3, 8])
def test_shards_give_the_study_of_the_whole(
    da_motion: DeepAccident, whole: V2XStudy, tmp_path: Path, count: int
) -> None:
    out = tmp_path / "study"
    numbers = [study_of(da_motion, out).count(f"{number}/{count}", workers=1) for number in range(count, 0, -1)]
    assert sum(numbers) == 8
    assert study_of(da_motion, out).count("merge") == 0
    study = study_of(da_motion, out).result()
    assert study.to_json() == whole.to_json()
    assert study.to_text() == whole.to_text()
    files = [[path.read_bytes() for path in each.to_csv(tmp_path)] for each in (study, whole)]
    assert files[0] == files[1]
    study_of(da_motion, out).remove()
    assert not (tmp_path / "study.unfinished").exists()


def test_what_was_counted_is_not_counted_again(
    da_motion: DeepAccident, whole: V2XStudy, tmp_path: Path, counted: list[str]
) -> None:
    work = study_of(da_motion, tmp_path / "study")
    with pytest.raises(UnfinishedError, match="8 of 8 are not done, such as type1"):
        work.result()
    assert work.count("2/2", workers=1) == 4
    with pytest.raises(UnfinishedError, match="4 of 8 are not done"):
        work.result()
    with ThreadPoolExecutor(2) as executor:
        assert work.count(executor=executor) == 8
    assert work.count("2/3") + work.count() == 10
    assert len(counted) == len(set(counted)) == 8
    assert work.result().to_json() == whole.to_json()


@pytest.mark.parametrize(
    ("error", "raised", "sentence", "left"),
    [
        (KeyboardInterrupt(), KeyboardInterrupt, "^$", 4),
        (ConfigError("no such day"), SomeFailedError, r"study: 1 of 4 failed:\n  type1.*/\d+: no such day\n", 2),
    ],
)
def test_a_stopped_count_loses_the_samples_at_hand(
    da_motion: DeepAccident,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    error: BaseException,
    raised: type[BaseException],
    sentence: str,
    left: int,
) -> None:
    work = study_of(da_motion, tmp_path / "study")
    monkeypatch.setattr(study_parts, "count_samples", failing_at(3, error))
    with pytest.raises(raised, match=sentence):
        work.count(workers=1)
    with pytest.raises(UnfinishedError, match=f"{left} of 8 are not done"):
        work.result()
    work.count(workers=1)
    with pytest.raises(EvaluationError, match="has 0 conditions, not"):
        work.result()


def test_counts_of_other_settings_are_not_taken(
    da_motion: DeepAccident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "study"
    monkeypatch.setattr(study_parts, "count_samples", lambda _: {})
    study_of(da_motion, out).count(workers=1)
    others = (
        replace(CONFIG, seeds=[3]),
        replace(CONFIG, model="constant_turn_rate"),
        replace(CONFIG, protocol="boxes"),
        replace(CONFIG, egos=["other_vehicle"]),
    )
    for config in others:
        with pytest.raises(UnfinishedError, match="are not done"):
            study_of(da_motion, out, config).result()
    for content in (b"[", b"{}", b'[{"condition": {}, "counts": {}}]', b'[{"condition": {"agents": "all"}}]'):
        min((tmp_path / "study.unfinished").iterdir()).write_bytes(content)
        with pytest.raises(EvaluationError, match=r"\.json: no saved counts \(.*\); remove it, and count again"):
            study_of(da_motion, out, replace(CONFIG, resampling=Resampling(resamples=0))).result()
    monkeypatch.setattr(study_parts, "__version__", "another")
    with pytest.raises(UnfinishedError, match="8 of 8 are not done"):
        study_of(da_motion, out).result()


def test_it_says_what_it_is_of(da_motion: DeepAccident, tmp_path: Path) -> None:
    assert repr(study_of(da_motion, tmp_path)) == f"StudyInParts(8 samples, {tmp_path})"
