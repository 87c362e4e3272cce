"""An evaluation in parts, each of which could be a job: whatever they are, the bundle has the bytes of one run."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, EvaluationError, ResultsError, UnfinishedError
from deepaccident_devkit.evaluation import Resampling
from deepaccident_devkit.evaluation.results import Results, shards
from deepaccident_devkit.evaluation.runs import (
    EvaluationRun,
    SampleSelection,
    evaluate,
    evaluate_results,
    evaluate_shard,
    save_run,
    scenario_hashes,
    verify_bundle,
)
from deepaccident_devkit.evaluation.runs.sanity import check_sanity
from deepaccident_devkit.evaluation.runs.selection import scenario_of
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup, SampleLoader
from deepaccident_devkit.parallel import Shard
from deepaccident_devkit.splits import save_selection

SETUP = EvaluationSetup(task="accident", protocol="boxes")
Write = Callable[..., Results]
FEW = Resampling(resamples=5)


@dataclass(frozen=True)
class Job:
    """The same evaluation, whole or in parts."""

    dataset: DeepAccident
    results: Results
    selection: SampleSelection
    setup: EvaluationSetup = SETUP

    def part(self, text: str, out: Path, **how: Any) -> int:
        arguments = (self.dataset, self.results, self.setup, self.selection, Shard.parse(text))
        return len(evaluate_shard(*arguments, **{"workers": 1, **how}, out=out))

    def whole(self, out: Path | None = None, **how: Any) -> EvaluationRun:
        arguments = (self.dataset, self.results, self.setup, self.selection)
        return evaluate_results(*arguments, **{"workers": 1, **how}, out=out)

    def merged(self, out: Path) -> EvaluationRun:
        return self.whole(out, merge=True)


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


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def counts_beside(out: Path) -> list[Path]:
    return sorted(out.with_name(f"{out.name}.unfinished").iterdir())


class TestMerged:
    @pytest.mark.parametrize(
        "count", [pytest.param(1, marks=pytest.mark.slow), 3, pytest.param(8, marks=pytest.mark.slow)]
    )
    def test_any_number_of_parts_gives_the_bytes_of_one_run(
        self, job: Job, bundle: Path, tmp_path: Path, count: int, loaded: list[str]
    ) -> None:
        out = tmp_path / "out"
        done = [job.part(f"{number}/{count}", out) for number in (*range(count, 0, -1), 1)]
        assert sum(done[:-1]) == 30
        assert sorted(loaded) == sorted(job.results.tokens)  # the first part again has none to evaluate
        run = job.merged(out)
        assert len(loaded) == 30
        save_run(run.broken_down(["all", "town"], FEW), out)
        assert contents(out) == contents(bundle)
        assert not out.with_name("out.unfinished").exists()

    def test_parts_of_several_numbers_overlap(self, job: Job, bundle: Path, tmp_path: Path) -> None:
        for text in ("1/2", "1/3", "2/3", "3/3"):
            job.part(text, tmp_path / "out")
        run = job.merged(tmp_path / "out").broken_down(["all", "town"], FEW)
        assert contents(save_run(run, tmp_path / "out")) == contents(bundle)

    def test_a_run_without_merging_uses_what_is_there(self, job: Job, tmp_path: Path, loaded: list[str]) -> None:
        assert job.part("2/2", tmp_path / "out") == 15
        run = job.whole(tmp_path / "out")
        assert sorted(loaded) == sorted(job.results.tokens)
        assert dict(run.evaluator.counts) == dict(job.whole().evaluator.counts)

    def test_in_the_current_folder(self, job: Job, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        (tmp_path / "here").mkdir()
        monkeypatch.chdir(tmp_path / "here")
        job.part("1/1", Path())
        assert len(job.merged(Path()).evaluator) == 30

    def test_it_needs_a_folder(self, job: Job) -> None:
        with pytest.raises(ChoiceError, match="merge: expected the folder `out` of the shards, found None"):
            job.whole(merge=True)


class TestMissing:
    def test_a_part(self, job: Job, tmp_path: Path, bundle: Path) -> None:
        out = tmp_path / "out"
        for text in ("1/4", "4/4", "2/4"):
            job.part(text, out)
        before = counts_beside(out)
        with pytest.raises(UnfinishedError, match=r"out: 5 of 30 are not done, such as .*; run their shards again"):
            job.merged(out)
        assert counts_beside(out) == before
        job.part("3/4", out)
        assert contents(save_run(job.merged(out).broken_down(["all", "town"], FEW), out)) == contents(bundle)

    def test_a_part_that_broke_off_goes_on(self, job: Job, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        original, tokens = SampleLoader.__call__, list[str]()

        def load(loader: SampleLoader, token: str) -> tuple[Any, ...]:
            tokens.append(token)
            if len(tokens) == 10:
                raise KeyboardInterrupt
            return original(loader, token)

        monkeypatch.setattr(SampleLoader, "__call__", load)
        with pytest.raises(KeyboardInterrupt):
            job.part("1/2", tmp_path / "out")
        job.part("2/2", tmp_path / "out")
        with pytest.raises(UnfinishedError, match="7 of 30 are not done"):
            job.merged(tmp_path / "out")
        before = len(tokens)
        assert job.part("1/2", tmp_path / "out") == 15
        assert len(tokens) == before + 7
        assert len(job.merged(tmp_path / "out").evaluator) == 30

    def test_a_sample_that_fails_leaves_the_others(
        self, job: Job, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        original, broken = SampleLoader.__call__, job.results.tokens[3]

        def load(loader: SampleLoader, token: str) -> tuple[Any, ...]:
            if token == broken:
                raise FileNotFoundError("gone")
            return original(loader, token)

        with monkeypatch.context() as patch:
            patch.setattr(SampleLoader, "__call__", load)
            with pytest.raises(EvaluationError, match=f"^{broken}: .*: gone$"):
                job.part("1/1", tmp_path / "out")
        with pytest.raises(UnfinishedError, match=f"1 of 30 are not done, such as {broken};"):
            job.merged(tmp_path / "out")
        job.part("1/1", tmp_path / "out")
        assert len(job.merged(tmp_path / "out").evaluator) == 30


class TestStale:
    @pytest.fixture
    def counted(self, job: Job, tmp_path: Path) -> Path:
        for text in ("1/2", "2/2"):
            job.part(text, tmp_path / "out")
        return tmp_path / "out"

    def test_other_rules_samples_or_predictions(
        self, job: Job, counted: Path, tmp_path: Path, write_accidents: Write
    ) -> None:
        others = (
            replace(job, setup=replace(SETUP, switches={"reading.danger_distance": 0.5})),
            replace(job, results=write_accidents(tmp_path / "moved.json", job.results.tokens, moved=3.0)),
        )
        for other in others:
            with pytest.raises(UnfinishedError, match="30 of 30 are not done"):
                other.merged(counted)
        fewer = replace(job, selection=replace(job.selection, agents=("ego_vehicle",)))
        with pytest.raises(UnfinishedError, match="6 of 6 are not done"):
            fewer.whole(counted, merge=True, allow_partial=True)
        assert len(job.merged(counted).evaluator) == 30

    def test_other_labels(self, own_release: Path, tmp_path: Path, write_accidents: Write) -> None:
        dataset = DeepAccident(dataroot=own_release, verbose=False)
        every = SampleSelection(split="train", scope="all")
        job = Job(dataset, write_accidents(tmp_path / "a.json", every.tokens(dataset)), every)
        job.part("1/2", tmp_path / "out")
        job.part("2/2", tmp_path / "out")
        label = next(own_release.glob("train/**/ego_vehicle/label/**/*.txt"))
        label.write_bytes(label.read_bytes() + b"\n")
        with pytest.raises(UnfinishedError, match="5 of 10 are not done"):
            job.merged(tmp_path / "out")

    def test_damaged_or_foreign_files(self, job: Job, counted: Path) -> None:
        path = counts_beside(counted)[0]
        path.write_text(path.read_text()[:-9])
        for name in ("notes.txt", "ab.x-of-y.counts.json", "ab.3-of-2.counts.json", "ab.0-of-0.counts.json"):
            (path.parent / name).write_text("mine")
        with pytest.raises(UnfinishedError, match="15 of 30 are not done"):
            job.merged(counted)
        assert not path.exists()


class TestResultShards:
    """Those of motion results: each part checks some, together all."""

    @pytest.fixture
    def motion(self, job: Job, tmp_path: Path, write_motion: Write, monkeypatch: pytest.MonkeyPatch) -> Job:
        monkeypatch.setattr(shards, "_MOST_SAMPLES", 1)
        chosen = replace(job.selection, agents=("ego_vehicle",))
        results = write_motion(tmp_path / "motion", chosen.tokens(job.dataset))
        return Job(job.dataset, results, chosen, EvaluationSetup(task="motion"))

    def test_a_damaged_one_stops_one_part(self, motion: Job, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(evaluate, "evaluate_samples", lambda *_, **__: None)
        damaged = sorted((motion.results.path / "shards").iterdir())[4]
        content = bytearray(damaged.read_bytes())
        content[-1] ^= 1
        damaged.write_bytes(content)
        stopped = [text for text in ("1/4", "2/4", "3/4", "4/4") if self.is_stopped(motion, text, tmp_path)]
        assert len(stopped) == 1

    def is_stopped(self, motion: Job, text: str, folder: Path) -> bool:
        try:
            motion.part(text, folder / "out")
        except ResultsError as error:
            return "00004.npz" in str(error)
        return False

    def test_of_some_samples(self, motion: Job) -> None:
        first, *others = motion.results.tokens
        path = next(iter(sorted((motion.results.path / "shards").iterdir())))
        path.write_bytes(path.read_bytes()[:-1] + b"x")
        motion.results.check(samples=others)
        with pytest.raises(ResultsError, match=path.name):
            motion.results.check(samples=[first])


class Counting(ThreadPoolExecutor):
    """Threads that count what they are given."""

    given = 0

    def submit(self, *arguments: Any, **named: Any) -> Any:
        self.given += 1
        return super().submit(*arguments, **named)


CALLS: dict[str, Callable[..., Any]] = {
    "evaluate": lambda job, **how: job.whole(**how).summary(),
    "shard": lambda job, **how: dict(
        evaluate_shard(job.dataset, job.results, SETUP, job.selection, Shard(1, 2), **how).counts
    ),
    "hashes": lambda job, **how: scenario_hashes(job.dataset, map(scenario_of, job.results.tokens), **how),
    "breakdowns": lambda job, **how: job.whole().broken_down(["agent", "all"], FEW, **how).summary(),
    "sanity": lambda job, **how: check_sanity(job.dataset, job.results, SETUP, job.results.tokens, samples=2, **how),
}


@pytest.mark.parametrize("call", CALLS)
def test_any_executor_gives_the_same(job: Job, call: str, tmp_path: Path) -> None:
    out = {"out": tmp_path / "out"} if call == "shard" else {}
    with Counting(2) as executor:
        found = CALLS[call](job, executor=executor, **out)
        assert executor.given > 0
    assert found == CALLS[call](job, workers=1, **out)


def test_a_bundle_is_verified_on_any_executor(job: Job, bundle: Path) -> None:
    with Counting(2) as executor:
        found = verify_bundle(bundle, job.dataset, results=job.results, split=job.selection.split, executor=executor)
        assert executor.given > 4  # hashes, samples and breakdowns
    assert found.is_same, found.to_text()


def test_checks_of_motion_run_on_any_executor(job: Job, tmp_path: Path, write_motion: Write) -> None:
    results = write_motion(tmp_path / "motion", job.results.tokens[:1])
    with Counting(1) as executor:
        results.check(executor=executor)
        assert executor.given == 1
