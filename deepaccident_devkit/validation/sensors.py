"""Checks of the sensors' files, and whether a JPEG is whole.

Pillow reports only a file that is cut.
"""

import hashlib
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from io import BytesIO
from typing import Any, Final

import numpy as np

from deepaccident_devkit.errors import ReleaseError
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.release import read_bev, read_lidar
from deepaccident_devkit.release.images import decode_image, read_image_bytes
from deepaccident_devkit.release.npz import TAGS
from deepaccident_devkit.release.store import ReleasePath
from deepaccident_devkit.support.arrays import AnyArray, BoolArray, ByteArray, FloatArray, IntArray
from deepaccident_devkit.support.reading import FileKind, read_bytes
from deepaccident_devkit.tables import Finding
from deepaccident_devkit.tables.scan import finding_of
from deepaccident_devkit.taxonomy import (
    BEV_CAMERA,
    BEV_RESOLUTION,
    BEV_SHAPE,
    CAMERAS,
    CATEGORIES,
    LIDAR,
    OWN_ACTOR_ID,
)
from deepaccident_devkit.validation.inventory import Inventory
from deepaccident_devkit.validation.subject import MOST_BOXES, Subject, frames_text

ZEROS: Final = 64
"""Zero bytes in a row from which on they are a fault."""
# Markers of a scan's head and of the picture's end; coded data hold neither.
_SCAN, _END = b"\xff\xda", b"\xff\xd9"
# In a JPEG's head: how many codes of each length grey's AC coefficients have; nearly all encoders write just these.
_USUAL_CODES: Final = bytes.fromhex("100002010303020403050504040000017d")
# The brightness that decoders give to blocks whose data are missing: 128, and what rounding does to it.
_GREY = (126.0, 130.0)
# Of red, green and blue in the brightness.
_SHARES = (0.299, 0.587, 0.114)
# Data that a decoder of a whole picture does not look at.
_MORE = bytes(range(1, 251)) * 40
_KINDS: dict[str, FileKind] = {LIDAR: "lidar", BEV_CAMERA: "bev"}
LIDAR_RANGE = 75.0
"""Metres; the real LiDAR ends at 70."""
POINT_COUNT = (5, 0.25)
"""Points, and as a share, by which a box's count may be off: label and cloud are not of exactly one instant, and real
cars are off by up to 12 points, or 24 % of a few."""
WALKER_POINT_COUNT = (30, 0.25)
"""The same for pedestrians, whose real boxes change their size between the count and the label."""
# Points by which one box alone may be off, and a pedestrian's: the release has 77 for 55, and 486 for 260.
_LARGE_COUNT = (25, 300)
# Boxes of one label, and their share of those with points, that are off if the cloud is not the label's.
_FRAME_OFF = (2, 0.25)
# The same for all labels of an agent, of whose boxes up to 7.5 % are off in the release.
_AGENT_OFF = (3, 0.15)
_BEV_HALF = 55.0
_VEHICLES = tuple(CATEGORIES.index(name) for name in ("car", "truck", "van"))
_BEV_LEAST_SHARE = 0.5
_THUMBNAIL = (32, 18)
# The largest ratio of an image's distance from its neighbours in time to their distance from each other.
_OUT_OF_SEQUENCE = 3.0
# Grey levels; below it images are the same to the eye.
_LEAST_DIFFERENCE = 6.0
# Grey levels between the darkest and the lightest spot of a picture that shows something.
_BLANK = 40.0
# Metres an agent may move while its pictures stay the same.
_STILL = 0.02
PICTURE_ORIENTATIONS: dict[str, str] = {
    "forward-up": "as the format says",
    "mirrored": "left and right exchanged",
    "backward-up": "turned by half",
    "mirrored-backward": "front and rear exchanged",
    "left-up": "turned by a quarter, left up",
    "right-up": "turned by a quarter, right up",
    "transposed": "rows and columns exchanged",
    "anti-transposed": "rows and columns exchanged, and turned by half",
}
"""The eight ways in which the BEV camera's picture could lie."""


