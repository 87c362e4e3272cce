"""Checks of sensor files, including JPEGs with lost data.

Pillow only reports a JPEG that is truncated.
"""

import hashlib
from collections import defaultdict
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from io import BytesIO
from typing import Any

import numpy as np

from deepaccident_devkit.errors import ReleaseError
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.release import read_bev, read_lidar
from deepaccident_devkit.release.images import (
    calib_fault,
    decode_image,
    image_size,
    read_image_bytes,
)
from deepaccident_devkit.release.npz import TAGS
from deepaccident_devkit.release.store import ReleasePath
from deepaccident_devkit.support.arrays import AnyArray, BoolArray, ByteArray, FloatArray, IntArray
from deepaccident_devkit.support.reading import FileKind, read_bytes
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
from deepaccident_devkit.validation.subject import (
    CAR_CODES,
    MAX_LABEL_BOXES,
    Findings,
    Subject,
    frames_text,
)

MIN_ZERO_BYTES = 64
"""Number of consecutive zero bytes that counts as a fault."""
# Markers of a scan's header and of the image's end; neither occurs in coded data.
_SCAN_MARKER = b"\xff\xda"
_END_MARKER = b"\xff\xd9"
# Number of codes of each length for the AC coefficients of luminance, as in a JPEG's header. Nearly
# all encoders write these.
_STANDARD_CODES = bytes.fromhex("100002010303020403050504040000017d")
# Luminance that decoders give to blocks with missing data: 128, up to rounding.
_MISSING_BRIGHTNESS = (126.0, 130.0)
# Weights of red, green and blue in the luminance.
_BRIGHTNESS_SHARES = (0.299, 0.587, 0.114)
# Data that a decoder ignores after a complete image.
_SURPLUS_DATA = bytes(range(1, 251)) * 40
# Channel → kind of its files; camera channels have images.
_KINDS: dict[str, FileKind] = {LIDAR: "lidar", BEV_CAMERA: "bev"}
LIDAR_RANGE_M = 75.0
"""Largest coordinate in a point cloud; it reaches 70 in real data."""
POINT_COUNT_TOLERANCE = (5, 0.25)
"""Largest error of a box's point count against its cloud: in points, and as a share of them.

Label and cloud are not from exactly the same time: counts of real cars are off by up to 12 points,
or by 24 % of a few points.
"""
WALKER_POINT_COUNT_TOLERANCE = (30, 0.25)
"""Largest error for pedestrians, whose real boxes change size between the count and the label."""
# Error in points above which a single box counts as wrong, for other classes and for pedestrians.
# The worst in the release are 77 instead of 55, and 486 instead of 260.
_BOX_POINT_TOLERANCE = (25, 300)
# Fewest wrong boxes in a label, and smallest share of its boxes with points, that show that the
# cloud belongs to another label.
_FRAME_MISCOUNTS = (2, 0.25)
# Limits over all labels of an agent; in the release, up to 7.5 % of an agent's boxes are wrong.
_AGENT_MISCOUNTS = (3, 0.15)
_BEV_HALF_WIDTH_M = 55.0

# Smallest share of vehicles that have the vehicle tag at their centre.
_MIN_BEV_SHARE = 0.5
# Width and height in pixels.
_THUMBNAIL_SIZE = (32, 18)
# Largest ratio between an image's distance from its neighbours in time and their distance from each
# other.
_MAX_DISTANCE_RATIO = 3.0
# Difference in grey levels below which two images look the same.
_MIN_DIFFERENCE = 6.0
# Smallest difference in grey levels between the darkest and lightest spot of an image with content.
_MIN_CONTRAST = 40.0
# Distance that an agent may move while its images stay the same.
_STANDSTILL_TOLERANCE_M = 0.02
# Agent, channel and frame of a file.
_Recording = tuple[str, str, int]
PICTURE_ORIENTATIONS: dict[str, str] = {
    "forward-up": "as the format defines",
    "mirrored": "left and right swapped",
    "backward-up": "rotated by 180°",
    "mirrored-backward": "front and rear swapped",
    "left-up": "rotated by 90°, left up",
    "right-up": "rotated by 90°, right up",
    "transposed": "rows and columns swapped",
    "anti-transposed": "rows and columns swapped, and rotated by 180°",
}
"""The eight possible orientations of the BEV camera's image."""


