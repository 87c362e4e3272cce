"""Checks of the sensors' files, and of JPEGs with lost data.

Pillow only reports a file that is cut.
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
from deepaccident_devkit.validation.subject import MAX_LABEL_BOXES, Subject, frames_text

MIN_ZERO_BYTES: Final = 64
"""Zero bytes in a row that are a fault."""
# Markers of a scan's header and of the picture's end; coded data hold neither.
_SCAN_MARKER: Final = b"\xff\xda"
_END_MARKER: Final = b"\xff\xd9"
# In a JPEG's header, the number of codes of each length for grey's AC coefficients; nearly all
# encoders write these.
_STANDARD_CODES: Final = bytes.fromhex("100002010303020403050504040000017d")
# The brightness that decoders give to blocks with missing data, 128, within rounding.
_MISSING_BRIGHTNESS: Final = (126.0, 130.0)
# Shares of red, green and blue in the brightness.
_BRIGHTNESS_SHARES: Final = (0.299, 0.587, 0.114)
# Data that a decoder of a complete picture does not read.
_SURPLUS_DATA: Final = bytes(range(1, 251)) * 40
_KINDS: dict[str, FileKind] = {LIDAR: "lidar", BEV_CAMERA: "bev"}
LIDAR_RANGE_M = 75.0
"""Range of coordinates in a cloud; the real LiDAR ends at 70."""
POINT_COUNT_TOLERANCE = (5, 0.25)
"""Difference of a box's count from its cloud, in points and as a share of them.

Label and cloud are not of exactly one instant, and real cars are off by up to 12 points, or 24 % of
a few.
"""
WALKER_POINT_COUNT_TOLERANCE = (30, 0.25)
"""The same for pedestrians; real boxes change their size between the count and the label."""
# Points by which a single box may be off, and a pedestrian's: the release has 77 for 55, and 486
# for 260.
_BOX_POINT_TOLERANCE = (25, 300)
# Boxes of one label, and their share of its boxes with points, that are off if the cloud belongs to
# another label.
_FRAME_MISCOUNTS = (2, 0.25)
# The same for all labels of an agent; in the release up to 7.5 % of an agent's boxes are off.
_AGENT_MISCOUNTS = (3, 0.15)
_BEV_HALF_WIDTH_M = 55.0
_VEHICLES = tuple(CATEGORIES.index(name) for name in ("car", "truck", "van"))
_MIN_BEV_SHARE = 0.5
_THUMBNAIL_SIZE = (32, 18)
# Ratio of an image's distance from its neighbours in time to their distance from each other.
_MAX_DISTANCE_RATIO = 3.0
# Grey levels; images with a smaller difference look the same.
_MIN_DIFFERENCE = 6.0
# Grey levels between the darkest and the lightest spot of a picture with content.
_MIN_CONTRAST = 40.0
# Distance that an agent may move while its pictures stay the same.
_STANDSTILL_TOLERANCE_M = 0.02
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
"""The eight possible orientations of the BEV camera's picture."""


def zero_stretch(content: bytes) -> tuple[int, int] | None:
    """Return offset and length of zero bytes in a JPEG's picture data that no encoder writes.

    None is returned without any. With the standard codes, zero bits are coefficients that are
    negative one after the other up to a block's end. `MIN_ZERO_BYTES` bytes hold several such
    blocks, which no picture has. In codes made for one picture they can be an even surface, and
    count as correct.
    """
    start, stop = _last_scan(content)
    if content.find(_STANDARD_CODES, 0, start) < 0:
        return None
    zeros = content.find(bytes(MIN_ZERO_BYTES), start, stop)
    if zeros < 0:
        return None
    data = content[zeros:stop]
    return zeros, len(data) - len(data.lstrip(b"\0"))


