"""Compare by named digests what two checkouts of the devkit compute and write.

Usage: `digests.py BEFORE AFTER`. Both read the same releases, which BEFORE made with a fixed seed,
one after the other in the same folder, so that paths in files are equal. A worker in each checkout
writes a JSON file of names and digests: tables, labels, predictions, counts and summaries of all
protocols, studies, exports, releases in nuScenes' format, and a generated release. If a checkout
cannot compute a name, the error is its digest. Then the names that changed, came and went are
printed. The exit status is 1 if any of them matches no --expect.

    python .ci/tools/digests.py ../main . --expect 'evaluate/warning/boxes/*' --expect
    'export/*.manifest.json'

It takes about six minutes of a processor.
"""

import argparse
import contextlib
import dataclasses
import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from fnmatch import fnmatchcase
from importlib import import_module
from importlib.util import find_spec
from itertools import chain, product
from pathlib import Path
from types import ModuleType
from typing import Any

RELEASES = {
    "labelled": ["--scenarios", "6", "--frames", "35", "--sensors", "none", "--seed", "977"],
    "sensors": ["--scenarios", "2", "--frames", "11", "--size", "32x18", "--seed", "978"],
}
"""Release → options of `synth`: one with pasts and futures, and a small one with all sensors."""
GENERATED = [
    "--scenarios",
    "2",
    "--frames",
    "2",
    "--size",
    "48x27",
    "--seed",
    "979",
    "--layout",
    "B",
    "--designed",
]
"""Options of `synth` for the release that each checkout makes; all its files are compared."""
EXPORTS = {
    "av2": ("labelled", ["export", "av2"]),
    "cache": ("sensors", ["cache", "--size", "16x9", "--where", "length=1..1000"]),
    "clips": ("sensors", ["export", "clips"]),
    "labels": ("labelled", ["labels", "--samples", "all", "--split"]),
    "labels of beverse": (
        "labelled",
        ["labels", "--samples", "evaluate", "--names", "beverse", "--split"],
    ),
    "mcap": ("sensors", ["export", "mcap", "--motion-labels", "deepaccident"]),
    "mmdet3d": ("sensors", ["export", "mmdet3d"]),
    "mmdet3d released": ("sensors", ["export", "mmdet3d", "--style", "released"]),
    "nuscenes": ("sensors", ["export", "nuscenes"]),
    "opencood": ("sensors", ["export", "opencood"]),
    "parquet": ("labelled", ["export", "parquet"]),
    "questions": (
        "labelled",
        ["export", "questions", "--observe", "1", "--ahead", "1", "--stride", "0.5"],
    ),
    "release": ("sensors", ["export", "release", "--channels", "Camera_Front", "--size", "16x9"]),
    "town-maps": ("sensors", ["export", "town-maps"]),
}
"""Name → the release that is exported, and the command.

Commands that end in --split get a split file of all scenarios.
"""
NUSCENES_EXPORTS = {
    "labelled": ["--agents", "ego_vehicle,other_vehicle"],
    "sensors": ["--lidar-axes", "nuscenes", "--no-sweeps"],
}
"""Release that is exported to nuScenes' format and opened again → options of the export."""
NUSCENES_TASKS = ("motion", "detection", "forecasting")
"""Tasks evaluated on nuScenes, which has no accidents and no boxes of the own vehicle."""
STUDIES: dict[str, dict[str, Any]] = {
    "partners": {
        "title": "Partners",
        "question": "What do partners add?",
        "headline": {
            "row": "sees all",
            "less": "sees single",
            "number": "iou_100",
            "where": "accidents",
        },
        "releases": {"test": {"dataroot": "releases/labelled"}},
        "test": {"release": "test"},
        "rows": [
            {
                "name": "sees {agents}",
                "baseline": "constant_velocity",
                "agents": ["single", "all"],
            },
            {"name": "late {latency} s", "baseline": "constant_turn_rate", "latency": [0.2, 0.5]},
            {"name": "off", "baseline": "standing", "pose_noise": 0.5, "packet_loss": 0.1},
            {"name": "labels", "trivial": "labels"},
            {"name": "nothing", "trivial": "nothing"},
            {"name": "everything", "trivial": "everything"},
        ],
        "groups": {"accidents": ["collision=true"]},
        "by": ["impact_step", "weather"],
        "compare": [["labels", "nothing"]],
    },
    "nuscenes": {
        "title": "A study of a release in nuScenes' format",
        "question": "What does a baseline reach?",
        "releases": {
            "test": {
                "seed": 980,
                "scenarios": 2,
                "frames": 16,
                "image_size": [32, 18],
                "sensor_step": 5,
                "rig": "road",
                "nuscenes": True,
            }
        },
        "test": {"release": "test", "samples": "all", "labels": "fiery", "horizon": 0.5},
        "rows": [
            {"name": "standing", "baseline": "standing", "agents": "single", "horizon": 0.5},
            {
                "name": "constant velocity",
                "baseline": "constant_velocity",
                "agents": "single",
                "horizon": 0.5,
            },
        ],
        "compare": [["constant velocity", "standing"]],
    },
}
"""Name → recipe of a study without models."""
FILES_LEFT_OUT = {
    "*.deepaccident*": "marks of how far an export is, only for the devkit",
    "*.manifest.json": "names the version of the devkit and of stored results",
}
"""Pattern of files that are not compared → why."""
KEYS_LEFT_OUT = {
    "devkit_version": "a version",
    "environment": "versions of libraries",
    "settings": "all choices of the protocol, which later versions extend",
    "switches": "as settings",
    "explanation": "no evaluation here asks for it",
    "sanity": "no evaluation here asks for it",
    "results": "paths of the predictions, and notes with a version; predictions "
    "have digests of their own",
}
"""Key of an evaluation's summary that is not compared → why."""
STUDY_KEYS_LEFT_OUT = {"devkit": "a version", "recipe": "the same in both checkouts"}
"""Key of a study's summary that is not compared → why."""
CELL_KEYS_LEFT_OUT = {
    "key": "depends on the version",
    "machine": "versions of libraries",
    "seconds": "a time",
}
"""Key of a study's cell that is not compared → why."""
STUDY_FILES_LEFT_OUT = {
    "index.html": "has times and versions, and otherwise shows the numbers and figures",
    "study.json": "has times and versions; its numbers are compared one by one",
}
"""File of a study's results that is not compared → why."""
SPLIT = "everything.txt"
"""Name of a split file of all scenarios of the labelled release."""
MAX_PRINTED = 20
"""Number of names of a section that are printed one by one."""
Digests = dict[str, str]


