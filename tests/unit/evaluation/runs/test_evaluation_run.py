"""From a results file to an evaluation: refusals, partial and interrupted runs, workers and
executors.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from support.expected_errors import assert_raises

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
def no_evaluation(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fail a test that comes to the long work."""

    def refuse(*_arguments: Any, **_options: Any) -> None:
        pytest.fail("was evaluated")

    monkeypatch.setattr(evaluation_run, "evaluate_samples", refuse)


def test_a_run_equals_the_evaluator_by_hand(
    da_b: DeepAccident, results: Results, run: EvaluationRun
) -> None:
    by_hand = AccidentEvaluator("boxes")
    for token in results.tokens:
        by_hand.update(token, results.prediction(token), None, accident_context(da_b, token, 2.0))

    assert (run.result, run.result.positives, run.partial) == (by_hand.compute(), 3, None)
    assert run.attributes == sample_attributes(da_b, results.tokens)
    assert set(run.times_to_impact.values()) == {0.5, None}


def test_a_run_names_its_release_and_results(
    da_b: DeepAccident, results: Results, run: EvaluationRun
) -> None:
    assert run.release.scenarios == scenario_hashes(da_b, da_b.split_scenarios("val"))
    assert (run.results.fingerprint, run.results.form) == (results.fingerprint, None)
    assert run.results.meta == {"method": "truth", "moved": 0.1}


def test_breakdowns_are_made_once_each_in_the_order_asked(run: EvaluationRun) -> None:
    some = run.broken_down(["agent", "all", "agent"], Resampling(resamples=5)).breakdowns
    assert [breakdown.by for breakdown in some] == ["agent", "all"]
    assert some[1].groups[0].result == run.result

    every = run.broken_down(resampling=Resampling(resamples=0)).breakdowns
    assert [breakdown.by for breakdown in every] == list(BREAKDOWNS)

    assert_raises(
        (
            lambda: run.broken_down(["wether"]),
            ChoiceError,
            r"by: expected one of all, .*, found 'wether'; did you mean 'weather'",
        ),
    )


@pytest.mark.usefixtures("no_evaluation")
class TestRefused:
    def test_results_that_do_not_fit_are_refused(
        self,
        da_b: DeepAccident,
        selection: SampleSelection,
        tmp_path: Path,
        write_motion: Write,
        write_accidents: Write,
    ) -> None:
        """Results of another kind, with too short a horizon, with a damaged shard, without all
        samples, and with none of them.
        """
        tokens = selection.tokens(da_b)
        accidents = write_accidents(tmp_path / "some.json", tokens[1:])
        train_tokens = replace(selection, split="train").tokens(da_b)
        train_accidents = write_accidents(tmp_path / "other.json", train_tokens)
        maps = write_motion(tmp_path / "motion", tokens)
        damaged = write_motion(tmp_path / "damaged", tokens)
        shard = next((tmp_path / "damaged" / "shards").iterdir())
        shard.write_bytes(shard.read_bytes()[:-100])

        motion = EvaluationSetup(task="motion")
        evaluate = partial(evaluate_results, da_b)
        assert_raises(
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
                partial(evaluate, train_accidents, SETUP, selection, allow_partial=True),
                ResultsError,
                ("made with --split train", "no sample is left to evaluate"),
            ),
        )

    @pytest.mark.parametrize(("task", "protocol"), [("accident", "boxes"), ("warning", "clean")])
    def test_scenarios_without_meta_are_counted_before_the_start(
        self, da_b: DeepAccident, own_release: Path, tmp_path: Path, task: str, protocol: str
    ) -> None:
        scenario = da_b.find(split="train")[0]["token"]
        meta = own_release / "train" / scenario.replace("/", "/meta/")
        meta.with_suffix(".txt").unlink()
        release = DeepAccident(dataroot=own_release, verbose=False)
        selection = SampleSelection(split="train", samples="all", scope="all")
        path = tmp_path / "none.json"
        with ResultsWriter(path, "accident") as writer:
            for sample in selection.tokens(release):
                writer.add(sample, [])

        setup = EvaluationSetup(task=task, protocol=protocol)
        assert_raises(
            (
                lambda: evaluate_results(release, path, setup, selection),
                EvaluationError,
                r"no meta file, .* for 1 of 2 scenarios, .*--where 'weather!=unknown'",
            ),
        )

        list_path = tmp_path / "mine.txt"
        save_selection(release.find("weather!=unknown", split="train"), list_path)
        remaining = replace(selection, split=str(list_path))
        check_metas(release, remaining.tokens(release), remaining.split)


