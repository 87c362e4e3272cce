"""Bundles made again: they are the same, or every difference is named."""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from support.evaluation_runs import stored_run
from support.expected_errors import assert_raises
from support.generated_bundles import change_json

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import EvaluationError, ResultsError
from deepaccident_devkit.evaluation import Resampling
from deepaccident_devkit.evaluation.results import Results
from deepaccident_devkit.evaluation.runs import (
    EvaluationRun,
    SampleSelection,
    Verification,
    compare_bundles,
    default_selection,
    evaluate_results,
    save_run,
    verify_bundle,
)
from deepaccident_devkit.evaluation.runs.rows import read_rows, write_rows
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.evaluation.runs.verification import ABSENT_TEXT, find_differences
from deepaccident_devkit.support.reading import file_checksum

pytestmark = pytest.mark.slow

Write = Callable[..., Results]
CHANGED_SUMMARY = "files.json: metrics_summary.json"


@pytest.fixture
def bundle(run: EvaluationRun, tmp_path: Path) -> Path:
    broken_down = run.broken_down(["all", "agent"], Resampling(resamples=10))
    return save_run(broken_down, tmp_path / "bundle")


def verify(bundle: Path, dataset: DeepAccident, **options: Any) -> Verification:
    """Verify with the bundle's own copy of the results, or with the file beside the bundle."""
    results = None if (bundle / "results").exists() else bundle.with_name("accidents.json")
    return verify_bundle(bundle, dataset, workers=1, **{"results": results, **options})


def places_of(verification: Verification) -> list[str]:
    return [difference.where for difference in verification.differences]


def test_the_same_evaluation_has_no_differences(bundle: Path, da_b: DeepAccident) -> None:
    verification = verify(bundle, da_b)
    assert (verification.is_same, verification.samples, verification.notes) == (True, 6, ())
    assert verification.to_dict()["same"] is True


@pytest.mark.parametrize(
    ("task", "protocol"),
    [
        ("motion", "paper"),
        ("accident", "boxes"),
        ("detection", "opencood"),
        ("warning", "clean"),
        ("warning", "field"),
        ("planning", "clean"),
        ("planning", "uniad"),
        ("forecasting", "clean"),
    ],
)
def test_no_task_has_differences(
    da_b: DeepAccident, tmp_path: Path, task: str, protocol: str
) -> None:
    """Verify with groups, another horizon, and numbers that only some samples have."""
    setup = EvaluationSetup(task=task, protocol=protocol, horizon=0.5)
    selection = default_selection(setup, "val", agents=("ego_vehicle",), scope="all")
    run, results = stored_run(da_b, setup, tmp_path / "results", selection)
    broken_down = run.broken_down(("all", "agent"), Resampling(resamples=10))
    bundle = save_run(broken_down, tmp_path / "bundle")

    verification = verify(bundle, da_b, results=results)
    assert (verification.is_same, verification.differences) == (True, ())


def test_a_bundle_with_its_results_can_be_moved(
    run: EvaluationRun, tmp_path: Path, own_release: Path
) -> None:
    bundle = save_run(run, tmp_path / "bundle", include_results=True)
    moved_bundle = tmp_path / "moved"
    shutil.move(bundle, moved_bundle)
    (tmp_path / "accidents.json").unlink()

    moved_release = DeepAccident(dataroot=own_release, verbose=False)
    assert verify(moved_bundle, moved_release).is_same


def test_a_partial_evaluation_is_the_same(
    da_b: DeepAccident,
    selection: SampleSelection,
    tmp_path: Path,
    write_accidents: Write,
    run: EvaluationRun,
) -> None:
    results = write_accidents(tmp_path / "some.json", selection.tokens(da_b)[1:])
    part = evaluate_results(da_b, results, run.setup, selection, allow_partial=True, workers=1)
    assert verify(save_run(part, tmp_path / "bundle"), da_b, results=results).is_same


@pytest.mark.parametrize(
    ("path", "value", "differing_paths"),
    [
        ("metrics/apa", 0.99, ["metrics/apa"]),
        ("breakdowns/all/groups/0/metrics/apa", 1 - 1e-16, ["breakdowns/all/groups/0/metrics/apa"]),
        ("devkit_version", "0.0.9", ["devkit_version"]),
        ("environment/numpy", "1.0", []),
    ],
)
def test_another_value_of_the_summary_is_named(
    bundle: Path, da_b: DeepAccident, path: str, value: object, differing_paths: list[str]
) -> None:
    """Values are compared to the last bit; another numpy is a note."""

    def change(summary: Any) -> None:
        *keys, last_key = path.split("/")
        parent = summary
        for key in keys:
            parent = parent[int(key) if key.isdigit() else key]
        parent[last_key] = value

    change_json(bundle / "metrics_summary.json", change)
    verification = verify(bundle, da_b)

    places = [f"metrics_summary.json: {differing_path}" for differing_path in differing_paths]
    assert places_of(verification) == [CHANGED_SUMMARY, *places]

    numpy_note = "evaluated with numpy 1.0, verified with "
    has_numpy_note = any(numpy_note in note for note in verification.notes)
    assert has_numpy_note != bool(differing_paths)
    assert verification.samples == 6


