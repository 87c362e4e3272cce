"""`Explorer`: all data of a release and of models that pages read, with its caches."""

from __future__ import annotations

import hashlib
import os
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Generic, TypeVar
from urllib.parse import quote

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import IndexStoreError, SensorFileError
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.plugins.explore.background import Jobs
from deepaccident_devkit.plugins.explore.choices import SCORE_PREFIX
from deepaccident_devkit.plugins.explore.models import Model, open_models
from deepaccident_devkit.plugins.explore.scenarios import Scenarios
from deepaccident_devkit.release.images import picture_bytes
from deepaccident_devkit.release.store.store import FileCache
from deepaccident_devkit.render.boxes import EDGES, actor_color, recorders_of, segments_in_image
from deepaccident_devkit.render.camera import best_view
from deepaccident_devkit.render.captions import has_sensor_file
from deepaccident_devkit.render.figures import figure_png
from deepaccident_devkit.render.replay import recording_of, served_replay
from deepaccident_devkit.render.replay.entries import ReplayRecording
from deepaccident_devkit.render.styles import COLLIDER_COLOR, MISSING_COLOR
from deepaccident_devkit.support.arrays import as_floats
from deepaccident_devkit.support.cores import usable_cores
from deepaccident_devkit.support.files import is_writable_folder, place_in
from deepaccident_devkit.support.parallel import Store
from deepaccident_devkit.tables.tokens import sample_token
from deepaccident_devkit.taxonomy import CAMERAS
from deepaccident_devkit.v2x.agents import agents_of
from deepaccident_devkit.v2x.tracks import scenario_tracks

if TYPE_CHECKING:
    from deepaccident_devkit.tables.records import ScenarioRecord

_Value = TypeVar("_Value")
_THUMBNAILS: Final = "thumbnails"
# Width and height in pixels.
PICTURE_SIZE: Final = (320, 180)
# Increased whenever the same release gives different pictures.
_THUMBNAIL_VERSION: Final = 1
_JPEG_QUALITY: Final = 75
# Metres from the centre of a picture from above to its left edge.
_HALF_WIDTH_M: Final = 40.0
# Bytes of pictures in memory; and scenarios with a replay in memory, some megabytes each.
_MAX_PICTURE_BYTES, _MAX_REPLAYS = 64_000_000, 6
# Pixels per inch of rendered figures.
DPI: Final = 80
# Smallest number of scenarios for which processes are worth their start.
_MIN_SCENARIOS_FOR_PROCESSES: Final = 64


class Explorer:
    """A release and models, opened for reading; safe to use from several threads.

    Attributes:
        dataset: The release.
        models: Models by name, in the order given.
        jobs: Slow work in the background.
        workers: Processes for slow work.
        scenarios: Columns of the release's scenarios.
        pictures: JPEG and PNG files in memory, by what they show.
        replays: Data of replays, by scenario and model.
        thumbnails: Files of thumbnails.
    """

    def __init__(
        self,
        dataset: Dataset,
        *,
        bundles: Iterable[str | os.PathLike[str]] = (),
        results: Iterable[str | os.PathLike[str]] = (),
        workers: int | None = None,
    ) -> None:
        """Open bundles and results.

        Args:
            dataset: The release.
            bundles: Folders that `save_run` wrote.
            results: Files or folders of results; the results of a bundle join it.
            workers: Processes for slow work; None uses few.

        Raises:
            ResultsError: One of them cannot be read.
        """
        self.dataset = dataset
        self.workers = workers or _few_workers(len(dataset.scenario))
        self.jobs = Jobs()
        self.scenarios = Scenarios(dataset, self.jobs, workers=self.workers)
        self.models: Mapping[str, Model] = open_models(
            map(Path, bundles), map(Path, results), self.jobs
        )
        self.pictures: ValueCache[bytes] = ValueCache(_MAX_PICTURE_BYTES, len)
        self.replays: ValueCache[dict[str, Any]] = ValueCache(_MAX_REPLAYS)
        self._recordings: ValueCache[ReplayRecording] = ValueCache(_MAX_REPLAYS)
        self.thumbnails = FileStore(dataset)

    def __repr__(self) -> str:
        """Return the release and the names of the models."""
        return f"Explorer({self.dataset!r}, models: {', '.join(self.models) or 'none'})"

    def begin(self) -> None:
        """Begin slow work in the background: the columns of the scenarios, and models' scores."""
        for model in self.models.values():
            if model.bundle is not None:
                _ = model.job
        self.scenarios.begin()

    @property
    def first_page(self) -> str:
        """Path of the first page: of the model, of several models, or of the scenarios."""
        pages = [f"model/{quote(name, safe='')}/" for name in self.models] or [""]
        if len(pages) == 1:
            return pages[0]
        return "models/"

    @property
    def scores(self) -> dict[str, Model]:
        """Column `score:MODEL` → model, for models with scores."""
        return {
            f"{SCORE_PREFIX}{name}": model
            for name, model in self.models.items()
            if model.bundle is not None
        }

    def thumbnail(self, token: str) -> bytes:
        """Return a scenario's thumbnail as JPEG; raise TokenError."""
        record = self.dataset.scenario.get(token)
        images = _last_images(self.dataset, record)
        dataroot = str(self.dataset.dataroot)
        identity = repr((_THUMBNAIL_VERSION, PICTURE_SIZE, token, dataroot, images))
        make = partial(thumbnail, self.dataset, record)
        return self.thumbnails.get(identity, "thumbnail.jpg", make)

    def recording(self, token: str) -> ReplayRecording:
        """Return what replays know of a scenario; raise TokenError."""
        return self._recordings.get(token, lambda: recording_of(self.dataset, token, None))

    def replay(self, token: str, model: str | None) -> dict[str, Any]:
        """Return the data of a scenario's replay (`served_replay`), with a model's predictions.

        Without a model it has no predictions.
        """

        def make() -> dict[str, Any]:
            prediction = None
            if model is not None:
                prediction = self.models[model].results
            return served_replay(self.dataset, token, "", prediction=prediction)

        return self.replays.get((token, model), make)

    def drawn(self, key: Hashable, draw: Callable[[], Any]) -> bytes:
        """Return a figure as PNG, rendered at the first call with a key."""
        return self.pictures.get(key, lambda: figure_png(draw(), dpi=DPI))


