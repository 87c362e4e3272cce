"""Kinds of files: where healthy files lie, how a user reads them, and how the output is judged.

`KINDS` includes the kinds of `other_kinds`, `road_kinds` and `weights_kinds`.
"""

import json
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from campaign import other_kinds, plain, road_kinds, weights_kinds
from campaign.healthy import SETUPS, open_release, select_samples
from campaign.kind import (
    Action,
    Kind,
    Output,
    Workspace,
    find_long_sentence,
    open_dataset,
    read_findings,
)
from campaign.mutations import HTML
from campaign.tables_of_releases import judge_tables, read_tables
from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation.results import read_results
from deepaccident_devkit.evaluation.runs import compare_bundles, evaluate_results, verify_bundle
from deepaccident_devkit.motion import LabelFiles
from deepaccident_devkit.plugins.synth.spec import draw, read_spec
from deepaccident_devkit.plugins.synth.spec.model import AllOf, Part
from deepaccident_devkit.release import find_release, read_calib
from deepaccident_devkit.render.evaluation.report import report_html
from deepaccident_devkit.support.reading import file_checksum
from deepaccident_devkit.tables import Index
from deepaccident_devkit.tables.index import MANIFEST_FILE

_MAX_TEXT_CHARACTERS = 20_000
_OTHER_PIXELS = "other pixels than numpy reads"


# ---- a release's small files


def _open(workspace: Workspace, on_error: Any) -> DeepAccident:
    return DeepAccident(
        "v1",
        workspace.folder,
        index_dir=workspace.scratch / "index",
        workers=1,
        verbose=False,
        on_error=on_error,
    )


def _validate(workspace: Workspace, *, deep: bool = False) -> list[str]:
    return read_findings(workspace.folder, deep=deep)


def _judge_sentences(_workspace: Workspace, sentences: list[str]) -> str | None:
    return find_long_sentence(sentences)


_SMALL = (
    Action(lambda workspace: read_tables(_open(workspace, "raise")), judge_tables),
    Action(lambda workspace: read_tables(_open(workspace, "skip")), judge_tables),
    Action(_validate, _judge_sentences),
)
_DEEP = Action(lambda workspace: _validate(workspace, deep=True), _judge_sentences)


def _judge_calib(workspace: Workspace, output: Output) -> str | None:
    expected_arrays = plain.read_calib(workspace.changed_file)
    for name, array in output.items():
        if not np.array_equal(array, expected_arrays[name], equal_nan=True):
            return f"{name} differs from what numpy reads"
    return None


_CALIB = Action(lambda workspace: read_calib(workspace.changed_file, raw=True), _judge_calib)


def _judge_splits(workspace: Workspace, output: Output) -> str | None:
    """Check that all scenarios with a split are listed in the split file."""
    is_file = workspace.changed_file.is_file()
    listed_scenarios = plain.read_split(workspace.changed_file) if is_file else []
    scenarios = [value for value in output.values() if isinstance(value, dict)]
    for scenario in scenarios:
        if scenario["split"] and scenario["token"] not in listed_scenarios:
            return f"{scenario['token']} is not listed"
    return None


_SPLITS = (
    Action(lambda workspace: read_tables(_open(workspace, "raise")), _judge_splits),
    Action(lambda workspace: sorted(_open(workspace, "skip").split_scenarios("train"))),
    Action(_validate, _judge_sentences),
)


# ---- a release's sensors


@cache
def _open_sensors(folder: Path) -> DeepAccident:
    """Open the release with changed sensor files; once, while they are healthy."""
    return open_release(folder, folder.parents[1] / "index_of_sensors")


def _sample_token(workspace: Workspace) -> str:
    """Return the token of the sample that the changed sensor file belongs to."""
    path = workspace.changed_file.relative_to(workspace.folder)
    scenario_type, agent, _, name, _ = path.parts
    frame = path.stem[-3:]
    return f"{scenario_type}/{name}/{agent}/{frame}"


def _load_image(workspace: Workspace) -> Any:
    dataset = _open_sensors(workspace.folder)
    return dataset.load_image(f"{_sample_token(workspace)}/Camera_Front")


def _judge_image(workspace: Workspace, image: Any) -> str | None:
    is_same = np.array_equal(image, plain.read_image(workspace.changed_file))
    if is_same:
        return None
    return "other pixels than Pillow reads"


def _load_points(workspace: Workspace) -> Any:
    dataset = _open_sensors(workspace.folder)
    return dataset.load_point_cloud(_sample_token(workspace), frame="lidar")