def ends_early(content: bytes, image: ByteArray) -> bool:
    """Return whether the coded data of a JPEG end before its picture (H, W, 3), which ends grey.

    More data before the end then change the picture, which needs them.
    """
    low, high = _MISSING_BRIGHTNESS
    if not low < image[-1, -1] @ _BRIGHTNESS_SHARES < high:
        return False
    start, stop = _last_scan(content)
    # A 0xff at the end of the data would turn the bytes after it into a marker.
    data = content[:stop].rstrip(b"\xff")
    longer = data + _SURPLUS_DATA + content[stop:]
    return start > 0 and not np.array_equal(_decode_jpeg(longer), image)


def _last_scan(content: bytes) -> tuple[int, int]:
    """Return start and end of a JPEG's last scan; without a scan, 0 and the file's end."""
    start = max(content.rfind(_SCAN_MARKER), 0)
    stop = content.find(_END_MARKER, start)
    return start, stop if stop >= 0 else len(content)


def _decode_jpeg(content: bytes) -> Any:
    """Return the picture in a file's bytes, shape (H, W, 3); None if it is damaged."""
    from PIL import Image

    try:
        with Image.open(BytesIO(content), formats=("JPEG",)) as image:
            return np.asarray(image.convert("RGB"))
    except (OSError, ValueError, SyntaxError):
        return None


@dataclass(slots=True)
class _BevHits:
    """Vehicles of one recording with the vehicle tag at their centre.

    Attributes:
        boxes: Number of all vehicles.
        hits: Orientation → vehicles with the tag.
        poor_frames: Frames in which less than half of the vehicles have it.
    """

    boxes: int = 0
    hits: dict[str, int] = field(default_factory=lambda: dict.fromkeys(PICTURE_ORIENTATIONS, 0))
    poor_frames: list[int] = field(default_factory=list)


def check_sensors(subject: Subject, inventory: Inventory) -> Iterator[Finding]:
    """Decode all sensor files of a scenario and compare them with its labels and calib files."""
    checksums: dict[str, list[tuple[str, str, int]]] = defaultdict(list)
    for (agent, channel), frames in inventory.items():
        paths = {}
        for frame in frames:
            if frame <= subject.num_frames:
                paths[frame] = subject.files.scenario.channel_path(agent, channel, frame)
        row = subject.agents.index(agent)
        usable_frames: list[int] = []
        if channel in CAMERAS:
            yield from _check_images(subject, row, channel, paths, usable_frames)
        elif channel == LIDAR:
            yield from _check_clouds(subject, row, paths, usable_frames)
        else:
            yield from _check_bevs(subject, row, paths, usable_frames)
        for frame in usable_frames:
            content = read_bytes(paths[frame], _KINDS.get(channel, "image"))
            checksum = hashlib.blake2b(content, digest_size=16).hexdigest()
            checksums[checksum].append((agent, channel, frame))
    yield from _repeated_files(subject, checksums)


def _check_images(
    subject: Subject,
    agent: int,
    channel: str,
    paths: Mapping[int, ReleasePath],
    usable_frames: list[int],
) -> Iterator[Finding]:
    """Decode a camera's images; frames that show more than a wall or fog join `usable_frames`."""
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
        message = _lost_data_text(content, image)
        if message is not None:
            yield subject.finding("sensor-unreadable", str(path), message)
            continue
        sizes[frame] = (image.shape[1], image.shape[0])
        thumbnail = cv2.resize(image, _THUMBNAIL_SIZE, interpolation=cv2.INTER_AREA)
        thumbnails[frame] = thumbnail.astype(np.float64)
    yield from _check_image_sizes(subject, agent, channel, sizes)
    for frame, thumbnail in thumbnails.items():
        if _has_content(thumbnail):
            usable_frames.append(frame)
    odd = out_of_sequence(thumbnails)
    # At the impact another car may suddenly fill the view.
    if subject.num_frames in odd and _collides(subject, agent):
        odd.remove(subject.num_frames)
    if odd:
        folder = subject.files.scenario.kind_folder(subject.agents[agent], channel)
        message = f"does not fit between its neighbours, {frames_text(odd)}"
        yield subject.finding("image-out-of-sequence", str(folder), message)