@pytest.mark.parametrize("kind", ["label", "meta", "calib"])
def test_another_file_of_a_scenario_is_named(bundle: Path, own_release: Path, kind: str) -> None:
    """As long as the index does not know of the other file, there are no numbers to compare."""
    dataset = DeepAccident(dataroot=own_release, verbose=False)
    pattern = "val/*/meta/*.txt" if kind == "meta" else f"val/*/ego_vehicle/{kind}/*/*"
    path = min(own_release.glob(pattern))
    path.write_bytes(path.read_bytes() + b"\n")
    scenario = min(dataset.split_scenarios("val"))

    verification = verify(bundle, dataset)
    assert places_of(verification) == ["all numbers"]
    assert "the index is out of date" in verification.notes[0]

    reindexed = DeepAccident(dataroot=own_release, index_dir=own_release / "anew", verbose=False)
    assert places_of(verify(bundle, reindexed)) == [
        "metrics_summary.json: release/fingerprint",
        f"scenarios.json: {scenario}/{kind}",
    ]


def add_a_point(release: Path) -> None:
    """Add a LiDAR point to a box, as another processor may; the agent's own row stays."""
    path = min(release.glob("val/*/ego_vehicle/label/*/*_001.txt"))
    lines = path.read_text().split("\n")
    words = lines[-1].split(" ")
    words[11] = str(int(words[11]) + 1)
    lines[-1] = " ".join(words)
    path.write_text("\n".join(lines))


def make_bundle_of_devkit_1_0_0(bundle: Path) -> None:
    """Drop the hashes of boxes and points: devkit 1.0.0 kept only the hashes of whole files."""

    def drop_hashes(content: Any) -> None:
        for hashes in content["scenarios"].values():
            del hashes["boxes"], hashes["points"]

    path = bundle / "scenarios.json"
    change_json(path, drop_hashes)
    checksum = {path.name: file_checksum(path)}
    change_json(bundle / "files.json", lambda content: content["files"].update(checksum))


def test_labels_with_a_few_other_points_are_the_same(
    bundle: Path,
    own_release: Path,
    results: Results,
    run: EvaluationRun,
    selection: SampleSelection,
) -> None:
    add_a_point(own_release)
    dataset = DeepAccident(dataroot=own_release, verbose=False)
    assert verify(bundle, dataset).is_same

    other_run = evaluate_results(dataset, results, run.setup, selection, workers=1)
    other_bundle = save_run(other_run, bundle.with_name("other"))
    assert compare_bundles(bundle, other_bundle, Resampling(resamples=10)).samples == 6

    make_bundle_of_devkit_1_0_0(bundle)
    scenario = min(dataset.split_scenarios("val"))
    assert places_of(verify(bundle, dataset)) == [
        "metrics_summary.json: release/fingerprint",
        f"scenarios.json: {scenario}/label",
    ]
    with pytest.raises(EvaluationError, match="files differ in 1 scenario "):
        compare_bundles(bundle, other_bundle)


def test_a_bundle_of_devkit_1_0_0_verifies_and_compares(
    bundle: Path, da_b: DeepAccident, run: EvaluationRun
) -> None:
    new_bundle = save_run(run, bundle.with_name("new"))
    make_bundle_of_devkit_1_0_0(bundle)

    assert verify(bundle, da_b).is_same
    assert compare_bundles(bundle, new_bundle, Resampling(resamples=10)).samples == 6


def test_a_missing_scenario_leaves_no_numbers(bundle: Path, own_release: Path) -> None:
    for folder in own_release.glob("val/*_normal"):
        shutil.rmtree(folder)

    verification = verify(bundle, DeepAccident(dataroot=own_release, verbose=False))

    assert places_of(verification) == ["all numbers"]
    assert "3 predictions for samples that are not in this release" in verification.notes[0]
    assert verification.samples == 0


def test_a_scenario_missing_from_the_bundle_is_named(bundle: Path, da_b: DeepAccident) -> None:
    path = bundle / "scenarios.json"
    scenarios = json.loads(path.read_text())["scenarios"]
    missing = min(scenario for scenario in scenarios if "_normal/" in scenario)
    change_json(path, lambda content: content["scenarios"].pop(missing))

    assert places_of(verify(bundle, da_b)) == [
        "files.json: scenarios.json",
        f"scenarios.json: {missing}",
    ]