def zero_stretch(content: bytes) -> tuple[int, int] | None:
    """Find a run of zero bytes in a JPEG's data that no encoder writes; return offset and length.

    Return None if there is none. With the standard codes, zero bits mean coefficients that are all
    negative up to the end of a block. `MIN_ZERO_BYTES` bytes contain several such blocks, which do
    not occur in images. With codes made for one image, they may be a uniform area, and are
    accepted.
    """
    start, stop = _last_scan(content)
    if content.find(_STANDARD_CODES, 0, start) < 0:
        return None
    offset = content.find(bytes(MIN_ZERO_BYTES), start, stop)
    if offset < 0:
        return None
    data = content[offset:stop]
    data_after_zeros = data.lstrip(b"\0")
    return offset, len(data) - len(data_after_zeros)


def ends_early(content: bytes, image: ByteArray) -> bool:
    """Return whether a JPEG's coded data end before its decoded image (H, W, 3) is complete.

    The image then ends in grey, and changes if data are inserted before the end.
    """
    low, high = _MISSING_BRIGHTNESS
    brightness = image[-1, -1] @ _BRIGHTNESS_SHARES
    if not low < brightness < high:
        return False
    start, stop = _last_scan(content)
    # A 0xff at the end of the data would turn the following bytes into a marker.
    data = content[:stop].rstrip(b"\xff")
    longer_picture = _decode_jpeg(data + _SURPLUS_DATA + content[stop:])
    return start > 0 and not np.array_equal(longer_picture, image)


def _last_scan(content: bytes) -> tuple[int, int]:
    """Return the start and end of a JPEG's last scan; 0 and the file's end if it has none."""
    start = max(content.rfind(_SCAN_MARKER), 0)
    stop = content.find(_END_MARKER, start)
    if stop < 0:
        stop = len(content)
    return start, stop


def _decode_jpeg(content: bytes) -> Any:
    """Decode a file's bytes to an image (H, W, 3); None if they are damaged."""
    from PIL import Image

    try:
        with Image.open(BytesIO(content), formats=("JPEG",)) as image:
            return np.asarray(image.convert("RGB"))
    except (OSError, ValueError, SyntaxError):
        return None


@dataclass(slots=True)
class _BevHits:
    """How many vehicles in one recording have the vehicle tag at their centre.

    Attributes:
        boxes: Number of all vehicles.
        hits: Orientation → number of vehicles with the tag.
        poor_frames: Frames in which fewer than half of the vehicles have it.
    """

    boxes: int = 0
    hits: dict[str, int] = field(default_factory=lambda: dict.fromkeys(PICTURE_ORIENTATIONS, 0))
    poor_frames: list[int] = field(default_factory=list)


def check_sensors(subject: Subject, inventory: Inventory) -> Findings:
    """Decode a scenario's sensor files, and compare them with its labels and calib files."""
    recordings: dict[str, list[_Recording]] = defaultdict(list)
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
            recordings[checksum].append((agent, channel, frame))
    yield from _repeated_files(subject, recordings)


def check_first_images(subject: Subject, inventory: Inventory) -> Findings:
    """Compare the size of each camera's first image with K, without decoding it."""
    for (agent, channel), frames in inventory.items():
        frame = frames[0]
        if channel in CAMERAS and frame <= subject.num_frames:
            row = subject.agents.index(agent)
            path = subject.files.scenario.channel_path(agent, channel, frame)
            with suppress(ReleaseError):  # the deep check reports what cannot be read
                yield from _check_image_sizes(subject, row, channel, {frame: image_size(path)})


def _check_images(
    subject: Subject,
    agent: int,
    channel: str,
    paths: Mapping[int, ReleasePath],
    usable_frames: list[int],
) -> Findings:
    """Decode and check a camera's images.

    Frames that show more than a wall or fog are appended to `usable_frames`.
    """
    import cv2

    thumbnails = {}
    sizes = {}
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
    odd_frames = out_of_sequence(thumbnails)
    # At the impact, another car may suddenly fill the image.
    if subject.num_frames in odd_frames and _collides(subject, agent):
        odd_frames.remove(subject.num_frames)
    if odd_frames:
        folder = subject.kind_folder(agent, channel)
        message = f"does not fit between its neighbours, {frames_text(odd_frames)}"
        yield subject.finding("image-out-of-sequence", folder, message)