def _judge_points(workspace: Workspace, cloud: Any) -> str | None:
    points = plain.read_array(workspace.changed_file)
    is_same = np.array_equal(cloud.xyz, points[:, :3] * (1, -1, 1), equal_nan=True)
    if is_same:
        return None
    return "other points than numpy reads"


def _load_bev(workspace: Workspace) -> Any:
    return _open_sensors(workspace.folder).load_bev(_sample_token(workspace))


def _judge_bev(workspace: Workspace, bev: Any) -> str | None:
    high_byte, low_byte, tag = np.moveaxis(plain.read_array(workspace.changed_file), -1, 0)[:3]
    instance = low_byte.astype(int) + 256 * high_byte.astype(int)
    is_same = np.array_equal(bev.semantic, tag.astype(int))
    if is_same and np.array_equal(bev.instance, instance):
        return None
    return _OTHER_PIXELS


# ---- results


def _read_predictions(workspace: Workspace) -> Any:
    results = read_results(_results_path(workspace))
    results.check()
    return {token: results.prediction(token) for token in results.tokens}


def _results_path(workspace: Workspace) -> Path:
    """Return the path of the results' file or folder."""
    if workspace.folder.name != "results":
        return workspace.folder
    path = workspace.changed_file.relative_to(workspace.folder)
    return workspace.folder / path.parts[0]


def _judge_accidents(workspace: Workspace, output: Output) -> str | None:
    return _find_entry_fault(
        workspace,
        output,
        lambda accident: [
            accident.positions.tolist(),
            accident.time,
            accident.score,
            accident.ids and list(accident.ids),
        ],
        lambda entry: [entry["positions"], entry["time"], entry["score"], entry.get("ids")],
    )


def _judge_boxes(workspace: Workspace, output: Output) -> str | None:
    entries = plain.read_json(workspace.changed_file)["results"]
    if list(output) != list(entries):
        return "other samples"
    for token, detected in output.items():
        boxes = detected.boxes
        numbers = np.column_stack([boxes.center, boxes.size, detected.scores])
        expected_numbers = []
        for entry in entries[token]:
            size = np.take(entry["size"], plain.NUSCENES_SIZE_ORDER)
            expected_numbers.append((*entry["translation"], *size, entry["detection_score"]))
        if not np.array_equal(numbers, np.reshape(expected_numbers, (-1, 7))):
            return f"{token}: other boxes"
    return None


def _judge_plans(workspace: Workspace, output: Output) -> str | None:
    return _find_entry_fault(
        workspace,
        output,
        lambda plan: [
            plan.times.tolist(),
            plan.path.tolist(),
            plan.score,
            plan.yaw is not None and plan.yaw.tolist(),
        ],
        lambda entry: [entry["times"], entry["path"], entry["score"], entry.get("yaw") or False],
    )


def _judge_forecasts(workspace: Workspace, output: Output) -> str | None:
    return _find_entry_fault(
        workspace,
        output,
        lambda forecast: [
            forecast.actor_id,
            forecast.times.tolist(),
            forecast.paths.tolist(),
            forecast.probabilities.tolist(),
        ],
        lambda entry: [entry["id"], entry["times"], entry["paths"], entry["probabilities"]],
    )


def _find_entry_fault(
    workspace: Workspace,
    output: Output,
    list_prediction: Callable[[Any], list[Any]],
    list_entry: Callable[[Any], list[Any]],
) -> str | None:
    """Compare predictions with the entries of the file, sample by sample.

    Args:
        workspace: Workspace of the case.
        output: Predictions by the token of their sample.
        list_prediction: Function that returns the values of a prediction.
        list_entry: Function that returns the values of an entry of the file.
    """
    entries = plain.read_json(workspace.changed_file)["results"]
    if list(output) != list(entries):
        return "other samples"
    for token, predictions in output.items():
        values = list(map(list_prediction, predictions))
        if values != list(map(list_entry, entries[token])):
            return f"{token}: other predictions"
    return None


def _judge_motion(workspace: Workspace, output: Output) -> str | None:
    paths = (workspace.folder / "motion" / "shards").glob("*.npz")
    shards = [path for path in paths if path.is_file()]
    for token, prediction in output.items():
        arrays = (plain.read_array(shard, f"{token}/instance") for shard in shards)
        if not any(np.array_equal(prediction.instances, array) for array in arrays):
            return f"{token}: other instances"
    return None


