"""Baselines write the same bytes when calls share the work, on any executor and after an
interruption.
"""

import multiprocessing
import shutil
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from support.expected_errors import assert_raises

from deepaccident_devkit import DeepAccident, __version__
from deepaccident_devkit.errors import ConfigError, NotAvailableError, ResultsError, SomeFailedError
from deepaccident_devkit.evaluation.results import ResultsTask, read_results
from deepaccident_devkit.plugins.baselines import Baseline, predict_results
from deepaccident_devkit.plugins.baselines.predict_results import is_predicted, samples_by_scenario
from deepaccident_devkit.v2x import Link

NOISY = Baseline(agents="+behind", link=Link(latency=0.1, pose_noise=0.2, seed=4))
FILE_NAMES: dict[ResultsTask, str] = {
    "motion": "motion",
    "accident": "accident.json",
    "detection": "detection.json",
}


@pytest.fixture(scope="module")
def tokens(da_b: DeepAccident) -> list[str]:
    """Return samples of four scenarios, two agents and two moments."""
    own = [
        sample["token"]
        for sample in da_b.sample
        if sample["labelled"] and sample["agent"] in ("ego_vehicle", "other_vehicle")
    ]
    runs = list(samples_by_scenario(Path("out"), own).values())
    return [token for run in runs[:4] for token in run if token.endswith(("2", "4"))]