def _has_content(picture: FloatArray) -> bool:
    """Return whether a picture (h, w, 3) shows more than an even surface."""
    contrast = np.ptp(picture, axis=(0, 1)).max()
    return bool(contrast >= _MIN_CONTRAST)


def _lost_data_text(content: bytes, image: ByteArray) -> str | None:
    """Return a sign that a picture lost data, though it can be decoded; None without any."""
    zeros = zero_stretch(content)
    if zeros is not None:
        offset, length = zeros
        text = f"holds {length} zero bytes in a row from byte {offset} on"
        return f"{text}: part of the picture is lost"
    if ends_early(content, image):
        return "its data end early: the rest of the picture is lost"
    return None


def _collides(subject: Subject, agent: int) -> bool:
    """Return whether the agent belongs to the pair that meta names."""
    own = subject.own & (subject.boxes.agent == agent)
    return bool(subject.in_collision[own].any())


def _check_image_sizes(
    subject: Subject, agent: int, channel: str, sizes: Mapping[int, tuple[int, int]]
) -> Iterator[Finding]:
    """Compare the size of every image with its K: it is twice the principal point."""
    camera = CAMERAS.index(channel)
    for frame, (width, height) in sizes.items():
        intrinsic = subject.files.calibs.intrinsic[agent * subject.num_frames + frame - 1, camera]
        expected = 2 * intrinsic[:2, 2]
        if np.abs(expected - (width, height)).max() > 1:
            path = subject.files.scenario.channel_path(subject.agents[agent], channel, frame)
            message = f"is {width}x{height}, K says {expected[0]:.0f}x{expected[1]:.0f}"
            yield subject.finding("image-size", str(path), message)


def out_of_sequence(thumbnails: Mapping[int, FloatArray]) -> list[int]:
    """Return frames with pictures (h, w, 3) that do not fit between their neighbours.

    They are much further from both neighbours than these are from each other. Neighbours are 0.1 s
    apart: where frames are missing, a sequence ends. At an end, the distance of its one neighbour
    is compared with that of the next step, unless the neighbour has no content: the obstacle in
    view may just have gone.
    """
    frames = np.array(sorted(thumbnails), dtype=np.int64)
    odd_frames = []
    for sequence in np.split(frames, np.flatnonzero(np.diff(frames) != 1) + 1):
        odd_frames += _odd_frames(sequence.tolist(), thumbnails)
    return odd_frames


def _odd_frames(frames: Sequence[int], thumbnails: Mapping[int, FloatArray]) -> list[int]:
    """Return the frames of one sequence without gaps that do not fit into it."""
    if len(frames) < 3:
        return []
    pictures = np.stack([thumbnails[frame] for frame in frames])
    step = _picture_distance(pictures[1:], pictures[:-1])
    neighbour_distance = _picture_distance(pictures[2:], pictures[:-2])
    odd = np.zeros(len(frames), dtype=bool)
    limit = np.maximum(_MAX_DISTANCE_RATIO * neighbour_distance, _MIN_DIFFERENCE)
    odd[1:-1] = np.minimum(step[1:], step[:-1]) > limit
    median_step = np.median(step)
    for end, neighbour, end_step, next_step in (
        (0, 1, step[0], step[1]),
        (-1, -2, step[-1], step[-2]),
    ):
        comparable = not odd[neighbour] and _has_content(pictures[neighbour])
        end_limit = max(_MAX_DISTANCE_RATIO * max(next_step, median_step), _MIN_DIFFERENCE)
        odd[end] = comparable and end_step > end_limit
    return [frame for frame, is_odd in zip(frames, odd.tolist(), strict=True) if is_odd]


def _picture_distance(pictures: FloatArray, others: FloatArray) -> FloatArray:
    difference = np.abs(pictures - others)
    return np.asarray(difference.mean(axis=(1, 2, 3)))