def _has_content(picture: FloatArray) -> bool:
    """Return whether an image (h, w, 3) shows more than a uniform surface."""
    contrast = np.ptp(picture, axis=(0, 1)).max()
    return bool(contrast >= _MIN_CONTRAST)


def _lost_data_text(content: bytes, image: ByteArray) -> str | None:
    """Describe how an image that can be decoded shows lost data; None if it does not."""
    zeros = zero_stretch(content)
    if zeros is not None:
        offset, length = zeros
        text = f"contains {length:,} zero bytes in a row from byte {offset:,} on"
        return f"{text}: part of the image is lost"
    if ends_early(content, image):
        return "the data end early: the rest of the image is lost"
    return None


def _collides(subject: Subject, agent: int) -> bool:
    """Return whether meta names the agent as one of the colliders."""
    is_own = subject.own & (subject.boxes.agent == agent)
    return bool(subject.in_collision[is_own].any())


def _check_image_sizes(
    subject: Subject, agent: int, channel: str, sizes: Mapping[int, tuple[int, int]]
) -> Findings:
    """Compare the sizes of images with K, whose principal point should be in the middle.

    Images with the same fault share a finding about the first of them.
    """
    camera = CAMERAS.index(channel)
    frames_by_fault: dict[str, list[int]] = {}
    for frame, size in sizes.items():
        row = agent * subject.num_frames + frame - 1
        principal_point = subject.files.calibs.intrinsic[row, camera, :2, 2]
        fault = calib_fault(size, 2 * principal_point)
        if fault is not None:
            frames_by_fault.setdefault(fault, []).append(frame)
    for fault, frames in frames_by_fault.items():
        path = subject.files.scenario.channel_path(subject.agents[agent], channel, frames[0])
        yield subject.finding("image-size", str(path), f"{fault} ({frames_text(frames)})")


def out_of_sequence(thumbnails: Mapping[int, FloatArray]) -> list[int]:
    """Return the frames whose images (h, w, 3) do not fit between their neighbours.

    Such an image is much farther from both neighbours than these are from each other. Neighbours
    are 0.1 s apart; a missing frame ends a sequence. At its ends, the distance from the only
    neighbour is compared with the distance of the next step. It is ignored if the neighbour has no
    content: an obstacle may just have left the view.
    """
    frames = np.array(sorted(thumbnails), dtype=np.int64)
    gaps = np.flatnonzero(np.diff(frames) != 1) + 1
    odd_frames = []
    for sequence in np.split(frames, gaps):
        odd_frames += _odd_frames(sequence.tolist(), thumbnails)
    return odd_frames


def _odd_frames(frames: Sequence[int], thumbnails: Mapping[int, FloatArray]) -> list[int]:
    """Return the frames of one unbroken sequence that do not fit into it."""
    if len(frames) < 3:
        return []
    pictures = np.stack([thumbnails[frame] for frame in frames])
    step = _picture_distance(pictures[1:], pictures[:-1])
    neighbour_distance = _picture_distance(pictures[2:], pictures[:-2])
    limit = np.maximum(_MAX_DISTANCE_RATIO * neighbour_distance, _MIN_DIFFERENCE)
    is_odd = np.zeros(len(frames), dtype=bool)
    is_odd[1:-1] = np.minimum(step[1:], step[:-1]) > limit
    median_step = np.median(step)
    for end, neighbour, end_step, next_step in (
        (0, 1, step[0], step[1]),
        (-1, -2, step[-1], step[-2]),
    ):
        is_comparable = not is_odd[neighbour] and _has_content(pictures[neighbour])
        usual_step = max(next_step, median_step)
        end_limit = max(_MAX_DISTANCE_RATIO * usual_step, _MIN_DIFFERENCE)
        is_odd[end] = is_comparable and end_step > end_limit
    return [frames[position] for position in np.flatnonzero(is_odd).tolist()]


