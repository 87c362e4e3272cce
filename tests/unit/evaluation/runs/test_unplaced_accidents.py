"""Accidents that no label shows both actors of: they end no evaluation; their samples are left out,
and a note counts them.
"""

import shutil
from collections import Counter
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from support.memory_results import MemoryResults

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
from deepaccident_devkit.render.outcomes.described import sample_drawing
from deepaccident_devkit.statistics import dataset_statistics
from deepaccident_devkit.v2x.collisions import default_scenario

pytestmark = pytest.mark.slow

ALARM = Accident(positions=[[5.0, 0.0], [8.0, 0.0]], time=1.0, score=0.5)


META_CHANGES: dict[str, tuple[int, str, str | None]] = {
    "id 0": (3, "0", "ego none"),
    "in no label": (3, "424242", None),
    "one actor twice": (3, "", None),
    "a first line alone": (3, "0", ""),
}
"""Index in meta's first line, the actor id there (empty: the first actor again), and the line of
colliding agents (None: as it was, empty: no further lines).
"""


@pytest.fixture(scope="module")
def whole_release(tmp_path_factory: pytest.TempPathFactory) -> Path:
    config = SynthConfig(scenarios=4, frames=30, seed=5, sensors="none", unplanned=0, designed=True)
    return make_release(tmp_path_factory.mktemp("unplaced") / "release", config, workers=1)


@pytest.fixture(scope="module", params=META_CHANGES)
def unplaced(
    request: pytest.FixtureRequest, whole_release: Path, tmp_path_factory: pytest.TempPathFactory
) -> SimpleNamespace:
    """Copy the release with a changed meta file; gives the token of its scenario, too."""
    root = Path(shutil.copytree(whole_release, tmp_path_factory.mktemp("unplaced") / "release"))
    meta = min(root.glob("*_accident/meta/*.txt"))
    first_line, *further_lines = meta.read_text().split("\n")
    words = first_line.split()
    index, actor, agents = META_CHANGES[request.param]
    words[index] = actor or words[1]
    if agents == "":
        further_lines = []
    elif agents is not None:
        further_lines[0] = f" colliding agents: {agents}"
    meta.write_text("\n".join([" ".join(words), *further_lines]))

    split_lines = []
    for path in sorted(root.glob("*/meta/*.txt")):
        split_lines.append(f"{path.parents[1].name} {path.stem}\n")

    split = root / "mine.txt"
    split.write_text("".join(split_lines))
    return SimpleNamespace(
        dataset=DeepAccident("v1", root, verbose=False),
        token=f"{meta.parents[1].name}/{meta.stem}",
        split=str(split),
    )


def evaluate_alarms(
    unplaced: SimpleNamespace, path: Path, task: Any, protocol: str
) -> EvaluationRun:
    """Evaluate the same alarm in every sample."""
    setup = EvaluationSetup(task=task, protocol=protocol)
    selection = default_selection(setup, unplaced.split, samples="all")
    with ResultsWriter(path, "accident") as writer:
        for token in selection.tokens(unplaced.dataset):
            writer.add(token, [ALARM])
    return evaluate_results(unplaced.dataset, path, setup, selection, workers=1)


SAMPLES_PER_SCENARIO = 5 * 6
"""Five agents, every half second of 3 s."""


def test_an_unplaced_accident_ends_no_evaluation_of_accidents(
    unplaced: SimpleNamespace, tmp_path: Path
) -> None:
    boxes = evaluate_alarms(unplaced, tmp_path / "boxes.json", "accident", "boxes").result
    left_out = 5 * 5  # five agents, every half second from 2 s before the impact on
    assert (boxes.unplaced, boxes.at_impact) == (left_out, 5)
    assert boxes.samples == 4 * SAMPLES_PER_SCENARIO - left_out - 5
    assert UNPLACED_NOTE.format(f"{boxes.unplaced} samples") in boxes.notes

    paper = evaluate_alarms(unplaced, tmp_path / "paper.json", "accident", "paper").result
    assert paper.samples == 4 * SAMPLES_PER_SCENARIO


def test_an_unplaced_accident_ends_no_evaluation_of_warnings(
    unplaced: SimpleNamespace, tmp_path: Path
) -> None:
    """It does not count as a normal scenario, either."""
    clean = evaluate_alarms(unplaced, tmp_path / "clean.json", "warning", "clean")
    field = evaluate_alarms(unplaced, tmp_path / "field.json", "warning", "field")
    note = UNPLACED_NOTE.format(f"{SAMPLES_PER_SCENARIO} samples")
    assert note in clean.result.notes
    assert note in field.result.notes

    recordings: Counter[str] = Counter()
    for group in clean.result.groups.values():
        recordings.update(group.recordings)

    assert (recordings["accident"], recordings["twins"], recordings["others"]) == (5, 10, 0)

    prevented = prevention_evaluator(unplaced.dataset, clean.evaluator, workers=1).compute()
    assert [scenario.scenario for scenario in prevented.skipped] == [unplaced.token]


def test_maps_are_compared_with_maps_as_usual(unplaced: SimpleNamespace) -> None:
    dataset = unplaced.dataset
    token = f"{unplaced.token}/ego_vehicle/020"
    labels = dataset.motion_labels(token, MotionLabelConfig(protocol="released"))
    label = labels.to_present("bilinear")
    output = instances_of(label.instance, label.config.grid)
    results: Any = MemoryResults("motion", {token: output})

    for protocol in ("released", "paper"):
        setup = EvaluationSetup(task="accident", protocol=protocol)
        evaluator = setup.evaluator()
        evaluator.update(token, *SampleLoader(dataset, results, setup)(token))
        assert evaluator.compute().samples == 1


def test_descriptions_and_verdicts_say_that_it_is_unplaced(unplaced: SimpleNamespace) -> None:
    story = describe(unplaced.dataset, unplaced.token)
    one_actor_twice = story.facts["partners"] is None
    assert story.facts["collision"] is True
    assert "collide in 2.9 s, but the labels do not show how" in story.text
    assert ("two collide" in story.text) == one_actor_twice
    assert (" that no label shows" in story.text) != one_actor_twice

    assert default_scenario(unplaced.dataset) != unplaced.token  # the other accident can be shown

    sample = f"{unplaced.token}/ego_vehicle/020"
    described = sample_drawing(unplaced.dataset, sample, [ALARM])
    assert "; collision in 1.0 s, but no label shows both actors" in described.words


def test_an_unplaced_accident_is_a_collision_everywhere(
    unplaced: SimpleNamespace, request: pytest.FixtureRequest
) -> None:
    """It is found by queries, counted by statistics, and named where a report skips it."""
    dataset, token = unplaced.dataset, unplaced.token
    assert token in [scenario["token"] for scenario in dataset.find(collision=True)]

    angles = dataset_statistics(dataset).histograms["collision_angles"]
    assert angles.left_out.counts["total"] == 1

    one_actor_twice = request.node.callspec.params["unplaced"] == "one actor twice"
    for report in (
        lead_time_ledger(dataset, [token], workers=1),
        avoidability_report(dataset, [token], workers=1),
    ):
        unrecorded = ["counterpart not recorded" in skipped.reason for skipped in report.skipped]
        assert unrecorded == [not one_actor_twice]

    assert dataset.render_frame(f"{token}/030")
    assert dataset.render_sample(f"{token}/ego_vehicle/030")
