"""From nothing to checked numbers by the command line alone: each step is a process of its own, as
a user has it.
"""

import json
from pathlib import Path

import pytest
from verbs import ran

pytestmark = pytest.mark.slow

TASKS = {
    ("motion", "motion"): "released",
    ("accident", "motion"): "released",
    ("accident", "accident.json"): "boxes",
    ("detection", "detection.json"): "paper",
}
"""Task and results → protocol."""


def told(*words: object) -> str:
    return ran(*words).stdout


@pytest.fixture(scope="module")
def release(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("chain") / "release"
    told("synth", root, "--scenarios", 2, "--frames", 25, "--sensors", "none", "--seed", 12)
    return root


@pytest.fixture(scope="module")
def folder(release: Path) -> Path:
    """Where a single vehicle's and five agents' predictions are, and what comes of them."""
    folder = release.parent
    told("labels", release, "--split", "train", "--samples", "evaluate", "--out", folder / "labels")
    for agents in ("single", "all"):
        told(
            "predict",
            "constant_velocity",
            release,
            "--split",
            "train",
            "--agents",
            agents,
            "--out",
            folder / agents,
        )
    return folder


@pytest.mark.parametrize("name", ["motion", "accident.json", "detection.json"])
def test_results_are_valid_and_of_the_split(release: Path, folder: Path, name: str) -> None:
    valid = told(
        "check", "results", folder / "all" / name, "--dataroot", release, "--split", "train"
    )
    assert "all 20 samples have a prediction, and nothing else has" in valid


@pytest.mark.parametrize(
    ("task", "name", "protocol"),
    [(task, name, protocol) for (task, name), protocol in TASKS.items()],
)
def test_each_evaluation_is_verified(
    release: Path, folder: Path, task: str, name: str, protocol: str
) -> None:
    out, results = folder / f"{task}_{name}_{protocol}", ("--results", folder / "all" / name)
    options = ("--split", "train", "--protocol", protocol, "--out", out, "--resamples", 0)
    assert f"{task}, protocol {protocol}" in told("evaluate", task, release, *results, *options)
    summary = json.loads((out / "metrics_summary.json").read_text())
    assert (summary["task"], summary["protocol"], summary["counts"]["samples"]) == (
        task,
        protocol,
        20,
    )
    assert (out / "report.html").stat().st_size > 50_000
    assert "all numbers are equal" in told("check", "bundle", out, "--dataroot", release, *results)


def test_five_agents_are_compared_with_one(release: Path, folder: Path) -> None:
    bundles = [folder / f"compared_{agents}" for agents in ("single", "all")]
    for agents, bundle in zip(("single", "all"), bundles, strict=True):
        options = (
            "--results",
            folder / agents / "motion",
            "--split",
            "train",
            "--out",
            bundle,
            "--resamples",
            0,
        )
        told("evaluate", "motion", release, *options)
    text = told("evaluate", "compare", *bundles, "--out", folder / "compared.json")
    assert "motion, protocol released: 20 samples of 1 scenario" in text
    numbers = {
        each["number"]: each
        for each in json.loads((folder / "compared.json").read_text())["numbers"]
    }
    assert numbers["ranges/100x100/pq"]["b"] > numbers["ranges/100x100/pq"]["a"]


def test_accuracy_is_shown_over_bytes(release: Path, folder: Path) -> None:
    """Of nobody, of those that fit into a budget, and of all."""
    words = (
        "predict",
        "constant_velocity",
        release,
        "--split",
        "train",
        "--task",
        "accident",
        "--agents",
        "all",
    )
    told(*words, "--budget", 1500, "--out", folder / "some")
    bundles = [folder / f"accuracy_{agents}" for agents in ("single", "some", "all")]
    for agents, bundle in zip(("single", "some", "all"), bundles, strict=True):
        options = (
            "--results",
            folder / agents / "accident.json",
            "--split",
            "train",
            "--out",
            bundle,
        )
        text = told(
            "evaluate", "accident", release, *options, "--protocol", "boxes", "--resamples", 20
        )
        assert "partners, payload boxes\n" in text
        assert "partners, payload boxes<" in (bundle / "report.html").read_text(encoding="utf-8")
        assert (
            json.loads((bundle / "metrics_summary.json").read_text())["results"]["meta"]["bytes"][
                "samples"
            ]
            == 20
        )
    files = [folder / f"over.{kind}" for kind in ("png", "pdf", "csv", "json")]
    outs = [word for path in files for word in ("--out", path)]
    text = told("evaluate", "compare", *bundles, "--style", "cvpr-page", "--resamples", 20, *outs)
    assert "\n".join(f"written: {path}" for path in files) in text
    assert (files[0].read_bytes()[1:4], files[1].read_bytes()[:4]) == (b"PNG", b"%PDF")
    points = json.loads(files[3].read_text())["points"]
    sizes = {each["evaluation"]: each["bytes"] for each in points}
    assert sizes["accuracy_single"] == 0 < sizes["accuracy_some"] <= 1500 < sizes["accuracy_all"]
    assert files[2].read_text().count("\n") == len(points) + 1
