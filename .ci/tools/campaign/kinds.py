"""Kinds of files: where the healthy ones lie, how a user reads them, and when what was read is
wrong.

`KINDS` has those of `other_kinds`, `road_kinds` and `weights_kinds` too.
"""

import json
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from campaign import other_kinds, plain, road_kinds, weights_kinds
from campaign.healthy import SETUPS, opened, selection
from campaign.kind import Action, Kind, Room, dataset_of
from campaign.mutations import HTML
from campaign.tables_of_releases import judge_tables, tables
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
from deepaccident_devkit.validation import validate_release

# ---- a release's small files


def _opened(room: Room, on_error: Any) -> DeepAccident:
    return DeepAccident(
        "v1",
        room.tree,
        index_dir=room.scratch / "index",
        workers=1,
        verbose=False,
        on_error=on_error,
    )


def _validate(room: Room, *, deep: bool = False) -> Any:
    report = validate_release(room.tree, workers=1, deep=deep)
    return [str(finding) for finding in report.findings]


def _judge_sentences(_room: Room, sentences: list[str]) -> str | None:
    return next(
        (f"a sentence of {len(each)} characters" for each in sentences if len(each) > 2000), None
    )


_SMALL = (
    Action(lambda room: tables(_opened(room, "raise")), judge_tables),
    Action(lambda room: tables(_opened(room, "skip")), judge_tables),
    Action(_validate, _judge_sentences),
)
_DEEP = Action(lambda room: _validate(room, deep=True), _judge_sentences)


def _same_arrays(found: Mapping[str, Any], expected: Mapping[str, Any]) -> str | None:
    for name, array in found.items():
        if not np.array_equal(array, expected[name], equal_nan=True):
            return f"{name} differs from what numpy reads"
    return None


_CALIB = Action(
    lambda room: read_calib(room.victim, raw=True),
    lambda room, read: _same_arrays(read, plain.calib(room.victim)),
)


def _judge_splits(room: Room, read: Mapping[str, Any]) -> str | None:
    listed = plain.split_file(room.victim) if room.victim.is_file() else []
    wrong = [
        each["token"]
        for each in read.values()
        if isinstance(each, dict) and each["split"] and each["token"] not in listed
    ]
    return f"{wrong[0]} is not listed" if wrong else None


_SPLITS = (
    Action(lambda room: tables(_opened(room, "raise")), _judge_splits),
    Action(lambda room: sorted(_opened(room, "skip").split_scenarios("train"))),
    Action(_validate, _judge_sentences),
)


# ---- a release's sensors


@cache
def _sensors(tree: Path) -> DeepAccident:
    """The release whose sensors' files are changed; opened once, while they are healthy."""
    return opened(tree, tree.parents[1] / "index_of_sensors")


def _token(room: Room) -> str:
    scenario_type, agent, _, name, file = room.victim.relative_to(room.tree).parts
    return f"{scenario_type}/{name}/{agent}/{file[-7:-4]}"


def _image(room: Room) -> Any:
    return _sensors(room.tree).load_image(f"{_token(room)}/Camera_Front")


def _judge_image(room: Room, read: Any) -> str | None:
    return (
        None if np.array_equal(read, plain.image(room.victim)) else "other pixels than Pillow reads"
    )


def _judge_lidar(room: Room, read: Any) -> str | None:
    points = plain.array(room.victim)
    same = np.array_equal(read.xyz, points[:, :3] * (1, -1, 1), equal_nan=True)
    return None if same else "other points than numpy reads"


def _judge_bev(room: Room, read: Any) -> str | None:
    pixels = plain.array(room.victim).astype(int)
    same = np.array_equal(read.semantic, pixels[..., 2]) and np.array_equal(
        read.instance, pixels[..., 1] + 256 * pixels[..., 0]
    )
    return None if same else "other pixels than numpy reads"


# ---- results


def _predictions(room: Room) -> Any:
    results = read_results(_top(room))
    results.check()
    return {token: results.prediction(token) for token in results.tokens}


def _top(room: Room) -> Path:
    """The results' file or folder."""
    return (
        room.tree / room.victim.relative_to(room.tree).parts[0]
        if room.tree.name == "results"
        else room.tree
    )


def _judge_accidents(room: Room, read: Mapping[str, Any]) -> str | None:
    said = plain.json_file(room.victim)["results"]
    if list(read) != list(said):
        return "other samples"
    for token, accidents in read.items():
        found = [
            (each.positions.tolist(), each.time, each.score, each.ids and list(each.ids))
            for each in accidents
        ]
        if found != [
            (each["positions"], each["time"], each["score"], each.get("ids"))
            for each in said[token]
        ]:
            return f"{token}: other accidents"
    return None


def _judge_boxes(room: Room, read: Mapping[str, Any]) -> str | None:
    said = plain.json_file(room.victim)["results"]
    if list(read) != list(said):
        return "other samples"
    for token, detected in read.items():
        found = np.column_stack([detected.boxes.center, detected.boxes.size, detected.scores])
        rows = [
            (*each["translation"], *np.take(each["size"], [1, 0, 2]), each["detection_score"])
            for each in said[token]
        ]
        if not np.array_equal(found, np.reshape(rows, (-1, 7))):
            return f"{token}: other boxes"
    return None