def digest(value: object) -> str:
    """Return a hash of values: arrays by type, shape and bytes, records by their fields."""
    sha = hashlib.sha256()
    for part in _parts(value):
        sha.update(part)
    return sha.hexdigest()[:16]


def _parts(value: Any) -> Iterator[bytes]:
    """Yield the content of a value as bytes."""
    if dataclasses.is_dataclass(value):
        value = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        for name in sorted(value, key=repr):
            if value[name] is not None:  # a field that is None equals a field that is missing
                yield f"{name!r}:".encode()
                yield from _parts(value[name])
    elif isinstance(value, bytes):
        yield value
    elif hasattr(value, "tobytes"):
        yield f"{value.dtype}{value.shape}".encode()
        yield value.tobytes()
    elif isinstance(value, Iterable) and not isinstance(value, str):
        yield b"["
        for item in value:
            yield from _parts(item)
        yield b"]"
    else:
        yield f"{value!r},".encode()


def leaves(value: Any, name: str = "", depth: int = 3) -> Iterator[tuple[str, str]]:
    """Yield the name and text of each value of a JSON document.

    The text of a value that is long or lies deeper than `depth` is its digest.
    """
    if isinstance(value, list) and value and isinstance(value[0], Mapping):
        value = dict(enumerate(value))
    if isinstance(value, Mapping) and depth:
        for key, item in value.items():
            yield from leaves(item, f"{name}/{key}", depth - 1)
    else:
        text = json.dumps(value)
        yield name.removeprefix("/"), text if len(text) <= 40 else digest(value)