def test_other_results_are_named(
    bundle: Path, da_b: DeepAccident, results: Results, tmp_path: Path, write_accidents: Write
) -> None:
    other_results = write_accidents(tmp_path / "other.json", results.tokens, moved=1.0)
    places = places_of(verify(bundle, da_b, results=other_results.path))

    assert {location.split(": ")[0] for location in places} == {
        "metrics_summary.json",
        "counts.json",
        "samples.parquet",
    }
    assert "metrics_summary.json: results/fingerprint" in places


def test_other_counts_of_a_sample_are_named(bundle: Path, da_b: DeepAccident) -> None:
    path = bundle / "counts.json"
    token = min(json.loads(path.read_text())["counts"])
    change_json(path, lambda content: content["counts"][token].update(unjudged=7))

    assert places_of(verify(bundle, da_b)) == [
        "files.json: counts.json",
        f"counts.json: {token}/unjudged",
    ]


def test_other_and_missing_rows_are_named(bundle: Path, da_b: DeepAccident) -> None:
    rows, header = read_rows(bundle / "samples.parquet")
    rows[2]["tp_10m"] = 5
    write_rows(bundle / "samples.parquet", rows[:-1], header)

    assert places_of(verify(bundle, da_b)) == [
        "files.json: samples.parquet",
        f"samples.parquet: {rows[2]['token']}/tp_10m",
        f"samples.parquet: {rows[-1]['token']}",
    ]


def test_foreign_missing_and_damaged_files_are_named(bundle: Path, da_b: DeepAccident) -> None:
    (bundle / "mine.txt").touch()
    (bundle / "counts.json").unlink()
    (bundle / "samples.parquet").write_bytes(b"PAR1")
    (bundle / "scenarios.json").write_text("{}")
    assert places_of(verify(bundle, da_b)) == [
        "files.json: counts.json",
        "files.json: samples.parquet",
        "files.json: scenarios.json",
        "files.json: mine.txt",
        "scenarios.json",
        "counts.json",
        "samples.parquet",
    ]

    (bundle / "files.json").write_text("")
    assert places_of(verify(bundle, da_b))[0] == "files.json"


def test_counts_of_another_protocol_are_named(bundle: Path, da_b: DeepAccident) -> None:
    """With a smaller danger distance, the pairs that pass closely in the normal scenario are no
    accidents.
    """
    change_json(
        bundle / "metrics_summary.json",
        lambda summary: summary.update(switches={"reading.danger_distance": 0.5}),
    )
    counts = json.loads((bundle / "counts.json").read_text())["counts"]
    normal_tokens = [token for token in counts if "_normal" in token]

    places = places_of(verify(bundle, da_b))
    assert places[:2] == [
        CHANGED_SUMMARY,
        "metrics_summary.json: settings/choices/reading/danger_distance",
    ]
    assert {f"counts.json: {token}/named" for token in normal_tokens} < set(places)


@pytest.mark.parametrize(
    ("stored", "current", "expected"),
    [
        ({"a": 1, "b": [1, 2]}, {"b": [1, 2], "a": 1}, []),
        ({"a": 1}, {"a": 1.0}, [("a", 1, 1.0)]),
        ({"a": True}, {"a": 1}, [("a", True, 1)]),
        ({"a": {"b": [1, 2]}}, {"a": {"b": [1, 3]}}, [("a/b/1", 2, 3)]),
        ({"a": [1]}, {"a": [1, 2]}, [("a", [1], [1, 2])]),
        ({"a": 1}, {"b": 1}, [("a", 1, ABSENT_TEXT), ("b", ABSENT_TEXT, 1)]),
        ({"a": None}, {}, [("a", None, ABSENT_TEXT)]),
        ({"skip": 1, "keep": {"skip": 1}}, {"skip": 2, "keep": {"skip": 2}}, [("keep/skip", 1, 2)]),
    ],
)
def test_find_differences(stored: Any, current: Any, expected: list[tuple[str, Any, Any]]) -> None:
    assert list(find_differences(stored, current, without=["skip"])) == expected


def test_foreign_files_are_named_and_not_opened(
    bundle: Path, da_b: DeepAccident, tmp_path: Path
) -> None:
    os.mkfifo(bundle / "a pipe")
    (bundle / "loop").symlink_to("loop")
    (bundle / "a link").symlink_to(tmp_path)
    (bundle / "extra\x1b.bin").write_bytes(b"1")
    (bundle / "scenarios.json").rename(tmp_path / "scenarios.json")
    (bundle / "scenarios.json").symlink_to(tmp_path / "scenarios.json")
    with (bundle / "counts.json").open("r+b") as file:
        file.truncate(5 << 30)

    verification = verify(bundle, da_b)
    findings = {difference.where: difference.found for difference in verification.differences}
    assert findings["files.json: a pipe"] == "not a regular file (a named pipe)"
    assert findings["files.json: loop"] == findings["files.json: a link"] == "a link"
    assert findings["files.json: extra\x1b.bin"] == "a file that is not listed"
    assert "is a link, which is not followed" in findings["scenarios.json"]
    assert "has 5,368,709,120 bytes" in findings["counts.json"]
    assert "\x1b" not in verification.to_text()


