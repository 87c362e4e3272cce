"""The healthy files that cases change: releases, an index, results, bundles, labels and exports.

Where PyTorch is installed, there are also files of weights and a training run.
"""

import json
import shutil
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import yaml
from support.nuscenes_dataroots import write_dataroot
from support.zipped_releases import zip_release

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation import (
    Accident,
    DetectedBoxes,
    Forecast,
    Plan,
    Resampling,
    accident_context,
    instances_of,
)
from deepaccident_devkit.evaluation.results import ResultsWriter
from deepaccident_devkit.evaluation.runs import SampleSelection, evaluate_results, save_run
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.export.bulk import export_release
from deepaccident_devkit.export.images import ImageConfig
from deepaccident_devkit.export.opencood import OpenCood
from deepaccident_devkit.export.questions import Questions, WindowRules
from deepaccident_devkit.motion import MotionLabelConfig, write_label_files
from deepaccident_devkit.plugins.study.recipe import SHIPPED_RECIPES
from deepaccident_devkit.plugins.synth.spec import design_text
from deepaccident_devkit.taxonomy import CAMERAS, AgentName
from deepaccident_devkit.testing import SmallRelease, write_small_release
from deepaccident_devkit.training.image_cache import CachedImages

AGENTS: tuple[AgentName, ...] = ("ego_vehicle", "infrastructure")
CHANNELS = ("Camera_Front", "lidar01", "BEV_instance_camera")
HORIZON_S = 0.5
LABELS = MotionLabelConfig(future_frames=1)
EXPORT = OpenCood(without_clouds=True)
SCHEDULER = "tcp://127.0.0.1:9"
"""Address at which no scheduler listens."""
SETUPS = {
    "motion": EvaluationSetup(task="motion", horizon=HORIZON_S),
    "accident": EvaluationSetup(task="accident", protocol="boxes", horizon=HORIZON_S),
    "detection": EvaluationSetup(task="detection"),
    "planning": EvaluationSetup(task="planning", protocol="clean", horizon=HORIZON_S),
    "forecasting": EvaluationSetup(task="forecasting", protocol="clean", horizon=HORIZON_S),
}


RECIPE = {
    "title": "Every key",
    "question": "Is each of them read?",
    "releases": {
        "there": {"dataroot": "/data/DeepAccident", "version": "v1"},
        "made": {
            "seed": 3,
            "scenarios": 4,
            "frames": 20,
            "spec": "scenes/mine.yaml",
            "nuscenes": True,
        },
    },
    "weights": {
        "first": {
            "release": "there",
            "split": "train",
            "preset": "tiny",
            "steps": 10,
            "learning_rate": 0.001,
        },
        "second": {
            "release": "made",
            "also": "there",
            "also_split": "val",
            "mix": 0.25,
            "from": "first",
        },
        "given": {"file": "tiny"},
    },
    "test": {
        "release": "made",
        "split": "all",
        "samples": "evaluate",
        "scope": "all",
        "agents": ["ego_vehicle"],
        "horizon": 1.5,
        "where": ["town=Town03"],
        "labels": "clean",
        "includes_training": True,
    },
    "seeds": [1, 2],
    "rows": [
        {
            "name": "{agents}, {latency} s",
            "weights": "first",
            "agents": ["single", "all"],
            "latency": [0.0, 0.2],
        },
        {
            "name": "boxes",
            "weights": "second",
            "baseline": "constant_velocity",
            "budget": 1000,
            "packet_loss": 0.1,
        },
        {"name": "black", "weights": "given", "control": "blank"},
        {
            "name": "off {pose_noise} m",
            "baseline": "standing",
            "pose_noise": [0.0, 0.5],
            "horizon": 2.0,
        },
        {"name": "nothing", "trivial": "nothing"},
    ],
    "groups": {"hidden": ["hidden_collider=true"]},
    "by": ["impact_step"],
    "compare": [["boxes", "black"]],
    "headline": {"row": "boxes", "less": "nothing", "number": "map", "where": "hidden"},
    "smoke": {"seeds": [1], "releases": {"made": {"scenarios": 2}}},
}
"""A recipe of a study."""
HAS_TORCH = find_spec("torch") is not None


