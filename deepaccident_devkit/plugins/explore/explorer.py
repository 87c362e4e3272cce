"""The data that pages read from a release and from models, with caches."""

from __future__ import annotations

import hashlib
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
from deepaccident_devkit.support.text import PathType
from deepaccident_devkit.tables.tokens import sample_token
from deepaccident_devkit.taxonomy import CAMERAS
from deepaccident_devkit.v2x.agents import agents_of
from deepaccident_devkit.v2x.tracks import scenario_tracks

if TYPE_CHECKING:
    from deepaccident_devkit.tables.records import ScenarioRecord

_Value = TypeVar("_Value")
_THUMBNAILS = "thumbnails"
# Width and height of thumbnails in pixels.
PICTURE_SIZE: Final = (320, 180)
# Increased whenever the same release would give different thumbnails.
_THUMBNAIL_VERSION = 1
_JPEG_QUALITY = 75
# Metres from the centre of a picture from above to its left edge.
_HALF_WIDTH_M = 40.0
# Largest size of all pictures in memory in bytes.
_MAX_PICTURE_BYTES = 64_000_000
# Largest number of replays in memory, which have some megabytes each.
_MAX_REPLAYS = 6
# Pixels per inch of rendered figures.
DPI: Final = 80
# Smallest number of scenarios for which it is worth starting processes.
_MIN_SCENARIOS_FOR_PROCESSES = 64


class Explorer:
    """A release and models that are opened for reading; safe to use from several threads.

    Attributes:
        dataset: The release.
        models: Models by name, in the order in which they were passed.
        jobs: Slow work in the background.
        workers: Number of processes for slow work.
        scenarios: Columns of the scenarios of the release.
        pictures: JPEG and PNG files in memory, by what they show.
        replays: Data of replays, by scenario and model.
        thumbnails: Files of thumbnails.
    """

    def __init__(
        self,
        dataset: Dataset,
        *,
        bundles: Iterable[PathType] = (),
        results: Iterable[PathType] = (),
        workers: int | None = None,
    ) -> None:
        """Open a release with bundles and results.

        Args:
            dataset: The release.
            bundles: Folders that `save_run` wrote.
            results: Files or folders of results. Results that a bundle was computed from are shown
                together with it.
            workers: Number of processes for slow work; None for a few.

        Raises:
            ResultsError: If a bundle or a results file cannot be read.
        """
        self.dataset = dataset
        self.workers = workers or _choose_workers(len(dataset.scenario))
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
        names = ", ".join(self.models) or "none"
        return f"Explorer({self.dataset!r}, models: {names})"

    def begin(self) -> None:
        """Start slow work in the background: scenarios' columns and models' scores."""
        for model in self.models.values():
            if model.bundle is not None:
                _ = model.job
        self.scenarios.begin()

    @property
    def first_page(self) -> str:
        """Path of the first page: the page of the only model, the list of models, or scenarios."""
        pages = [f"model/{quote(name, safe='')}/" for name in self.models] or [""]
        if len(pages) == 1:
            return pages[0]
        return "models/"

    @property
    def scores(self) -> dict[str, Model]:
        """The models with scores, by column (`score:MODEL`)."""
        return {
            f"{SCORE_PREFIX}{name}": model
            for name, model in self.models.items()
            if model.bundle is not None
        }

    def thumbnail(self, token: str) -> bytes:
        """Return the thumbnail of a scenario as JPEG; raise TokenError if there is none."""
        record = self.dataset.scenario.get(token)
        images = _find_last_images(self.dataset, record)
        dataroot = str(self.dataset.dataroot)
        identity = repr((_THUMBNAIL_VERSION, PICTURE_SIZE, token, dataroot, images))
        make = partial(thumbnail, self.dataset, record)
        return self.thumbnails.get(identity, "thumbnail.jpg", make)

    def recording(self, token: str) -> ReplayRecording:
        """Return what replays need to know about a scenario; raise TokenError if it is unknown."""
        make = partial(recording_of, self.dataset, token, None)
        return self._recordings.get(token, make)

    def replay(self, token: str, model: str | None) -> dict[str, Any]:
        """Return the data for a scenario's replay (`served_replay`), with a model's predictions.

        If `model` is None, there are no predictions.
        """

        def make() -> dict[str, Any]:
            if model is None:
                return served_replay(self.dataset, token, "")
            shown = self.models[model]
            return served_replay(
                self.dataset, token, "", prediction=shown.results, task=shown.setup.task
            )

        return self.replays.get((token, model), make)

    def drawn(self, key: Hashable, draw: Callable[[], Any]) -> bytes:
        """Return a figure as PNG; it is only drawn at the first call with the same key."""
        return self.pictures.get(key, lambda: figure_png(draw(), dpi=DPI))


