"""Results of the baselines in parts, on any executor, and after an interruption: the very bytes of one calm run."""

import multiprocessing
import shutil
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

from deepaccident_devkit import DeepAccident, __version__
from deepaccident_devkit.baselines import Baseline, predict_results
from deepaccident_devkit.baselines.predict_results import is_predicted, samples_by_scenario
from deepaccident_devkit.errors import ConfigError, NotAvailableError, ResultsError, SomeFailedError, UnfinishedError
from deepaccident_devkit.evaluation.results import ResultsTask, read_results
from deepaccident_devkit.v2x import Link

NOISY = Baseline(agents="+behind", link=Link(latency=0.1, pose_noise=0.2, seed=4))
NAMES: dict[ResultsTask, str] = {"motion": "motion", "accident": "accident.json", "detection": "detection.json"}


@pytest.fixture(scope="module")
def tokens(da_b: DeepAccident) -> list[str]:
    """Of four scenarios, two agents and two moments."""
    every = [each["token"] for each in da_b.sample if each["labelled"]]
    own = [token for token in every if token.split("/")[2] in ("ego_vehicle", "other_vehicle")]
    return [token for run in samples_by_scenario(own)[:4] for token in run if token.endswith(("2", "4"))]


@pytest.fixture(scope="module")
def wholes(da_b: DeepAccident, tokens: list[str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the results of all tasks, each made at once."""
    folder = tmp_path_factory.mktemp("whole")
    for task, name in NAMES.items():
        predict_results(da_b, task, tokens, folder / name, NOISY, workers=1)
    return folder


def contents(path: Path) -> dict[str, bytes]:
    """The bytes of a results file, or of those in a folder."""
    files = [path] if path.is_file() else sorted(each for each in path.rglob("*") if each.is_file())
    return {each.relative_to(path.parent).as_posix(): each.read_bytes() for each in files}


@pytest.fixture
def predicted(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The tokens that are predicted, in order."""
    done: list[str] = []
    original = Baseline.predict

    def predict(self: Baseline, dataset: Any, task: ResultsTask, token: str) -> Any:
        done.append(token)
        return original(self, dataset, task, token)

    monkeypatch.setattr(Baseline, "predict", predict)
    return done


def stopped_at(token: str, error: BaseException) -> Callable[..., Any]:
    """A `Baseline.predict` that fails at a sample."""
    original = Baseline.predict

    def predict(self: Baseline, dataset: Any, task: ResultsTask, sample: str) -> Any:
        if sample == token:
            raise error
        return original(self, dataset, task, sample)

    return predict


def test_samples_are_taken_scenario_by_scenario(tokens: Sequence[str]) -> None:
    runs = samples_by_scenario(tokens)
    assert [len(run) for run in runs] == [4, 4, 4, 4]
    assert [token for run in runs for token in run] == tokens
    assert samples_by_scenario(["a/b/c/001", "a/d/c/001", "a/b/c/002"]) == [
        ("a/b/c/001",),
        ("a/d/c/001",),
        ("a/b/c/002",),
    ]


@pytest.mark.parametrize("task", NAMES)
@pytest.mark.parametrize("count", [pytest.param(1, marks=pytest.mark.slow), 3, pytest.param(8, marks=pytest.mark.slow)])
def test_shards_are_put_together_to_the_bytes_of_the_whole(
    da_b: DeepAccident, tokens: list[str], wholes: Path, tmp_path: Path, task: ResultsTask, count: int
) -> None:
    out = tmp_path / NAMES[task]
    call = partial(predict_results, da_b, task, tokens, out, NOISY, workers=1)
    with pytest.raises(UnfinishedError, match="16 of 16 are not done, such as"):
        call(part="merge")
    for number in range(count, 0, -1):
        assert not is_predicted(da_b, task, tokens, out, NOISY)
        call(part=f"{number}/{count}")
        assert not out.exists()
    assert call(part="merge") == out
    assert contents(out) == contents(wholes / NAMES[task])
    assert [path.name for path in tmp_path.iterdir()] == [NAMES[task]]


def test_a_missing_shard_is_refused_or_done_without_one(
    da_b: DeepAccident, tokens: list[str], wholes: Path, tmp_path: Path
) -> None:
    out = tmp_path / "accident.json"
    call = partial(predict_results, da_b, "accident", tokens, out, NOISY, workers=1)
    call(part="1/3")
    call(part="3/3")
    with pytest.raises(UnfinishedError, match=rf"4 of 16 are not done, such as {tokens[4]}; run their shards again"):
        call(part="merge")
    assert not out.exists()
    call()
    assert contents(out) == contents(wholes / "accident.json")


def test_shards_of_other_settings_or_samples_are_not_taken(
    da_b: DeepAccident, tokens: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "accident.json"
    predict_results(da_b, "accident", tokens, out, NOISY, workers=1, part="1/1")
    for samples, baseline in ((tokens[:-1], NOISY), (tokens, Baseline())):
        with pytest.raises(UnfinishedError, match=f"{len(samples)} of {len(samples)} are not done"):
            predict_results(da_b, "accident", samples, out, baseline, part="merge")
    module = import_module(
        "deepaccident_devkit.baselines.predict_results"
    )  # a function of the package is called so too
    monkeypatch.setattr(module, "__version__", "another")
    with pytest.raises(UnfinishedError, match="16 of 16 are not done"):
        predict_results(da_b, "accident", tokens, out, NOISY, part="merge")


@pytest.mark.parametrize("part", [None, "1/1"])
def test_an_interrupted_call_loses_the_scenario_at_hand(
    da_b: DeepAccident,
    tokens: list[str],
    wholes: Path,
    tmp_path: Path,
    predicted: list[str],
    monkeypatch: pytest.MonkeyPatch,
    part: str | None,
) -> None:
    call = partial(predict_results, da_b, "motion", tokens, tmp_path / "motion", NOISY, workers=1)
    with monkeypatch.context() as patch:
        patch.setattr(Baseline, "predict", stopped_at(tokens[6], KeyboardInterrupt()))
        with pytest.raises(KeyboardInterrupt):
            call(part=part)
    assert predicted == tokens[:6]
    assert not (tmp_path / "motion").exists()
    del predicted[:]
    call(part=part)
    assert predicted == tokens[4:]
    call(part=part)
    call(part="merge")
    assert predicted == tokens[4:]
    assert contents(tmp_path / "motion") == contents(wholes / "motion")


def test_scenarios_that_fail_are_listed_and_the_others_done(
    da_b: DeepAccident, tokens: list[str], wholes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "detection.json"
    call = partial(predict_results, da_b, "detection", tokens, out, NOISY, workers=1)
    with monkeypatch.context() as patch:
        patch.setattr(Baseline, "predict", stopped_at(tokens[6], ConfigError("no such day")))
        scenario = tokens[6].rsplit("/", 2)[0]
        with pytest.raises(SomeFailedError, match=rf"1 of 4 failed:\n  {scenario}: no such day\n"):
            call()
        with pytest.raises(UnfinishedError, match=f"4 of 16 are not done, such as {tokens[4]}"):
            call(part="merge")
    call()
    assert contents(out) == contents(wholes / "detection.json")


def test_an_agent_that_is_not_there_is_named_before_anything_is_written(
    tokens: list[str], tmp_path: Path, own_release: Path
) -> None:
    for folder in own_release.glob("**/other_vehicle_behind"):
        shutil.rmtree(folder)
    partial_release, out = DeepAccident("v1", own_release, verbose=False), tmp_path / "out" / "accident.json"
    with pytest.raises(NotAvailableError, match="other_vehicle_behind is not in this release"):
        predict_results(partial_release, "accident", tokens, out, Baseline(agents="all"))
    assert not out.parent.exists()


@pytest.mark.parametrize("task", NAMES)
def test_complete_results_stay_and_others_are_refused(
    da_b: DeepAccident, tokens: list[str], wholes: Path, tmp_path: Path, predicted: list[str], task: ResultsTask
) -> None:
    out = wholes / NAMES[task]
    before = contents(out)
    assert is_predicted(da_b, task, tokens, out, NOISY)
    for part in (None, "1/3", "merge"):
        assert predict_results(da_b, task, tokens, out, NOISY, part=part) == out
    others = ((tokens[1:], NOISY), (tokens[::-1], NOISY), (tokens, Baseline(agents="+behind")))
    for samples, baseline in others:
        for part in (None, "1/3", "merge"):
            with pytest.raises(ResultsError, match=f"{out}: is there already; choose another path, or remove it"):
                predict_results(da_b, task, samples, out, baseline, part=part)
    broken = tmp_path / NAMES[task]
    broken.mkdir()
    (broken / "results.json").write_bytes(b"{}")
    with pytest.raises(ResultsError, match="is there already"):
        predict_results(da_b, task, tokens, broken, NOISY)
    assert not predicted
    assert contents(out) == before


def test_results_say_of_what_they_are(da_b: DeepAccident, wholes: Path) -> None:
    meta = read_results(wholes / "motion").meta
    assert meta == {
        **NOISY.meta(),
        "release": {"version": "v1", "index": da_b.tables_folder.name},
        "devkit": __version__,
    }


def test_a_token_that_comes_twice_is_refused_at_once(
    da_b: DeepAccident, tokens: list[str], tmp_path: Path, predicted: list[str]
) -> None:
    with pytest.raises(ResultsError, match=f"{tokens[3]}: comes twice; give each sample once"):
        predict_results(da_b, "accident", [*tokens, tokens[3]], tmp_path / "out", workers=1)
    assert not predicted


def spawned() -> Executor:
    return ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn"))


@pytest.mark.parametrize(
    "kind",
    [partial(ThreadPoolExecutor, 2), pytest.param(spawned, marks=pytest.mark.slow)],
    ids=["threads", "processes"],
)
def test_any_executor_writes_the_same(
    da_b: DeepAccident, tokens: list[str], wholes: Path, tmp_path: Path, kind: Callable[[], Executor]
) -> None:
    with kind() as executor:
        for task, name in NAMES.items():
            path = predict_results(da_b, task, tokens, tmp_path / name, NOISY, executor=executor)
            assert contents(path) == contents(wholes / name)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(NAMES.values())


def test_another_process_may_write_the_same_part(
    da_b: DeepAccident, tokens: list[str], wholes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    call = partial(predict_results, da_b, "motion", tokens, tmp_path / "motion", NOISY, workers=1)
    original, others = Baseline.predict, [0]

    def predict(self: Baseline, dataset: Any, task: ResultsTask, token: str) -> Any:
        if token == tokens[3] and not others[0]:
            others[0] += 1
            call(part="1/4")
        return original(self, dataset, task, token)

    monkeypatch.setattr(Baseline, "predict", predict)
    call()
    assert others == [1]
    assert contents(tmp_path / "motion") == contents(wholes / "motion")
