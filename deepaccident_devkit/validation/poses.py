"""Checks over the frames of a scenario: poses, velocities, and boxes without a track."""

from collections.abc import Callable, Iterator

import numpy as np

from deepaccident_devkit.support.arrays import BoolArray, FloatArray, IntArray
from deepaccident_devkit.tables import Finding
from deepaccident_devkit.tables.boxes import MIN_BOXES, VelocityFit, match_velocities
from deepaccident_devkit.tables.build import ROTATION_TOLERANCE, TRANSLATION_TOLERANCE
from deepaccident_devkit.taxonomy import (
    CAMERAS,
    CATEGORIES,
    FRAME_PERIOD,
    RELEASED_VELOCITY_FRAME,
    UNTRACKED_ID,
    VELOCITY_FRAMES,
)
from deepaccident_devkit.validation.agreement import SAME_POSITION_M
from deepaccident_devkit.validation.subject import Subject, frames_text, near_pairs

CAMERA_YAW_DEG = dict(zip(CAMERAS, (0.0, 55.0, -55.0, 180.0, 110.0, -110.0), strict=True))
"""Direction of each camera, to the left of the agent's front."""
CAMERA_FIELD_DEG = {**dict.fromkeys(CAMERAS, 70.0), "Camera_Back": 110.0}
"""Horizontal field of view of each camera."""
_YAW_TOLERANCE_DEG = 5.0
_FIELD_TOLERANCE = 0.02
# Distance from the LiDAR: a truck's front is up to 4.8 m from its middle, real poles have their
# cameras at 5.1 m.
_MAX_CAMERA_DISTANCE_M = 5.5
_MAX_TILT_SINE = np.sin(np.radians(10.0))
# Difference between a camera's height and the median of all six.
_CAMERA_HEIGHT_TOLERANCE_M = 0.4
_LIDAR_HEIGHTS_M = (0.8, 4.5)
_POLE_MOUNT_TOLERANCE = 0.01
_POLE_POSE_TOLERANCE = 0.02
# Distance from the middle of the neighbouring frames.
_MAX_JUMP_M = 0.75
# The impact can be up to three frames before the last, and frames after it fit no displacement. Of
# fewer than eight frames the first half is judged all the same.
_IMPACT_FRAMES = 4
# Difference of a label's first line from the displacement: absolute, and as a share of its speed.
_SPEED_TOLERANCE_MPS = 1.0
_SPEED_TOLERANCE_SHARE = 0.2
# Boxes of an actor that must not fit for a finding, and their share of its boxes.
_MIN_WRONG_BOXES = 3
_MIN_WRONG_SHARE = 0.8
# Distance within which a vehicle that the agent saw is near enough to be tracked.
_TRACKING_RADIUS_M = 15.0
# Boxes that must show lost ids, since the tracking of a single box comes and goes.
_MIN_TRACKABLE_BOXES = 2
_VEHICLES = tuple(CATEGORIES.index(name) for name in ("car", "truck", "van"))


def check_poses(subject: Subject) -> Iterator[Finding]:
    """Yield all findings in the calib files of a scenario and the labels' first lines."""
    for agent in range(len(subject.agents)):
        for check in _POSE_CHECKS:
            yield from check(subject, agent)


def _frames_of(subject: Subject, agent: int) -> slice:
    start = agent * subject.num_frames
    return slice(start, start + subject.num_frames)


def _mask_text(frames: BoolArray) -> str:
    """Return the numbers of the frames in a mask (F,)."""
    return frames_text(np.flatnonzero(frames) + 1)


