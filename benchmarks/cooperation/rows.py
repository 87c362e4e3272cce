"""The rows of benchmarks/cooperation: what predicts, with which data, and how its results are written and counted."""

import gzip
import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import torch

from benchmarks.cooperation.numbers import Evaluators, HiddenActors, scene_of
from deepaccident_devkit import DeepAccident
from deepaccident_devkit.baselines import predict_accidents, predict_detections, predict_motion
from deepaccident_devkit.evaluation import Accident, DetectedBoxes, MotionOutput, ResultsWriter, read_results
from deepaccident_devkit.evaluation.breakdowns import cluster_of
from deepaccident_devkit.evaluation.runs import SampleSelection, evaluate_results, save_run
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.export.torch import V2XDataset, collate
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.model.checkpoint import load_weights, read_weights
from deepaccident_devkit.model.network import V2XFormer
from deepaccident_devkit.model.presets import ModelChoice, tiny
from deepaccident_devkit.model.results import PredictConfig, prediction_of
from deepaccident_devkit.support.files import write_bytes
from deepaccident_devkit.taxonomy import FRAME_PERIOD
from deepaccident_devkit.v2x import Link

Kind = Literal["model", "baseline", "nothing", "everything"]
Control = Literal["blank", "strangers"]
SETUPS: Final = {
    "motion": EvaluationSetup(task="motion", protocol="paper", switches={"labels": "clean"}),
    "accident": EvaluationSetup(task="accident", protocol="boxes"),
    "detection": EvaluationSetup(task="detection", protocol="paper"),
}
FILES: Final = {"motion": "motion", "accident": "accident.json", "detection": "detection.json"}
HORIZON: Final = 2.0
EGO: Final = "ego_vehicle"
_FOREIGN: Final = ("images", "intrinsics", "ego_from_camera", "image_from_ego", "agent_from_past", "ego_from_agent")
"""What a stranger brings with it: images, cameras and poses."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One line of the tables.

    Attributes:
        name: of the line.
        says: what it is, for readers.
        kind: what predicts.
        arm: of a model, whose weights.
        agents: who cooperates in the test.
        control: what is spoilt in the inputs; None for nothing.
        latency: seconds by which partners' data are late.
        pose_noise: metres.
        first_seed_alone: whether only the first of the model's seeds is tested.
    """

    name: str
    says: str
    kind: Kind = "model"
    arm: str | None = None
    agents: str = "all"
    control: Control | None = None
    latency: float = 0.0
    pose_noise: float = 0.0
    first_seed_alone: bool = False

    @property
    def link(self) -> Link | None:
        """What happens to the partners' data."""
        if not (self.latency or self.pose_noise):
            return None
        return Link(latency=self.latency, pose_noise=self.pose_noise or None)


@dataclass(frozen=True, slots=True, kw_only=True)
class RowJob:
    """A row with one model's weights; cheap to pickle.

    Attributes:
        row: the row.
        release: the test release.
        split: its split file.
        out: folder of the results and bundles.
        weights: of a model.
        device: where it is.
    """

    row: Row
    release: Path
    split: Path
    out: Path
    weights: Path | None = None
    device: str = "cpu"

    @property
    def selection(self) -> SampleSelection:
        """The samples of the test: the last two seconds of accidents and of their twins, of the ego vehicle."""
        return SampleSelection(split=str(self.split), samples="evaluate", scope="all", agents=(EGO,), horizon=HORIZON)


def opened(folder: Path) -> DeepAccident:
    """A release, without words."""
    return DeepAccident("v1", folder, verbose=False)


def write_results(job: RowJob) -> None:
    """Predict the test's samples; the folder of results appears when all are there."""
    folder = job.out / "results"
    if folder.exists():
        return
    dataset = opened(job.release)
    unfinished = folder.with_name("results.unfinished")
    shutil.rmtree(unfinished, ignore_errors=True)
    unfinished.mkdir(parents=True)
    labels = tiny().labels
    form = {"grid": labels.grid, "step": labels.step * FRAME_PERIOD, "labels": "clean"}
    with ExitStack() as stack:
        writers = {
            task: stack.enter_context(
                ResultsWriter(
                    unfinished / name, task, meta={"method": job.row.says}, **(form if task == "motion" else {})
                )
            )
            for task, name in FILES.items()
        }
        for token, *found in _predicted(job, dataset, job.selection.tokens(dataset)):
            for writer, each in zip(writers.values(), found, strict=True):
                writer.add(token, each)
    unfinished.rename(folder)


def count_results(job: RowJob) -> None:
    """Evaluate a row's results: a bundle a task, and the counts of hidden actors."""
    dataset, results = opened(job.release), job.out / "results"
    for task, setup in SETUPS.items():
        bundle = job.out / task
        if not bundle.exists():
            save_run(evaluate_results(dataset, results / FILES[task], setup, job.selection, workers=1), bundle)
    if (job.out / "hidden.json").exists():
        return
    motion, boxes = (read_results(results / FILES[task]) for task in ("motion", "detection"))
    evaluator = HiddenActors()
    for token in job.selection.tokens(dataset):
        ego_from_world = dataset.world_from(token, "ego").inverse()
        found = boxes.prediction(token)
        local = DetectedBoxes(boxes=found.boxes.transform(ego_from_world, "ego"), scores=found.scores)
        evaluator.update(token, scene_of(dataset, token, tiny().labels), motion.prediction(token), local)
    evaluator.save(job.out / "hidden.json")