def _picture_distance(pictures: FloatArray, other_pictures: FloatArray) -> FloatArray:
    difference = np.abs(pictures - other_pictures)
    distance: FloatArray = difference.mean(axis=(1, 2, 3))
    return distance


def _check_clouds(
    subject: Subject, agent: int, paths: Mapping[int, ReleasePath], usable_frames: list[int]
) -> Findings:
    """Decode and check an agent's clouds; readable frames are appended to `usable_frames`."""
    odd_frames = []
    miscounts = np.zeros((subject.num_frames + 1, 3), dtype=np.int64)
    for frame, path in paths.items():
        try:
            cloud = read_lidar(path)
            points = cloud.xyz
        except ReleaseError as error:
            yield finding_of(error, "sensor-unreadable", subject.token)
            continue
        usable_frames.append(frame)
        is_finite = np.isfinite(points).all() and np.isfinite(cloud.intensity).all()
        if not is_finite or (len(points) and np.abs(points).max() > LIDAR_RANGE_M):
            odd_frames.append(frame)
        sample = agent * subject.num_frames + frame - 1
        rows = np.flatnonzero(subject.boxes.sample == sample)
        if 0 < len(rows) <= MAX_LABEL_BOXES:
            boxes = subject.lidar_boxes.select(rows)
            miscounts[frame] = _count_miscounts(boxes, points)
    folder = subject.kind_folder(agent, LIDAR)
    if odd_frames:
        message = f"points that are not numbers, or beyond {LIDAR_RANGE_M:.0f} m"
        yield subject.finding("points-odd", folder, f"{message}, {frames_text(odd_frames)}")
    is_foreign = _exceeds(miscounts, _FRAME_MISCOUNTS) | (miscounts[:, 2] > 0)
    is_foreign |= _exceeds(miscounts.sum(axis=0), _AGENT_MISCOUNTS)
    differs = miscounts[:, 0] > 0
    for code, mask in (
        ("points-differ", is_foreign & differs),
        ("box-points-differ", ~is_foreign & differs),
    ):
        if mask.any():
            message = "boxes whose points differ from the count in their labels"
            message += f": {miscounts[mask, 0].sum()}, {frames_text(np.flatnonzero(mask))}"
            yield subject.finding(code, folder, message)


def _count_miscounts(boxes: Boxes, points: FloatArray) -> tuple[int, int, int]:
    """Count the boxes of a label that contain other numbers of points than it states.

    In a cloud of another frame, agent or place, many counts differ. In the release, the counts of
    single boxes are wrong.

    Returns:
        Numbers of boxes with a wrong count, of boxes that could show it, and of boxes so wrong that
        one is enough.
    """
    counted_points = boxes.count_points(points)
    max_count = np.maximum(counted_points, boxes.num_lidar_pts)
    is_walker = boxes.category == CATEGORIES.index("pedestrian")
    tolerances = np.where(is_walker[:, None], WALKER_POINT_COUNT_TOLERANCE, POINT_COUNT_TOLERANCE)
    min_points, share = tolerances.T
    difference = np.abs(counted_points - boxes.num_lidar_pts)
    is_wrong = difference > np.maximum(min_points, share * max_count)
    is_judged = max_count > min_points
    box_tolerance, walker_tolerance = _BOX_POINT_TOLERANCE
    is_large = difference > np.where(is_walker, walker_tolerance, box_tolerance)
    is_decisive = is_wrong & is_large
    return int(is_wrong.sum()), int(is_judged.sum()), int(is_decisive.sum())


def _exceeds(miscounts: IntArray, limit: tuple[int, float]) -> BoolArray:
    """Return whether `_count_miscounts` (…, 3) reaches both a number and a share, shape (…)."""
    min_number, min_share = limit
    wrong_counts = miscounts[..., 0]
    judged_counts = miscounts[..., 1]
    has_number = wrong_counts >= min_number
    has_share = wrong_counts >= min_share * judged_counts
    return has_number & has_share


