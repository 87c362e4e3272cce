"""Predict, evaluate and store the rows of docs/benchmark.md: `python -m benchmarks.pages.benchmark
RELEASE`.

Each row is a folder of benchmarks/v1: `results.tar.xz`, and a bundle of each task without its
pictures, which `deepaccident check bundle` repeats. `python docs/make_tables.py benchmark` makes
the page's table from the stored bundles. `--published RELEASE` writes what is published of the
release itself (`synth/benchmark.py`), `--lock` writes the lock file.
"""

import json
import lzma
import shutil
import sys
from importlib.metadata import distributions
from pathlib import Path

from click.testing import CliRunner

from benchmarks.measure import temporary_folder
from benchmarks.pages.marks import TOP, put, table
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.evaluation.runs.bundles import FILES_FILE, SUMMARY_FILE, checksums_of
from deepaccident_devkit.plugins.synth.benchmark import described_release

ROWS_FOLDER = TOP / "benchmarks" / "v1"
PUBLISHED = TOP / "deepaccident_devkit" / "plugins" / "synth" / "benchmark_v1.json.xz"
ROWS = {
    f"{model}_{agents}": (model, agents)
    for model in ("constant_velocity", "tiny", "tiny_lidar")
    for agents in ("single", "all")
}
"""Row → model, and agents that cooperate."""
TASKS = {"motion": "motion", "accident": "motion", "detection": "detection.json"}
"""Task → its results in the folder of results."""
NUMBERS = {
    "IoU, 100 m × 100 m (%)": ("motion", "ranges/100x100/iou", 1),
    "VPQ, 100 m × 100 m (%)": ("motion", "ranges/100x100/pq", 1),
    "APA": ("accident", "apa", 2),
    "mAP (%)": ("detection", "mean_average_precision", 1),
}
"""Column → task, path in the result, number of decimals."""


def run(*words: str) -> None:
    """Run a command of the devkit; raises SystemExit if it fails."""
    print(f"deepaccident {' '.join(words)}", flush=True)
    result = CliRunner().invoke(deepaccident, words, catch_exceptions=False)
    if result.exit_code:
        raise SystemExit(result.output)


def store_row(release: Path, name: str) -> None:
    """Make the results and the bundles of a row, and store them."""
    model, agents = ROWS[name]
    row = ROWS_FOLDER / name
    with temporary_folder() as folder:
        new_row = folder / name
        results = new_row / "results"
        split = ("--split", "test")
        run("predict", model, str(release), "--agents", agents, *split, "--out", str(results))
        round_numbers(results / TASKS["detection"])
        for task, file in TASKS.items():
            evaluation = ("evaluate", task, str(release), "--protocol", "paper")
            paths = ("--results", str(results / file), *split, "--out", str(new_row / task))
            run(*evaluation, *paths)
            slim_down(new_row / task)
        shutil.make_archive(str(results), "xztar", new_row, "results")
        shutil.rmtree(results)
        shutil.rmtree(row, ignore_errors=True)
        shutil.copytree(new_row, row)


def round_numbers(path: Path) -> None:
    """Write a JSON file again with four decimals, which halves its size."""
    text = path.read_text(encoding="utf-8")
    content = json.loads(text, parse_float=lambda number: round(float(number), 4))
    rounded = json.dumps(content, ensure_ascii=False, separators=(",", ":"))
    path.write_text(rounded, encoding="utf-8")


def slim_down(bundle: Path) -> None:
    """Remove a bundle's figures and report, and the places of its release and results; its list of
    files is updated.
    """
    shutil.rmtree(bundle / "figures", ignore_errors=True)
    (bundle / "report.html").unlink(missing_ok=True)
    summary_path = bundle / SUMMARY_FILE
    summary = json.loads(summary_path.read_text(encoding="utf-8"))
    summary["release"]["dataroot"] = "v1"
    summary["results"]["path"] = "results"
    summary_text = json.dumps(summary, indent=1, ensure_ascii=False)
    summary_path.write_text(summary_text, encoding="utf-8")
    files_path = bundle / FILES_FILE
    files = json.loads(files_path.read_text(encoding="utf-8"))
    files["files"] = checksums_of(bundle)
    files_path.write_text(json.dumps(files, indent=1), encoding="utf-8")


def text(name: str, column: str) -> str:
    """Return a cell of the page's table: a number with its interval."""
    task, path, digits = NUMBERS[column]
    summary_path = ROWS_FOLDER / name / task / SUMMARY_FILE
    summary = json.loads(summary_path.read_text(encoding="utf-8"))
    values = {headline["path"]: headline["value"] for headline in summary["headlines"]}
    low, high = summary["breakdowns"]["all"]["groups"][0]["intervals"][path]
    return f"{values[path]:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


def main(_release: Path | None = None) -> None:
    """Write the page's table."""
    rows = [
        (f"`{name}`", *(text(name, column) for column in NUMBERS))
        for name in ROWS
        if (ROWS_FOLDER / name).is_dir()
    ]
    put("benchmark", table(("row", *NUMBERS), rows))


def write_lock() -> None:
    """Write the installed packages into the lock file."""
    packages = [
        f"{package.name}=={package.version}"
        for package in distributions()
        if package.name != "deepaccident_devkit"
    ]
    lines = [f"# Python {sys.version.split()[0]}", *sorted(packages), ""]
    (ROWS_FOLDER / "lock.txt").write_text("\n".join(lines), encoding="utf-8")


def write_published(release: Path) -> None:
    """Write what is published of a release."""
    content = described_release(release, progress=True)
    compact = json.dumps(content, separators=(",", ":"), sort_keys=True)
    PUBLISHED.write_bytes(lzma.compress(compact.encode(), preset=9))


if __name__ == "__main__":
    mode, *arguments = sys.argv[1:]
    if mode == "--lock":
        write_lock()
    elif mode == "--published":
        write_published(Path(arguments[0]))
    else:
        for row_name in arguments or ROWS:
            store_row(Path(mode).resolve(), row_name)
