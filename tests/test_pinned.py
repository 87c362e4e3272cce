"""The devkit's results on the session's releases do not change; floats have a tolerance.

After a change that should change numbers, `pytest tests/test_pinned.py --pin` writes
tests/data/pinned.json again.
"""

import dataclasses
import hashlib
import json
import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.study_recipes import BASELINE_RECIPE, write_recipe

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation.runs import SampleSelection, default_selection, evaluate_results
from deepaccident_devkit.evaluation.runs.setups import TASKS, EvaluationSetup
from deepaccident_devkit.export.bulk import export_release
from deepaccident_devkit.export.nuscenes import NuScenes
from deepaccident_devkit.geometry.quaternions import to_matrix
from deepaccident_devkit.interactions import interactions
from deepaccident_devkit.motion import LABEL_PROTOCOLS, PRESETS, MotionLabelConfig, motion_labels
from deepaccident_devkit.plugins.baselines import predict_results
from deepaccident_devkit.plugins.nuscenes import open_nuscenes
from deepaccident_devkit.plugins.study import read_recipe, run_study

PINS_PATH = Path(__file__).parent / "data" / "pinned.json"
EVALUATIONS = {
    "motion": {
        "motion": ("released", "paper"),
        "accident": ("released", "paper", "boxes"),
        "warning": ("clean", "field"),
    },
    "accident": {"accident": ("paper", "boxes")},
    "detection": {"detection": ("released", "released_iou", "paper", "opencood")},
    "planning": {"planning": tuple(TASKS["planning"].protocols)},
    "forecasting": {"forecasting": tuple(TASKS["forecasting"].protocols)},
}
"""Kind of results → task → protocols."""
COLLIDING_AGENTS = ("ego_vehicle_behind", "other_vehicle")
"""Agents with predicted plans that lead to collisions; other plans hardly show a fault."""
STUDY: dict[str, Any] = {
    **BASELINE_RECIPE,
    "rows": [
        {"name": "sees {agents}", "baseline": "constant_velocity", "agents": ["single", "all"]}
    ],
    "groups": {"accidents": ["collision=true"]},
    "compare": [],
}
"""Recipe of a study of baselines, except for the folder of its release."""
LABEL_FIELDS = ("instance", "centerness", "offset", "flow", "future_egomotion", "valid", "id_map")
Pins = dict[str, list[Any]]


def pin(value: Any) -> list[Any]:
    """Summarise values by their number, a hash and two sums.

    The hash covers all values except finite floats. The second sum weights each float by its index.
    """
    digest = hashlib.sha256()
    floats = [np.zeros(1)]
    count = 0
    for leaf in map(np.asarray, iterate_leaves(value)):
        count += leaf.size
        finite = np.isfinite(leaf) if leaf.dtype.kind == "f" else np.zeros(leaf.shape, bool)
        floats.append(leaf[finite].astype(float))
        digest.update(repr(leaf[~finite].tolist()).encode())
    numbers = np.concatenate(floats)
    weights = np.linspace(1.0, 2.0, len(numbers))
    return [count, digest.hexdigest()[:12], float(numbers.sum()), float(numbers @ weights)]


def iterate_leaves(value: Any) -> Iterator[Any]:
    """Yield the arrays and single values in lists, mappings and records, one after another."""
    if dataclasses.is_dataclass(value):
        value = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        for name in sorted(value, key=str):
            yield name
            yield from iterate_leaves(value[name])
    elif isinstance(value, list | tuple):
        for item in value:
            yield from iterate_leaves(item)
    else:
        yield value


def are_same(value: Any, expected: Any) -> bool:
    """Return whether two values are equal, or nearly equal floats."""
    if isinstance(value, list):
        return len(value) == len(expected) and all(map(are_same, value, expected))
    if isinstance(value, float) and isinstance(expected, float):
        if math.isnan(value):
            return math.isnan(expected)
        return math.isclose(value, expected, rel_tol=1e-6, abs_tol=1e-9)
    return bool(value == expected)


def tables(da: DeepAccident, _: DeepAccident, __: Path) -> Pins:
    """Pin each column of each table."""
    return pin_tables(da)


def pin_tables(da: DeepAccident) -> Pins:
    """Pin each column of each table of a release."""
    pins = {}
    for name in da.table_names:
        table = da.arrow(name)
        for column in table.column_names:
            values = table[column].to_pylist()
            pins[f"{name}.{column}"] = pin(without_ambiguous_angles(column, values))
    return pins


def without_ambiguous_angles(column: str, values: Any) -> Any:
    """Return rotations as matrices, and headings as cosine and sine; other columns unchanged.

    Half a turn has two quaternions and two angles.
    """
    if column == "rotation":
        return to_matrix(values)
    if column == "yaw":
        return [np.cos(values), np.sin(values)]
    return values


def pairs(_: DeepAccident, da: DeepAccident, __: Path) -> Pins:
    """Pin each column of the interactions of each scenario."""
    pins = {}
    for scenario in da.scenario:
        token = scenario["token"]
        result = interactions(da, token)
        for name, table in (
            ("interaction", result.to_arrow()),
            ("interaction_pair", result.pairs.to_arrow()),
        ):
            for column in table.column_names:
                pins[f"{token} {name}.{column}"] = pin(table[column].to_pylist())
    return pins


def labels(_: DeepAccident, da: DeepAccident, __: Path) -> Pins:
    """Pin the label maps of a sample by each preset and protocol."""
    token = da.get_sample(da.scenario[0]["token"], "ego_vehicle", 20)["token"]
    configs = {name: MotionLabelConfig.preset(name) for name in PRESETS}
    configs |= {f"protocol {name}": MotionLabelConfig(protocol=name) for name in LABEL_PROTOCOLS}
    pins = {}
    for name, config in configs.items():
        label = motion_labels(da, token, config)
        for field in LABEL_FIELDS:
            pins[f"{name}.{field}"] = pin(getattr(label, field))
    return pins