def zero_stretch(content: bytes) -> tuple[int, int] | None:
    """Place and length of a stretch of zero bytes in a JPEG's picture data that no encoder writes; None without any.

    With the usual codes, zero bits are coefficients that are negative one after the other up to a block's last. `ZEROS`
    bytes hold several such blocks, which no picture has. In codes made for one picture they can be an even surface, and
    nothing is said.
    """
    start, stop = _last_scan(content)
    if (
        content.find(_USUAL_CODES, 0, start) < 0
        or (zeros := content.find(bytes(ZEROS), start, stop)) < 0
    ):
        return None
    data = content[zeros:stop]
    return zeros, len(data) - len(data.lstrip(b"\0"))


def ends_early(content: bytes, image: ByteArray) -> bool:
    """Whether the coded data of a JPEG end before its picture (H, W, 3) does: the rest of it is grey.

    More data before the end then change the picture, which needs them.
    """
    least, most = _GREY
    if not least < image[-1, -1] @ _SHARES < most:
        return False
    start, stop = _last_scan(content)
    longer = (
        content[:stop].rstrip(b"\xff") + _MORE + content[stop:]
    )  # a last 0xff would make a marker of what follows
    return start > 0 and not np.array_equal(_decoded(longer), image)


def _last_scan(content: bytes) -> tuple[int, int]:
    """Where the last scan of a JPEG begins, and where its coded data end; zero and the file's end if it has none."""
    start = max(content.rfind(_SCAN), 0)
    stop = content.find(_END, start)
    return start, stop if stop >= 0 else len(content)


def _decoded(content: bytes) -> Any:
    """The picture in a file's bytes; None if it is damaged."""
    from PIL import Image

    try:
        with Image.open(BytesIO(content), formats=("JPEG",)) as image:
            return np.asarray(image.convert("RGB"))
    except (OSError, ValueError, SyntaxError):
        return None


@dataclass(slots=True)
class _BevHits:
    """Vehicles whose centre has the vehicle's tag, for one recording: under each orientation, and frame by frame."""

    boxes: int = 0
    hits: dict[str, int] = field(default_factory=lambda: dict.fromkeys(PICTURE_ORIENTATIONS, 0))
    poor_frames: list[int] = field(default_factory=list)


def check_sensors(subject: Subject, inventory: Inventory) -> Iterator[Finding]:
    """Decode all sensor files of a scenario and compare them with its labels and calib files."""
    checksums: dict[str, list[tuple[str, str, int]]] = defaultdict(list)
    for (agent, channel), frames in inventory.items():
        usable = [frame for frame in frames if frame <= subject.num_frames]
        paths = {
            frame: subject.files.scenario.channel_path(agent, channel, frame) for frame in usable
        }
        row = subject.agents.index(agent)
        telling: list[int] = []
        if channel in CAMERAS:
            yield from _images(subject, row, channel, paths, telling)
        elif channel == LIDAR:
            yield from _clouds(subject, row, paths, telling)
        else:
            yield from _bevs(subject, row, paths, telling)
        for frame in telling:
            content = read_bytes(paths[frame], _KINDS.get(channel, "image"))
            checksums[hashlib.blake2b(content, digest_size=16).hexdigest()].append(
                (agent, channel, frame)
            )
    yield from _repeated(subject, checksums)