@pytest.fixture(scope="module")
def complete_results(
    da_b: DeepAccident, tokens: list[str], tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """Return a folder with the results of all tasks, each written by one call."""
    folder = tmp_path_factory.mktemp("whole")
    for task, name in FILE_NAMES.items():
        predict_results(da_b, task, tokens, folder / name, NOISY, workers=1)
    return folder


def file_contents(path: Path) -> dict[str, bytes]:
    """Return the bytes of a results file, or of all files of a results folder."""
    paths = [path, *path.rglob("*")]
    return {
        file.relative_to(path.parent).as_posix(): file.read_bytes()
        for file in paths
        if file.is_file()
    }


@pytest.fixture
def predicted_tokens(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Record the predicted tokens, in order."""
    predicted: list[str] = []
    original = Baseline.predict

    def predict(self: Baseline, dataset: Any, task: ResultsTask, token: str) -> Any:
        predicted.append(token)
        return original(self, dataset, task, token)

    monkeypatch.setattr(Baseline, "predict", predict)
    return predicted


def patch_to_fail(token: str, error: BaseException) -> pytest.MonkeyPatch:
    """Let `Baseline.predict` fail at a sample until the patch is undone."""
    original, patch = Baseline.predict, pytest.MonkeyPatch()

    def predict(self: Baseline, dataset: Any, task: ResultsTask, sample: str) -> Any:
        if sample == token:
            raise error
        return original(self, dataset, task, sample)

    patch.setattr(Baseline, "predict", predict)
    return patch


def interrupt(call: Callable[[], object], token: str) -> None:
    """Interrupt a call at a sample, as Ctrl-C does."""
    patch = patch_to_fail(token, KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt):
        call()
    patch.undo()


@pytest.mark.parametrize("task", FILE_NAMES)
def test_several_calls_share_the_scenarios(
    da_b: DeepAccident,
    tokens: list[str],
    complete_results: Path,
    tmp_path: Path,
    predicted_tokens: list[str],
    task: ResultsTask,
) -> None:
    out = tmp_path / FILE_NAMES[task]
    with ThreadPoolExecutor(3) as threads:
        paths = threads.map(
            lambda _: predict_results(da_b, task, tokens, out, NOISY, workers=1), range(3)
        )
        assert list(paths) == [out] * 3
    assert sorted(predicted_tokens) == sorted(tokens)
    assert file_contents(out) == file_contents(complete_results / FILE_NAMES[task])
    assert [path.name for path in tmp_path.iterdir()] == [FILE_NAMES[task]]


def test_an_interrupted_call_loses_the_scenario_at_hand(
    da_b: DeepAccident,
    tokens: list[str],
    complete_results: Path,
    tmp_path: Path,
    predicted_tokens: list[str],
) -> None:
    out = tmp_path / "motion"
    call = partial(predict_results, da_b, "motion", tokens, out, NOISY, workers=1)
    interrupt(call, tokens[6])
    assert (predicted_tokens, out.exists()) == (tokens[:6], False)
    predicted_tokens.clear()
    call()
    assert predicted_tokens == tokens[4:]
    assert file_contents(out) == file_contents(complete_results / "motion")


def test_predictions_with_other_settings_or_samples_are_not_reused(
    da_b: DeepAccident, tokens: list[str], tmp_path: Path, predicted_tokens: list[str]
) -> None:
    out = tmp_path / "accident.json"
    for samples, baseline in ((tokens[:-1], NOISY), (tokens, Baseline()), (tokens, NOISY)):
        call = partial(predict_results, da_b, "accident", samples, out, baseline, workers=1)
        interrupt(call, samples[-1])
    predicted_tokens.clear()
    predict_results(da_b, "accident", tokens, out, NOISY, workers=1)
    assert predicted_tokens == tokens[-4:]
    assert [path.name for path in tmp_path.iterdir()] == ["accident.json"]


def test_scenarios_that_fail_are_listed_and_the_others_done(
    da_b: DeepAccident, tokens: list[str], complete_results: Path, tmp_path: Path
) -> None:
    out, scenario = tmp_path / "detection.json", tokens[6].rsplit("/", 2)[0]
    call = partial(predict_results, da_b, "detection", tokens, out, NOISY, workers=1)
    patch = patch_to_fail(tokens[6], ConfigError("no such day"))
    assert_raises((call, SomeFailedError, rf"1 of 4 failed:\n  {scenario}: no such day\n"))
    patch.undo()
    call()
    assert file_contents(out) == file_contents(complete_results / "detection.json")


def test_a_missing_agent_is_named_before_anything_is_written(
    tokens: list[str], tmp_path: Path, own_release: Path
) -> None:
    for folder in own_release.glob("**/other_vehicle_behind"):
        shutil.rmtree(folder)
    dataset = DeepAccident("v1", own_release, verbose=False)
    out = tmp_path / "out" / "accident.json"
    predict = partial(predict_results, dataset, "accident", tokens, out, Baseline(agents="all"))
    assert_raises((predict, NotAvailableError, "other_vehicle_behind is not in this release"))
    assert not out.parent.exists()


@pytest.mark.parametrize("task", FILE_NAMES)
def test_complete_results_stay_and_others_are_refused(
    da_b: DeepAccident,
    tokens: list[str],
    complete_results: Path,
    tmp_path: Path,
    predicted_tokens: list[str],
    task: ResultsTask,
) -> None:
    out, broken_results = complete_results / FILE_NAMES[task], tmp_path / FILE_NAMES[task]
    before = file_contents(out)
    assert is_predicted(da_b, task, tokens, out, NOISY)
    assert predict_results(da_b, task, tokens, out, NOISY) == out
    broken_results.mkdir()
    (broken_results / "results.json").write_bytes(b"{}")
    other_calls = (
        (out, tokens[1:], NOISY),
        (out, tokens[::-1], NOISY),
        (out, tokens, Baseline(agents="+behind")),
    )
    for path, samples, baseline in (*other_calls, (broken_results, tokens, NOISY)):
        call = partial(predict_results, da_b, task, samples, path, baseline)
        assert_raises((call, ResultsError, (f"{path}: already exists", "choose another path")))
    assert predicted_tokens == []
    assert file_contents(out) == before


def test_results_name_their_settings_and_release(
    da_b: DeepAccident, tokens: list[str], complete_results: Path
) -> None:
    recordings = da_b.recordings({token.rsplit("/", 2)[0] for token in tokens})
    release = {"version": "v1", "index": da_b.tables_folder.name, "recordings": recordings}
    meta = read_results(complete_results / "motion").meta
    assert meta.items() >= {**NOISY.meta(), "release": release, "devkit": __version__}.items()

    total_bytes = 0
    for token in tokens:
        earlier_token = token[:-1] + str(int(token[-1]) - 1)  # earlier by the latency
        sizes = da_b.message_sizes(earlier_token, agents="+behind", clouds=False)
        _, *partner_sizes = sizes.values()
        total_bytes += sum(size.boxes for size in partner_sizes)
    assert meta["bytes"]["mean"] == total_bytes / len(tokens)
    assert meta["bytes"]["partners"] == 1.0


def test_results_note_what_a_budget_lets_through(
    da_b: DeepAccident, tokens: list[str], tmp_path: Path
) -> None:
    def predict_bytes(name: str, baseline: Baseline) -> dict[str, Any]:
        path = tmp_path / name
        predict_results(da_b, "detection", tokens, path, baseline, workers=1)
        assert is_predicted(da_b, "detection", tokens, path, baseline)
        return read_results(path).meta["bytes"]

    single = predict_bytes("single.json", Baseline(agents="single", link=None))
    unlimited = predict_bytes("all.json", Baseline(agents="all", link=None))
    features_link = Link(budget=1_000_000, payload=400_000)
    features = predict_bytes("features.json", Baseline(agents="all", link=features_link))
    tiny_link = Link(budget=1, payload="boxes")
    nothing = predict_bytes("none.json", Baseline(agents="all", link=tiny_link))

    assert (single["mean"], single["partners"], single["payload"]) == (0.0, 0.0, "boxes")
    assert (unlimited["partners"], unlimited["link"]) == (4.0, unlimited["mean"] / 4)
    assert features == {
        "payload": 400_000,
        "mean": 800_000.0,
        "link": 400_000.0,
        "partners": 2.0,
        "budget": 1_000_000,
        "samples": 16,
    }
    assert nothing == {**single, "budget": 1}


def test_a_token_that_comes_twice_is_refused_at_once(
    da_b: DeepAccident, tokens: list[str], tmp_path: Path, predicted_tokens: list[str]
) -> None:
    call = partial(
        predict_results, da_b, "accident", [*tokens, tokens[3]], tmp_path / "out", workers=1
    )
    assert_raises((call, ResultsError, (f"{tokens[3]}: appears twice", "give each sample once")))
    assert not predicted_tokens


@pytest.mark.slow
def test_another_executor_writes_the_same(
    da_b: DeepAccident, tokens: list[str], complete_results: Path, tmp_path: Path
) -> None:
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as executor:
        for task, name in FILE_NAMES.items():
            path = predict_results(da_b, task, tokens, tmp_path / name, NOISY, executor=executor)
            assert file_contents(path) == file_contents(complete_results / name)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(FILE_NAMES.values())
