"""An accident of which no label shows both actors ends no evaluation: its samples are left out, and
told.
"""

import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from memory_results import MemoryResults

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.descriptions import describe
from deepaccident_devkit.evaluation import instances_of
from deepaccident_devkit.evaluation.predictions import Accident
from deepaccident_devkit.evaluation.results import ResultsWriter
from deepaccident_devkit.evaluation.runs import EvaluationRun, default_selection, evaluate_results
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup, SampleLoader
from deepaccident_devkit.evaluation.truth import UNPLACED_NOTE
from deepaccident_devkit.motion import MotionLabelConfig
from deepaccident_devkit.plugins.safety import avoidability_report, lead_time_ledger
from deepaccident_devkit.plugins.safety.prevention import prevention_evaluator
from deepaccident_devkit.plugins.synth import SynthConfig, make_release
from deepaccident_devkit.render.outcomes.above import difference_words
from deepaccident_devkit.render.outcomes.verdicts import sample_verdict
from deepaccident_devkit.statistics import dataset_statistics
from deepaccident_devkit.v2x.collisions import default_scenario

pytestmark = pytest.mark.slow

ALARM = Accident(positions=[[5.0, 0.0], [8.0, 0.0]], time=1.0, score=0.5)


CHANGES: dict[str, tuple[int, str, str | None]] = {
    "id 0": (3, "0", "ego none"),
    "in no label": (3, "424242", None),
    "one actor twice": (3, "", None),
    "a first line alone": (3, "0", ""),
}
"""Place in meta's first line, the actor there (the first one again), and its agents (no further
lines at all).
"""


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    config = SynthConfig(scenarios=4, frames=30, seed=5, sensors="none", unplanned=0, designed=True)
    return make_release(tmp_path_factory.mktemp("unplaced") / "release", config, workers=1)


@pytest.fixture(scope="module", params=CHANGES)
def unplaced(
    request: pytest.FixtureRequest, whole: Path, tmp_path_factory: pytest.TempPathFactory
) -> SimpleNamespace:
    """The release with such a meta file, and the token of its scenario."""
    root = Path(shutil.copytree(whole, tmp_path_factory.mktemp("unplaced") / "release"))
    meta = min(root.glob("*_accident/meta/*.txt"))
    line, *others = meta.read_text().split("\n")
    first = line.split()
    place, actor, agents = CHANGES[request.param]
    first[place] = actor or first[1]
    if agents is not None:
        others = [f" colliding agents: {agents}", *others[1:]] if agents else []
    meta.write_text("\n".join([" ".join(first), *others]))
    split = root / "mine.txt"
    split.write_text(
        "".join(
            f"{each.parents[1].name} {each.stem}\n" for each in sorted(root.glob("*/meta/*.txt"))
        )
    )
    dataset = DeepAccident("v1", root, verbose=False)
    return SimpleNamespace(
        dataset=dataset, token=f"{meta.parents[1].name}/{meta.stem}", split=str(split)
    )


def run_of(unplaced: SimpleNamespace, path: Path, task: Any, protocol: str) -> EvaluationRun:
    setup = EvaluationSetup(task=task, protocol=protocol)
    selection = default_selection(setup, unplaced.split, samples="all")
    with ResultsWriter(path, "accident") as writer:
        for token in selection.tokens(unplaced.dataset):
            writer.add(token, [ALARM])
    return evaluate_results(unplaced.dataset, path, setup, selection, workers=1)


SAMPLES = 5 * 6
"""Of a scenario: five agents, every half second of 3 s."""


def test_it_ends_no_evaluation_of_accidents(unplaced: SimpleNamespace, tmp_path: Path) -> None:
    boxes = run_of(unplaced, tmp_path / "boxes.json", "accident", "boxes").result
    # those from 2 s before the impact on
    assert (boxes.unplaced, boxes.at_impact, boxes.samples) == (5 * 5, 5, 4 * SAMPLES - 5 * 5 - 5)
    assert UNPLACED_NOTE.format(f"{boxes.unplaced} samples") in boxes.notes
    assert (
        run_of(unplaced, tmp_path / "paper.json", "accident", "paper").result.samples == 4 * SAMPLES
    )


def test_it_ends_no_evaluation_of_warnings_and_is_no_normal_scenario(
    unplaced: SimpleNamespace, tmp_path: Path
) -> None:
    clean, field = (
        run_of(unplaced, tmp_path / f"{protocol}.json", "warning", protocol)
        for protocol in ("clean", "field")
    )
    assert all(
        UNPLACED_NOTE.format(f"{SAMPLES} samples") in run.result.notes for run in (clean, field)
    )
    recordings = [each.recordings for each in clean.result.groups.values()]
    assert [sum(each[kind] for each in recordings) for kind in ("accident", "twins", "others")] == [
        5,
        10,
        0,
    ]
    prevented = prevention_evaluator(unplaced.dataset, clean.evaluator, workers=1).compute()
    assert [each.scenario for each in prevented.skipped] == [unplaced.token]


def test_maps_are_compared_with_maps_as_ever(unplaced: SimpleNamespace) -> None:
    dataset, token = unplaced.dataset, f"{unplaced.token}/ego_vehicle/020"
    label = dataset.motion_labels(token, MotionLabelConfig(protocol="released")).to_present(
        "bilinear"
    )
    results = cast(
        "Any", MemoryResults("motion", {token: instances_of(label.instance, label.config.grid)})
    )
    for protocol in ("released", "paper"):
        setup = EvaluationSetup(task="accident", protocol=protocol)
        evaluator = setup.evaluator()
        evaluator.update(token, *SampleLoader(dataset, results, setup)(token))
        assert evaluator.compute().samples == 1


def test_nothing_false_is_said(unplaced: SimpleNamespace) -> None:
    story = describe(unplaced.dataset, unplaced.token)
    twice = story.facts["partners"] is None
    words = (
        "collide in 2.9 s, but the labels do not show how",
        "two collide",
        " that no label shows",
    )
    assert [story.facts["collision"], *(each in story.text for each in words)] == [
        True,
        True,
        twice,
        not twice,
    ]
    assert default_scenario(unplaced.dataset) != unplaced.token  # the other accident can be shown
    verdict: Any = sample_verdict(
        unplaced.dataset, f"{unplaced.token}/ego_vehicle/020", [ALARM], protocol="boxes"
    )
    assert difference_words(verdict.compared).startswith(
        "an accident comes in 1.0 s that no label shows both actors of"
    )


def test_it_is_a_collision_everywhere(
    unplaced: SimpleNamespace, request: pytest.FixtureRequest
) -> None:
    """Found, counted, skipped by name."""
    dataset, token = unplaced.dataset, unplaced.token
    assert token in [scenario["token"] for scenario in dataset.find(collision=True)]
    assert dataset_statistics(dataset).histograms["collision_angles"].left_out.counts["total"] == 1
    twice = request.node.callspec.params["unplaced"] == "one actor twice"
    for report in (
        lead_time_ledger(dataset, [token], workers=1),
        avoidability_report(dataset, [token], workers=1),
    ):
        assert ["counterpart not recorded" in each.reason for each in report.skipped] == [not twice]
    assert all(
        [dataset.render_frame(f"{token}/030"), dataset.render_sample(f"{token}/ego_vehicle/030")]
    )