def _check_bevs(
    subject: Subject, agent: int, paths: Mapping[int, ReleasePath], usable_frames: list[int]
) -> Findings:
    """Decode and check an agent's BEV arrays; readable frames are appended to `usable_frames`."""
    total = _BevHits()
    for frame, path in paths.items():
        try:
            semantic = read_bev(path).semantic
        except ReleaseError as error:
            yield finding_of(error, "sensor-unreadable", subject.token)
            continue
        usable_frames.append(frame)
        _count_bev_hits(total, semantic, _vehicle_centers(subject, agent, frame), frame)
    folder = subject.kind_folder(agent, BEV_CAMERA)
    best_orientation = max(total.hits, key=lambda name: total.hits[name])
    best_hits = total.hits[best_orientation]
    forward_hits = total.hits["forward-up"]
    if total.boxes and best_hits > forward_hits + max(2, 0.25 * total.boxes):
        message = (
            f"{best_hits} of {total.boxes} vehicles are where the labels put them if the picture is"
        )
        meaning = PICTURE_ORIENTATIONS[best_orientation]
        message += f" '{best_orientation}' ({meaning}), {forward_hits} if forward is up"
        yield subject.finding("bev-orientation", folder, message)
    elif total.poor_frames:
        message = "fewer than half of the labelled vehicles are in the picture"
        yield subject.finding("bev-differs", folder, f"{message}, {frames_text(total.poor_frames)}")


def _count_bev_hits(total: _BevHits, semantic: ByteArray, centers: FloatArray, frame: int) -> None:
    """Add the vehicles in one frame to the counts of its recording."""
    if not len(centers):
        return
    total.boxes += len(centers)
    for name in PICTURE_ORIENTATIONS:
        hits = _find_hits(semantic, _turn_centers(centers, name))
        total.hits[name] += int(hits.sum())
        if name == "forward-up" and len(centers) > 2 and hits.mean() < _MIN_BEV_SHARE:
            total.poor_frames.append(frame)


def _vehicle_centers(subject: Subject, agent: int, frame: int) -> FloatArray:
    """Return the centres of other vehicles in the BEV camera's view in metres, shape (M, 2).

    The columns are forward and left.
    """
    sample = agent * subject.num_frames + frame - 1
    boxes = subject.boxes
    is_vehicle = np.isin(boxes.labels.category, CAR_CODES)
    is_other = subject.label_id != OWN_ACTOR_ID
    rows = np.flatnonzero((boxes.sample == sample) & is_vehicle & is_other)
    centers: FloatArray = boxes.labels.center[rows, :2]
    is_in_view = (np.abs(centers) < _BEV_HALF_WIDTH_M).all(axis=1)
    return centers[is_in_view]


def _turn_centers(centers: FloatArray, orientation: str) -> FloatArray:
    """Turn centres (M, 2) so that `_find_hits` finds them in a BEV image with this orientation.

    Centres are forward and left coordinates. `_find_hits` assumes that forward is up.
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
    """Return which centres (M, 2) are in cells with the vehicle tag, shape (M,)."""
    middle = (BEV_SHAPE[0] - 1) / 2
    pixels: IntArray = np.rint(middle - centers / BEV_RESOLUTION).astype(np.int64)
    row, column = pixels.T
    is_hit: BoolArray = semantic[row, column] == TAGS["vehicle"]
    return is_hit


def _repeated_files(
    subject: Subject, recordings_by_checksum: Mapping[str, Sequence[_Recording]]
) -> Findings:
    """Yield a finding for files with identical bytes.

    An agent that stands still may record such files repeatedly.
    """
    for recordings in recordings_by_checksum.values():
        if len(recordings) < 2 or _stood_still(subject, recordings):
            continue
        names = [f"{agent}/{channel}/{frame:03d}" for agent, channel, frame in recordings]
        listed_files = ", ".join(names[:4])
        if len(names) > 4:
            listed_files += f" and {len(names) - 4} more"
        yield subject.finding("file-repeated", subject.token, f"identical files: {listed_files}")


def _stood_still(subject: Subject, recordings: Sequence[_Recording]) -> bool:
    """Return whether all files are from one channel of an agent that did not move in between."""
    channels = {(agent, channel) for agent, channel, _ in recordings}
    if len(channels) > 1:
        return False
    frames: AnyArray = np.array([frame for _, _, frame in recordings])
    agent = subject.agents.index(recordings[0][0])
    path = subject.positions[agent][frames - 1]
    distance = np.ptp(path, axis=0).max()
    return bool(distance < _STANDSTILL_TOLERANCE_M)