def evaluators_of(folder: Path) -> Evaluators:
    """What `count_results` has counted."""
    counted = {task: setup.evaluator().resume(folder / task / "counts.json") for task, setup in SETUPS.items()}
    return {**counted, "hidden": HiddenActors().resume(folder / "hidden.json")}


def write_counts(path: Path, rows: Mapping[str, Evaluators]) -> None:
    """The counts of all rows but those of detection, which are many, packed; the same ones give the same bytes."""
    told = {
        name: {kind: dict(each.counts) for kind, each in found.items() if kind != "detection"}
        for name, found in rows.items()
    }
    write_bytes(path, gzip.compress(json.dumps(told, sort_keys=True).encode(), mtime=0))


def read_counts(path: Path) -> dict[str, Evaluators]:
    """The evaluators of all rows, from what `write_counts` wrote."""
    found: dict[str, Evaluators] = {}
    for name, kinds in json.loads(gzip.decompress(path.read_bytes())).items():
        evaluators = {kind: HiddenActors() if kind == "hidden" else SETUPS[kind].evaluator() for kind in kinds}
        for kind, counts in kinds.items():
            for token, each in counts.items():
                evaluators[kind].add(token, each)
        found[name] = evaluators
    return found


def donors(tokens: Sequence[str]) -> list[str]:
    """For each sample one at the same place in the list of another pair's scenario, whose partners take part in it."""
    scenarios: dict[str, list[str]] = {}
    for token in tokens:
        scenarios.setdefault(token.rsplit("/", 2)[0], []).append(token)
    names = list(scenarios)
    chosen = []
    for at, name in enumerate(names):
        others = [each for each in names[at + 1 :] + names[:at] if cluster_of(each) != cluster_of(name)]
        assert others, f"{name}: there is no other pair to take partners from"
        given = scenarios[others[0]]
        chosen += [given[min(rank, len(given) - 1)] for rank in range(len(scenarios[name]))]
    return chosen


def blanked(item: Mapping[str, Any]) -> dict[str, Any]:
    """An item whose images are all black."""
    return {**item, "images": torch.zeros_like(item["images"])}


def with_strangers(item: Mapping[str, Any], donor: Mapping[str, Any]) -> dict[str, Any]:
    """An item whose partners' images, cameras and poses are those of another item's agents with the same names."""
    changed = {name: item[name].clone() for name in _FOREIGN}
    for slot, name in enumerate(item["agents"]):
        if slot and name in donor["agents"]:
            for key, values in changed.items():
                values[slot] = donor[key][donor["agents"].index(name)]
    return {**item, **changed}


_Found = tuple[str, MotionOutput, list[Accident], DetectedBoxes]


def _predicted(job: RowJob, dataset: DeepAccident, tokens: Sequence[str]) -> Iterator[_Found]:
    if job.row.kind == "model":
        yield from _by_model(job, dataset, tokens)
        return
    for token in tokens:
        yield _by_baseline(job.row, dataset, token) if job.row.kind == "baseline" else _trivial(job.row, token)


def _by_model(job: RowJob, dataset: DeepAccident, tokens: Sequence[str]) -> Iterator[_Found]:
    row = job.row
    assert job.weights is not None, f"{row.name}: has no weights"
    model = V2XFormer(ModelChoice().config)
    load_weights(model, read_weights(job.weights), whole=True)
    model.to(job.device).eval()
    config = PredictConfig(agents=row.agents, link=row.link, device=job.device)
    given = model.config.inputs(config.agents, link=config.link)
    items = V2XDataset(dataset, tokens, given)
    foreign = V2XDataset(dataset, donors(tokens), given) if row.control == "strangers" else None
    for at in range(len(items)):
        item: Any = items[at]
        if row.control == "blank":
            item = blanked(item)
        elif foreign is not None:
            item = with_strangers(item, foreign[at])
        found = prediction_of(model, collate([item]), config)
        yield found.token, found.motion, found.accidents, found.boxes


def _by_baseline(row: Row, dataset: DeepAccident, token: str) -> _Found:
    motion = predict_motion(dataset, token, agents=row.agents, config=tiny().labels)
    return (
        token,
        motion,
        predict_accidents(dataset, token, agents=row.agents, horizon=HORIZON),
        predict_detections(dataset, token, agents=row.agents),
    )


def _trivial(row: Row, token: str) -> _Found:
    """An empty map, or one that is all one actor; no alarm, no box."""
    labels = tiny().labels
    maps = np.full((1, labels.future_frames + 1, *labels.grid.shape), int(row.kind == "everything"), dtype=np.int32)
    empty = Boxes.from_arrays(np.zeros((0, 3)), np.zeros((0, 3)), [], frame="world")
    return token, MotionOutput(grid=labels.grid, instances=maps), [], DetectedBoxes(boxes=empty, scores=np.zeros(0))