def _check_clouds(
    subject: Subject, agent: int, paths: Mapping[int, ReleasePath], usable_frames: list[int]
) -> Iterator[Finding]:
    """Decode an agent's point clouds; readable frames join `usable_frames`."""
    odd = []
    miscounts = np.zeros((subject.num_frames + 1, 3), dtype=np.int64)
    for frame, path in paths.items():
        try:
            cloud = read_lidar(path)
            points = cloud.xyz
        except ReleaseError as error:
            yield finding_of(error, "sensor-unreadable", subject.token)
            continue
        usable_frames.append(frame)
        finite = np.isfinite(points).all() and np.isfinite(cloud.intensity).all()
        if not finite or (len(points) and np.abs(points).max() > LIDAR_RANGE_M):
            odd.append(frame)
        boxes = _sample_boxes(subject, agent, frame)
        if 0 < len(boxes) <= MAX_LABEL_BOXES:
            miscounts[frame] = _count_miscounts(boxes, points)
    folder = str(subject.files.scenario.kind_folder(subject.agents[agent], LIDAR))
    if odd:
        message = f"points that are no numbers, or beyond {LIDAR_RANGE_M:.0f} m"
        yield subject.finding("points-odd", folder, f"{message}, {frames_text(odd)}")
    foreign = _exceeds(miscounts, _FRAME_MISCOUNTS) | (miscounts[:, 2] > 0)
    foreign |= _exceeds(miscounts.sum(axis=0), _AGENT_MISCOUNTS)
    differs = miscounts[:, 0] > 0
    for code, mask in (
        ("points-differ", foreign & differs),
        ("box-points-differ", ~foreign & differs),
    ):
        if mask.any():
            message = "boxes with other points than their labels count"
            message += f": {miscounts[mask, 0].sum()}, {frames_text(np.flatnonzero(mask))}"
            yield subject.finding(code, folder, message)


def _count_miscounts(boxes: Boxes, points: FloatArray) -> tuple[int, int, int]:
    """Return how many boxes of a label hold other points than it counts.

    A cloud of another frame, agent or location changes the counts of many boxes; the release is off
    in single boxes.

    Returns:
        Boxes that are off, boxes that could show it, and boxes that are off enough to show it on
        their own.
    """
    counted = boxes.count_points(points)
    max_count = np.maximum(counted, boxes.num_lidar_pts)
    is_walker = boxes.category == CATEGORIES.index("pedestrian")
    tolerances = np.where(is_walker[:, None], WALKER_POINT_COUNT_TOLERANCE, POINT_COUNT_TOLERANCE)
    min_points, share = tolerances.T
    difference = np.abs(counted - boxes.num_lidar_pts)
    wrong = difference > np.maximum(min_points, share * max_count)
    box_tolerance, walker_tolerance = _BOX_POINT_TOLERANCE
    large = difference > np.where(is_walker, walker_tolerance, box_tolerance)
    return int(wrong.sum()), int((max_count > min_points).sum()), int((wrong & large).sum())


def _exceeds(miscounts: IntArray, limit: tuple[int, float]) -> BoolArray:
    """Return whether counts (…, 3) of `_count_miscounts` reach a number and a share, shape (…)."""
    number, share = limit
    wrong = miscounts[..., 0]
    return np.asarray((wrong >= number) & (wrong >= share * miscounts[..., 1]))


def _sample_boxes(subject: Subject, agent: int, frame: int) -> Boxes:
    """Return the boxes of one label in its LiDAR frame."""
    sample = agent * subject.num_frames + frame - 1
    rows = np.flatnonzero(subject.boxes.sample == sample)
    return subject.lidar_boxes.select(rows)


