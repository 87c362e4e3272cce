"""From a results file to an evaluation: refusals, partial and broken-off runs, workers and
executors.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, EvaluationError, ResultsError
from deepaccident_devkit.evaluation import (
    AccidentEvaluator,
    Resampling,
    accident_context,
    sample_attributes,
)
from deepaccident_devkit.evaluation.breakdowns import WITHIN_RECORDINGS
from deepaccident_devkit.evaluation.results import Results, ResultsWriter
from deepaccident_devkit.evaluation.runs import (
    BREAKDOWNS,
    EvaluationRun,
    SampleSelection,
    evaluate_results,
    evaluation_run,
    save_run,
    scenario_hashes,
)
from deepaccident_devkit.evaluation.runs.evaluation_run import (
    breakdowns_of,
    check_metas,
    partial_of,
)
from deepaccident_devkit.evaluation.runs.sanity import check_sanity
from deepaccident_devkit.evaluation.runs.setups import (
    Coverage,
    EvaluationSetup,
    SampleLoader,
    checkpoint_path,
    remove_checkpoints,
    scenario_of,
)
from deepaccident_devkit.selection.splits import save_selection

SETUP = EvaluationSetup(task="accident", protocol="boxes")
Write = Callable[..., Results]


@pytest.fixture
def nothing_long(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fails a test that comes to the long work."""

    def refused(*_arguments: Any, **_named: Any) -> None:
        pytest.fail("was evaluated")

    monkeypatch.setattr(evaluation_run, "evaluate_samples", refused)


def test_equals_the_evaluator_by_hand(
    da_b: DeepAccident, results: Results, run: EvaluationRun
) -> None:
    by_hand = AccidentEvaluator("boxes")
    for token in results.tokens:
        by_hand.update(token, results.prediction(token), None, accident_context(da_b, token, 2.0))
    assert (run.result, run.result.positives, run.partial) == (by_hand.compute(), 3, None)
    assert (run.attributes, set(run.times_to_impact.values())) == (
        sample_attributes(da_b, results.tokens),
        {0.5, None},
    )


def test_says_what_it_depends_on(da_b: DeepAccident, results: Results, run: EvaluationRun) -> None:
    assert run.release.scenarios == scenario_hashes(da_b, da_b.split_scenarios("val"))
    assert (run.results.fingerprint, run.results.form) == (results.fingerprint, None)
    assert run.results.meta == {"method": "truth", "moved": 0.1}


def test_breakdowns(run: EvaluationRun) -> None:
    broken = run.broken_down(["agent", "all", "agent"], Resampling(resamples=5))
    assert [each.by for each in broken.breakdowns] == ["agent", "all"]
    assert broken.breakdowns[1].groups[0].result == run.result
    assert [
        each.by for each in run.broken_down(resampling=Resampling(resamples=0)).breakdowns
    ] == list(BREAKDOWNS)
    assert_refused(
        (
            lambda: run.broken_down(["wether"]),
            ChoiceError,
            r"by: expected one of all, .*, found 'wether'; did you mean 'weather'",
        ),
    )


