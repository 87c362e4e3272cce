"""`Explorer`: what all pages read of a release and of models, and what they keep in memory and in files."""

from __future__ import annotations

import hashlib
import os
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable, Mapping
from contextlib import suppress
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
# Pixels.
PICTURE_SIZE: Final = (320, 180)
# Counted up where the same release gives other pictures.
_VERSION: Final = 1
_QUALITY: Final = 75
# Metres from the middle of a picture from above to its left edge.
_REACH: Final = 40.0
# Bytes of pictures in memory; and scenarios whose replay is in memory, some megabytes each.
_MOST_PICTURES, _MOST_REPLAYS = 64_000_000, 6
# Pixels of rendered figures to an inch.
DPI: Final = 80
# Scenarios from which on processes are worth their start.
_MANY: Final = 64


class Explorer:
    """A release and models, opened for reading; safe to use from several threads.

    Attributes:
        dataset: the release.
        models: by name, in the order given.
        jobs: slow work in the background.
        workers: processes for slow work.
        scenarios: columns of the release's scenarios.
        pictures: JPEG and PNG files in memory, by what they show.
        replays: what replays play, by scenario and model.
        thumbnails: files of thumbnails.
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
            dataset: the release.
            bundles: folders that `save_run` wrote.
            results: files or folders of results; those of a bundle join it.
            workers: processes for slow work; None takes few.

        Raises:
            ResultsError: one of them cannot be read.
        """
        self.dataset = dataset
        self.workers = workers or _few_workers(len(dataset.scenario))
        self.jobs = Jobs()
        self.scenarios = Scenarios(dataset, self.jobs, workers=self.workers)
        self.models: Mapping[str, Model] = open_models(
            map(Path, bundles), map(Path, results), self.jobs
        )
        self.pictures: Kept[bytes] = Kept(_MOST_PICTURES, len)
        self.replays: Kept[dict[str, Any]] = Kept(_MOST_REPLAYS)
        self._recordings: Kept[ReplayRecording] = Kept(_MOST_REPLAYS)
        self.thumbnails = KeptFiles(dataset)

    def __repr__(self) -> str:
        """Of which release, and of which models."""
        return f"Explorer({self.dataset!r}, models: {', '.join(self.models) or 'none'})"

    def begin(self) -> None:
        """Begin slow work in the background: the columns of the scenarios, and models' scores."""
        for model in self.models.values():
            if model.bundle is not None:
                _ = model.job
        self.scenarios.begin()

    @property
    def first_page(self) -> str:
        """What a reader sees first: the page of the model or of several models, or without any the scenarios."""
        pages = [f"model/{quote(name, safe='')}/" for name in self.models] or [""]
        return pages[0] if len(pages) == 1 else "models/"

    @property
    def scores(self) -> dict[str, Model]:
        """Columns `score:MODEL`, of models that have scores."""
        return {
            f"{SCORE_PREFIX}{name}": model
            for name, model in self.models.items()
            if model.bundle is not None
        }

    def thumbnail(self, token: str) -> bytes:
        """A scenario's thumbnail as JPEG; raises TokenError."""
        record = self.dataset.scenario.get(token)
        identity = repr(
            (
                _VERSION,
                PICTURE_SIZE,
                token,
                str(self.dataset.dataroot),
                _last_images(self.dataset, record),
            )
        )
        return self.thumbnails.get(
            identity, "thumbnail.jpg", lambda: thumbnail(self.dataset, record)
        )

    def recording(self, token: str) -> ReplayRecording:
        """What replays know of a scenario; raises TokenError."""
        return self._recordings.get(token, lambda: recording_of(self.dataset, token, None))

    def replay(self, token: str, model: str | None) -> dict[str, Any]:
        """What the replay of a scenario plays (`served_replay`), with a model's predictions; None for none."""

        def make() -> dict[str, Any]:
            prediction = None if model is None else self.models[model].results
            return served_replay(self.dataset, token, "", prediction=prediction)

        return self.replays.get((token, model), make)

    def drawn(self, key: Hashable, draw: Callable[[], Any]) -> bytes:
        """A figure as PNG, rendered at the first call with a key."""
        return self.pictures.get(key, lambda: figure_png(draw(), dpi=DPI))