def _choose_workers(scenarios: int) -> int:
    """Return how many background processes to use for a number of scenarios.

    They leave some cores to other users of the machine. A small release needs no extra processes.
    """
    if scenarios >= _MIN_SCENARIOS_FOR_PROCESSES:
        return max(2, min(4, usable_cores() // 2))
    return 1


class ValueCache(Generic[_Value]):
    """A cache of values that are made on demand; the least recently used ones are evicted first.

    Each value is made once, even if several threads request it at the same time, and does not delay
    other values.
    """

    def __init__(self, max_size: float, size: Callable[[_Value], float] = lambda _: 1.0) -> None:
        """Make an empty cache.

        Args:
            max_size: Largest sum of the sizes of all values.
            size: Function that returns the size of a value; by default each value has size 1.
        """
        self._max_size = max_size
        self._size = size
        self._values: OrderedDict[Hashable, _Value] = OrderedDict()
        self._total = 0.0
        self._lock = threading.Lock()
        self._key_locks: dict[Hashable, threading.Lock] = {}

    def get(self, key: Hashable, make: Callable[[], _Value]) -> _Value:
        """Return the value of a key; if `make` raises an error, raise it and keep nothing."""
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
    """Small files; each is made only once.

    They are stored next to the index, or in the user's cache if that folder is not writable.
    """

    def __init__(self, dataset: Dataset) -> None:
        """Store files next to the index of a release, so that rebuilding the index removes them."""
        self.folder = place_in(dataset.tables_folder, _THUMBNAILS, opened=True)
        if not is_writable_folder(dataset.tables_folder):
            self.folder = FileCache.of_user().folder.with_name(_THUMBNAILS)
        self._store = Store(self.folder, self.folder, "keeps thumbnails", IndexStoreError)

    def get(self, identity: str, name: str, make: Callable[[], bytes]) -> bytes:
        """Return the content of a file, which `make` produces at the first call.

        Errors of `make` are raised.

        Args:
            identity: Text that distinguishes the file from all others.
            name: Name of the file.
            make: Function that makes the content.
        """
        identity_bytes = identity.encode(errors="surrogateescape")
        digest = hashlib.blake2b(identity_bytes, digest_size=16).hexdigest()
        path = f"{digest[:2]}/{digest[2:]}/{name}"
        stored = self._store.read_result(path, digest, "image")
        if stored is not None:
            return stored
        content = make()
        # If the disk is full or the folder cannot be written to, it is made again the next time.
        with suppress(OSError):
            self._store.write_result(path, digest, content)
        return content


def thumbnail(dataset: Dataset, record: ScenarioRecord) -> bytes:
    """Draw a thumbnail (JPEG) of the last moment of a scenario at which there is an image.

    It shows the image of the camera that shows the colliding pair best, with the pair in red boxes.
    Without a collision, it shows the front camera's image. Without downloaded images, it shows the
    actors from above, and if there are no labels either, a grey panel.
    """
    frame, _ = _find_last_images(dataset, record)
    boxes = scenario_tracks(dataset, record).at(frame)
    collision = record["collision"]
    pair_ids = [] if collision is None else collision["ids"]
    pair = boxes.select(np.isin(boxes.actor_id, pair_ids))
    samples = [sample_token(record["token"], agent, frame) for agent in agents_of(dataset, record)]
    camera = _choose_camera(dataset, samples, pair)
    image = None
    if camera is not None:
        image = _draw_camera_picture(dataset, camera, pair)
    if image is None:
        image = _draw_from_above(dataset, record, boxes, pair)
    return picture_bytes(image, "JPEG", quality=_JPEG_QUALITY)


def _find_last_images(
    dataset: Dataset, record: ScenarioRecord
) -> tuple[int, list[tuple[str, str]]]:
    """Return the last frame with an image, and the (agent, camera) pairs that have one there.

    If there are no images, the frame is the last one of the scenario.
    """
    frames_by_camera = {}
    for key, frames in dataset.sensor_frames(record).items():
        if key[1] in CAMERAS and frames:
            frames_by_camera[key] = frames
    last_frames = [frames[-1] for frames in frames_by_camera.values()]
    last_frame = max(last_frames, default=record["num_frames"])
    cameras = [key for key, frames in frames_by_camera.items() if frames[-1] == last_frame]
    return last_frame, cameras


def _choose_camera(dataset: Dataset, samples: list[str], pair: Boxes) -> str | None:
    """Return the token of the camera image to show; None if there is no image.

    Without a pair, a front camera is chosen if there is one.
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


def _draw_camera_picture(dataset: Dataset, camera: str, pair: Boxes) -> Any:
    """Draw a camera's image with boxes around the pair; return None if it cannot be read."""
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


def _draw_from_above(dataset: Dataset, record: ScenarioRecord, boxes: Boxes, pair: Boxes) -> Any:
    """Draw all actors from above, centred on the pair or, without one, on all actors."""
    from PIL import Image, ImageDraw

    width, height = PICTURE_SIZE
    picture = Image.new("RGB", PICTURE_SIZE, "#ffffff" if len(boxes) else MISSING_COLOR)
    if not len(boxes):
        return picture
    central_boxes = pair if len(pair) else boxes
    middle = central_boxes.center[:, :2].mean(axis=0)
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