def _images(
    subject: Subject, agent: int, channel: str, paths: Mapping[int, ReleasePath], telling: list[int]
) -> Iterator[Finding]:
    """Decode a camera's images; the frames that show something (more than a wall, fog) go to `telling`."""
    import cv2

    thumbnails: dict[int, FloatArray] = {}
    sizes: dict[int, tuple[int, int]] = {}
    for frame, path in paths.items():
        try:
            content = read_image_bytes(path)
            image = decode_image(path, content)
        except ReleaseError as error:
            yield finding_of(error, "sensor-unreadable", subject.token)
            continue
        if (what := _lost_part(content, image)) is not None:
            yield subject.finding("sensor-unreadable", str(path), what)
            continue
        sizes[frame] = (image.shape[1], image.shape[0])
        thumbnails[frame] = cv2.resize(image, _THUMBNAIL, interpolation=cv2.INTER_AREA).astype(
            np.float64
        )
    yield from _image_sizes(subject, agent, channel, sizes)
    telling += [
        frame
        for frame, picture in thumbnails.items()
        if np.ptp(picture, axis=(0, 1)).max() >= _BLANK
    ]
    odd = out_of_sequence(thumbnails)
    if subject.num_frames in odd and _collides(subject, agent):
        odd.remove(subject.num_frames)  # at the impact another car may fill the view at once
    if odd:
        folder = subject.files.scenario.kind_folder(subject.agents[agent], channel)
        what = f"does not fit between its neighbours, {frames_text(odd)}"
        yield subject.finding("image-out-of-sequence", str(folder), what)


def _lost_part(content: bytes, image: ByteArray) -> str | None:
    """What shows that a part of a picture is lost, though it can be decoded."""
    if (zeros := zero_stretch(content)) is not None:
        return f"holds {zeros[1]} zero bytes in a row from byte {zeros[0]} on: part of the picture is lost"
    return (
        "its data end early: the rest of the picture is lost"
        if ends_early(content, image)
        else None
    )


def _collides(subject: Subject, agent: int) -> bool:
    """Whether the agent is one of the pair that meta names."""
    own = subject.own & (subject.boxes.agent == agent)
    return bool(subject.in_collision[own].any())


def _image_sizes(
    subject: Subject, agent: int, channel: str, sizes: Mapping[int, tuple[int, int]]
) -> Iterator[Finding]:
    """Every image must be as large as its K says: twice the principal point."""
    camera = CAMERAS.index(channel)
    for frame, (width, height) in sizes.items():
        intrinsic = subject.files.calibs.intrinsic[agent * subject.num_frames + frame - 1, camera]
        expected = 2 * intrinsic[:2, 2]
        if np.abs(expected - (width, height)).max() > 1:
            path = subject.files.scenario.channel_path(subject.agents[agent], channel, frame)
            what = f"is {width}x{height}, K says {expected[0]:.0f}x{expected[1]:.0f}"
            yield subject.finding("image-size", str(path), what)


def out_of_sequence(thumbnails: Mapping[int, FloatArray]) -> list[int]:
    """Frames whose picture (h, w, 3) is much further from both neighbours than these are from each other.

    Neighbours are 0.1 s apart: where frames are missing, a sequence ends. At the ends, where there is one neighbour,
    its distance is held against that of the next step, unless the neighbour shows nothing: what hid the view may just
    have gone.
    """
    frames = np.array(sorted(thumbnails), dtype=np.int64)
    sequences = np.split(frames, np.flatnonzero(np.diff(frames) != 1) + 1)
    return [frame for sequence in sequences for frame in _odd_in(sequence.tolist(), thumbnails)]


def _odd_in(frames: Sequence[int], thumbnails: Mapping[int, FloatArray]) -> list[int]:
    """The frames out of one sequence without gaps whose picture does not fit."""
    if len(frames) < 3:
        return []
    pictures = np.stack([thumbnails[frame] for frame in frames])
    step = _distance(pictures[1:], pictures[:-1])
    over = _distance(pictures[2:], pictures[:-2])
    least = np.minimum(step[1:], step[:-1])
    odd = np.zeros(len(frames), dtype=bool)
    odd[1:-1] = least > np.maximum(_OUT_OF_SEQUENCE * over, _LEAST_DIFFERENCE)
    usual = np.median(step)
    for end, inner, first, second in ((0, 1, step[0], step[1]), (-1, -2, step[-1], step[-2])):
        told = not odd[inner] and np.ptp(pictures[inner], axis=(0, 1)).max() >= _BLANK
        odd[end] = told and first > max(_OUT_OF_SEQUENCE * max(second, usual), _LEAST_DIFFERENCE)
    return [frame for frame, is_odd in zip(frames, odd.tolist(), strict=True) if is_odd]