def _evaluate(task: str) -> Action:
    """Return an action that computes the numbers of a task and the page that shows them."""

    def read(workspace: Workspace) -> Any:
        dataset = open_dataset(workspace.home)
        samples = select_samples(task)
        path = _results_path(workspace)
        run = evaluate_results(dataset, path, SETUPS[task], samples, workers=1, allow_partial=True)
        return run.summary(), report_html(run, [])

    def judge(_workspace: Workspace, output: tuple[Any, str]) -> str | None:
        summary, page = output
        foreign_texts = [text for text in HTML if text in page]
        if fault := _find_json_fault(summary):
            return fault
        if foreign_texts:
            return f"a page that has {foreign_texts[0]}"
        return None

    return Action(read, judge)


def _find_json_fault(content: Any) -> str | None:
    try:
        json.dumps(content, allow_nan=False)
    except ValueError as error:
        return f"a summary that is no JSON: {error}"
    return None


# ---- bundles


def _verify(workspace: Workspace) -> Any:
    verified = verify_bundle(workspace.folder, open_dataset(workspace.home), workers=1)
    return verified.is_same, verified.to_text()


def _judge_verified(workspace: Workspace, output: tuple[bool, str]) -> str | None:
    """Check that a changed file is not taken for the same."""
    is_same, text = output
    if len(text) > _MAX_TEXT_CHARACTERS:
        return f"a text of {len(text)} characters"
    if not is_same or workspace.changed_file.name == "files.json":
        return None
    if _checksum(workspace.healthy_file) == _checksum(workspace.changed_file):
        return None
    return "said to be the same, though the file has another checksum"


def _checksum(path: Path) -> str:
    if path.is_file():
        return file_checksum(path)
    return "none"


def _compare(workspace: Workspace) -> Any:
    healthy_bundle = workspace.home / "kept" / "bundles" / workspace.folder.name
    comparison = compare_bundles(workspace.folder, healthy_bundle)
    return comparison.to_text(), comparison.to_dict()


_BUNDLE = (
    Action(_verify, _judge_verified),
    Action(_compare, lambda _workspace, output: _find_json_fault(output[1])),
)


# ---- written labels


def _read_labels(workspace: Workspace) -> Any:
    files = LabelFiles(workspace.folder)
    return {token: files[token] for token in files}


def _judge_labels(workspace: Workspace, output: Output) -> str | None:
    for token, labels in output.items():
        recording, _, frame = token.rpartition("/")
        path = workspace.folder / f"{recording}.npz"
        for name in ("instance", "future_egomotion"):
            expected = plain.read_array(path, f"{frame}/{name}")
            if not np.array_equal(getattr(labels, name), expected, equal_nan=True):
                return f"{token}: other {name} than numpy reads"
    return None


# ---- scenario files


def _read_spec(workspace: Workspace) -> Part:
    template = read_spec(workspace.changed_file)
    draw(template, np.random.default_rng(0))
    return template.root


def _judge_spec(workspace: Workspace, part: Part) -> str | None:
    return _find_part_fault(part, plain.read_yaml(workspace.changed_file), "")


def _find_part_fault(part: Part, content: Any, path: str) -> str | None:
    """Return the first value that differs between a part and the file's content.

    Keys of a file have the names of the part's fields; only `from` has another one.
    """
    for name, choice in part.fields.items():
        keys = (name, name.removesuffix("_arm"), name.replace("_", "-"))
        value = next(content[key] for key in keys if key in content)
        fault = None
        if isinstance(choice, Part):
            fault = _find_part_fault(choice, value, f"{path}.{name}")
        elif isinstance(choice, AllOf):
            for item, item_content in zip(choice.items, value, strict=True):
                if isinstance(item, Part):
                    fault = fault or _find_part_fault(item, item_content, name)
        else:
            alternatives = list(choice.alternatives())
            expected = value if isinstance(value, list) else [value]
            scalars = [*alternatives, *expected]
            is_plain = all(isinstance(item, str | int | float | bool | None) for item in scalars)
            if is_plain and alternatives != expected:
                fault = f"{path}.{name}: {alternatives} and not {expected}"
        if fault:
            return fault
    return None


# ---- the index


def _read_index(workspace: Workspace, *, check: bool = False) -> Any:
    root = workspace.home / "release"
    if check:
        from deepaccident_devkit.tables import open_index

        open_index(find_release(root), index_dir=workspace.folder, workers=1, check_files=True)
    dataset = open_release(root, workspace.folder)
    dataset.table_names.sort()
    return {name: dataset.arrow(name).to_pydict() for name in dataset.table_names}