class _InterruptedExport(OpenCood):
    """Export that is interrupted when all scenarios are written."""

    def finish(self, *_: object) -> None:
        raise KeyboardInterrupt


def make_healthy(folder: Path) -> Path:
    """Write all healthy files into a new folder, which takes a few seconds; return the folder.

    Files in its folder `kept` are never changed.
    """
    _write_releases(folder)
    dataset = open_release(folder / "release", folder / "index")
    sensors = open_release(folder / "sensors", folder / "index_of_sensors")
    for task, setup in SETUPS.items():
        results = folder / "results" / task
        _write_results(dataset, results, task)
        run = evaluate_results(dataset, results, setup, select_samples(task), workers=1)
        run = run.broken_down(("all", "agent"), Resampling(resamples=20))
        save_run(run, folder / "bundles" / task, include_results=True)
    write_label_files(dataset, folder / "labels", list_tokens(dataset), LABELS, workers=1)
    _write_texts(folder)
    _write_exports(dataset, sensors, folder)
    for method in ("stored", "deflated"):
        zip_release(folder / "small", folder / "zips" / f"{method}.zip", method)
    write_dataroot(folder / "road", keyframes=3, boxes=8)
    if HAS_TORCH:
        from campaign.healthy_weights import write_run, write_weight_files

        write_weight_files(folder / "weights")
        write_run(open_release(folder / "cameras", folder / "index_of_cameras"), folder / "run")
    for name in ("bundles", "index"):
        link_tree(folder / name, folder / "kept" / name)
    return folder


def open_release(root: Path, index_dir: Path) -> DeepAccident:
    """Open a release with its index, which is made if it does not exist."""
    return DeepAccident("v1", root, index_dir=index_dir, workers=1, verbose=False)


def link_tree(healthy: Path, home: Path) -> Path:
    """Copy a folder with hard links instead of files; return the copy.

    Folders keep their times, by which an index recognises its release.
    """
    return Path(shutil.copytree(healthy, home, copy_function=_link, dirs_exist_ok=True))


def select_samples(task: str) -> SampleSelection:
    """Return the selection of samples of a task's results."""
    # the infrastructure does not drive
    agents = AGENTS[:1] if task in ("planning", "forecasting") else None
    horizon = SETUPS[task].horizon
    return SampleSelection(split="train", samples="all", agents=agents, horizon=horizon)


def list_tokens(dataset: DeepAccident, task: str = "motion") -> list[str]:
    """Return the tokens of the samples that a task's results predict."""
    return list(select_samples(task).tokens(dataset))


def _write_releases(folder: Path) -> None:
    """Write small releases with and without sensors."""
    releases = [
        ("small", 2, AGENTS, ()),
        ("sensors", 1, AGENTS[:1], CHANNELS),
        ("release", 6, AGENTS, ()),
    ]
    if HAS_TORCH:
        releases.append(("cameras", 4, AGENTS, CAMERAS))
    for name, frames, agents, channels in releases:
        release = SmallRelease(splits=("train",), frames=frames, agents=agents, channels=channels)
        write_small_release(folder / name, release)


def _write_texts(folder: Path) -> None:
    """Write a scenario file, recipes of studies, and the file of a scheduler."""
    for name in ("specs", "recipes", "schedulers"):
        (folder / name).mkdir()
    (folder / "specs" / "crossing.yaml").write_text(design_text(1), encoding="utf-8")
    for name in ("agents", "road"):
        shutil.copy(SHIPPED_RECIPES / f"{name}.yaml", folder / "recipes")
    recipe = yaml.safe_dump(RECIPE, sort_keys=False)
    (folder / "recipes" / "every_key.yaml").write_text(recipe, encoding="utf-8")
    scheduler = {
        "type": "Scheduler",
        "id": "Scheduler-1",
        "address": SCHEDULER,
        "services": {"dashboard": 8787},
        "workers": {},
    }
    text = json.dumps(scheduler)
    (folder / "schedulers" / "scheduler.json").write_text(text, encoding="utf-8")


