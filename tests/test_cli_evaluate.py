"""`deepaccident evaluate`, end to end: results in, numbers out, checked and compared again."""

import json
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result
from refusals import assert_refused
from report_page import page_of

from deepaccident_devkit import DeepAccident, taxonomy
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.errors import ChoiceError, EvaluationError, ResultsError
from deepaccident_devkit.evaluation import Accident, DetectedBoxes, accident_context, instances_of
from deepaccident_devkit.evaluation.results import ResultsWriter
from deepaccident_devkit.evaluation.runs import SampleSelection, evaluate_results, read_bundle, save_run
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup

pytestmark = pytest.mark.slow

AGENTS = ("ego_vehicle", "infrastructure")
LISTED = ("--samples", "evaluate", "--scope", "all", "--resamples", "0")
LIST = ("--split", "train", "--agents", ",".join(AGENTS), "--resamples", "0")


def evaluate(*arguments: object, status: int = 0) -> Result:
    """Run the verb in this process; errors of the library come through."""
    words = ["evaluate", *map(str, arguments)]
    result = CliRunner().invoke(deepaccident, words, catch_exceptions=False)
    assert result.exit_code == status, result.output
    return result


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "deepaccident_devkit.cli", "evaluate", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder for what several tests read; with a blank in its name."""
    return tmp_path_factory.mktemp("evaluate") / "my results"


@pytest.fixture(scope="module")
def tokens(da_motion: DeepAccident) -> list[str]:
    return [token for token in da_motion.evaluation_samples("train") if token.split("/")[2] in AGENTS]


def write_accidents(dataset: DeepAccident, path: Path, tokens: Iterable[str], moved: float = 0.1) -> Path:
    with ResultsWriter(path, "accident") as writer:
        for token in tokens:
            truth = accident_context(dataset, token, 2.0).truth
            true = None if truth is None else truth.accident
            alarms = [] if true is None else [Accident(positions=true.positions + moved, time=true.time, ids=true.ids)]
            writer.add(token, alarms)
    return path


def write_motion(dataset: DeepAccident, path: Path, tokens: Iterable[str], moved: int = 0) -> Path:
    with ResultsWriter(path, "motion", meta={"method": "<b>moved</b>"}) as writer:
        for token in tokens:
            label = dataset.motion_labels(token).to_present("bilinear")
            writer.add(token, instances_of(np.roll(label.instance, moved, axis=2), label.config.grid))
    return path


def write_boxes(dataset: DeepAccident, path: Path, tokens: Iterable[str]) -> Path:
    with ResultsWriter(path, "detection") as writer:
        for token in tokens:
            there = dataset.boxes(token)
            writer.add(token, DetectedBoxes(boxes=there, scores=np.linspace(0.1, 1, len(there))))
    return path


@pytest.fixture(scope="module")
def accidents(da_motion: DeepAccident, folder: Path, tokens: list[str]) -> Path:
    """The true accidents, moved a little."""
    return write_accidents(da_motion, folder / "accidents.json", tokens)


@pytest.fixture(scope="module")
def motion(da_motion: DeepAccident, folder: Path, tokens: list[str]) -> Path:
    """The labels as predictions, moved by a column."""
    return write_motion(da_motion, folder / "motion", tokens, moved=1)


@pytest.fixture(scope="module")
def boxes(da_motion: DeepAccident, folder: Path, tokens: list[str]) -> Path:
    """The true boxes."""
    return write_boxes(da_motion, folder / "boxes.json", tokens)


@pytest.fixture(scope="module")
def bundle(da_motion: DeepAccident, folder: Path, accidents: Path) -> Path:
    """An evaluation with all that there is."""
    out = folder / "bundle"
    evaluate(
        *("accident", da_motion.dataroot, "--results", accidents, *LIST, "--protocol", "boxes", "--out", out),
        *("--sanity", "--include-results"),
    )
    return out


@pytest.mark.parametrize(
    ("task", "results", "protocol", "headline"),
    [
        ("motion", "motion", "released", "iou 30x30"),
        ("motion", "motion", "paper", "iou 30x30"),
        ("accident", "motion", "released", "apa"),
        ("accident", "motion", "paper", "apa"),
        ("accident", "motion", "boxes", "average_precision"),
        ("accident", "accidents", "boxes", "average_precision"),
        ("accident", "accidents", "paper", "apa"),
        ("detection", "boxes", "released", "mAP"),
        ("detection", "boxes", "paper", "mAP"),
        ("detection", "boxes", "opencood", "mAP"),
        ("warning", "accidents", "clean", "auc_ahead ego_involved"),
        ("warning", "accidents", "field", "AP ustring ego_involved"),
    ],
)
def test_every_task_and_protocol(
    da_motion: DeepAccident, request: pytest.FixtureRequest, task: str, results: str, protocol: str, headline: str
) -> None:
    path = request.getfixturevalue(results)
    words = (task, da_motion.dataroot, "--results", path, *LIST, "--protocol", protocol, "--samples", "evaluate")
    text = evaluate(*words, "--scope", "accident").output
    assert f"{task}, protocol {protocol}" in text
    assert "samples      8 of 1 scenarios: split train" in text
    assert f"\n  {headline} " in text
    assert "PARTIAL" not in text


def test_a_bundle_with_all_there_is(bundle: Path, accidents: Path, da_motion: DeepAccident) -> None:
    names = {path.name for path in bundle.iterdir()}
    assert names == {
        *("metrics_summary.json", "counts.json", "samples.parquet", "scenarios.json", "files.json"),
        *("report.html", "figures", "results"),
    }
    summary = read_bundle(bundle).summary
    assert summary["sanity"]["samples"] == 8
    assert summary["release"]["dataroot"] == str(da_motion.dataroot)
    assert (bundle / "results" / accidents.name).read_bytes() == accidents.read_bytes()
    assert not bundle.with_name("bundle.unfinished").exists()


def test_several_processes_write_one_evaluation(
    da_motion: DeepAccident, accidents: Path, bundle: Path, tmp_path: Path
) -> None:
    words = ("accident", da_motion.dataroot, "--results", accidents, *LIST, "--protocol", "boxes")
    words = (*words, "--sanity", "--include-results", "--out", tmp_path / "out")
    line = [sys.executable, "-m", "deepaccident_devkit.cli", "evaluate", *map(str, words)]
    running = [subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) for _ in range(2)]
    told = [process.communicate(timeout=300) for process in running]
    if all(process.returncode == 0 for process in running):  # else one began when all was done
        assert all("samples      8 of 1 scenarios: split train" in printed for printed, _ in told)
    else:
        assert any("holds an evaluation; pass overwrite=True" in errors for _, errors in told), told
    names = [path.relative_to(bundle) for path in bundle.rglob("*") if path.is_file()]
    assert Path("report.html") in names
    for name in names:
        assert (tmp_path / "out" / name).read_bytes() == (bundle / name).read_bytes(), name
    assert [each.name for each in tmp_path.iterdir()] == ["out"]


def test_json_is_the_summary(da_motion: DeepAccident, accidents: Path, tmp_path: Path) -> None:
    words = ("accident", da_motion.dataroot, "--results", accidents, *LIST, "--protocol", "boxes")
    done = evaluate(
        *words, "--by", "town", "--switch", "reading.danger_distance=0.5", "--json", "--out", tmp_path / "b"
    )
    summary = json.loads(done.stdout)
    assert list(summary["breakdowns"]) == ["all", "town"]
    assert summary["switches"] == {"reading.danger_distance": 0.5}
    assert summary == read_bundle(tmp_path / "b").summary
    assert f"written: {tmp_path / 'b'}" in done.stderr


@pytest.mark.parametrize(
    ("task", "protocol", "write", "line"),
    [
        ("motion", "released", write_motion, "iou 100x100 100.00 %"),
        ("accident", "boxes", write_accidents, "apa 1.000"),
        ("detection", "released", write_boxes, "AP car 97.22 %"),
        ("warning", "clean", write_accidents, "recall ego_involved 1.000"),
    ],
)
def test_a_partial_download_is_evaluated_and_its_report_has_pictures(
    da_partial: DeepAccident, tmp_path: Path, task: str, protocol: str, write: Callable[..., Path], line: str
) -> None:
    """The truth of the agents that are there is a perfect prediction (the released AP is 97.22 %, then)."""
    tokens = da_partial.evaluation_samples("val", "paper", scope="all")
    assert {token.split("/")[2] for token in tokens} == set(taxonomy.AGENTS) - {"other_vehicle_behind"}
    results = write(da_partial, tmp_path / "results", tokens)
    words = (task, da_partial.dataroot, "--results", results, "--split", "val", "--protocol", protocol)
    text = evaluate(*words, *LISTED, "--sanity", "--out", tmp_path / "bundle").stdout
    assert "samples      8 of 2 scenarios: split val" in text
    assert f" {line} " in " ".join(text.split())
    report = page_of(tmp_path / "bundle" / "report.html")
    assert len(report.all("img")) >= 2
    assert line.split(maxsplit=1)[0] in report.text


class TestPartial:
    def test_refused_unless_allowed_and_marked_everywhere(
        self, da_motion: DeepAccident, tokens: list[str], tmp_path: Path
    ) -> None:
        some = write_accidents(da_motion, tmp_path / "some.json", tokens[3:])
        words = ("accident", da_motion.dataroot, "--results", some, *LIST, "--protocol", "boxes")
        failed = run(*words, "--out", tmp_path / "bundle")
        assert failed.returncode == 2
        assert "3 of 8 samples have no prediction" in failed.stderr
        assert "--allow-partial" in failed.stderr
        assert not list(tmp_path.glob("bundle*"))
        text = evaluate(*words, "--allow-partial", "--sanity", "--out", tmp_path / "bundle").stdout
        titles = [block.splitlines()[0] for block in text.split("\n\n")]
        assert len(titles) > 4
        assert all("PARTIAL: 5 of 8 samples" in title for title in titles)
        assert "PARTIAL: 5 of 8 samples" in (tmp_path / "bundle" / "report.html").read_text(encoding="utf-8")


class TestVerify:
    def test_the_same(self, bundle: Path, da_motion: DeepAccident) -> None:
        done = run("verify", bundle, "--dataroot", da_motion.dataroot, "--on-error", "skip")
        assert (done.returncode, "the same; 8 samples evaluated again" in done.stdout) == (0, True), done.stderr

    def test_differences(self, bundle: Path, da_motion: DeepAccident) -> None:
        words = ("verify", bundle, "--dataroot", da_motion.dataroot)
        path = bundle / "metrics_summary.json"
        before = path.read_text()
        summary = json.loads(before)
        summary["metrics"]["apa"] = 0.5
        path.write_text(json.dumps(summary))
        try:
            assert "metrics_summary.json: metrics/apa: stored 0.5, found 1.0" in evaluate(*words, status=1).output
            stated = json.loads(evaluate(*words, "--json", status=1).stdout)
            changed = [each["where"] for each in stated["differences"]]
            assert changed == ["files.json: metrics_summary.json", "metrics_summary.json: metrics/apa"]
        finally:
            path.write_text(before)

    def test_no_bundle_and_no_release(self, bundle: Path, tmp_path: Path) -> None:
        for words in (("verify", tmp_path), ("verify", bundle, "--dataroot", tmp_path / "nowhere")):
            failed = run(*words)
            assert (failed.returncode, failed.stderr.startswith("error: ")) == (2, True)

    def test_paths_in_a_bundle_are_to_be_repeated(self, bundle: Path, da_motion: DeepAccident) -> None:
        failed = run("verify", bundle)
        command = f"deepaccident evaluate verify {shlex.quote(str(bundle))} --dataroot {da_motion.dataroot}\n"
        assert (failed.returncode, failed.stderr.count("\n"), failed.stderr.endswith(command)) == (2, 1, True)

    def test_nothing_is_written_into_the_release(
        self, bundle: Path, da_motion: DeepAccident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        copied = tmp_path / "release"
        shutil.copytree(da_motion.dataroot, copied, ignore=shutil.ignore_patterns(".deepaccident"))
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
        before = sorted(copied.rglob("*"))
        assert "the same" in evaluate("verify", bundle, "--dataroot", copied).output
        assert sorted(copied.rglob("*")) == before
        assert list((tmp_path / "cache").rglob("manifest.json"))
        shutil.rmtree(tmp_path / "cache")
        assert "the same" in evaluate("verify", bundle, "--dataroot", copied, "--index-dir", tmp_path / "index").output
        assert not (tmp_path / "cache").exists()
        DeepAccident(dataroot=copied, verbose=False)
        assert "the same" in evaluate("verify", bundle, "--dataroot", copied).output
        assert not (tmp_path / "cache").exists()


@pytest.fixture(scope="module")
def two(da_motion: DeepAccident, folder: Path) -> list[Path]:
    """Of two scenarios each; the second is worse."""
    made, selection = [], SampleSelection(split="train", scope="all", agents=AGENTS)
    for name, moved in (("a", 0.1), ("b", 1.0)):
        results = write_accidents(da_motion, folder / f"{name}.json", selection.tokens(da_motion), moved)
        setup = EvaluationSetup(task="accident", protocol="boxes")
        made.append(save_run(evaluate_results(da_motion, results, setup, selection, workers=1), folder / name))
    return made


class TestCompare:
    def test_text_and_files(self, two: list[Path], tmp_path: Path) -> None:
        for name in ("numbers.csv", "numbers.json"):
            picture = tmp_path / "differences.svg"
            out = ("--out", tmp_path / name, "--out", picture)
            text = evaluate("compare", *two, "--resamples", 20, *out).output
            # one cluster says nothing of others
            error = next(line.split() for line in text.splitlines() if line.startswith("position_error"))
            assert (error[2:5], error[-2:]) == (["0.283", "2.828", "+2.546"], ["are", "needed"])
            assert f"written: {tmp_path / name}\nwritten: {picture}" in text
            assert "<svg" in picture.read_text()
        stated = json.loads((tmp_path / "numbers.json").read_text())
        assert stated == json.loads(evaluate("compare", *two, "--resamples", 20, "--json").stdout)
        assert (tmp_path / "numbers.csv").read_text().count("\n") == len(stated["numbers"]) + 1

    def test_refused(self, two: list[Path], bundle: Path, tmp_path: Path) -> None:
        with pytest.raises(EvaluationError, match=r"samples only in .*; evaluate both at the same samples"):
            evaluate("compare", two[0], bundle)
        text = evaluate("compare", *two, "--out", tmp_path / "numbers.txt", status=2).output
        assert "--out: expected a file that ends in .csv, .json, .png" in text


class TestValidate:
    def test_tells_what_it_holds(self, motion: Path, accidents: Path, boxes: Path) -> None:
        for path, line in ((motion, "motion"), (accidents, "accident"), (boxes, "detection")):
            assert evaluate("check", path).stdout.startswith(f"results      {line}, {path}\n")

    def test_against_a_release(self, da_motion: DeepAccident, motion: Path) -> None:
        words = ("check", motion, "--dataroot", da_motion.dataroot, "--split", "train")
        good = evaluate(*words, "--agents", ",".join(AGENTS)).stdout
        assert good.endswith("all 8 samples have a prediction, and nothing else has\n")
        assert "12 of 20 samples have no prediction" in evaluate(*words, status=1).stdout

    def test_repeats_the_warnings_of_the_sanity_check(
        self, da_motion: DeepAccident, tmp_path: Path, tokens: list[str]
    ) -> None:
        with ResultsWriter(tmp_path / "empty.json", "accident") as writer:
            for token in tokens:
                writer.add(token, [])
        words = (da_motion.dataroot, "--results", tmp_path / "empty.json", *LIST, "--protocol", "boxes", "--sanity")
        told = [line for line in evaluate("accident", *words).stdout.splitlines() if line.startswith("WARNING: ")]
        assert "predictions looked at are empty" in told[0]
        release = ("--dataroot", da_motion.dataroot, *LIST[:-2])
        assert evaluate("check", tmp_path / "empty.json", *release).stdout.splitlines()[-len(told) :] == told

    def test_the_first_wrong_entry(self, accidents: Path, tmp_path: Path, tokens: list[str]) -> None:
        content = accidents.read_text().replace('"time":', '"tine":', 1)
        (tmp_path / "wrong.json").write_text(content)
        failed = run("check", tmp_path / "wrong.json")
        assert failed.returncode == 2
        assert "`tine`" in failed.stderr
        assert any(token in failed.stderr for token in tokens)


class TestRefused:
    @pytest.mark.parametrize(
        ("options", "error", "sentence"),
        [
            (("--switch", "gap=3"), ChoiceError, r"BoxAccidents has no switch 'gap'"),
            (
                ("--switch", "reading.danger_distance=high"),
                ChoiceError,
                r"switch danger_distance: expected a number, such as 1.0, found 'hi",
            ),
            (("--split", "nowhere"), ChoiceError, r"split: expected one of train, val"),
            (("--agents", "ego"), ChoiceError, r"--agents: expected one of ego_vehicle, .*did you mean 'ego_vehicle'"),
        ],
    )
    def test_choices(
        self, da_motion: DeepAccident, accidents: Path, options: tuple[str, ...], error: type[Exception], sentence: str
    ) -> None:
        with pytest.raises(error, match=sentence):
            evaluate("accident", da_motion.dataroot, "--results", accidents, *LIST, "--protocol", "boxes", *options)

    @pytest.mark.parametrize(
        ("options", "sentence"),
        [
            (("--switch", "reading.danger_distance"), "--switch: expected NAME=VALUE, found 'reading.danger_distance'"),
            (("--by", "wether"), "Invalid value for '--by'"),
            (("--protocol", "boxy"), "Invalid value for '--protocol'"),
        ],
    )
    def test_words(self, da_motion: DeepAccident, accidents: Path, options: tuple[str, ...], sentence: str) -> None:
        words = ("accident", da_motion.dataroot, "--results", accidents, *options)
        assert sentence in evaluate(*words, status=2).output

    def test_a_place_that_is_taken_before_the_release_is_read(self, accidents: Path, tmp_path: Path) -> None:
        (tmp_path / "thesis.tex").touch()
        with pytest.raises(ResultsError, match=r"is not empty and holds no evaluation"):
            evaluate("accident", tmp_path / "no release", "--results", accidents, "--out", tmp_path)


def test_an_operating_point_from_another_split(
    da_motion: DeepAccident, accidents: Path, bundle: Path, folder: Path
) -> None:
    """The release has one pair of twins; its evaluation stands for one of others once their names are changed."""
    out, samples = folder / "chooses", ("--samples", "evaluate", "--scope", "accident")
    words = ("warning", da_motion.dataroot, "--results", accidents, *LIST, *samples)
    evaluate(*words, "--out", out)
    assert_refused(
        (
            lambda: evaluate(*words, "--threshold-from", out),
            EvaluationError,
            r"or its twin, too; a threshold that is chosen on the recordings it is",
        ),
        (
            lambda: evaluate(*words, "--threshold-from", bundle),
            EvaluationError,
            "is an evaluation of accident boxes; expected one of warning, protocol",
        ),
    )
    scenarios = json.loads((out / "scenarios.json").read_text())
    others = {name.replace("_type001_", "_type009_"): each for name, each in scenarios["scenarios"].items()}
    (out / "scenarios.json").write_text(json.dumps(scenarios | {"scenarios": others}))
    printed = evaluate(*words, "--threshold-from", out, "--json").output
    summary = json.loads(printed[printed.index("{") :])
    stored = json.loads((out / "metrics_summary.json").read_text())["metrics"]["groups"]["ego_involved"]
    assert summary["switches"] == {"threshold": stored["best_f1"]}
    assert summary["metrics"]["operating_by"] == "given"


@pytest.fixture(scope="module")
def prevention(da_motion: DeepAccident, folder: Path) -> Path:
    """An evaluation of the true accidents over whole recordings, with the accidents that they would have prevented."""
    tokens = [token for token in da_motion.samples("train", "all") if token.split("/")[2] in AGENTS]
    results = write_accidents(da_motion, folder / "whole.json", tokens)
    words = ("warning", da_motion.dataroot, "--results", results, *LIST, "--prevented", "--include-results")
    text = evaluate(*words, "--out", folder / "prevention").output
    assert "\nprevented accidents\n  ego_involved, 1 s, 6 m/s²" in text
    assert "for another split: braking " in text
    return folder / "prevention"


def test_prevented_accidents_are_stored_shown_and_verified(prevention: Path, da_motion: DeepAccident) -> None:
    prevented = read_bundle(prevention).summary["prevented"]
    assert list(prevented["groups"]) == ["ego_involved", "infrastructure"]
    siren = prevented["references"]["always"]["ego_involved"]["right"]["0"]["1 s, 6 m/s²"]
    given = prevented["groups"]["ego_involved"]["right"]["0"]["1 s, 6 m/s²"]
    assert siren["shares"]["avoided"] >= given["shares"]["avoided"]
    assert siren["braking_seconds_per_minute"] > given["braking_seconds_per_minute"] == 0
    report = page_of(prevention / "report.html")
    assert "Prevented accidents" in report.text
    assert "random per frame, quiet" in report.text
    assert (prevention / "figures" / "prevention_ego_involved.png").is_file()
    words = ("verify", prevention, "--dataroot", da_motion.dataroot)
    assert "the same; " in evaluate(*words).output
    path = prevention / "metrics_summary.json"
    before = path.read_text()
    path.write_text(before.replace('"quiet_braking": 1.0', '"quiet_braking": 0.5'))
    try:
        assert "prevented/groups/ego_involved/quiet_braking: stored 0.5, found 1.0" in evaluate(*words, status=1).output
        path.write_text(json.dumps(json.loads(before) | {"prevented": {"groups": {}}}))
        assert "does not say how intervals were made" in evaluate(*words, status=1).output
    finally:
        path.write_text(before)


def test_a_threshold_of_little_braking_from_another_split(
    prevention: Path, da_motion: DeepAccident, folder: Path, tmp_path: Path
) -> None:
    other = tmp_path / "other"
    shutil.copytree(prevention, other)
    scenarios = json.loads((other / "scenarios.json").read_text())
    others = {name.replace("_type001_", "_type009_"): each for name, each in scenarios["scenarios"].items()}
    (other / "scenarios.json").write_text(json.dumps(scenarios | {"scenarios": others}))
    words = ("warning", da_motion.dataroot, "--results", folder / "whole.json", *LIST, "--threshold-from", other)
    words = (*words, "--threshold-by", "braking", "--prevented", "--json")
    printed = evaluate(*words).output
    summary = json.loads(printed[printed.index("{") :])
    assert summary["switches"] == {"threshold": 1.0}
    assert summary["prevented"]["operating_by"] == "given"
    assert not any("on these very recordings" in note for note in summary["prevented"]["notes"])
    stored = json.loads((other / "metrics_summary.json").read_text())
    del stored["prevented"]
    (other / "metrics_summary.json").write_text(json.dumps(stored))
    with pytest.raises(ResultsError, match="its summary has no prevented accidents; evaluate again with --prevented"):
        evaluate(*words)
