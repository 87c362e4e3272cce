"""Results of the baselines, shared, on any executor, and after an interruption: the very bytes of
one calm run.
"""

import multiprocessing
import shutil
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from refusals import assert_refused

from deepaccident_devkit import DeepAccident, __version__
from deepaccident_devkit.errors import ConfigError, NotAvailableError, ResultsError, SomeFailedError
from deepaccident_devkit.evaluation.results import ResultsTask, read_results
from deepaccident_devkit.plugins.baselines import Baseline, predict_results
from deepaccident_devkit.plugins.baselines.predict_results import is_predicted, samples_by_scenario
from deepaccident_devkit.v2x import Link

NOISY = Baseline(agents="+behind", link=Link(latency=0.1, pose_noise=0.2, seed=4))
NAMES: dict[ResultsTask, str] = {
    "motion": "motion",
    "accident": "accident.json",
    "detection": "detection.json",
}


@pytest.fixture(scope="module")
def tokens(da_b: DeepAccident) -> list[str]:
    """Of four scenarios, two agents and two moments."""
    every = [each["token"] for each in da_b.sample if each["labelled"]]
    own = [token for token in every if token.split("/")[2] in ("ego_vehicle", "other_vehicle")]
    runs = list(samples_by_scenario(Path("out"), own).values())
    return [token for run in runs[:4] for token in run if token.endswith(("2", "4"))]


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


def stopped_at(token: str, error: BaseException) -> pytest.MonkeyPatch:
    """A patch with which `Baseline.predict` fails at a sample."""
    original, patch = Baseline.predict, pytest.MonkeyPatch()

    def predict(self: Baseline, dataset: Any, task: ResultsTask, sample: str) -> Any:
        if sample == token:
            raise error
        return original(self, dataset, task, sample)

    patch.setattr(Baseline, "predict", predict)
    return patch


def interrupted(call: Callable[[], object], token: str) -> None:
    """A call that ends at a sample, as Ctrl-C ends it."""
    patch = stopped_at(token, KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt):
        call()
    patch.undo()


@pytest.mark.parametrize("task", NAMES)
def test_several_calls_share_the_scenarios(
    da_b: DeepAccident,
    tokens: list[str],
    wholes: Path,
    tmp_path: Path,
    predicted: list[str],
    task: ResultsTask,
) -> None:
    out = tmp_path / NAMES[task]
    with ThreadPoolExecutor(3) as threads:
        made = threads.map(
            lambda _: predict_results(da_b, task, tokens, out, NOISY, workers=1), range(3)
        )
        assert list(made) == [out] * 3
    assert (sorted(predicted), contents(out)) == (sorted(tokens), contents(wholes / NAMES[task]))
    assert [path.name for path in tmp_path.iterdir()] == [NAMES[task]]


def test_an_interrupted_call_loses_the_scenario_at_hand(
    da_b: DeepAccident, tokens: list[str], wholes: Path, tmp_path: Path, predicted: list[str]
) -> None:
    call = partial(predict_results, da_b, "motion", tokens, tmp_path / "motion", NOISY, workers=1)
    interrupted(call, tokens[6])
    assert (predicted, (tmp_path / "motion").exists()) == (tokens[:6], False)
    del predicted[:]
    call()
    assert (predicted, contents(tmp_path / "motion")) == (tokens[4:], contents(wholes / "motion"))


def test_what_was_predicted_with_other_settings_or_samples_is_not_taken(
    da_b: DeepAccident, tokens: list[str], tmp_path: Path, predicted: list[str]
) -> None:
    out = tmp_path / "accident.json"
    for samples, baseline in ((tokens[:-1], NOISY), (tokens, Baseline()), (tokens, NOISY)):
        interrupted(
            partial(predict_results, da_b, "accident", samples, out, baseline, workers=1),
            samples[-1],
        )
    del predicted[:]
    predict_results(da_b, "accident", tokens, out, NOISY, workers=1)
    assert (predicted, [path.name for path in tmp_path.iterdir()]) == (
        tokens[-4:],
        ["accident.json"],
    )


def test_scenarios_that_fail_are_listed_and_the_others_done(
    da_b: DeepAccident, tokens: list[str], wholes: Path, tmp_path: Path
) -> None:
    out, scenario = tmp_path / "detection.json", tokens[6].rsplit("/", 2)[0]
    call = partial(predict_results, da_b, "detection", tokens, out, NOISY, workers=1)
    patch = stopped_at(tokens[6], ConfigError("no such day"))
    assert_refused((call, SomeFailedError, rf"1 of 4 failed:\n  {scenario}: no such day\n"))
    patch.undo()
    call()
    assert contents(out) == contents(wholes / "detection.json")