def _check_bevs(
    subject: Subject, agent: int, paths: Mapping[int, ReleasePath], usable_frames: list[int]
) -> Iterator[Finding]:
    """Decode an agent's BEV arrays; readable frames join `usable_frames`."""
    total = _BevHits()
    for frame, path in paths.items():
        try:
            semantic = read_bev(path).semantic
        except ReleaseError as error:
            yield finding_of(error, "sensor-unreadable", subject.token)
            continue
        usable_frames.append(frame)
        _count_bev_hits(total, semantic, _vehicle_centers(subject, agent, frame), frame)
    folder = str(subject.files.scenario.kind_folder(subject.agents[agent], BEV_CAMERA))
    best = max(total.hits, key=lambda name: total.hits[name])
    best_hits = total.hits[best]
    forward_hits = total.hits["forward-up"]
    if total.boxes and best_hits > forward_hits + max(2, 0.25 * total.boxes):
        message = f"{best_hits} of {total.boxes} vehicles are where the labels have them if it is"
        message += f" '{best}' ({PICTURE_ORIENTATIONS[best]}), {forward_hits} if forward is up"
        yield subject.finding("bev-orientation", folder, message)
    elif total.poor_frames:
        message = "fewer than half of the labels' vehicles are in the picture"
        yield subject.finding("bev-differs", folder, f"{message}, {frames_text(total.poor_frames)}")


def _count_bev_hits(total: _BevHits, semantic: ByteArray, centers: FloatArray, frame: int) -> None:
    """Add the vehicles of one frame to the hits of its recording."""
    if not len(centers):
        return
    total.boxes += len(centers)
    for name in PICTURE_ORIENTATIONS:
        hits = _find_hits(semantic, _turn_picture(centers, name))
        total.hits[name] += int(hits.sum())
        if name == "forward-up" and len(centers) > 2 and hits.mean() < _MIN_BEV_SHARE:
            total.poor_frames.append(frame)


def _vehicle_centers(subject: Subject, agent: int, frame: int) -> FloatArray:
    """Return centres (M, 2) of vehicles in the BEV camera's view, forward and left, metres."""
    sample = agent * subject.num_frames + frame - 1
    boxes = subject.boxes
    is_vehicle = np.isin(boxes.labels.category, _VEHICLES) & (subject.label_id != OWN_ACTOR_ID)
    rows = np.flatnonzero((boxes.sample == sample) & is_vehicle)
    centers: FloatArray = boxes.labels.center[rows, :2]
    return centers[(np.abs(centers) < _BEV_HALF_WIDTH_M).all(axis=1)]


def _turn_picture(centers: FloatArray, orientation: str) -> FloatArray:
    """Return where centres (M, 2), forward and left, lie in a picture of another orientation.

    The result is forward and left as well, as if forward were up.
    """
    x, y = centers.T
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


def _find_hits(semantic: ByteArray, centers: FloatArray) -> BoolArray:
    """Return a mask (M,) of centres (M, 2) in cells with the vehicle tag."""
    middle = (BEV_SHAPE[0] - 1) / 2
    pixels: IntArray = np.rint(middle - centers / BEV_RESOLUTION).astype(np.int64)
    row, column = pixels.T
    tags = semantic[row, column]
    return np.asarray(tags == TAGS["vehicle"])


def _repeated_files(
    subject: Subject, checksums: Mapping[str, Sequence[tuple[str, str, int]]]
) -> Iterator[Finding]:
    """Yield files with the same bytes; an agent that stands still may record them repeatedly."""
    for recordings in checksums.values():
        if len(recordings) < 2 or _stood_still(subject, recordings):
            continue
        names = [f"{agent}/{channel}/{frame:03d}" for agent, channel, frame in recordings]
        listed = ", ".join(names[:4])
        if len(names) > 4:
            listed += f" and {len(names) - 4} more"
        yield subject.finding("file-repeated", subject.token, f"the same bytes: {listed}")


def _stood_still(subject: Subject, recordings: Sequence[tuple[str, str, int]]) -> bool:
    """Return whether they are one channel of an agent that did not move between the frames."""
    if len({(agent, channel) for agent, channel, _ in recordings}) > 1:
        return False
    frames: AnyArray = np.array([frame for _, _, frame in recordings])
    agent = subject.agents.index(recordings[0][0])
    path = subject.positions[agent][frames - 1]
    distance = np.ptp(path, axis=0).max()
    return bool(distance < _STANDSTILL_TOLERANCE_M)