def test_only_common_samples_are_evaluated_and_the_run_is_marked(
    da_b: DeepAccident, selection: SampleSelection, tmp_path: Path, write_accidents: Write
) -> None:
    tokens = selection.tokens(da_b)
    extra = replace(selection, agents=("other_vehicle_behind",)).tokens(da_b)
    results = write_accidents(tmp_path / "some.json", [*tokens[2:], *extra])

    run = evaluate_results(da_b, results, SETUP, selection, allow_partial=True, workers=1)
    assert run.evaluator.tokens == set(tokens[2:])
    assert run.summary()["partial"]["mark"] == "PARTIAL: 4 of 6 samples, 2 predictions left out"


def test_extra_predictions_do_not_mark_a_run(
    da_b: DeepAccident, selection: SampleSelection, tmp_path: Path, write_accidents: Write
) -> None:
    tokens = selection.tokens(da_b)
    extra = replace(selection, agents=("other_vehicle_behind",)).tokens(da_b)
    results = write_accidents(tmp_path / "more.json", [*tokens, *extra])

    assert_raises(
        (
            lambda: evaluate_results(da_b, results, SETUP, selection),
            ResultsError,
            r"; ignore them with --allow-partial .*; every evaluated sample",
        ),
    )

    run = evaluate_results(da_b, results, SETUP, selection, allow_partial=True, workers=1)
    assert (run.evaluator.tokens, run.partial) == (set(tokens), None)


class TestInterrupted:
    @pytest.fixture
    def interrupt_after(self, monkeypatch: pytest.MonkeyPatch) -> Callable[[int | None], list[str]]:
        """Interrupt a run after a number of samples; returns the tokens as they are loaded."""
        load_sample = evaluation_run.SampleLoader.__call__

        def start(count: int | None) -> list[str]:
            loaded_tokens: list[str] = []

            def load(loader: Any, token: str) -> tuple[Any, ...]:
                if len(loaded_tokens) == count:
                    raise KeyboardInterrupt
                loaded_tokens.append(token)
                return load_sample(loader, token)

            monkeypatch.setattr(evaluation_run.SampleLoader, "__call__", load)
            return loaded_tokens

        return start

    def evaluate_train(
        self, dataset: DeepAccident, results: Results, out: Path, **changes: Any
    ) -> EvaluationRun:
        setup = EvaluationSetup(task="accident", protocol="boxes", **changes)
        selection = SampleSelection(split="train", samples="evaluate", scope="all")
        return evaluate_results(dataset, results, setup, selection, workers=1, out=out)

    @pytest.fixture
    def ten_results(self, da_b: DeepAccident, tmp_path: Path, write_accidents: Write) -> Results:
        """Write results of ten samples: a batch of eight, and two more."""
        tokens = SampleSelection(split="train", samples="evaluate", scope="all").tokens(da_b)
        return write_accidents(tmp_path / "accidents.json", tokens)

    def test_a_run_goes_on_where_it_stopped(
        self,
        da_b: DeepAccident,
        ten_results: Results,
        tmp_path: Path,
        interrupt_after: Callable[[int | None], list[str]],
    ) -> None:
        first_tokens = interrupt_after(9)
        with pytest.raises(KeyboardInterrupt):
            self.evaluate_train(da_b, ten_results, tmp_path / "out")

        later_tokens = interrupt_after(None)
        run = self.evaluate_train(da_b, ten_results, tmp_path / "out")
        assert [*first_tokens[:8], *later_tokens] == list(ten_results.tokens)

        whole_run = self.evaluate_train(da_b, ten_results, tmp_path / "elsewhere")
        assert run.summary() == whole_run.summary()

    def test_other_rules_or_results_begin_anew(
        self,
        da_b: DeepAccident,
        ten_results: Results,
        tmp_path: Path,
        interrupt_after: Callable[[int | None], list[str]],
        write_accidents: Write,
    ) -> None:
        out = tmp_path / "out"
        self.evaluate_train(da_b, ten_results, out)
        loaded_tokens = interrupt_after(None)
        self.evaluate_train(da_b, ten_results, out)
        assert loaded_tokens == []

        self.evaluate_train(da_b, ten_results, out, switches={"reading.danger_distance": 0.5})
        assert len(loaded_tokens) == 10

        moved_results = write_accidents(tmp_path / "more.json", ten_results.tokens, moved=3.0)
        self.evaluate_train(da_b, moved_results, out)
        assert len(loaded_tokens) == 20

    def test_removing_checkpoints_leaves_other_files(self, tmp_path: Path) -> None:
        folder = tmp_path / "out.unfinished"
        checkpoint_path(tmp_path / "out", SETUP, ["x"], {}).mkdir(parents=True)
        (folder / "mine.txt").touch()
        remove_checkpoints(tmp_path / "out")
        assert [path.name for path in folder.iterdir()] == ["mine.txt"]

        (folder / "mine.txt").unlink()
        remove_checkpoints(tmp_path / "out")
        assert not folder.exists()