@cache
def _read_healthy_tables(home: Path) -> Any:
    dataset = open_release(home / "release", home / "kept" / "index")
    return {name: dataset.arrow(name).to_pydict() for name in dataset.table_names}


def _are_healthy(workspace: Workspace, tables: Any) -> bool:
    return repr(tables) == repr(_read_healthy_tables(workspace.home))


def _judge_index(workspace: Workspace, tables: Any) -> str | None:
    """Check that values differ only where a table's checksum differs too."""
    if _are_healthy(workspace, tables):
        return None
    index = Index.read(workspace.folder / "v1")
    table_files = index.table_files if index else {}
    for name, (_, checksum) in table_files.items():
        if _checksum(index.tables_folder / name) != checksum:
            return None
    return "other values, and all checksums are right"


def _judge_checked_index(workspace: Workspace, tables: Any) -> str | None:
    if _are_healthy(workspace, tables):
        return None
    return "other values after a check"


_INDEX = (
    Action(_read_index, _judge_index),
    Action(lambda workspace: _read_index(workspace, check=True), _judge_checked_index),
)

KINDS = {
    kind.name: kind
    for kind in (
        Kind("label", "text", "small", "*/*/label/*/*.txt", _SMALL),
        Kind("calib", "pickle", "small", "*/*/calib/*/*.pkl", (*_SMALL, _CALIB)),
        Kind("meta", "text", "small", "*/meta/*.txt", _SMALL),
        Kind("split file", "text", "small", "train.txt", _SPLITS),
        Kind(
            "image",
            "image",
            "sensors",
            "*/*/Camera_Front/*/*.jpg",
            (Action(_load_image, _judge_image), _DEEP),
        ),
        Kind(
            "LiDAR",
            "npz",
            "sensors",
            "*/*/lidar01/*/*.npz",
            (Action(_load_points, _judge_points), _DEEP),
        ),
        Kind(
            "BEV camera",
            "npz",
            "sensors",
            "*/*/BEV_instance_camera/*/*.npz",
            (Action(_load_bev, _judge_bev), _DEEP),
        ),
        Kind(
            "accident results",
            "json",
            "results",
            "accident",
            (Action(_read_predictions, _judge_accidents), _evaluate("accident")),
        ),
        Kind(
            "detection results",
            "json",
            "results",
            "detection",
            (Action(_read_predictions, _judge_boxes), _evaluate("detection")),
        ),
        Kind(
            "planning results",
            "json",
            "results",
            "planning",
            (Action(_read_predictions, _judge_plans), _evaluate("planning")),
        ),
        Kind(
            "forecasting results",
            "json",
            "results",
            "forecasting",
            (Action(_read_predictions, _judge_forecasts), _evaluate("forecasting")),
        ),
        Kind(
            "motion results",
            "json",
            "results",
            "motion/results.json",
            (Action(_read_predictions, _judge_motion), _evaluate("motion")),
        ),
        Kind(
            "motion shard",
            "npz",
            "results",
            "motion/shards/*.npz",
            (Action(_read_predictions, _judge_motion), _evaluate("motion")),
        ),
        Kind("bundle", "json", "bundles/accident", "*.json", _BUNDLE),
        Kind("planning bundle", "json", "bundles/planning", "*.json", _BUNDLE),
        Kind("forecasting bundle", "json", "bundles/forecasting", "*.json", _BUNDLE),
        Kind("bundle's samples", "parquet", "bundles/accident", "*.parquet", _BUNDLE),
        Kind("bundle's results", "npz", "bundles/motion", "results/motion/shards/*.npz", _BUNDLE),
        Kind(
            "labels' list",
            "json",
            "labels",
            "manifest.json",
            (Action(_read_labels, _judge_labels),),
        ),
        Kind("labels", "npz", "labels", "*/*/*.npz", (Action(_read_labels, _judge_labels),)),
        Kind("scenario file", "yaml", "specs", "*.yaml", (Action(_read_spec, _judge_spec),)),
        Kind("index's list", "json", "index", f"v1/{MANIFEST_FILE}", _INDEX),
        Kind("index's tables", "arrow", "index", "v1/tables-*/*.arrow", _INDEX),
        Kind("index's rows", "shard", "index", "v1/kept/*/*", _INDEX),
        *other_kinds.KINDS,
        *road_kinds.KINDS,
        *weights_kinds.KINDS,
    )
}
"""All kinds by their names."""
