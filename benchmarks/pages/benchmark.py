"""The rows of docs/benchmark.md: `python -m benchmarks.pages.benchmark RELEASE` predicts, evaluates
and keeps them.

Each row is a folder of benchmarks/v1: `results.tar.xz`, and a bundle of each task without its
pictures, which `deepaccident check bundle` repeats. `python docs/make_tables.py benchmark` makes
the page's table of the bundles that are kept. With `--published RELEASE` what is published of the
release itself is written (`synth/benchmark.py`), with `--lock` the lock file.
"""

import json
import lzma
import shutil
import sys
import tempfile
from importlib.metadata import distributions
from pathlib import Path

from click.testing import CliRunner

from benchmarks.pages.marks import TOP, put, table
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.evaluation.runs.bundles import FILES_FILE, SUMMARY_FILE, checksums_of
from deepaccident_devkit.plugins.synth.benchmark import described_release

KEPT = TOP / "benchmarks" / "v1"
PUBLISHED = TOP / "deepaccident_devkit" / "plugins" / "synth" / "benchmark_v1.json.xz"
ROWS = {
    f"{model}_{agents}": (model, agents)
    for model in ("constant_velocity", "tiny", "tiny_lidar")
    for agents in ("single", "all")
}
"""Row → what predicts, and which agents cooperate."""
TASKS = {"motion": "motion", "accident": "motion", "detection": "detection.json"}
"""Task → its results."""
NUMBERS = {
    "IoU 30x30 (%)": ("motion", "ranges/30x30/iou", 1),
    "IoU 100x100 (%)": ("motion", "ranges/100x100/iou", 1),
    "VPQ 100x100 (%)": ("motion", "ranges/100x100/pq", 1),
    "APA": ("accident", "apa", 2),
    "mAP (%)": ("detection", "mean_average_precision", 1),
}
"""Column → task, path in the result, decimals."""


def run(*words: str) -> None:
    """Run a command of the devkit; raises SystemExit if it fails."""
    print(f"deepaccident {' '.join(words)}", flush=True)
    result = CliRunner().invoke(deepaccident, words, catch_exceptions=False)
    if result.exit_code:
        raise SystemExit(result.output)


def keep(release: Path, name: str) -> None:
    """Make a row: its results and its bundles."""
    model, agents = ROWS[name]
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder) / name
        run(
            "predict",
            model,
            str(release),
            "--agents",
            agents,
            "--split",
            "test",
            "--out",
            str(made / "results"),
        )
        round_numbers(made / "results" / TASKS["detection"])
        for task, results in TASKS.items():
            given = (
                "--results",
                str(made / "results" / results),
                "--split",
                "test",
                "--out",
                str(made / task),
            )
            run("evaluate", task, str(release), "--protocol", "paper", *given)
            slim(made / task)
        shutil.make_archive(str(made / "results"), "xztar", made, "results")
        shutil.rmtree(made / "results")
        kept = KEPT / name
        shutil.rmtree(kept, ignore_errors=True)
        shutil.copytree(made, kept)


def round_numbers(path: Path) -> None:
    """Write a JSON file anew with four decimals, which is half as much to keep."""
    told = json.loads(
        path.read_text(encoding="utf-8"), parse_float=lambda word: round(float(word), 4)
    )
    path.write_text(json.dumps(told, ensure_ascii=False, separators=(",", ":")), encoding="utf-8")


def slim(bundle: Path) -> None:
    """Remove a bundle's figures and report, and where its release and results were; its list of
    files says so.
    """
    shutil.rmtree(bundle / "figures", ignore_errors=True)
    (bundle / "report.html").unlink(missing_ok=True)
    told = json.loads((bundle / SUMMARY_FILE).read_text(encoding="utf-8"))
    told["release"]["dataroot"], told["results"]["path"] = "v1", "results"
    (bundle / SUMMARY_FILE).write_text(
        json.dumps(told, indent=1, ensure_ascii=False), encoding="utf-8"
    )
    listed = json.loads((bundle / FILES_FILE).read_text(encoding="utf-8"))
    listed["files"] = checksums_of(bundle)
    (bundle / FILES_FILE).write_text(json.dumps(listed, indent=1), encoding="utf-8")


def text(name: str, column: str) -> str:
    """A cell: a number with its interval."""
    task, path, digits = NUMBERS[column]
    told = json.loads((KEPT / name / task / SUMMARY_FILE).read_text(encoding="utf-8"))
    (value,) = [each["value"] for each in told["headlines"] if each["path"] == path]
    low, high = told["breakdowns"]["all"]["groups"][0]["intervals"][path]
    return f"{value:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


def main(_release: Path | None = None) -> None:
    """Write the page's table."""
    rows = [
        (f"`{name}`", *(text(name, column) for column in NUMBERS))
        for name in ROWS
        if (KEPT / name).is_dir()
    ]
    put("benchmark", table(("row", *NUMBERS), rows))


if __name__ == "__main__":
    what, *rest = sys.argv[1:]
    if what == "--lock":
        lines = sorted(
            f"{each.name}=={each.version}"
            for each in distributions()
            if each.name != "deepaccident_devkit"
        )
        (KEPT / "lock.txt").write_text(
            "\n".join([f"# Python {sys.version.split()[0]}", *lines, ""]), encoding="utf-8"
        )
    elif what == "--published":
        told = json.dumps(
            described_release(Path(rest[0]), progress=True), separators=(",", ":"), sort_keys=True
        )
        PUBLISHED.write_bytes(lzma.compress(told.encode(), preset=9))
    else:
        for name in rest or ROWS:
            keep(Path(what).resolve(), name)
