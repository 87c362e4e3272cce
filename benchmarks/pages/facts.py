"""What others measured of the real release, beside a synthetic one without sensors, or beside a
release given.
"""

import tempfile
from pathlib import Path

from benchmarks.pages.marks import put, table
from deepaccident_devkit import DeepAccident
from deepaccident_devkit.plugins.synth import SynthConfig, make_release
from deepaccident_devkit.statistics import ReleaseFacts, release_facts

RELEASE = SynthConfig(scenarios=180, frames=None, seed=5, sensors=False)


def main(release: Path | None) -> None:
    """Measure, and write the table into docs/synth.md; without a release, some ten minutes."""
    with tempfile.TemporaryDirectory() as folder:
        root = release or make_release(Path(folder) / "release", RELEASE, workers=2)
        report = release_facts(
            DeepAccident(dataroot=root, index_dir=Path(folder) / "index", verbose=False)
        )
    put("facts", page_text(report))


def page_text(report: ReleaseFacts) -> str:
    """The rows that others measured, as Markdown."""
    rows = [fact.texts() for fact in report.facts if fact.source]
    head = ("fact", "others", f"here, {report.scenarios} scenarios", "verdict")
    return f"\n{table(head, ((name, others, here, verdict) for name, _, others, here, _, verdict in rows))}\n"  # noqa: E501