class DigestCollector:
    """Collects the digests of a checkout."""

    def __init__(self) -> None:
        self.digests: Digests = {}

    def add(self, name: str, compute: Callable[..., object], *arguments: object) -> None:
        """Add the digest of what a function returns, its digests by name, or its error."""
        try:
            result = compute(*arguments)
        except (Exception, SystemExit) as error:  # noqa: BLE001 - a removed name may raise anything
            self.digests[name] = f"{type(error).__name__}: {str(error)[:160]}"
            return
        if isinstance(result, Mapping):
            for part, part_digest in result.items():
                self.digests[f"{name}/{part}"] = part_digest
        else:
            self.digests[name] = digest(result)


def first_of(*names: str) -> ModuleType:
    """Import the first of several modules that exists; raises ModuleNotFoundError if none does.

    A folder without `__init__.py`, such as one that git left with nothing but bytecode, is none.
    """
    for name in names:
        try:
            spec = find_spec(name)
        except ModuleNotFoundError as error:
            if not name.startswith(f"{error.name}."):
                raise  # the parent package exists, but lacks something that it imports
            continue
        if spec is not None and spec.origin is not None:
            return import_module(name)
    raise ModuleNotFoundError(f"none of these modules exists: {', '.join(names)}")


def plugin(name: str) -> ModuleType:
    """Import a module that has moved below `plugins`, from there or from where it was before."""
    return first_of(f"deepaccident_devkit.plugins.{name}", f"deepaccident_devkit.{name}")


def command(*arguments: str) -> None:
    """Run a command of the devkit in this process, silently, with the options of its checkout."""
    import click

    from deepaccident_devkit.cli import deepaccident

    with (
        Path(os.devnull).open("w") as sink,
        contextlib.redirect_stdout(sink),
        contextlib.redirect_stderr(sink),
    ):
        try:
            deepaccident.main(list(arguments), standalone_mode=False)
        except click.UsageError:
            deepaccident.main(_former_arguments(arguments), standalone_mode=False)


def _former_arguments(arguments: Sequence[str]) -> list[str]:
    """Return a command in the spelling of November 2026; add a line for each option renamed."""
    words = [word for word in arguments if word != "--designed"]
    if words != list(arguments):
        return words  # that checkout lacks only --designed
    size_option = {"synth": "--image-size", "cache": "--resize"}.get(words[0], "--size")
    line = "\0".join(words)
    line = line.replace("--sensors\0none", "--no-sensors").replace("--size", size_option)
    return line.split("\0")


def digests_of_files(folder: Path, left_out: Iterable[str] = FILES_LEFT_OUT) -> Digests:
    """Return relative path → hash of the content of a file, or of the target of a link."""
    patterns = tuple(left_out)
    digests = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_dir() or any(fnmatchcase(name, pattern) for pattern in patterns):
            continue
        digests[name] = digest(str(path.readlink()) if path.is_symlink() else path.read_bytes())
    return digests


def digests_of_tables(dataset: Any, table: str) -> Digests:
    """Return a digest of each column as Arrow holds it, and of each other field of the records."""
    arrow, records = dataset.arrow(table), list(getattr(dataset, table))
    digests = {}
    for name in arrow.column_names:
        digests[name] = digest([str(arrow.schema.field(name).type), arrow[name].to_pylist()])
    for name in records[0] if records else ():
        if name not in digests:
            digests[name] = digest([record[name] for record in records])
    return digests


def add_tables(collector: DigestCollector, name: str, dataset: Any) -> None:
    """Add digests of the tables, and of the boxes and pairs of road users derived from them."""
    for table in dataset.table_names:
        collector.add(f"tables/{name}/{table}", digests_of_tables, dataset, table)
    for frame in ("world", "ego", "lidar"):
        collector.add(f"tables/{name}/box/{frame}", digests_of_boxes, dataset, frame)
    for record in dataset.scenario:
        collector.add(
            f"tables/{name}/interaction/{record['token']}",
            digests_of_interactions,
            dataset,
            record["token"],
        )


def digests_of_boxes(dataset: Any, frame: str) -> Digests:
    """Return a digest of each field of the boxes of some samples."""
    boxes = [dataset.boxes(token, frame) for token in some_samples(dataset, 40)]
    digests = {}
    for field in dataclasses.fields(boxes[0]):
        digests[field.name] = digest([getattr(sample_boxes, field.name) for sample_boxes in boxes])
    return digests