def _check_intrinsics(subject: Subject, agent: int) -> Iterator[Finding]:
    intrinsic = subject.files.calibs.intrinsic[_frames_of(subject, agent)]
    focal = intrinsic[..., (0, 1), (0, 1)]
    constants = intrinsic[..., (0, 1, 2, 2, 2), (1, 0, 0, 1, 2)]
    deviation = np.abs(constants - (0.0, 0.0, 0.0, 0.0, 1.0))
    has_form = (focal > 0).all(axis=-1) & (deviation < 1e-6).all(axis=-1)
    pinhole: BoolArray = np.asarray(has_form)
    center = intrinsic[..., 0, 2]
    ratio = focal[..., 0] / np.where(center > 0, center, np.nan)
    fields = [CAMERA_FIELD_DEG[camera] for camera in CAMERAS]
    expected = 1 / np.tan(np.radians(fields) / 2)
    aspect = focal[..., 1] / np.where(focal[..., 0] > 0, focal[..., 0], np.nan)
    square = np.abs(aspect - 1) < _FIELD_TOLERANCE
    usual = (np.abs(ratio / expected - 1) < _FIELD_TOLERANCE) & square
    yield from _camera_findings(
        subject, agent, "intrinsic-form", ~pinhole, "is no pinhole camera's K"
    )
    yield from _camera_findings(
        subject, agent, "intrinsic-odd", pinhole & ~usual, "its f does not fit its field of view"
    )


def _check_cameras(subject: Subject, agent: int) -> Iterator[Finding]:
    pose = subject.files.calibs.camera_from_lidar[_frames_of(subject, agent)]
    # The optical axis in the LiDAR frame.
    forward = pose[..., 2, :3]
    yaw = np.degrees(np.arctan2(forward[..., 1], forward[..., 0]))
    expected_yaw = [CAMERA_YAW_DEG[camera] for camera in CAMERAS]
    yaw_error = np.abs((yaw - expected_yaw + 180) % 360 - 180)
    position = -np.einsum("...ji,...j->...i", pose[..., :3, :3], pose[..., :3, 3])
    misplaced = np.linalg.norm(position, axis=-1) > _MAX_CAMERA_DISTANCE_M
    # A pole's cameras may look down; others are neither rolled nor pitched.
    if not subject.is_pole(agent):
        rolled = np.abs(pose[..., 0, 2]) > _MAX_TILT_SINE
        pitched = np.abs(forward[..., 2]) > _MAX_TILT_SINE
        misplaced |= rolled | pitched
    height = position[..., 2]
    height_error = np.abs(height - np.median(height, axis=-1, keepdims=True))
    misplaced |= height_error > _CAMERA_HEIGHT_TOLERANCE_M
    bad: BoolArray = (yaw_error > _YAW_TOLERANCE_DEG) | misplaced
    yield from _camera_findings(
        subject, agent, "camera-misplaced", bad, "looks another way, or is far from the LiDAR"
    )


def _camera_findings(
    subject: Subject, agent: int, code: str, bad: BoolArray, message: str
) -> Iterator[Finding]:
    """Yield a finding a camera with frames in a mask (F, 6)."""
    for camera, frames in zip(CAMERAS, bad.T, strict=True):
        if frames.any():
            location = f"{subject.calib_folder(agent)}: {camera}"
            yield subject.finding(code, location, f"{message}, {_mask_text(frames)}")


def _check_mounts(subject: Subject, agent: int) -> Iterator[Finding]:
    calibs = subject.files.calibs
    frames = _frames_of(subject, agent)
    location = subject.calib_folder(agent)
    lidar = calibs.ego_from_lidar[frames]
    height = lidar[:, 2, 3]
    if subject.is_pole(agent):
        odd = np.abs(lidar - np.eye(4)).max(axis=(1, 2)) > _POLE_MOUNT_TOLERANCE
        expected = "expected the identity on a pole"
    else:
        low, high = _LIDAR_HEIGHTS_M
        odd = (height < low) | (height > high)
        expected = f"expected {low} to {high} m above the road"
    if odd.any():
        yield subject.finding("lidar-height", location, f"{expected}, {_mask_text(odd)}")
    cameras = calibs.camera_from_lidar[frames]
    for name, pose in {"lidar_to_ego": lidar, "lidar_to_Camera": cameras}.items():
        change = np.abs(pose - np.median(pose, axis=0))
        shift = change[..., :3, 3].reshape(len(pose), -1).max(axis=1)
        turn = change[..., :3, :3].reshape(len(pose), -1).max(axis=1)
        changed = (shift > TRANSLATION_TOLERANCE) | (turn > ROTATION_TOLERANCE)
        if changed.any():
            message = f"{name} changes by up to {1000 * shift.max():.0f} mm"
            message += f" and {turn.max():.2g} in its rotation, {_mask_text(changed)}"
            yield subject.finding("calib-changes", location, message)
    intrinsic = calibs.intrinsic[frames]
    if (np.abs(intrinsic - intrinsic[0]) > 1.0).any():
        yield subject.finding("calib-changes", location, "intrinsics change")