def _few_workers(scenarios: int) -> int:
    """Processes in the background, which leave others on the machine theirs; a small release needs none of its own."""
    return max(2, min(4, usable_cores() // 2)) if scenarios >= _MANY else 1


class Kept(Generic[_Value]):
    """Values that are made when they are asked for the first time; those that were not asked for the longest go.

    Each is made once, also if several threads ask for it at the same time; other values are made meanwhile.
    """

    def __init__(self, most: float, size: Callable[[_Value], float] = lambda _: 1.0) -> None:
        """Keep values as long as their sizes are at most so much in sum; by default so many values."""
        self._most, self._size = most, size
        self._values: OrderedDict[Hashable, _Value] = OrderedDict()
        self._total = 0.0
        self._lock = threading.Lock()
        self._making: dict[Hashable, threading.Lock] = {}

    def get(self, key: Hashable, make: Callable[[], _Value]) -> _Value:
        """The value of a key; raises what `make` raises, of which nothing is kept."""
        with self._lock:
            if key in self._values:
                self._values.move_to_end(key)
                return self._values[key]
            making = self._making.setdefault(key, threading.Lock())
        with making:
            with self._lock:
                if key in self._values:
                    return self._values[key]
            try:
                value = make()
                with self._lock:
                    self._values[key] = value
                    self._total += self._size(value)
                    while self._total > self._most and len(self._values) > 1:
                        _, old = self._values.popitem(last=False)
                        self._total -= self._size(old)
            finally:
                with self._lock:
                    self._making.pop(key, None)
        return value


class KeptFiles:
    """Small files that are made once: beside the index, and where that cannot be written, in the user's cache."""

    def __init__(self, dataset: Dataset) -> None:
        """Take the release whose index they lie beside: they go when the tables are made again."""
        self.folder = place_in(dataset.tables_folder, _THUMBNAILS, opened=True)
        if not is_writable_folder(dataset.tables_folder):
            self.folder = FileCache.of_user().folder.with_name(_THUMBNAILS)
        self._store = Store(self.folder, self.folder, "keeps thumbnails", IndexStoreError)

    def get(self, identity: str, name: str, make: Callable[[], bytes]) -> bytes:
        """The content of a file; `identity` tells it from all others. Raises what `make` raises."""
        digest = hashlib.blake2b(
            identity.encode(errors="surrogateescape"), digest_size=16
        ).hexdigest()
        place = f"{digest[:2]}/{digest[2:]}/{name}"
        kept = self._store.kept(place, digest, "image")
        if kept is not None:
            return kept
        content = make()
        with suppress(
            OSError
        ):  # no room, or a folder that may not be written to: it is made again the next time
            self._store.keep(place, digest, content)
        return content


def thumbnail(dataset: Dataset, record: ScenarioRecord) -> bytes:
    """A scenario's last moment with an image as JPEG: the pair in the best camera with red boxes; of others, the front.

    Where no image was downloaded it is the actors from above; without labels a grey panel.
    """
    moment, _ = _last_images(dataset, record)
    boxes = scenario_tracks(dataset, record).at(moment)
    told = record["collision"]
    pair = boxes.select(np.isin(boxes.actor_id, [] if told is None else told["ids"]))
    samples = [sample_token(record["token"], agent, moment) for agent in agents_of(dataset, record)]
    camera = _camera(dataset, samples, pair)
    image = None if camera is None else _photo(dataset, camera, pair)
    if image is None:
        image = _from_above(dataset, record, boxes, pair)
    return picture_bytes(image, "JPEG", quality=_QUALITY)


def _last_images(dataset: Dataset, record: ScenarioRecord) -> tuple[int, list[tuple[str, str]]]:
    """The number of the last frame with an image, or without any the last one, and the agents and cameras of those."""
    cameras = {
        key: frames for key, frames in dataset.sensor_frames(record).items() if key[1] in CAMERAS
    }
    last = max((frames[-1] for frames in cameras.values() if frames), default=record["num_frames"])
    return last, [key for key, frames in cameras.items() if last in frames[-1:]]


def _camera(dataset: Dataset, samples: list[str], pair: Boxes) -> str | None:
    """The camera (token) that is shown, of no pair a front one if there is any; None where no image is there."""
    view = best_view(dataset, samples, pair) if len(pair) else None
    if view is not None and has_sensor_file(dataset, view.camera):
        return view.camera
    cameras = (f"{sample}/{channel}" for channel in CAMERAS for sample in samples)
    return next((camera for camera in cameras if has_sensor_file(dataset, camera)), None)


def _photo(dataset: Dataset, camera: str, pair: Boxes) -> Any:
    """What a camera saw, with the pair's boxes; None if the file cannot be read."""
    from PIL import Image, ImageDraw

    width, height = PICTURE_SIZE
    try:
        picture = Image.fromarray(
            dataset.load_image(camera, min_size=(height, width), size=(height, width))
        )
    except SensorFileError:
        return None
    sample, channel = camera.rsplit("/", 1)
    lens = dataset.camera(camera)
    optical = pair.transform(dataset.world_from(sample, channel).inverse(), channel)
    own = dataset.get("agent", sample.rsplit("/", 1)[0])["actor_id"]
    pen, scale = ImageDraw.Draw(picture), as_floats([width / lens.width, height / lens.height])
    for corners in optical.select(optical.actor_id != own).corners():
        segments, _ = segments_in_image(corners[np.array(EDGES)], lens)
        for start, end in (segments * scale).tolist():
            pen.line([*start, *end], fill=COLLIDER_COLOR, width=1)
    return picture


def _from_above(dataset: Dataset, record: ScenarioRecord, boxes: Boxes, pair: Boxes) -> Any:
    """All actors from above, around the pair or the middle of all."""
    from PIL import Image, ImageDraw

    width, height = PICTURE_SIZE
    picture = Image.new("RGB", PICTURE_SIZE, "#ffffff" if len(boxes) else MISSING_COLOR)
    if not len(boxes):
        return picture
    middle = (pair if len(pair) else boxes).center[:, :2].mean(axis=0)
    scale = width / 2 / _REACH
    recorders = recorders_of(dataset, record["token"])
    pen = ImageDraw.Draw(picture)
    places = (boxes.bottom_corners()[..., :2] - middle) * as_floats([scale, -scale]) + as_floats(
        [width / 2, height / 2]
    )
    for outline, actor, category in zip(
        places, boxes.actor_id.tolist(), boxes.category_names, strict=True
    ):
        color = actor_color(category, recorders.get(actor), collides=actor in pair.actor_id)
        pen.polygon([tuple(place) for place in outline.tolist()], fill=color)
    return picture
