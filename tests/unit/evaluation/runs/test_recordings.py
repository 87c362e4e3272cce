"""Results that note their recordings are refused by a release that has others under the same names."""

from pathlib import Path

from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ResultsError
from deepaccident_devkit.evaluation.results import Results, ResultsWriter, read_results
from deepaccident_devkit.evaluation.runs.setups import check_recordings, release_note


def results_of(dataset: DeepAccident, path: Path, note: object) -> Results:
    with ResultsWriter(path, "accident", meta={"release": note}) as writer:
        writer.add(dataset.sample[0]["token"], [])
    return read_results(path)


def test_other_recordings_of_the_same_names_are_refused(da_b: DeepAccident, own_release: Path, tmp_path: Path) -> None:
    first, second, *_ = tokens = [each["token"] for each in da_b.scenario]
    note = release_note(da_b, tokens)
    assert {*note["recordings"]} == {*tokens}
    assert len({*note["recordings"].values()}) == len(tokens)
    results = results_of(da_b, tmp_path / "whole.json", note)
    check_recordings(results, da_b)
    label = min(own_release.rglob(f"ego_vehicle/label/{da_b.scenario[0]['name']}/*_002.txt"))
    label.write_text("".join(label.read_text().splitlines(keepends=True)[:-1]))  # one box fewer
    other = DeepAccident("v1", own_release, verbose=False)
    assert_refused((lambda: check_recordings(results, other), ResultsError, (str(results.path), "1 of 6", first)))
    check_recordings(results_of(da_b, tmp_path / "second.json", release_note(da_b, [second])), other)


def test_what_is_not_known_is_not_compared(da_b: DeepAccident, tmp_path: Path) -> None:
    for number, note in enumerate(({}, None, "v1", {"version": "v1"}, {"recordings": {"elsewhere/x": "0"}})):
        check_recordings(results_of(da_b, tmp_path / f"{number}.json", note), da_b)
