"""Compare what others measured of the real release with a synthetic one without sensors, or with a
given release.
"""

from pathlib import Path

from benchmarks.measure import temporary_folder
from benchmarks.pages import synth
from deepaccident_devkit import DeepAccident
from deepaccident_devkit.plugins.synth import SynthConfig, make_release
from deepaccident_devkit.statistics import ReleaseFacts, release_facts

RELEASE = SynthConfig(scenarios=180, frames=None, seed=5, sensors=False)


def main(release: Path | None) -> None:
    """Measure, keep the facts in synth.json, and write the tables of docs/synth.md.

    Without a release this takes about ten minutes.
    """
    with temporary_folder() as folder:
        root = release or make_release(folder / "release", RELEASE, workers=2)
        index = folder / "index"
        dataset = DeepAccident(dataroot=root, index_dir=index, verbose=False)
        report = release_facts(dataset)
    content = synth.measured()
    content["facts"] = kept_facts(report)
    synth.save(content)


def kept_facts(report: ReleaseFacts) -> synth.MeasuredFacts:
    """Return the values of the facts that others measured on the real release."""
    values = {}
    for fact in report.facts:
        if fact.source and fact.here is not None:
            ends = None if fact.ends is None else list(fact.ends)
            values[synth.fact_name(fact)] = synth.MeasuredFact(
                here=fact.here, ends=ends, verdict=fact.verdict
            )
    return synth.MeasuredFacts(scenarios=report.scenarios, values=values)