def digests_of_interactions(dataset: Any, scenario: str) -> Digests:
    """Return a digest of each column of the two tables of a scenario's interactions."""
    from deepaccident_devkit.interactions import interactions

    result = interactions(dataset, scenario)
    tables = {"interaction": result.to_arrow(), "interaction_pair": result.pairs.to_arrow()}
    digests = {}
    for name, table in tables.items():
        for column in table.column_names:
            digests[f"{name}/{column}"] = digest(table[column].to_pylist())
    return digests


def add_labels(collector: DigestCollector, name: str, dataset: Any) -> None:
    """Add digests of the motion labels by each preset and protocol."""
    from deepaccident_devkit.motion import LABEL_PROTOCOLS, PRESETS, MotionLabelConfig

    configs = {preset: MotionLabelConfig.preset(preset) for preset in PRESETS}
    configs |= {
        f"protocol {protocol}": MotionLabelConfig(protocol=protocol) for protocol in LABEL_PROTOCOLS
    }
    configs |= {
        "agents single": MotionLabelConfig(agents="single"),
        "vehicles": MotionLabelConfig(only_vehicle=True),
    }
    for choice, config in configs.items():
        collector.add(f"labels/{name}/{choice}", digests_of_labels, dataset, config)


def add_segmentation(collector: DigestCollector, dataset: Any) -> None:
    """Add digests of the targets of segmentation, which need the images from above."""
    from deepaccident_devkit.motion import bev_segmentation

    for token in some_samples(dataset, 6):
        collector.add(f"labels/segmentation/{token}", bev_segmentation, dataset, token)


def digests_of_labels(dataset: Any, config: Any) -> Digests:
    """Return a digest of each array of the labels of some samples."""
    from deepaccident_devkit.motion import motion_labels

    labels = [motion_labels(dataset, token, config) for token in some_samples(dataset, 12)]
    fields = (
        "segmentation",
        "instance",
        "centerness",
        "offset",
        "flow",
        "future_egomotion",
        "valid",
        "id_map",
    )
    return {field: digest([getattr(label, field) for label in labels]) for field in fields}