def _judge_plans(room: Room, read: Mapping[str, Any]) -> str | None:
    return _fault_of_entries(
        room,
        read,
        lambda plan: [
            plan.times.tolist(),
            plan.path.tolist(),
            plan.score,
            plan.yaw is not None and plan.yaw.tolist(),
        ],
        lambda entry: [entry["times"], entry["path"], entry["score"], entry.get("yaw") or False],
    )


def _judge_forecasts(room: Room, read: Mapping[str, Any]) -> str | None:
    return _fault_of_entries(
        room,
        read,
        lambda each: [
            each.actor_id,
            each.times.tolist(),
            each.paths.tolist(),
            each.probabilities.tolist(),
        ],
        lambda entry: [entry["id"], entry["times"], entry["paths"], entry["probabilities"]],
    )


def _fault_of_entries(
    room: Room,
    read: Mapping[str, Any],
    facts: Callable[[Any], list[Any]],
    stated: Callable[[Any], list[Any]],
) -> str | None:
    """A sample whose predictions are not what the file states, entry by entry."""
    entries = plain.json_file(room.victim)["results"]
    if list(read) != list(entries):
        return "other samples"
    for token, predictions in read.items():
        if list(map(facts, predictions)) != list(map(stated, entries[token])):
            return f"{token}: other predictions"
    return None


def _judge_motion(room: Room, read: Mapping[str, Any]) -> str | None:
    shards = [path for path in (room.tree / "motion" / "shards").glob("*.npz") if path.is_file()]
    for token, output in read.items():
        if not any(
            np.array_equal(output.instances, plain.array(shard, f"{token}/instance"))
            for shard in shards
        ):
            return f"{token}: other instances"
    return None


def _evaluation(task: str) -> Action:
    """The numbers, and the page that shows them."""

    def read(room: Room) -> Any:
        dataset = dataset_of(room.home)
        run = evaluate_results(
            dataset, _top(room), SETUPS[task], selection(task), workers=1, allow_partial=True
        )
        return run.summary(), report_html(run, [])

    def judge(_room: Room, read: tuple[Any, str]) -> str | None:
        summary, page = read
        foreign = next((text for text in HTML if text in page), None)
        return _json_fault(summary) or (None if foreign is None else f"a page that has {foreign}")

    return Action(read, judge)


def _json_fault(content: Any) -> str | None:
    try:
        json.dumps(content, allow_nan=False)
    except ValueError as error:
        return f"a summary that is no JSON: {error}"
    return None


# ---- bundles


def _verify(room: Room) -> Any:
    verified = verify_bundle(room.tree, dataset_of(room.home), workers=1)
    return verified.is_same, verified.to_text()


def _judge_verified(room: Room, read: tuple[bool, str]) -> str | None:
    same, text = read
    if len(text) > 20_000:
        return f"a text of {len(text)} characters"
    if not same or room.victim.name == "files.json":
        return None
    before, now = _checksum(room.healthy), _checksum(room.victim)
    return None if before == now else "said to be the same, though the file has another checksum"


def _checksum(path: Path) -> str:
    return file_checksum(path) if path.is_file() else "none"


def _compare(room: Room) -> Any:
    comparison = compare_bundles(room.tree, room.home / "kept" / "bundles" / room.tree.name)
    return comparison.to_text(), comparison.to_dict()


_BUNDLE = (
    Action(_verify, _judge_verified),
    Action(_compare, lambda _room, read: _json_fault(read[1])),
)


# ---- written labels


def _labels(room: Room) -> Any:
    files = LabelFiles(room.tree)
    return {token: files[token] for token in files}


def _judge_labels(room: Room, read: Mapping[str, Any]) -> str | None:
    for token, labels in read.items():
        recording, _, frame = token.rpartition("/")
        path = room.tree / f"{recording}.npz"
        for name, found in (
            ("instance", labels.instance),
            ("future_egomotion", labels.future_egomotion),
        ):
            if not np.array_equal(found, plain.array(path, f"{frame}/{name}"), equal_nan=True):
                return f"{token}: other {name} than numpy reads"
    return None


# ---- scenario files


def _spec(room: Room) -> Any:
    template = read_spec(room.victim)
    draw(template, np.random.default_rng(0))
    return template.root


def _judge_spec(room: Room, read: Part) -> str | None:
    return _part_fault(read, plain.yaml_file(room.victim), "")