@pytest.mark.usefixtures("nothing_long")
class TestRefused:
    def test_results_that_do_not_fit(
        self,
        da_b: DeepAccident,
        selection: SampleSelection,
        tmp_path: Path,
        write_motion: Write,
        write_accidents: Write,
    ) -> None:
        """Of another kind, of too short a look ahead, with a damaged shard, missing samples,
        nothing in common.
        """
        tokens, motion = selection.tokens(da_b), EvaluationSetup(task="motion")
        accidents = write_accidents(tmp_path / "some.json", tokens[1:])
        others = write_accidents(
            tmp_path / "other.json", replace(selection, split="train").tokens(da_b)
        )
        maps, damaged = (write_motion(tmp_path / name, tokens) for name in ("motion", "damaged"))
        shard = next((tmp_path / "damaged" / "shards").iterdir())
        shard.write_bytes(shard.read_bytes()[:-100])
        evaluate = partial(evaluate_results, da_b)
        assert_refused(
            (
                partial(evaluate, accidents, motion, selection),
                EvaluationError,
                ("accident results", "motion results"),
            ),
            (
                partial(evaluate, maps, replace(motion, horizon=3.0), selection),
                EvaluationError,
                ("look 2 s ahead (5 frames, 0.5 s apart",),
            ),
            (partial(evaluate, damaged, motion, selection), ResultsError, (shard.name,)),
            (
                partial(evaluate, accidents, SETUP, selection),
                ResultsError,
                (f"some.json: without a prediction: 1 of 6 samples ({tokens[0]})",),
            ),
            (
                partial(evaluate, others, SETUP, selection, allow_partial=True),
                ResultsError,
                ("of --split train", "nothing is left to evaluate"),
            ),
        )

    @pytest.mark.parametrize(("task", "protocol"), [("accident", "boxes"), ("warning", "clean")])
    def test_scenarios_without_meta_are_counted_before_the_start(
        self, da_b: DeepAccident, own_release: Path, tmp_path: Path, task: str, protocol: str
    ) -> None:
        every = SampleSelection(split="train", samples="all", scope="all")
        silent = [scenario["token"] for scenario in da_b.find(split="train")][:1]
        for token in silent:
            (own_release / "train" / token.replace("/", "/meta/")).with_suffix(".txt").unlink()
        release = DeepAccident(dataroot=own_release, verbose=False)
        with ResultsWriter(tmp_path / "none.json", "accident") as writer:
            for sample in every.tokens(release):
                writer.add(sample, [])
        assert_refused(
            (
                lambda: evaluate_results(
                    release,
                    tmp_path / "none.json",
                    EvaluationSetup(task=task, protocol=protocol),
                    every,
                ),
                EvaluationError,
                r"1 of 2 scenarios have no meta file, .*--where 'weather!=unknown'",
            ),
        )
        save_selection(release.find("weather!=unknown", split="train"), tmp_path / "mine.txt")
        chosen = replace(every, split=str(tmp_path / "mine.txt"))
        check_metas(release, chosen.tokens(release), chosen.split)


def test_only_what_is_in_both_and_marked(
    da_b: DeepAccident, selection: SampleSelection, tmp_path: Path, write_accidents: Write
) -> None:
    tokens = selection.tokens(da_b)
    extra = replace(selection, agents=("other_vehicle_behind",)).tokens(da_b)
    results = write_accidents(tmp_path / "some.json", [*tokens[2:], *extra])
    run = evaluate_results(da_b, results, SETUP, selection, allow_partial=True, workers=1)
    assert run.evaluator.tokens == set(tokens[2:])
    assert run.summary()["partial"]["mark"] == "PARTIAL: 4 of 6 samples, 2 predictions left out"


def test_other_predictions_alone_do_not_mark(
    da_b: DeepAccident, selection: SampleSelection, tmp_path: Path, write_accidents: Write
) -> None:
    tokens = selection.tokens(da_b)
    extra = replace(selection, agents=("other_vehicle_behind",)).tokens(da_b)
    results = write_accidents(tmp_path / "more.json", [*tokens, *extra])
    assert_refused(
        (
            lambda: evaluate_results(da_b, results, SETUP, selection),
            ResultsError,
            r"; leave them out with --allow-partial .*; no sample",
        ),
    )
    run = evaluate_results(da_b, results, SETUP, selection, allow_partial=True, workers=1)
    assert (run.evaluator.tokens, run.partial) == (set(tokens), None)