def some_samples(dataset: Any, count: int) -> list[str]:
    """Return the tokens of about this many labelled samples, of all scenarios and agents."""
    tokens = [record["token"] for record in dataset.sample if record["labelled"]]
    step = max(len(tokens) // count, 1)
    return tokens[7 % step :: step]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Evaluated:
    """A release on which predictions of baselines are evaluated.

    Attributes:
        name: Name of the release in digests.
        dataset: The release.
        split: Split file of all its scenarios.
        folder: Folder for the results files of the predictions.
        baselines: Baselines by name.
        tasks: Names of the tasks; None for all.
        scope: Scope of the evaluated samples; None for the default of each task.
    """

    name: str
    dataset: Any
    split: Path
    folder: Path
    baselines: Mapping[str, Any]
    tasks: Sequence[str] | None = None
    scope: str | None = None


def baselines() -> dict[str, Any]:
    """Return the baselines to evaluate."""
    from deepaccident_devkit.v2x import Link

    baseline = plugin("baselines").Baseline
    noisy = Link(latency=0.2, pose_noise=0.4, packet_loss=0.1, seed=977)
    return {
        "constant velocity": baseline(),
        "turn rate of all, noisy": baseline(
            agents="all", model="constant_turn_rate", link=noisy, horizon=3.0
        ),
    }


def add_evaluations(collector: DigestCollector, evaluated: Evaluated) -> None:
    """Add digests of predictions, and of evaluations by each protocol of each task."""
    from deepaccident_devkit.evaluation import read_results
    from deepaccident_devkit.evaluation.runs.setups import TASKS

    dataset, predict_results = evaluated.dataset, plugin("baselines").predict_results
    predicted_tasks = [task for task in TASKS if task != "segmentation"]  # baselines lack it
    tasks = tuple(evaluated.tasks or predicted_tasks)
    kinds = tuple(dict.fromkeys(chain.from_iterable(result_kinds(TASKS[task]) for task in tasks)))
    for (name, baseline), kind in product(evaluated.baselines.items(), kinds):
        label = f"{evaluated.name}/{name}, {kind}"
        path = evaluated.folder / name / (kind if kind == "motion" else f"{kind}.json")
        path.parent.mkdir(parents=True, exist_ok=True)
        tokens = predicted_samples(evaluated, kind)
        results = read_results(predict_results(dataset, kind, tokens, path, baseline, workers=1))
        collector.add(f"predicted/{label}", map, results.prediction, tokens)
        if kind == "motion":
            collector.add(f"predicted/{label}, as forecasts", motion_forecasts, dataset, results)
        for task, protocol in protocols_of(tasks, kind):
            digest_name = f"evaluate/{task}/{protocol}/{label}"
            collector.add(digest_name, digests_of_evaluation, evaluated, results, task, protocol)


def result_kinds(task: Any) -> tuple[str, ...]:
    """Return the kinds of results that a task is evaluated from (once called `kinds`)."""
    kinds: tuple[str, ...] = task.result_kinds if hasattr(task, "result_kinds") else task.kinds
    return kinds


def predicted_samples(evaluated: Evaluated, kind: str) -> list[str]:
    """Return the tokens of all samples that have predictions of a kind of results."""
    from deepaccident_devkit.evaluation.runs import default_selection
    from deepaccident_devkit.evaluation.runs.setups import TASKS, EvaluationSetup

    # each kind of results has the name of the task that it is made for
    setup = EvaluationSetup(task=kind, protocol=next(iter(TASKS[kind].protocols)))
    selection = default_selection(setup, evaluated.split, samples="all", scope="all")
    tokens: list[str] = selection.tokens(evaluated.dataset)
    return tokens


def protocols_of(tasks: Iterable[str], kind: str) -> Iterator[tuple[str, str]]:
    """Yield the task and protocol of each evaluation that takes results of a kind."""
    from deepaccident_devkit.evaluation.runs.setups import TASKS

    for task in tasks:
        for protocol in TASKS[task].protocols:
            takes_maps_only = (task, protocol) == ("accident", "released")
            if kind in (("motion",) if takes_maps_only else result_kinds(TASKS[task])):
                yield task, protocol


def motion_forecasts(dataset: Any, results: Any) -> list[Any]:
    """Return the forecasts that predicted motion gives of some samples."""
    from deepaccident_devkit.evaluation.forecasting import forecasting_truth, forecasts_of

    forecasts = []
    for token in results.tokens[:: max(len(results.tokens) // 20, 1)]:
        truth = forecasting_truth(dataset, token)
        forecasts.append(forecasts_of(results.prediction(token), truth.actor_id, truth.present))
    return forecasts


def digests_of_evaluation(evaluated: Evaluated, results: Any, task: Any, protocol: str) -> Digests:
    """Return the numbers of an evaluation by name, and digests of breakdowns and of counts."""
    from deepaccident_devkit.evaluation import Resampling
    from deepaccident_devkit.evaluation.runs import default_selection, evaluate_results
    from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup

    dataset, resampling = evaluated.dataset, Resampling(resamples=30)
    setup = EvaluationSetup(task=task, protocol=protocol)
    selection = default_selection(setup, evaluated.split, scope=evaluated.scope)
    # pools of processes would take longer to start than the work itself
    run = evaluate_results(dataset, results, setup, selection, allow_partial=True, workers=1)
    run = run.broken_down(None, resampling)
    if (task, protocol) == ("warning", "clean"):
        run = plugin("safety.prevention").with_prevented(run, dataset, resampling)
    summary = {name: value for name, value in run.summary().items() if name not in KEYS_LEFT_OUT}
    breakdowns = summary.pop("breakdowns")
    return {
        **dict(leaves(summary)),
        **{f"breakdowns/{name}": digest(table) for name, table in breakdowns.items()},
        "counts of samples": digest(dict(run.evaluator.counts)),
    }


def add_studies(collector: DigestCollector, folder: Path) -> None:
    """Add digests of studies without models, and of the recipes that ship."""
    for name in STUDIES:
        collector.add(f"study/{name}", digests_of_study, name, folder)
    collector.add("recipe", digests_of_recipes)


def digests_of_study(name: str, folder: Path) -> Digests:
    """Run a study; return digests of its numbers and files."""
    study = plugin("study")
    recipe = folder / f"{name}.yaml"
    recipe.parent.mkdir(exist_ok=True)
    recipe.write_text(json.dumps(STUDIES[name]))  # JSON is YAML
    report = study.run_study(study.read_recipe(str(recipe)), folder / "out", workers=1)
    summary = {k: value for k, value in report.to_dict().items() if k not in STUDY_KEYS_LEFT_OUT}
    summary["cells"] = [
        {key: value for key, value in cell.items() if key not in CELL_KEYS_LEFT_OUT}
        for cell in summary["cells"]
    ]
    files = digests_of_files(folder / "out" / name, STUDY_FILES_LEFT_OUT)
    return {**dict(leaves(summary, depth=5)), **files}


def shipped_recipes() -> Path:
    """Return the folder of shipped recipes; checkouts before November 30 called it `SHIPPED`."""
    recipe = plugin("study.recipe")
    folder: Path = recipe.SHIPPED_RECIPES if hasattr(recipe, "SHIPPED_RECIPES") else recipe.SHIPPED
    return folder


def digests_of_recipes() -> Digests:
    """Return a digest of each recipe that ships, as it is and for a quick trial."""
    from msgspec import to_builtins

    study = plugin("study")
    names = sorted(path.stem for path in shipped_recipes().glob("*.yaml"))
    digests = {}
    for name, smoke in product(names, (False, True)):
        recipe = to_builtins(study.read_recipe(name, smoke=smoke))
        for source in recipe["releases"].values():
            if source.get("spec"):
                source["spec"] = Path(source["spec"]).name  # its folder is in the checkout
        digests[f"{name}{'-smoke' * smoke}"] = digest(recipe)
    return digests


def add_nuscenes(collector: DigestCollector, folder: Path) -> None:
    """Add digests of exports to nuScenes' format, opened as releases."""
    for name, options in NUSCENES_EXPORTS.items():
        dataroot = folder / "nuscenes" / name
        release = folder / "releases" / name
        command("export", "nuscenes", str(release), "--out", str(dataroot), *options)
        dataset, label = plugin("nuscenes").open_nuscenes(dataroot), f"nuscenes {name}"
        add_tables(collector, label, dataset)
        every_box = f"tables/{label}/annotation with ignored"
        collector.add(every_box, digests_of_tables, dataset.with_ignored, "annotation")
        add_labels(collector, label, dataset)
        collector.add(f"check/{label}", plugin("nuscenes.check").check_source, dataset)
        if name == "sensors":
            for token in some_samples(dataset, 6):
                collector.add(f"sensors/{label}/{token}", digests_of_sensors, dataset, token)
        else:
            add_nuscenes_evaluations(
                collector, label, dataset, dataroot.with_name(f"{name} predicted")
            )


def add_nuscenes_evaluations(
    collector: DigestCollector, name: str, dataset: Any, folder: Path
) -> None:
    """Add digests of evaluations on nuScenes, and of detections in nuScenes' own format."""
    split = folder / SPLIT
    write_split(split, dataset)
    baseline = {"constant velocity": baselines()["constant velocity"]}
    evaluated = Evaluated(
        name=name,
        dataset=dataset,
        split=split,
        folder=folder,
        baselines=baseline,
        tasks=NUSCENES_TASKS,
        scope="all",  # none of its scenarios is designed to end in an accident
    )
    add_evaluations(collector, evaluated)
    results = folder / "constant velocity" / "detection.json"
    own_format = f"predicted/{name}/constant velocity, nuScenes' detections"
    collector.add(own_format, nuscenes_detections, dataset, results)


def nuscenes_detections(dataset: Any, results: Path) -> bytes:
    """Return the file of detections that nuScenes' own evaluation reads."""
    from deepaccident_devkit.evaluation import ResultsWriter, read_results

    detections = read_results(results)
    copied = results.with_name("detections without notes.json")
    with ResultsWriter(copied, "detection") as writer:  # notes of a model are expected, if any
        for token in detections.tokens:
            writer.add(token, detections.prediction(token))
    path: Path = plugin("nuscenes.results").write_detections(dataset, copied)
    return path.read_bytes()


def digests_of_sensors(dataset: Any, token: str) -> Digests:
    """Return digests of a sample's point cloud, cameras, images and token in nuScenes."""
    from deepaccident_devkit.taxonomy import CAMERAS

    parts = {"lidar": dataset.load_point_cloud(token), "token": dataset.nuscenes_token(token)}
    for camera in CAMERAS:
        image = dataset.load_image(token, camera)
        parts[camera] = [image, dataset.camera(token, camera), dataset.ego_from(token, camera)]
    return {name: digest(part) for name, part in parts.items()}


def write_split(path: Path, dataset: Any) -> None:
    """Write a split file of all scenarios of a release."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [record["token"].replace("/", " ") + "\n" for record in dataset.scenario]
    path.write_text("".join(lines))


def digests_of_export(name: str, folder: Path) -> Digests:
    """Return digests of the files that an export writes."""
    release, words = EXPORTS[name]
    out = folder / "exported" / name / ("scene.mcap" if name == "mcap" else "out")
    out.parent.mkdir(parents=True)
    split = [str(folder / SPLIT)] if words[-1] == "--split" else []
    command(*words, *split, str(folder / "releases" / release), "--out", str(out))
    return digests_of_files(out.parent)


def digests_of_generated(folder: Path) -> Digests:
    """Return digests of the files of a release that this checkout makes."""
    command("synth", str(folder / "generated"), *GENERATED)
    return digests_of_files(folder / "generated")


def write_digests(out: Path) -> None:
    """Write all digests of the checkout on the path, from the releases in this folder."""
    import deepaccident_devkit
    from deepaccident_devkit import DeepAccident

    print(f"  {deepaccident_devkit.__file__}", flush=True)
    folder, collector = Path.cwd(), DigestCollector()
    dataset, sensors = (
        DeepAccident("v1", folder / "releases" / name, verbose=False) for name in RELEASES
    )
    write_split(folder / SPLIT, dataset)

    def labels() -> None:
        add_labels(collector, "labelled", dataset)
        add_segmentation(collector, sensors)

    def evaluations() -> None:
        evaluated = Evaluated(
            name="labelled",
            dataset=dataset,
            split=folder / SPLIT,
            folder=folder / "predicted",
            baselines=baselines(),
        )
        add_evaluations(collector, evaluated)

    def exports() -> None:
        for name in EXPORTS:
            collector.add(f"export/{name}", digests_of_export, name, folder)

    sections: dict[str, Callable[[], None]] = {
        "synth": lambda: collector.add("synth", digests_of_generated, folder),
        "tables of labels": lambda: add_tables(collector, "labelled", dataset),
        "tables with sensors": lambda: add_tables(collector, "sensors", sensors),
        "labels": labels,
        "evaluations": evaluations,
        "studies": lambda: add_studies(collector, folder / "studies"),
        "exports": exports,
        "nuScenes": lambda: add_nuscenes(collector, folder),
    }
    for name, section in sections.items():
        before = len(collector.digests)
        collector.add(f"all {name}", section)
        print(f"  {name}: {len(collector.digests) - before:,} digests", flush=True)
    out.write_text(
        json.dumps(collector.digests, indent=1, sort_keys=True, ensure_ascii=False) + "\n"
    )


def run_in(checkout: Path, python: str, *arguments: str, folder: Path) -> None:
    """Run Python with a checkout's package in a folder; raises CalledProcessError."""
    environment = {
        **os.environ,
        "PYTHONPATH": str(checkout),
        "MPLBACKEND": "Agg",
        "PYTHONHASHSEED": "0",
    }
    subprocess.run([python, *arguments], cwd=folder, env=environment, check=True, stderr=None)


def digests_in(checkout: Path, python: str, releases: Path, folder: Path) -> Digests:
    """Return the digests that a worker in a checkout computes in a new folder."""
    shutil.rmtree(folder, ignore_errors=True)
    without_index = shutil.ignore_patterns(".deepaccident")
    shutil.copytree(
        releases, folder / "releases", ignore=without_index, copy_function=shutil.copyfile
    )
    out = folder / "digests.json"
    run_in(checkout, python, __file__, "--worker", str(out), folder=folder)
    digests: Digests = json.loads(out.read_text())
    return digests


def make_releases(checkout: Path, python: str, folder: Path) -> None:
    """Make the releases with a checkout."""
    for name, words in RELEASES.items():
        call = (
            f"import sys; sys.path.append({str(Path(__file__).parent)!r}); from "
            f"digests import command"
        )
        run_in(
            checkout,
            python,
            "-c",
            f"{call}; command(*sys.argv[1:])",
            "synth",
            str(folder / name),
            *words,
            folder=folder,
        )


def differences(before: Digests, after: Digests) -> dict[str, str]:
    """Return name → how its digest differs."""
    changes = {}
    for name, old_digest in before.items():
        if name not in after:
            changes[name] = f"went (was {old_digest})"
        elif after[name] != old_digest:
            changes[name] = f"changed: {old_digest} → {after[name]}"
    for name, new_digest in after.items():
        if name not in before:
            changes[name] = f"came ({new_digest})"
    return changes


def print_differences(changes: Mapping[str, str], title: str) -> None:
    """Print names and how they differ; of a long section only some, and how many more it has."""
    print(f"{title}: {len(changes):,}")
    counts: Counter[str] = Counter()
    for name, change in sorted(changes.items()):
        section = "/".join(name.split("/")[:3])
        counts[section] += 1
        if counts[section] <= MAX_PRINTED:
            print(f"  {name}: {change}")
    for section, count in counts.items():
        if count > MAX_PRINTED:
            print(f"  {section}/…: {count - MAX_PRINTED:,} more")


def parse_arguments() -> argparse.Namespace:
    """Return the arguments of the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n\n")[0])
    parser.add_argument(
        "checkouts", nargs="*", type=Path, metavar="CHECKOUT", help="two folders: BEFORE and AFTER"
    )
    parser.add_argument(
        "--release", type=Path, help="folder of releases that a run with --keep made"
    )
    parser.add_argument(
        "--expect", action="append", default=[], metavar="PATTERN", help="names that may differ"
    )
    parser.add_argument("--python", default=sys.executable, help="interpreter of both workers")
    parser.add_argument(
        "--keep", type=Path, help="folder for releases and digests, instead of a temporary one"
    )
    parser.add_argument("--worker", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.worker is None and len(arguments.checkouts) != 2:
        parser.error("give two checkouts")
    return arguments


def compare(arguments: argparse.Namespace, folder: Path) -> tuple[Digests, Digests]:
    """Return the digests of the two checkouts; also write them into a folder."""
    (folder / "releases").mkdir(parents=True, exist_ok=True)
    before, after = (checkout.resolve() for checkout in arguments.checkouts)
    releases = folder / "releases"
    if arguments.release is not None:
        releases = arguments.release.resolve()
    else:
        make_releases(before, arguments.python, releases)
    results = []
    for name, checkout in (("before", before), ("after", after)):
        print(f"{name}: {checkout}", flush=True)
        digests = digests_in(checkout, arguments.python, releases, folder / "run")
        text = json.dumps(digests, indent=1, sort_keys=True, ensure_ascii=False)
        (folder / f"{name}.json").write_text(text)
        results.append(digests)
    return results[0], results[1]


def main() -> int:
    """Compare two checkouts; return the exit status."""
    arguments = parse_arguments()
    if arguments.worker is not None:
        write_digests(arguments.worker)
        return 0
    with tempfile.TemporaryDirectory() as temporary:
        before, after = compare(arguments, (arguments.keep or Path(temporary)).resolve())
    expected, unexpected = {}, {}
    for name, change in differences(before, after).items():
        is_expected = any(fnmatchcase(name, pattern) for pattern in arguments.expect)
        (expected if is_expected else unexpected)[name] = change
    equal_count = sum(before[name] == after.get(name) for name in before)
    print(f"{equal_count:,} equal")
    print_differences(expected, "as expected")
    print_differences(unexpected, "unexpected")
    return int(bool(unexpected))


if __name__ == "__main__":
    sys.exit(main())
