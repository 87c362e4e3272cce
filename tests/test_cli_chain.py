"""From nothing to checked numbers with only the command line; each step is its own process."""

import json
import re
from pathlib import Path

import pytest
from support.command_calls import run_command

pytestmark = pytest.mark.slow

PROTOCOLS = {
    ("motion", "motion"): "released",
    ("accident", "motion"): "released",
    ("accident", "accident.json"): "boxes",
    ("detection", "detection.json"): "paper",
}
"""Task and name of the results → protocol."""


def run_and_read(*words: object) -> str:
    return run_command(*words).stdout


@pytest.fixture(scope="module")
def release(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("chain") / "release"
    run_and_read("synth", root, "--scenarios", 2, "--frames", 25, "--sensors", "none", "--seed", 12)
    return root


@pytest.fixture(scope="module")
def folder(release: Path) -> Path:
    """A folder with the predictions of a single vehicle and of five agents, and for bundles."""
    folder = release.parent
    run_and_read(
        "labels", release, "--split", "train", "--samples", "evaluate", "--out", folder / "labels"
    )
    for agents in ("single", "all"):
        command = ("predict", "constant_velocity", release, "--split", "train")
        run_and_read(*command, "--agents", agents, "--out", folder / agents)
    return folder


@pytest.mark.parametrize("name", ["motion", "accident.json", "detection.json"])
def test_results_are_valid_and_of_the_split(release: Path, folder: Path, name: str) -> None:
    output = run_and_read(
        "check", "results", folder / "all" / name, "--dataroot", release, "--split", "train"
    )
    assert "all 20 samples have a prediction, and no others do" in output


@pytest.mark.parametrize(
    ("task", "name", "protocol"),
    [(task, name, protocol) for (task, name), protocol in PROTOCOLS.items()],
)
def test_each_evaluation_is_verified(
    release: Path, folder: Path, task: str, name: str, protocol: str
) -> None:
    out = folder / f"{task}_{name}_{protocol}"
    results = ("--results", folder / "all" / name)
    options = ("--split", "train", "--protocol", protocol, "--out", out, "--resamples", 0)

    output = run_and_read("evaluate", task, release, *results, *options)

    assert f"{task}, protocol {protocol}" in output
    summary = json.loads((out / "metrics_summary.json").read_text())
    assert (summary["task"], summary["protocol"]) == (task, protocol)
    assert summary["counts"]["samples"] == 20
    assert (out / "report.html").stat().st_size > 50_000
    output = run_and_read("check", "bundle", out, "--dataroot", release, *results)
    assert "all numbers are equal" in output


def test_five_agents_are_compared_with_one(release: Path, folder: Path) -> None:
    bundles = [folder / f"compared_{agents}" for agents in ("single", "all")]
    for agents, bundle in zip(("single", "all"), bundles, strict=True):
        results = folder / agents / "motion"
        options = ("--split", "train", "--out", bundle, "--resamples", 0)
        run_and_read("evaluate", "motion", release, "--results", results, *options)

    path = folder / "compared.json"
    output = run_and_read("evaluate", "compare", *bundles, "--out", path)

    assert "motion prediction, protocol: released code; 20 samples of 1 scenario" in output
    rows = json.loads(path.read_text())["numbers"]
    (panoptic_quality,) = [row for row in rows if row["number"] == "ranges/100x100/pq"]
    assert panoptic_quality["b"] > panoptic_quality["a"]


def test_accuracy_is_shown_over_bytes(release: Path, folder: Path) -> None:
    """The ego receives no messages, the ones that fit into a budget, or all."""
    command = ("predict", "constant_velocity", release, "--split", "train", "--task", "accident")
    run_and_read(*command, "--agents", "all", "--budget", 1500, "--out", folder / "some")
    bundles = [folder / f"accuracy_{agents}" for agents in ("single", "some", "all")]
    for agents, bundle in zip(("single", "some", "all"), bundles, strict=True):
        results = folder / agents / "accident.json"
        options = ("--split", "train", "--protocol", "boxes", "--resamples", 20, "--out", bundle)
        output = run_and_read("evaluate", "accident", release, "--results", results, *options)
        report = (bundle / "report.html").read_text(encoding="utf-8")
        sent = r"none" if agents == "single" else r"\d[\d,]* bytes per .* partners, payload boxes"
        assert re.search(rf"^ +communication +{sent}$", output, re.MULTILINE)
        assert re.search(rf">communication<[^>]*><\w+>{sent}<", report)
        summary = json.loads((bundle / "metrics_summary.json").read_text())
        assert summary["results"]["meta"]["bytes"]["samples"] == 20

    png, pdf, csv, points_json = paths = [
        folder / f"over.{kind}" for kind in ("png", "pdf", "csv", "json")
    ]
    options = ("--style", "cvpr-page", "--resamples", 20)
    outs = [word for path in paths for word in ("--out", path)]
    output = run_and_read("evaluate", "compare", *bundles, *options, *outs)

    assert "\n".join(f"wrote {path}" for path in paths) in output
    assert png.read_bytes()[1:4] == b"PNG"
    assert pdf.read_bytes()[:4] == b"%PDF"
    points = json.loads(points_json.read_text())["points"]
    num_bytes = {point["evaluation"]: point["bytes"] for point in points}
    assert num_bytes["accuracy_single"] == 0 < num_bytes["accuracy_some"] <= 1500
    assert num_bytes["accuracy_all"] > 1500
    assert csv.read_text().count("\n") == len(points) + 1