def _check_path(subject: Subject, agent: int) -> Iterator[Finding]:
    location = subject.calib_folder(agent)
    pose = subject.files.calibs.world_from_ego[_frames_of(subject, agent)]
    tilted = pose[:, 2, 2] < np.cos(np.radians(45))
    if tilted.any():
        yield subject.finding("pose-tilted", location, f"over 45° in {_mask_text(tilted)}")
    if subject.is_pole(agent):
        change = np.abs(pose - np.median(pose, axis=0)).max(axis=(1, 2))
        moved = change > _POLE_POSE_TOLERANCE
        if moved.any():
            yield subject.finding("pole-moves", location, _mask_text(moved))
        return
    position = subject.positions[agent]
    bend = np.linalg.norm(position[2:] - 2 * position[1:-1] + position[:-2], axis=1) / 2
    jumps = np.flatnonzero(bend > _MAX_JUMP_M) + 2
    jumps = jumps[jumps <= subject.num_frames - 1 - _IMPACT_FRAMES]
    if len(jumps):
        message = f"over {_MAX_JUMP_M} m off the frames around at {frames_text(jumps)}"
        yield subject.finding("pose-jump", location, message)


def _check_speed(subject: Subject, agent: int) -> Iterator[Finding]:
    """Compare a label's first line with the agent's displacement, except in the last frames.

    Displacements are central differences.
    """
    name = subject.agents[agent]
    if name not in subject.files.scan.labelled:
        return
    start = list(subject.files.scan.labelled).index(name) * subject.num_frames
    labelled = subject.files.labels.agent_velocity[start : start + subject.num_frames]
    measured = _differentiate(subject.positions[agent, :, :2])
    speed = np.linalg.norm(measured, axis=1)
    error = np.linalg.norm(labelled - measured, axis=1)
    # Written so that a NaN does not fit either.
    differs = ~(error <= _SPEED_TOLERANCE_MPS + _SPEED_TOLERANCE_SHARE * speed)
    differs[max(subject.num_frames // 2, subject.num_frames - _IMPACT_FRAMES) :] = False
    if differs.any():
        message = f"the first line is over {_SPEED_TOLERANCE_MPS:.0f} m/s off the displacement"
        message += f", {_mask_text(differs)}"
        yield subject.finding("speed-off", subject.label_folder(agent), message)


def _differentiate(position: FloatArray) -> FloatArray:
    """Return velocities (F, 2), m/s, of positions (F, 2) at 10 Hz.

    Differences are one-sided at the ends, and 0 for a single frame.
    """
    if len(position) < 2:
        return np.zeros_like(position)
    return np.asarray(np.gradient(position, FRAME_PERIOD, axis=0))


_POSE_CHECKS: tuple[Callable[[Subject, int], Iterator[Finding]], ...] = (
    _check_intrinsics,
    _check_cameras,
    _check_mounts,
    _check_path,
    _check_speed,
)


def check_velocities(subject: Subject, fit: VelocityFit) -> Iterator[Finding]:
    """Report a frame other than the release's, none that fits, or actors that do not fit it."""
    if fit.boxes < MIN_BOXES:
        return
    if fit.best is not None:
        yield from _check_actor_velocities(subject, fit.best)
    if fit.best == RELEASED_VELOCITY_FRAME:
        return
    shares = ", ".join(f"{name} {count / fit.boxes:.0%}" for name, count in fit.fits.items())
    message = f"of {fit.boxes} moving boxes fit: {shares}"
    code = "velocity-unexplained"
    if fit.best:
        message = f"they are in {VELOCITY_FRAMES[fit.best]}; {message}"
        code = "velocity-frame"
    yield subject.finding(code, subject.token, message)


def _check_actor_velocities(subject: Subject, frame: str) -> Iterator[Finding]:
    """Find tracks with mostly velocities that do not fit the frame of the other tracks."""
    rows, matches = match_velocities(subject.boxes, subject.velocity)
    keys = np.column_stack([subject.boxes.agent[rows], subject.label_id[rows]])
    tracks, track = np.unique(keys, axis=0, return_inverse=True)
    track = track.reshape(-1)
    is_wrong = ~matches[frame]
    count = np.bincount(track, minlength=len(tracks))
    wrong_count = np.bincount(track[is_wrong], minlength=len(tracks))
    bad_tracks = (wrong_count >= _MIN_WRONG_BOXES) & (wrong_count >= _MIN_WRONG_SHARE * count)
    wrong_rows = subject.mask(rows[bad_tracks[track] & is_wrong])
    yield from subject.label_findings(
        "velocity-off", wrong_rows, "velocities do not fit the displacement"
    )


def check_untracked(subject: Subject) -> Iterator[Finding]:
    """Find labels, or agents with all of their labels, that lost their ids."""
    boxes = subject.boxes
    shape = (len(subject.agents), subject.num_frames)
    size = shape[0] * shape[1]
    tracked = np.bincount(boxes.sample[subject.tracked], minlength=size).reshape(shape)
    untracked = subject.label_id == UNTRACKED_ID
    rows = np.flatnonzero(untracked & (tracked == 0)[boxes.agent, boxes.frame - 1])
    rows = rows[_is_trackable(subject, rows)]
    trackable = np.bincount(boxes.sample[rows], minlength=size).reshape(shape)
    for agent, counts in enumerate(trackable):
        frames = np.flatnonzero(counts >= _MIN_TRACKABLE_BOXES) + 1
        if not tracked[agent].any() and counts.sum() >= _MIN_TRACKABLE_BOXES:
            message = f"every id of its labels is {UNTRACKED_ID}"
            message += f", also of {counts.sum()} boxes that can be tracked"
        elif len(frames):
            message = f"every id is {UNTRACKED_ID}, also of actors that can be tracked"
            message += f", {frames_text(frames)}"
        else:
            continue
        yield subject.finding("ids-untracked", subject.label_folder(agent), message)


def _is_trackable(subject: Subject, rows: IntArray) -> BoolArray:
    """Return a mask (M,) of untracked boxes that their agent saw and could have tracked.

    They are near vehicles, or are tracked by another agent that is no nearer.
    """
    labels = subject.boxes.labels
    boxes = subject.boxes
    distance = np.linalg.norm(labels.center[:, :2], axis=1)
    is_vehicle = np.isin(labels.category[rows], _VEHICLES)
    trackable: BoolArray = is_vehicle & (distance[rows] < _TRACKING_RADIUS_M)
    tracked_rows = np.flatnonzero(subject.tracked)
    if len(rows) and len(tracked_rows):
        all_rows = np.concatenate([rows, tracked_rows])
        pairs, _ = near_pairs(subject.centers[all_rows], boxes.frame[all_rows], SAME_POSITION_M)
        pairs = np.sort(pairs, axis=1)
        pairs = pairs[(pairs[:, 0] < len(rows)) & (pairs[:, 1] >= len(rows))]
        pair_distance = distance[all_rows[pairs]]
        no_nearer = pair_distance[:, 1] >= pair_distance[:, 0]
        trackable[pairs[no_nearer, 0]] = True
    return trackable & ((labels.num_lidar_pts[rows] > 0) | labels.camera_visible[rows])
