"""What the devkit computes of the session's releases is what it was: exactly, and floats within a
tolerance.

`pytest tests/test_pinned.py --pin` writes tests/data/pinned.json anew, for a change that should
change numbers.
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
from studies import BASELINES, written

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

FILE = Path(__file__).parent / "data" / "pinned.json"
EVALUATED = {
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
"""Agents whose predicted plans lead to collisions; other plans hardly show a fault."""
STUDY: dict[str, Any] = {
    **BASELINES,
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
    """How many values there are, a hash of all but finite floats, and two sums of these, of which
    one is by place.
    """
    rest, floats, count = hashlib.sha256(), [np.zeros(1)], 0
    for leaf in map(np.asarray, leaves(value)):
        count += leaf.size
        finite = np.isfinite(leaf) if leaf.dtype.kind == "f" else np.zeros(leaf.shape, bool)
        floats.append(leaf[finite].astype(float))
        rest.update(repr(leaf[~finite].tolist()).encode())
    numbers = np.concatenate(floats)
    return [
        count,
        rest.hexdigest()[:12],
        float(numbers.sum()),
        float(numbers @ np.linspace(1.0, 2.0, len(numbers))),
    ]


def leaves(value: Any) -> Iterator[Any]:
    """The arrays and single values in lists, mappings and records, one after another."""
    if dataclasses.is_dataclass(value):
        value = {each.name: getattr(value, each.name) for each in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        for name in sorted(value, key=str):
            yield name
            yield from leaves(value[name])
    elif isinstance(value, list | tuple):
        for each in value:
            yield from leaves(each)
    else:
        yield value


def same(found: Any, expected: Any) -> bool:
    """Whether two values are equal, or nearly equal floats."""
    if isinstance(found, list):
        return len(found) == len(expected) and all(map(same, found, expected))
    if isinstance(found, float) and isinstance(expected, float):
        return math.isclose(found, expected, rel_tol=1e-6, abs_tol=1e-9) or (
            math.isnan(found) and math.isnan(expected)
        )
    return bool(found == expected)


def tables(da: DeepAccident, _: DeepAccident, __: Path) -> Pins:
    """Each column of each table."""
    return pins_of_tables(da)


def pins_of_tables(da: DeepAccident) -> Pins:
    """Pin each column of each table."""
    return {
        f"{table}.{column}": pin(turns(column, da.arrow(table)[column].to_pylist()))
        for table in da.table_names
        for column in da.arrow(table).column_names
    }


def turns(column: str, values: Any) -> Any:
    """A column; rotations as matrices, headings by cosine and sine: half a turn has two quaternions
    and two angles.
    """
    angles = {"rotation": to_matrix, "yaw": lambda yaw: [np.cos(yaw), np.sin(yaw)]}
    return angles.get(column, lambda each: each)(values)


def pairs(_: DeepAccident, da: DeepAccident, __: Path) -> Pins:
    """Each column of the interactions of each scenario."""
    made = {record["token"]: interactions(da, record["token"]) for record in da.scenario}
    found = {}
    for token, each in made.items():
        for name, table in (
            ("interaction", each.to_arrow()),
            ("interaction_pair", each.pairs.to_arrow()),
        ):
            found |= {
                f"{token} {name}.{column}": pin(table[column].to_pylist())
                for column in table.column_names
            }
    return found


def labels(_: DeepAccident, da: DeepAccident, __: Path) -> Pins:
    """The maps of a sample by each preset and protocol, and how other actors move."""
    token = da.get_sample(da.scenario[0]["token"], "ego_vehicle", 20)["token"]
    configs = {name: MotionLabelConfig.preset(name) for name in PRESETS}
    configs |= {f"protocol {name}": MotionLabelConfig(protocol=name) for name in LABEL_PROTOCOLS}
    made = {name: motion_labels(da, token, config) for name, config in configs.items()}
    return {
        f"{name}.{field}": pin(getattr(each, field))
        for name, each in made.items()
        for field in LABEL_FIELDS
    }


def evaluations(_: DeepAccident, da: DeepAccident, folder: Path) -> Pins:
    """Predictions of a baseline; counts and numbers of each task and protocol."""
    split, found = folder / "everything.txt", {}
    split.write_text("".join(each["token"].replace("/", " ") + "\n" for each in da.scenario))
    for kind, tasks in EVALUATED.items():
        agents = COLLIDING_AGENTS if kind == "planning" else ("ego_vehicle",)
        mine = {"samples": "all", "scope": "all", "agents": agents}
        tokens = SampleSelection(split=str(split), **mine).tokens(da)
        path = predict_results(
            da, kind, tokens, folder / (kind if kind == "motion" else f"{kind}.json")
        )
        for task, protocol in [
            (task, protocol) for task, protocols in tasks.items() for protocol in protocols
        ]:
            setup = EvaluationSetup(task=task, protocol=protocol)
            run = evaluate_results(da, path, setup, default_selection(setup, split, **mine))
            name, summary = f"{kind} {task} {protocol}", run.summary()
            found |= {
                f"{name} counts": pin(run.evaluator.counts),
                f"{name} numbers": pin(summary["metrics"]),
            }
            found[f"{name} headlines"] = [each["value"] for each in summary["headlines"]]
    return found


def study(_: DeepAccident, da: DeepAccident, folder: Path) -> Pins:
    """Pin all numbers of a study of baselines, its comparisons and the groups of its samples."""
    recipe = {**STUDY, "releases": {"test": {"dataroot": str(da.dataroot)}}}
    path = written(folder, recipe)
    summary = run_study(read_recipe(str(path)), folder / "out", workers=1).to_dict()
    found = {
        f"rows {name} {group}": pin(numbers)
        for name, row in summary["rows"].items()
        for group, numbers in row["groups"].items()
    }
    found |= {
        f"comparisons {comparison['row']} - {comparison['less']} {group}": pin(numbers)
        for comparison in summary["comparisons"]
        for group, numbers in comparison["groups"].items()
    }
    return {**found, "groups": pin(summary["groups"]), "headline": pin(summary["headline"])}


def nuscenes(_: DeepAccident, da: DeepAccident, folder: Path) -> Pins:
    """Pin the tables, boxes, labels and evaluations of a release in nuScenes' format."""
    export_release(da, folder / "dataroot", NuScenes(agents=("ego_vehicle",)))
    road = open_nuscenes(folder / "dataroot")
    tokens = [record["token"] for record in road.sample if record["labelled"]]
    found = {f"tables {name}": value for name, value in pins_of_tables(road).items()}
    for frame in ("world", "ego", "lidar"):
        found[f"boxes {frame}"] = pin([road.boxes(token, frame).center for token in tokens])
    for protocol in LABEL_PROTOCOLS:
        label = motion_labels(road, tokens[3], MotionLabelConfig(protocol=protocol))
        for field in LABEL_FIELDS:
            found[f"labels {protocol}.{field}"] = pin(getattr(label, field))
    path = predict_results(road, "detection", tokens, folder / "detection.json")
    for protocol in EVALUATED["detection"]["detection"]:
        setup = EvaluationSetup(task="detection", protocol=protocol)
        selection = default_selection(setup, "all", samples="all", scope="all")
        run = evaluate_results(road, path, setup, selection)
        found[f"detection {protocol} numbers"] = pin(run.summary()["metrics"])
    return found