def _distance(first: FloatArray, second: FloatArray) -> FloatArray:
    return np.asarray(np.abs(first - second).mean(axis=(1, 2, 3)))


def _clouds(
    subject: Subject, agent: int, paths: Mapping[int, ReleasePath], telling: list[int]
) -> Iterator[Finding]:
    """Decode an agent's point clouds; the frames that could be read go to `telling`."""
    odd, off = [], np.zeros((subject.num_frames + 1, 3), dtype=np.int64)
    for frame, path in paths.items():
        try:
            cloud = read_lidar(path)
            points = cloud.xyz
        except ReleaseError as error:
            yield finding_of(error, "sensor-unreadable", subject.token)
            continue
        telling.append(frame)
        if not (np.isfinite(points).all() and np.isfinite(cloud.intensity).all()) or (
            len(points) and np.abs(points).max() > LIDAR_RANGE
        ):
            odd.append(frame)
        boxes = _sample_boxes(subject, agent, frame)
        if 0 < len(boxes) <= MOST_BOXES:
            off[frame] = _miscounted(boxes, points)
    folder = str(subject.files.scenario.kind_folder(subject.agents[agent], LIDAR))
    if odd:
        what = f"points that are no numbers, or beyond {LIDAR_RANGE:.0f} m, {frames_text(odd)}"
        yield subject.finding("points-odd", folder, what)
    foreign = _many_off(off, _FRAME_OFF) | (off[:, 2] > 0) | _many_off(off.sum(axis=0), _AGENT_OFF)
    for code, frames in (
        ("points-differ", np.flatnonzero(foreign & (off[:, 0] > 0))),
        ("box-points-differ", np.flatnonzero(~foreign & (off[:, 0] > 0))),
    ):
        if len(frames):
            what = f"boxes with other points than their labels count: {off[frames, 0].sum()}, {frames_text(frames)}"
            yield subject.finding(code, folder, what)


def _miscounted(boxes: Boxes, points: FloatArray) -> tuple[int, int, int]:
    """How many boxes of a label hold other points than it counts; all that could show it; those far off by themselves.

    A cloud of another frame, agent or place changes the counts of many boxes; the release is off in single ones.
    """
    counted = boxes.count_points(points)
    most = np.maximum(counted, boxes.num_lidar_pts)
    walks = boxes.category == CATEGORIES.index("pedestrian")
    least, share = np.where(walks[:, None], WALKER_POINT_COUNT, POINT_COUNT).T
    off = np.abs(counted - boxes.num_lidar_pts)
    wrong = off > np.maximum(least, share * most)
    large = off > np.where(walks, _LARGE_COUNT[1], _LARGE_COUNT[0])
    return int(wrong.sum()), int((most > least).sum()), int((wrong & large).sum())


def _many_off(off: IntArray, limit: tuple[int, float]) -> BoolArray:
    """Whether so many boxes, and so large a share, are off: (…, 3) counts of `_miscounted` → (…)."""
    return np.asarray((off[..., 0] >= limit[0]) & (off[..., 0] >= limit[1] * off[..., 1]))


def _sample_boxes(subject: Subject, agent: int, frame: int) -> Boxes:
    """The boxes of one label in its LiDAR frame."""
    return subject.lidar_boxes.select(
        np.flatnonzero(subject.boxes.sample == agent * subject.num_frames + frame - 1)
    )