def test_warnings_are_broken_down_only_by_whole_recordings() -> None:
    assert not {*breakdowns_of("warning")} & {*WITHIN_RECORDINGS}
    assert {*breakdowns_of("accident")} & {*WITHIN_RECORDINGS}


def test_extra_samples_are_of_other_selections_or_of_no_release() -> None:
    coverage = Coverage(expected=5, missing=("a",), extra=("b", "c"), unknown=("d",))
    part = partial_of(coverage)
    assert (part.missing, part.extra, part.expected, part.evaluated) == (1, 3, 5, 4)


FEW_RESAMPLES = Resampling(resamples=5)


@dataclass(frozen=True)
class Job:
    """An evaluation that can be run several times."""

    dataset: DeepAccident
    results: Results
    selection: SampleSelection
    setup: EvaluationSetup = SETUP

    def evaluate(self, out: Path | None = None, **options: Any) -> EvaluationRun:
        return evaluate_results(
            self.dataset,
            self.results,
            self.setup,
            self.selection,
            **{"workers": 1, **options},
            out=out,
        )


@pytest.fixture(scope="module")
def job(
    da_b: DeepAccident, write_accidents: Write, tmp_path_factory: pytest.TempPathFactory
) -> Job:
    """Prepare an evaluation of all six scenarios: thirty samples."""
    folder = tmp_path_factory.mktemp("shards")
    save_selection(da_b.find(), folder / "all.txt")
    selection = SampleSelection(split=str(folder / "all.txt"), scope="all")
    results = write_accidents(folder / "accidents.json", selection.tokens(da_b))
    return Job(da_b, results, selection)


@pytest.fixture
def loaded_tokens(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Collect the tokens of the samples that are evaluated."""
    tokens: list[str] = []
    load_sample = SampleLoader.__call__

    def load(loader: SampleLoader, token: str) -> tuple[Any, ...]:
        tokens.append(token)
        return load_sample(loader, token)

    monkeypatch.setattr(SampleLoader, "__call__", load)
    return tokens


def test_processes_with_the_same_folder_share_the_samples(
    job: Job, tmp_path: Path, loaded_tokens: list[str]
) -> None:
    with ThreadPoolExecutor(3) as threads:
        runs = list(threads.map(lambda _: job.evaluate(tmp_path / "out"), range(3)))
    assert sorted(loaded_tokens) == sorted(job.results.tokens)

    summary = job.evaluate().summary()
    assert all(run.summary() == summary for run in runs)


class CountingExecutor(ThreadPoolExecutor):
    """An executor that counts its tasks."""

    task_count = 0

    def submit(self, *arguments: Any, **options: Any) -> Any:
        self.task_count += 1
        return super().submit(*arguments, **options)


CALLS: dict[str, Callable[..., Any]] = {
    "evaluate": lambda job, **options: job.evaluate(**options).summary(),
    "hashes": lambda job, **options: scenario_hashes(
        job.dataset, map(scenario_of, job.results.tokens), **options
    ),
    "breakdowns": lambda job, **options: (
        job.evaluate().broken_down(["agent", "all"], FEW_RESAMPLES, **options).summary()
    ),
    "sanity": lambda job, **options: check_sanity(
        job.dataset, job.results, SETUP, job.results.tokens, **options
    ),
}


@pytest.mark.parametrize("call", CALLS)
def test_any_executor_gives_the_same(job: Job, call: str) -> None:
    with CountingExecutor(2) as executor:
        by_executor = CALLS[call](job, executor=executor)
        assert executor.task_count > 0
    assert by_executor == CALLS[call](job, workers=1)