def _part_fault(part: Part, said: Any, path: str) -> str | None:
    """The first value that differs; keys of a file have their field's name, `from` alone another
    one.
    """
    for name, choice in part.fields.items():
        value = next(
            said[key]
            for key in (name, name.removesuffix("_arm"), name.replace("_", "-"))
            if key in said
        )
        if isinstance(choice, Part):
            faults: Iterator[str | None] = iter([_part_fault(choice, value, f"{path}.{name}")])
        elif isinstance(choice, AllOf):
            pairs = zip(choice.items, value, strict=True)
            faults = (
                _part_fault(item, each, name) if isinstance(item, Part) else None
                for item, each in pairs
            )
        else:
            found = list(choice.alternatives())
            expected = value if isinstance(value, list) else [value]
            plain_values = all(
                isinstance(each, str | int | float | bool | None) for each in [*found, *expected]
            )
            faults = iter(
                [
                    f"{path}.{name}: {found} and not {expected}"
                    if plain_values and found != expected
                    else None
                ]
            )
        if fault := next(filter(None, faults), None):
            return fault
    return None


# ---- the index


def _index(room: Room, *, check: bool = False) -> Any:
    if check:
        from deepaccident_devkit.tables import open_index

        open_index(
            find_release(room.home / "release"), index_dir=room.tree, workers=1, check_files=True
        )
    dataset = DeepAccident(
        "v1", room.home / "release", index_dir=room.tree, workers=1, verbose=False
    )
    dataset.table_names.sort()
    return {name: dataset.arrow(name).to_pydict() for name in dataset.table_names}


@cache
def _healthy_tables(home: Path) -> Any:
    dataset = DeepAccident(
        "v1", home / "release", index_dir=home / "kept" / "index", workers=1, verbose=False
    )
    return {name: dataset.arrow(name).to_pydict() for name in dataset.table_names}


def _same_tables(room: Room, read: Any) -> bool:
    return repr(read) == repr(_healthy_tables(room.home))


def _judge_opened(room: Room, read: Any) -> str | None:
    """Other values are there only where a table's checksum says so."""
    if _same_tables(room, read):
        return None
    index = Index.read(room.tree / "v1")
    files = index.table_files if index else {}
    damaged = [
        name
        for name, (_, checksum) in files.items()
        if _checksum(index.tables_folder / name) != checksum
    ]
    return None if damaged else "other values, and all checksums are right"


_INDEX = (
    Action(_index, _judge_opened),
    Action(
        lambda room: _index(room, check=True),
        lambda room, read: None if _same_tables(room, read) else "other values after a check",
    ),
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
            (Action(_image, _judge_image), _DEEP),
        ),
        Kind(
            "LiDAR",
            "npz",
            "sensors",
            "*/*/lidar01/*/*.npz",
            (
                Action(
                    lambda room: _sensors(room.tree).load_point_cloud(_token(room), frame="lidar"),
                    _judge_lidar,
                ),
                _DEEP,
            ),
        ),
        Kind(
            "BEV camera",
            "npz",
            "sensors",
            "*/*/BEV_instance_camera/*/*.npz",
            (Action(lambda room: _sensors(room.tree).load_bev(_token(room)), _judge_bev), _DEEP),
        ),
        Kind(
            "accident results",
            "json",
            "results",
            "accident",
            (Action(_predictions, _judge_accidents), _evaluation("accident")),
        ),
        Kind(
            "detection results",
            "json",
            "results",
            "detection",
            (Action(_predictions, _judge_boxes), _evaluation("detection")),
        ),
        Kind(
            "planning results",
            "json",
            "results",
            "planning",
            (Action(_predictions, _judge_plans), _evaluation("planning")),
        ),
        Kind(
            "forecasting results",
            "json",
            "results",
            "forecasting",
            (Action(_predictions, _judge_forecasts), _evaluation("forecasting")),
        ),
        Kind(
            "motion results",
            "json",
            "results",
            "motion/results.json",
            (Action(_predictions, _judge_motion), _evaluation("motion")),
        ),
        Kind(
            "motion shard",
            "npz",
            "results",
            "motion/shards/*.npz",
            (Action(_predictions, _judge_motion), _evaluation("motion")),
        ),
        Kind("bundle", "json", "bundles/accident", "*.json", _BUNDLE),
        Kind("planning bundle", "json", "bundles/planning", "*.json", _BUNDLE),
        Kind("forecasting bundle", "json", "bundles/forecasting", "*.json", _BUNDLE),
        Kind("bundle's samples", "parquet", "bundles/accident", "*.parquet", _BUNDLE),
        Kind("bundle's results", "npz", "bundles/motion", "results/motion/shards/*.npz", _BUNDLE),
        Kind("labels' list", "json", "labels", "manifest.json", (Action(_labels, _judge_labels),)),
        Kind("labels", "npz", "labels", "*/*/*.npz", (Action(_labels, _judge_labels),)),
        Kind("scenario file", "yaml", "specs", "*.yaml", (Action(_spec, _judge_spec),)),
        Kind("index's list", "json", "index", f"v1/{MANIFEST_FILE}", _INDEX),
        Kind("index's tables", "arrow", "index", "v1/tables-*/*.arrow", _INDEX),
        Kind("index's rows", "shard", "index", "v1/kept/*/*", _INDEX),
        *other_kinds.KINDS,
        *road_kinds.KINDS,
        *weights_kinds.KINDS,
    )
}
"""By name."""