def _bevs(
    subject: Subject, agent: int, paths: Mapping[int, ReleasePath], telling: list[int]
) -> Iterator[Finding]:
    """Decode an agent's BEV arrays; the frames that could be read go to `telling`."""
    total = _BevHits()
    for frame, path in paths.items():
        try:
            semantic = read_bev(path).semantic
        except ReleaseError as error:
            yield finding_of(error, "sensor-unreadable", subject.token)
            continue
        telling.append(frame)
        places = _vehicle_places(subject, agent, frame)
        if not len(places):
            continue
        hits = {name: _hits(semantic, _turned(places, name)) for name in PICTURE_ORIENTATIONS}
        total.boxes += len(places)
        for name, hit in hits.items():
            total.hits[name] += int(hit.sum())
        if len(places) > 2 and hits["forward-up"].mean() < _BEV_LEAST_SHARE:
            total.poor_frames.append(frame)
    folder = str(subject.files.scenario.kind_folder(subject.agents[agent], BEV_CAMERA))
    best = max(total.hits, key=lambda name: total.hits[name])
    if total.hits[best] > total.hits["forward-up"] + max(2, 0.25 * total.boxes) and total.boxes:
        shown = f"{total.hits[best]} of {total.boxes} vehicles are where the labels have them if it is '{best}'"
        what = (
            f"{shown} ({PICTURE_ORIENTATIONS[best]}), {total.hits['forward-up']} if forward is up"
        )
        yield subject.finding("bev-orientation", folder, what)
    elif total.poor_frames:
        what = f"fewer than half of the labels' vehicles are in the picture, {frames_text(total.poor_frames)}"
        yield subject.finding("bev-differs", folder, what)


def _vehicle_places(subject: Subject, agent: int, frame: int) -> FloatArray:
    """(M, 2) metres forward and left of the agent: centres of the vehicles that the BEV camera has in view."""
    sample = agent * subject.num_frames + frame - 1
    boxes = subject.boxes
    vehicles = np.isin(boxes.labels.category, _VEHICLES) & (subject.label_id != OWN_ACTOR_ID)
    rows = np.flatnonzero((boxes.sample == sample) & vehicles)
    places: FloatArray = subject.boxes.labels.center[rows, :2]
    return places[(np.abs(places) < _BEV_HALF).all(axis=1)]


def _turned(places: FloatArray, orientation: str) -> FloatArray:
    """Where a place (M, 2) forward, left lies in a picture of another orientation, as if forward were up."""
    x, y = places.T
    turned = {
        "forward-up": (x, y),
        "mirrored": (x, -y),
        "backward-up": (-x, -y),
        "mirrored-backward": (-x, y),
        "left-up": (y, -x),
        "right-up": (-y, x),
        "transposed": (y, x),
        "anti-transposed": (-y, -x),
    }[orientation]
    return np.column_stack(turned)


def _hits(semantic: ByteArray, places: FloatArray) -> BoolArray:
    center = (BEV_SHAPE[0] - 1) / 2
    pixels: IntArray = np.rint(center - places / BEV_RESOLUTION).astype(np.int64)
    return np.asarray(semantic[pixels[:, 0], pixels[:, 1]] == TAGS["vehicle"])


def _repeated(
    subject: Subject, checksums: Mapping[str, Sequence[tuple[str, str, int]]]
) -> Iterator[Finding]:
    """Files with the same bytes; an agent that stands still may see the same again and again."""
    for places in checksums.values():
        if len(places) < 2 or _stood_still(subject, places):
            continue
        names = [f"{agent}/{channel}/{frame:03d}" for agent, channel, frame in places]
        more = f" and {len(names) - 4} more" if len(names) > 4 else ""
        yield subject.finding(
            "file-repeated", subject.token, f"the same bytes: {', '.join(names[:4])}{more}"
        )


def _stood_still(subject: Subject, places: Sequence[tuple[str, str, int]]) -> bool:
    """Whether these are frames of one channel of an agent that did not move between them."""
    frames: AnyArray = np.array([frame for _, _, frame in places])
    if len({(agent, channel) for agent, channel, _ in places}) > 1:
        return False
    path = subject.positions[subject.agents.index(places[0][0])][frames - 1]
    return bool(np.ptp(path, axis=0).max() < _STILL)
