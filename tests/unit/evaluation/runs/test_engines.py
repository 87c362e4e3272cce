"""Evaluations on any executor, and several processes that share one."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation import Resampling
from deepaccident_devkit.evaluation.results import Results
from deepaccident_devkit.evaluation.runs import (
    EvaluationRun,
    SampleSelection,
    evaluate_results,
    save_run,
    scenario_hashes,
    verify_bundle,
)
from deepaccident_devkit.evaluation.runs.sanity import check_sanity
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup, SampleLoader, scenario_of
from deepaccident_devkit.splits import save_selection

SETUP = EvaluationSetup(task="accident", protocol="boxes")
Write = Callable[..., Results]
FEW = Resampling(resamples=5)


@dataclass(frozen=True)
class Job:
    """An evaluation."""

    dataset: DeepAccident
    results: Results
    selection: SampleSelection
    setup: EvaluationSetup = SETUP

    def whole(self, out: Path | None = None, **how: Any) -> EvaluationRun:
        arguments = (self.dataset, self.results, self.setup, self.selection)
        return evaluate_results(*arguments, **{"workers": 1, **how}, out=out)


@pytest.fixture(scope="module")
def job(da_b: DeepAccident, write_accidents: Write, tmp_path_factory: pytest.TempPathFactory) -> Job:
    """All six scenarios: thirty samples."""
    folder = tmp_path_factory.mktemp("shards")
    save_selection(da_b.find(), folder / "all.txt")
    every = SampleSelection(split=str(folder / "all.txt"), scope="all")
    return Job(da_b, write_accidents(folder / "accidents.json", every.tokens(da_b)), every)


@pytest.fixture(scope="module")
def bundle(job: Job, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_run(job.whole().broken_down(["all", "town"], FEW), tmp_path_factory.mktemp("bundle") / "whole")


@pytest.fixture
def loaded(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The samples that are evaluated."""
    tokens: list[str] = []
    original = SampleLoader.__call__

    def load(loader: SampleLoader, token: str) -> tuple[Any, ...]:
        tokens.append(token)
        return original(loader, token)

    monkeypatch.setattr(SampleLoader, "__call__", load)
    return tokens


def test_processes_that_are_given_one_folder_share_the_samples(job: Job, tmp_path: Path, loaded: list[str]) -> None:
    with ThreadPoolExecutor(3) as threads:
        runs = list(threads.map(lambda _: job.whole(tmp_path / "out"), range(3)))
    assert sorted(loaded) == sorted(job.results.tokens)
    assert all(run.summary() == job.whole().summary() for run in runs)


class Counting(ThreadPoolExecutor):
    """Threads that count what they are given."""

    given = 0

    def submit(self, *arguments: Any, **named: Any) -> Any:
        self.given += 1
        return super().submit(*arguments, **named)


CALLS: dict[str, Callable[..., Any]] = {
    "evaluate": lambda job, **how: job.whole(**how).summary(),
    "hashes": lambda job, **how: scenario_hashes(job.dataset, map(scenario_of, job.results.tokens), **how),
    "breakdowns": lambda job, **how: job.whole().broken_down(["agent", "all"], FEW, **how).summary(),
    "sanity": lambda job, **how: check_sanity(job.dataset, job.results, SETUP, job.results.tokens, **how),
}


@pytest.mark.parametrize("call", CALLS)
def test_any_executor_gives_the_same(job: Job, call: str) -> None:
    with Counting(2) as executor:
        found = CALLS[call](job, executor=executor)
        assert executor.given > 0
    assert found == CALLS[call](job, workers=1)


def test_a_bundle_is_verified_on_any_executor(job: Job, bundle: Path) -> None:
    with Counting(2) as executor:
        found = verify_bundle(bundle, job.dataset, results=job.results, split=job.selection.split, executor=executor)
        assert executor.given > 6 + 4  # hashes, samples and breakdowns
    assert found.is_same, found.to_text()


def test_checks_of_motion_run_on_any_executor(job: Job, tmp_path: Path, write_motion: Write) -> None:
    results = write_motion(tmp_path / "motion", job.results.tokens[:1])
    with Counting(1) as executor:
        results.check(executor=executor)
        assert executor.given == 1