def _few_workers(scenarios: int) -> int:
    """Return the number of processes in the background.

    They leave cores for other users of the machine; a small release needs no processes of its own.
    """
    if scenarios >= _MIN_SCENARIOS_FOR_PROCESSES:
        return max(2, min(4, usable_cores() // 2))
    return 1


class ValueCache(Generic[_Value]):
    """Values made at their first request; the least recently used ones are evicted first.

    Each is made once, also if several threads request it at the same time; other values are made
    meanwhile.
    """

    def __init__(self, max_size: float, size: Callable[[_Value], float] = lambda _: 1.0) -> None:
        """Keep values with sizes that sum up to at most `max_size`; each counts 1 by default."""
        self._max_size, self._size = max_size, size
        self._values: OrderedDict[Hashable, _Value] = OrderedDict()
        self._total = 0.0
        self._lock = threading.Lock()
        self._key_locks: dict[Hashable, threading.Lock] = {}

    def get(self, key: Hashable, make: Callable[[], _Value]) -> _Value:
        """Return the value of a key; raise what `make` raises, and then keep nothing."""
        with self._lock:
            if key in self._values:
                self._values.move_to_end(key)
                return self._values[key]
            key_lock = self._key_locks.setdefault(key, threading.Lock())
        with key_lock:
            with self._lock:
                if key in self._values:
                    return self._values[key]
            try:
                value = make()
                with self._lock:
                    self._values[key] = value
                    self._total += self._size(value)
                    while self._total > self._max_size and len(self._values) > 1:
                        _, evicted = self._values.popitem(last=False)
                        self._total -= self._size(evicted)
            finally:
                with self._lock:
                    self._key_locks.pop(key, None)
        return value


class FileStore:
    """Small files that are made once.

    They lie beside the index, or in the user's cache where that folder cannot be written.
    """

    def __init__(self, dataset: Dataset) -> None:
        """Store files beside the index of this release: rebuilding its tables removes them."""
        self.folder = place_in(dataset.tables_folder, _THUMBNAILS, opened=True)
        if not is_writable_folder(dataset.tables_folder):
            self.folder = FileCache.of_user().folder.with_name(_THUMBNAILS)
        self._store = Store(self.folder, self.folder, "keeps thumbnails", IndexStoreError)

    def get(self, identity: str, name: str, make: Callable[[], bytes]) -> bytes:
        """Return the content of a file; raise what `make` raises.

        `identity` distinguishes it from all others.
        """
        identity_bytes = identity.encode(errors="surrogateescape")
        digest = hashlib.blake2b(identity_bytes, digest_size=16).hexdigest()
        path = f"{digest[:2]}/{digest[2:]}/{name}"
        stored = self._store.kept(path, digest, "image")
        if stored is not None:
            return stored
        content = make()
        # If the disk is full, or the folder may not be written to, it is made again the next time.
        with suppress(OSError):
            self._store.keep(path, digest, content)
        return content


def thumbnail(dataset: Dataset, record: ScenarioRecord) -> bytes:
    """Return a picture of a scenario's last moment with an image, as JPEG.

    It shows the colliding pair with red boxes in the best camera; without a collision, the front
    camera. Without downloaded images it shows the actors from above, and without labels a grey
    panel.
    """
    frame, _ = _last_images(dataset, record)
    boxes = scenario_tracks(dataset, record).at(frame)
    collision = record["collision"]
    pair_ids = [] if collision is None else collision["ids"]
    pair = boxes.select(np.isin(boxes.actor_id, pair_ids))
    samples = [sample_token(record["token"], agent, frame) for agent in agents_of(dataset, record)]
    camera = _choose_camera(dataset, samples, pair)
    image = None
    if camera is not None:
        image = _camera_picture(dataset, camera, pair)
    if image is None:
        image = _picture_from_above(dataset, record, boxes, pair)
    return picture_bytes(image, "JPEG", quality=_JPEG_QUALITY)


def _last_images(dataset: Dataset, record: ScenarioRecord) -> tuple[int, list[tuple[str, str]]]:
    """Return the number of the last frame with an image, and the agents and cameras that have one.

    Without any image it is the last frame.
    """
    frames_by_camera = {
        key: frames for key, frames in dataset.sensor_frames(record).items() if key[1] in CAMERAS
    }
    last_frames = (frames[-1] for frames in frames_by_camera.values() if frames)
    last_frame = max(last_frames, default=record["num_frames"])
    cameras = [key for key, frames in frames_by_camera.items() if last_frame in frames[-1:]]
    return last_frame, cameras


def _choose_camera(dataset: Dataset, samples: list[str], pair: Boxes) -> str | None:
    """Return the token of the camera to show; None if no image exists.

    Without a pair it is a front camera if there is any.
    """
    view = None
    if len(pair):
        view = best_view(dataset, samples, pair)
    if view is not None and has_sensor_file(dataset, view.camera):
        return view.camera
    for channel in CAMERAS:
        for sample in samples:
            camera = f"{sample}/{channel}"
            if has_sensor_file(dataset, camera):
                return camera
    return None


def _camera_picture(dataset: Dataset, camera: str, pair: Boxes) -> Any:
    """Return the image of a camera with the pair's boxes; None if the file cannot be read."""
    from PIL import Image, ImageDraw

    width, height = PICTURE_SIZE
    try:
        pixels = dataset.load_image(camera, min_size=(height, width), size=(height, width))
        picture = Image.fromarray(pixels)
    except SensorFileError:
        return None
    sample, channel = camera.rsplit("/", 1)
    calibration = dataset.camera(camera)
    boxes = pair.transform(dataset.world_from(sample, channel).inverse(), channel)
    own_id = dataset.get("agent", sample.rsplit("/", 1)[0])["actor_id"]
    pen = ImageDraw.Draw(picture)
    scale = as_floats([width / calibration.width, height / calibration.height])
    for corners in boxes.select(boxes.actor_id != own_id).corners():
        segments, _ = segments_in_image(corners[np.array(EDGES)], calibration)
        for start, end in (segments * scale).tolist():
            pen.line([*start, *end], fill=COLLIDER_COLOR, width=1)
    return picture


def _picture_from_above(dataset: Dataset, record: ScenarioRecord, boxes: Boxes, pair: Boxes) -> Any:
    """Return a picture of all actors from above, around the pair or the centre of all."""
    from PIL import Image, ImageDraw

    width, height = PICTURE_SIZE
    picture = Image.new("RGB", PICTURE_SIZE, "#ffffff" if len(boxes) else MISSING_COLOR)
    if not len(boxes):
        return picture
    middle = (pair if len(pair) else boxes).center[:, :2].mean(axis=0)
    scale = width / 2 / _HALF_WIDTH_M
    recorders = recorders_of(dataset, record["token"])
    pen = ImageDraw.Draw(picture)
    offsets = boxes.bottom_corners()[..., :2] - middle
    outlines = offsets * as_floats([scale, -scale]) + as_floats([width / 2, height / 2])
    actors = zip(outlines, boxes.actor_id.tolist(), boxes.category_names, strict=True)
    for outline, actor, category in actors:
        color = actor_color(category, recorders.get(actor), collides=actor in pair.actor_id)
        pen.polygon([tuple(point) for point in outline.tolist()], fill=color)
    return picture