def test_an_agent_that_is_not_there_is_named_before_anything_is_written(
    tokens: list[str], tmp_path: Path, own_release: Path
) -> None:
    for folder in own_release.glob("**/other_vehicle_behind"):
        shutil.rmtree(folder)
    out, every = tmp_path / "out" / "accident.json", Baseline(agents="all")
    predict = partial(
        predict_results,
        DeepAccident("v1", own_release, verbose=False),
        "accident",
        tokens,
        out,
        every,
    )
    assert_refused((predict, NotAvailableError, "other_vehicle_behind is not in this release"))
    assert not out.parent.exists()


@pytest.mark.parametrize("task", NAMES)
def test_complete_results_stay_and_others_are_refused(
    da_b: DeepAccident,
    tokens: list[str],
    wholes: Path,
    tmp_path: Path,
    predicted: list[str],
    task: ResultsTask,
) -> None:
    out, broken = wholes / NAMES[task], tmp_path / NAMES[task]
    before = contents(out)
    assert is_predicted(da_b, task, tokens, out, NOISY)
    assert predict_results(da_b, task, tokens, out, NOISY) == out
    broken.mkdir()
    (broken / "results.json").write_bytes(b"{}")
    others = (
        (out, tokens[1:], NOISY),
        (out, tokens[::-1], NOISY),
        (out, tokens, Baseline(agents="+behind")),
    )
    for path, samples, baseline in (*others, (broken, tokens, NOISY)):
        call = partial(predict_results, da_b, task, samples, path, baseline)
        assert_refused((call, ResultsError, (f"{path}: is there already", "choose another path")))
    assert (predicted, contents(out)) == ([], before)


def test_results_say_of_what_they_are(da_b: DeepAccident, tokens: list[str], wholes: Path) -> None:
    recordings = da_b.recordings({token.rsplit("/", 2)[0] for token in tokens})
    release = {"version": "v1", "index": da_b.tables_folder.name, "recordings": recordings}
    meta = read_results(wholes / "motion").meta
    assert meta.items() >= {**NOISY.meta(), "release": release, "devkit": __version__}.items()
    early = [token[:-1] + str(int(token[-1]) - 1) for token in tokens]  # by the latency
    sizes = [da_b.message_sizes(token, agents="+behind", clouds=False) for token in early]
    whole = sum(each.boxes for by_agent in sizes for each in list(by_agent.values())[1:])
    assert (meta["bytes"]["mean"], meta["bytes"]["partners"]) == (whole / len(tokens), 1.0)


def test_results_note_what_a_budget_lets_through(
    da_b: DeepAccident, tokens: list[str], tmp_path: Path
) -> None:
    sent = {}
    for name, agents, link in (
        ("single", "single", None),
        ("all", "all", None),
        ("features", "all", Link(budget=1_000_000, payload=400_000)),
        ("none", "all", Link(budget=1, payload="boxes")),
    ):
        baseline, path = Baseline(agents=agents, link=link), tmp_path / f"{name}.json"
        predict_results(da_b, "detection", tokens, path, baseline, workers=1)
        assert is_predicted(da_b, "detection", tokens, path, baseline)
        sent[name] = read_results(path).meta["bytes"]
    assert (sent["single"]["mean"], sent["single"]["partners"], sent["single"]["payload"]) == (
        0.0,
        0.0,
        "boxes",
    )
    assert (sent["all"]["partners"], sent["all"]["link"]) == (4.0, sent["all"]["mean"] / 4)
    features = {
        "payload": 400_000,
        "mean": 800_000.0,
        "link": 400_000.0,
        "partners": 2.0,
        "budget": 1_000_000,
    }
    assert sent["features"] == {**features, "samples": 16}
    assert sent["none"] == {**sent["single"], "budget": 1}


def test_a_token_that_comes_twice_is_refused_at_once(
    da_b: DeepAccident, tokens: list[str], tmp_path: Path, predicted: list[str]
) -> None:
    twice = partial(
        predict_results, da_b, "accident", [*tokens, tokens[3]], tmp_path / "out", workers=1
    )
    assert_refused((twice, ResultsError, (f"{tokens[3]}: comes twice", "give each sample once")))
    assert not predicted


@pytest.mark.slow
def test_another_executor_writes_the_same(
    da_b: DeepAccident, tokens: list[str], wholes: Path, tmp_path: Path
) -> None:
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as executor:
        for task, name in NAMES.items():
            path = predict_results(da_b, task, tokens, tmp_path / name, NOISY, executor=executor)
            assert contents(path) == contents(wholes / name)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(NAMES.values())