@pytest.mark.parametrize(
    "name",
    ["metrics_summary.json", "files.json", "scenarios.json", "counts.json", "samples.parquet"],
)
def test_a_pipe_instead_of_a_file(bundle: Path, da_b: DeepAccident, name: str) -> None:
    (bundle / name).unlink()
    os.mkfifo(bundle / name)
    if name == "metrics_summary.json":
        assert_raises(
            (
                lambda: verify(bundle, da_b),
                ResultsError,
                r"metrics_summary.json: not a regular file \(a named pipe\)",
            ),
        )
    else:
        assert name in places_of(verify(bundle, da_b))


def test_paths_that_lead_out_are_opened_only_if_they_are_given(
    bundle: Path, da_b: DeepAccident, results: Results, tmp_path: Path
) -> None:
    command = f"check bundle {bundle} --dataroot {da_b.dataroot} --results {results.path}"
    assert_raises(
        (
            lambda: verify(bundle, da_b, results=None),
            ResultsError,
            f"are opened only if you give them: deepaccident {command}$",
        ),
    )

    split = tmp_path / "mine.txt"
    os.mkfifo(split)
    change_json(bundle / "metrics_summary.json", lambda summary: summary.update(split=str(split)))
    assert_raises(
        (lambda: verify(bundle, da_b), ResultsError, f"{command} --split {split}$"),
    )

    split.unlink()
    scenarios = sorted({token.rsplit("/", 2)[0] for token in results.tokens})
    lines = [scenario.replace("/", " ") for scenario in scenarios]
    split.write_text("\n".join([*lines, ""]))
    assert places_of(verify(bundle, da_b, split=split)) == [CHANGED_SUMMARY]


@pytest.mark.parametrize("kind", ["the folder", "the file", "a loop", "a pipe"])
def test_a_copy_of_the_results_that_leads_out_is_refused(
    run: EvaluationRun, da_b: DeepAccident, tmp_path: Path, kind: str
) -> None:
    bundle = save_run(run, tmp_path / "bundle", include_results=True)
    folder = bundle / "results"
    copy = folder / "accidents.json"
    if kind == "the folder":
        folder.rename(tmp_path / "moved")
        folder.symlink_to(tmp_path / "moved")
    elif kind == "the file":
        copy.rename(tmp_path / "elsewhere.json")
        copy.symlink_to(tmp_path / "elsewhere.json")
    elif kind == "a loop":
        copy.unlink()
        copy.symlink_to(copy)
    else:
        copy.unlink()
        os.mkfifo(copy)

    assert_raises(
        (
            lambda: verify(bundle, da_b),
            ResultsError,
            r"bundle: results(/accidents.json)? is (a link|not a regular file)",
        ),
    )


@pytest.mark.parametrize(
    "resampling",
    [
        {"resamples": 10**9},
        {"resamples": "9"},
        {"seed": -1},
        {"seed": []},
        {"confidence": "x"},
        {"depth": 1},
        {"seed": 0.5},
    ],
)
def test_counts_of_resamples_are_bounded(
    bundle: Path, da_b: DeepAccident, resampling: dict[str, Any]
) -> None:
    change_json(
        bundle / "metrics_summary.json",
        lambda summary: summary["breakdowns"]["all"].update(resampling=resampling),
    )
    assert "all numbers" in places_of(verify(bundle, da_b))


def test_missing_results_are_refused(bundle: Path, da_b: DeepAccident, results: Results) -> None:
    results.path.unlink()
    assert_raises(
        (lambda: verify(bundle, da_b), ResultsError, ("accidents.json", "no such file or folder"))
    )


def test_foreign_hashes_are_shown_as_plain_text(bundle: Path, da_b: DeepAccident) -> None:
    path = bundle / "scenarios.json"
    scenario = min(json.loads(path.read_text())["scenarios"])
    for points in ([10**400] * 8, [1], [None] * 8):
        hashes = {"label": "\u202e", "points": points}
        change_json(
            path, lambda content, hashes=hashes: content["scenarios"][scenario].update(hashes)
        )
        text = verify(bundle, da_b).to_text()
        assert "scenarios.json" in text
        assert "\u202e" not in text