def _write_exports(dataset: DeepAccident, sensors: DeepAccident, folder: Path) -> None:
    """Write a complete and an interrupted export, questions with answers, and an image cache."""
    export_release(dataset, folder / "exports" / "whole", EXPORT, workers=1)
    begun = folder / "exports" / "begun"
    with suppress(KeyboardInterrupt):
        export_release(dataset, begun, _InterruptedExport(without_clouds=True), workers=1)
    records = begun / ".deepaccident-parts" / "kept" / "opencood"
    max(records.glob("*/done")).unlink()  # as if its unit were incomplete
    (records / "a_unit_of_before.paths").write_bytes(b"before/one.yaml\0before/two.yaml\0")
    (begun / "before").mkdir()
    for name in ("one", "two"):
        (begun / "before" / f"{name}.yaml").write_bytes(b"written by the killed one\n")
    questions = folder / "questions"
    windows = WindowRules(observe=0, ahead=1, stride=0.5)
    export_release(dataset, questions, Questions(window=windows), workers=1)
    lines = []
    for question_line in (questions / "truth.jsonl").read_bytes().splitlines():
        question = json.loads(question_line)
        answer = {
            "id": question["id"],
            "accident": [0.9] * len(question["accident"]),
            "who": list(question["actors"])[:2],
            "where": [[1, 2], [3, 4]],
        }
        lines.append(f"{json.dumps(answer)}\n")
    (questions / "answers.jsonl").write_text("".join(lines), encoding="utf-8")
    images = ImageConfig(resize=(18, 30), cameras=CHANNELS[:1])
    cache = CachedImages(images=images, agents=AGENTS[:1], where=("length>=1",))
    export_release(sensors, folder / "cache", cache, workers=1)


def _link(source: str, target: str) -> None:
    Path(target).hardlink_to(source)


def _write_results(dataset: DeepAccident, path: Path, task: str) -> None:
    """Write a prediction for each sample of a task."""
    grid = LABELS.grid if task == "motion" else None
    path.parent.mkdir(exist_ok=True)
    meta = {"method": "a healthy one"}
    with ResultsWriter(path, task, meta=meta, grid=grid, step=HORIZON_S) as writer:  # type: ignore[arg-type]
        for token in list_tokens(dataset, task):
            writer.add(token, _predict(dataset, token, task))


def _predict(dataset: DeepAccident, token: str, task: str) -> object:
    """Return a prediction for a sample, most of it made from the truth."""
    if task == "motion":
        label = dataset.motion_labels(token, LABELS).to_present("bilinear")
        return instances_of(label.instance, label.config.grid)
    if task == "detection":
        boxes = dataset.boxes(token)
        return DetectedBoxes(boxes=boxes, scores=np.linspace(0.1, 1.0, len(boxes)))
    times = [0.1, HORIZON_S]
    if task == "planning":
        fast = Plan(times=times, path=[[1.0, 0.0], [5.0, 0.5]], score=1.0, yaw=[0.0, 0.1])
        slow = Plan(times=times, path=[[0.5, 0.0], [2.0, 0.0]], score=0.0, yaw=[0.0, 0.1])
        return [fast, slow]
    if task == "forecasting":
        paths = [[[1.0, 2.0], [3.0, 4.0]], [[1.0, 2.0], [1.0, 2.5]]]
        actors = [actor for actor in dataset.boxes(token).actor_id.tolist() if actor >= 0]
        return [
            Forecast(actor_id=actor, times=times, paths=paths, probabilities=[0.75, 0.25])
            for actor in actors
        ]
    truth = accident_context(dataset, token, HORIZON_S).truth
    if truth is None or truth.accident is None:
        return []
    accident = truth.accident
    return [Accident(positions=accident.positions, time=accident.time, score=0.5)]