Section = Callable[[DeepAccident, DeepAccident, Path], Pins]
SECTIONS: list[Section] = [tables, pairs, labels, evaluations, study, nuscenes]


@pytest.mark.slow
@pytest.mark.parametrize("section", SECTIONS, ids=lambda section: section.__name__)
def test_numbers_are_what_they_were(
    section: Callable[..., Pins],
    da: DeepAccident,
    da_motion: DeepAccident,
    tmp_path: Path,
    pytestconfig: pytest.Config,
) -> None:
    found = json.loads(json.dumps(section(da, da_motion, tmp_path)))
    kept = json.loads(FILE.read_text(encoding="utf-8")) if FILE.exists() else {}
    if pytestconfig.getoption("--pin"):
        before = kept.get(section.__name__, {})
        kept[
            section.__name__
        ] = {  # what is the same stays as it is written, in spite of other last digits
            name: before[name] if name in before and same(value, before[name]) else value
            for name, value in found.items()
        }
        rows = (
            f'"{name}": {{\n'
            + ",\n".join(f" {json.dumps(key)}: {json.dumps(each)}" for key, each in of.items())
            for name, of in kept.items()
        )
        FILE.write_text("{" + "\n},\n".join(rows) + "\n}}\n", encoding="utf-8")
    expected = kept[section.__name__]
    assert found.keys() == expected.keys()
    assert [name for name in found if not same(found[name], expected[name])] == []