def evaluations(_: DeepAccident, da: DeepAccident, folder: Path) -> Pins:
    """Pin counts and numbers of a baseline's predictions by each task and protocol."""
    split = folder / "everything.txt"
    lines = [scenario["token"].replace("/", " ") + "\n" for scenario in da.scenario]
    split.write_text("".join(lines))
    pins: Pins = {}
    for kind, protocols_by_task in EVALUATIONS.items():
        agents = COLLIDING_AGENTS if kind == "planning" else ("ego_vehicle",)
        options = {"samples": "all", "scope": "all", "agents": agents}
        tokens = SampleSelection(split=str(split), **options).tokens(da)
        file_name = kind if kind == "motion" else f"{kind}.json"
        path = predict_results(da, kind, tokens, folder / file_name)
        for task, protocols in protocols_by_task.items():
            for protocol in protocols:
                setup = EvaluationSetup(task=task, protocol=protocol)
                run = evaluate_results(da, path, setup, default_selection(setup, split, **options))
                name, summary = f"{kind} {task} {protocol}", run.summary()
                pins[f"{name} counts"] = pin(run.evaluator.counts)
                pins[f"{name} numbers"] = pin(summary["metrics"])
                pins[f"{name} headlines"] = [row["value"] for row in summary["headlines"]]
    return pins


def study(_: DeepAccident, da: DeepAccident, folder: Path) -> Pins:
    """Pin all numbers of a study of baselines, its comparisons and the groups of its samples."""
    recipe = {**STUDY, "releases": {"test": {"dataroot": str(da.dataroot)}}}
    path = write_recipe(folder, recipe)
    summary = run_study(read_recipe(str(path)), folder / "out", workers=1).to_dict()
    pins = {}
    for name, row in summary["rows"].items():
        for group, numbers in row["groups"].items():
            pins[f"rows {name} {group}"] = pin(numbers)
    for comparison in summary["comparisons"]:
        rows = f"{comparison['row']} - {comparison['less']}"
        for group, numbers in comparison["groups"].items():
            pins[f"comparisons {rows} {group}"] = pin(numbers)
    return {**pins, "groups": pin(summary["groups"]), "headline": pin(summary["headline"])}


def nuscenes(_: DeepAccident, da: DeepAccident, folder: Path) -> Pins:
    """Pin the tables, boxes, labels and evaluations of a release in nuScenes' format."""
    export_release(da, folder / "dataroot", NuScenes(agents=("ego_vehicle",)))
    road = open_nuscenes(folder / "dataroot")
    tokens = [record["token"] for record in road.sample if record["labelled"]]
    pins = {f"tables {name}": value for name, value in pin_tables(road).items()}
    for frame in ("world", "ego", "lidar"):
        pins[f"boxes {frame}"] = pin([road.boxes(token, frame).center for token in tokens])
    for protocol in LABEL_PROTOCOLS:
        label = motion_labels(road, tokens[3], MotionLabelConfig(protocol=protocol))
        for field in LABEL_FIELDS:
            pins[f"labels {protocol}.{field}"] = pin(getattr(label, field))
    path = predict_results(road, "detection", tokens, folder / "detection.json")
    for protocol in EVALUATIONS["detection"]["detection"]:
        setup = EvaluationSetup(task="detection", protocol=protocol)
        selection = default_selection(setup, "all", samples="all", scope="all")
        run = evaluate_results(road, path, setup, selection)
        pins[f"detection {protocol} numbers"] = pin(run.summary()["metrics"])
    return pins


Section = Callable[[DeepAccident, DeepAccident, Path], Pins]
SECTIONS: list[Section] = [tables, pairs, labels, evaluations, study, nuscenes]


@pytest.mark.slow
@pytest.mark.parametrize("section", SECTIONS, ids=lambda section: section.__name__)
def test_numbers_do_not_change(
    section: Callable[..., Pins],
    da: DeepAccident,
    da_motion: DeepAccident,
    tmp_path: Path,
    pytestconfig: pytest.Config,
) -> None:
    pins = json.loads(json.dumps(section(da, da_motion, tmp_path)))
    all_pins = json.loads(PINS_PATH.read_text(encoding="utf-8")) if PINS_PATH.exists() else {}
    if pytestconfig.getoption("--pin"):
        old_pins = all_pins.get(section.__name__, {})
        all_pins[section.__name__] = keep_unchanged_pins(pins, old_pins)
        write_pins(all_pins)

    expected = all_pins[section.__name__]
    assert pins.keys() == expected.keys()
    assert [name for name in pins if not are_same(pins[name], expected[name])] == []


def keep_unchanged_pins(pins: Pins, old_pins: Pins) -> Pins:
    """Return the pins, with the old digits of all that are still the same within the tolerance."""
    merged_pins = dict(pins)
    for name, value in pins.items():
        if name in old_pins and are_same(value, old_pins[name]):
            merged_pins[name] = old_pins[name]
    return merged_pins


def write_pins(pins_by_section: dict[str, Pins]) -> None:
    """Write the file of all pins, one pin a line."""
    sections = []
    for section_name, pins in pins_by_section.items():
        lines = [f" {json.dumps(name)}: {json.dumps(values)}" for name, values in pins.items()]
        sections.append(f'"{section_name}": {{\n' + ",\n".join(lines))
    PINS_PATH.write_text("{" + "\n},\n".join(sections) + "\n}}\n", encoding="utf-8")