class TestBrokenOff:
    @pytest.fixture
    def broken_after(self, monkeypatch: pytest.MonkeyPatch) -> Callable[[int | None], list[str]]:
        """Break a run off after so many samples; gives the tokens that were loaded."""
        original = evaluation_run.SampleLoader.__call__

        def start(count: int | None) -> list[str]:
            loaded: list[str] = []

            def load(loader: Any, token: str) -> tuple[Any, ...]:
                if len(loaded) == count:
                    raise KeyboardInterrupt
                loaded.append(token)
                return original(loader, token)

            monkeypatch.setattr(evaluation_run.SampleLoader, "__call__", load)
            return loaded

        return start

    def run_of(
        self, dataset: DeepAccident, results: Results, out: Path, **changes: Any
    ) -> EvaluationRun:
        setup = EvaluationSetup(task="accident", protocol="boxes", **changes)
        every = SampleSelection(split="train", samples="evaluate", scope="all")
        return evaluate_results(dataset, results, setup, every, workers=1, out=out)

    @pytest.fixture
    def ten(self, da_b: DeepAccident, tmp_path: Path, write_accidents: Write) -> Results:
        """Results of ten samples, of which eight are one batch."""
        tokens = SampleSelection(split="train", samples="evaluate", scope="all").tokens(da_b)
        return write_accidents(tmp_path / "accidents.json", tokens)

    def test_goes_on_where_it_stopped(
        self,
        da_b: DeepAccident,
        ten: Results,
        tmp_path: Path,
        broken_after: Callable[[int | None], list[str]],
    ) -> None:
        first = broken_after(9)
        with pytest.raises(KeyboardInterrupt):
            self.run_of(da_b, ten, tmp_path / "out")
        then, run = broken_after(None), self.run_of(da_b, ten, tmp_path / "out")
        assert [*first[:8], *then] == list(ten.tokens)
        assert run.summary() == self.run_of(da_b, ten, tmp_path / "elsewhere").summary()

    def test_other_rules_or_results_or_labels_begin_anew(
        self,
        da_b: DeepAccident,
        ten: Results,
        tmp_path: Path,
        broken_after: Callable[[int | None], list[str]],
        write_accidents: Write,
    ) -> None:
        out = tmp_path / "out"
        self.run_of(da_b, ten, out)
        loaded = broken_after(None)
        self.run_of(da_b, ten, out)
        assert loaded == []
        self.run_of(da_b, ten, out, switches={"reading.danger_distance": 0.5})
        assert len(loaded) == 10
        self.run_of(da_b, write_accidents(tmp_path / "more.json", ten.tokens, moved=3.0), out)
        assert len(loaded) == 20

    def test_removing_leaves_what_is_not_its_own(self, tmp_path: Path) -> None:
        folder = tmp_path / "out.unfinished"
        checkpoint_path(tmp_path / "out", SETUP, ["x"], {}).mkdir(parents=True)
        (folder / "mine.txt").touch()
        remove_checkpoints(tmp_path / "out")
        assert [each.name for each in folder.iterdir()] == ["mine.txt"]
        (folder / "mine.txt").unlink()
        remove_checkpoints(tmp_path / "out")
        assert not folder.exists()


def test_warnings_are_broken_down_by_whole_recordings_alone() -> None:
    assert not {*breakdowns_of("warning")} & {*WITHIN_RECORDINGS}
    assert {*breakdowns_of("accident")} & {*WITHIN_RECORDINGS}


def test_extra_samples_are_those_of_other_lists_and_those_of_no_release() -> None:
    found = partial_of(Coverage(expected=5, missing=("a",), extra=("b", "c"), unknown=("d",)))
    assert (found.missing, found.extra, found.expected, found.evaluated) == (1, 3, 5, 4)


FEW = Resampling(resamples=5)


@dataclass(frozen=True)
class Job:
    """An evaluation."""

    dataset: DeepAccident
    results: Results
    selection: SampleSelection
    setup: EvaluationSetup = SETUP

    def whole(self, out: Path | None = None, **how: Any) -> EvaluationRun:
        return evaluate_results(
            *(self.dataset, self.results, self.setup, self.selection),
            **{"workers": 1, **how},
            out=out,
        )


@pytest.fixture(scope="module")
def job(
    da_b: DeepAccident, write_accidents: Write, tmp_path_factory: pytest.TempPathFactory
) -> Job:
    """All six scenarios: thirty samples."""
    folder = tmp_path_factory.mktemp("shards")
    save_selection(da_b.find(), folder / "all.txt")
    every = SampleSelection(split=str(folder / "all.txt"), scope="all")
    return Job(da_b, write_accidents(folder / "accidents.json", every.tokens(da_b)), every)


@pytest.fixture(scope="module")
def bundle(job: Job, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_run(
        job.whole().broken_down(["all", "town"], FEW), tmp_path_factory.mktemp("bundle") / "whole"
    )


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


def test_processes_that_are_given_one_folder_share_the_samples(
    job: Job, tmp_path: Path, loaded: list[str]
) -> None:
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
    "hashes": lambda job, **how: scenario_hashes(
        job.dataset, map(scenario_of, job.results.tokens), **how
    ),
    "breakdowns": lambda job, **how: (
        job.whole().broken_down(["agent", "all"], FEW, **how).summary()
    ),
    "sanity": lambda job, **how: check_sanity(
        job.dataset, job.results, SETUP, job.results.tokens, **how
    ),
}


@pytest.mark.parametrize("call", CALLS)
def test_any_executor_gives_the_same(job: Job, call: str) -> None:
    with Counting(2) as executor:
        found = CALLS[call](job, executor=executor)
        assert executor.given > 0
    assert found == CALLS[call](job, workers=1)
