"""Checks over the frames of a scenario: poses, velocities, and boxes that lost their track."""

from collections.abc import Callable

import numpy as np

from deepaccident_devkit.support.arrays import BoolArray, IntArray
from deepaccident_devkit.tables.boxes import MIN_BOXES, VelocityFit, match_velocities
from deepaccident_devkit.tables.build import ROTATION_TOLERANCE, TRANSLATION_TOLERANCE
from deepaccident_devkit.taxonomy import (
    CAMERAS,
    RELEASED_VELOCITY_FRAME,
    UNTRACKED_ID,
    VELOCITY_FRAMES,
)
from deepaccident_devkit.v2x.agent_motion import differentiate
from deepaccident_devkit.validation.agreement import SAME_POSITION_M
from deepaccident_devkit.validation.subject import (
    CAR_CODES,
    Findings,
    Subject,
    frames_text,
    near_pairs,
)

CAMERA_YAW_DEG = dict(zip(CAMERAS, (0.0, 55.0, -55.0, 180.0, 110.0, -110.0), strict=True))
"""Direction of each camera in degrees, counter-clockwise from the agent's front."""
CAMERA_FIELD_DEG = {**dict.fromkeys(CAMERAS, 70.0), "Camera_Back": 110.0}
"""Horizontal field of view of each camera in degrees."""
# Largest deviation of a camera's direction from the usual one.
_YAW_TOLERANCE_DEG = 5.0
# Largest relative error of a focal length.
_FIELD_TOLERANCE = 0.02
# Largest distance of a camera from the LiDAR: a truck's front is up to 4.8 m from its centre, and
# the cameras of real poles are at 5.1 m.
_MAX_CAMERA_DISTANCE_M = 5.5
_MAX_TILT_SINE = np.sin(np.radians(10.0))
# Largest deviation of a camera's height from the median of all six.
_CAMERA_HEIGHT_TOLERANCE_M = 0.4
# Smallest and largest height of a vehicle's LiDAR above the road.
_LIDAR_HEIGHTS_M = (0.8, 4.5)
# Largest deviation of a pole's matrix from the identity, and of its pose from the median pose.
_POLE_MOUNT_TOLERANCE = 0.01
_POLE_POSE_TOLERANCE = 0.02
# Largest distance from the midpoint of the neighbouring frames.
_MAX_JUMP_M = 0.75
# The impact can be up to three frames before the last; displacements after it do not fit. If a
# recording has fewer than eight frames, its first half is checked all the same.
_IMPACT_FRAMES = 4
# Largest deviation of a label's first line from the displacement: absolute, and as a share of its
# speed.
_SPEED_TOLERANCE_MPS = 1.0
_SPEED_TOLERANCE_SHARE = 0.2
# A finding needs at least this many boxes of an actor that do not fit, and this share of them.
_MIN_WRONG_BOXES = 3
_MIN_WRONG_SHARE = 0.8
# Distance within which a vehicle that the agent saw should be tracked.
_TRACKING_RADIUS_M = 15.0
# Fewest boxes that show lost ids; the tracking of single boxes comes and goes.
_MIN_TRACKABLE_BOXES = 2


def check_poses(subject: Subject) -> Findings:
    """Yield all findings about a scenario's calib files and the labels' first lines."""
    for agent in range(len(subject.agents)):
        for check in _POSE_CHECKS:
            yield from check(subject, agent)


def _frames_of(subject: Subject, agent: int) -> slice:
    start = agent * subject.num_frames
    return slice(start, start + subject.num_frames)


def _frames_in_mask(frames: BoolArray) -> str:
    """List the frame numbers that are set in a mask (F,)."""
    frame_numbers = np.flatnonzero(frames) + 1
    return frames_text(frame_numbers)


def _check_intrinsics(subject: Subject, agent: int) -> Findings:
    intrinsic = subject.files.calibs.intrinsic[_frames_of(subject, agent)]
    focal = intrinsic[..., (0, 1), (0, 1)]
    constants = intrinsic[..., (0, 1, 2, 2, 2), (1, 0, 0, 1, 2)]
    deviation = np.abs(constants - (0.0, 0.0, 0.0, 0.0, 1.0))
    has_focal = (focal > 0).all(axis=-1)
    has_constants = (deviation < 1e-6).all(axis=-1)
    is_pinhole: BoolArray = np.asarray(has_focal & has_constants)
    focal_x = focal[..., 0]
    center_x = intrinsic[..., 0, 2]
    ratio = focal_x / np.where(center_x > 0, center_x, np.nan)
    fields = [CAMERA_FIELD_DEG[camera] for camera in CAMERAS]
    expected_ratio = 1 / np.tan(np.radians(fields) / 2)
    aspect = focal[..., 1] / np.where(focal_x > 0, focal_x, np.nan)
    is_square = np.abs(aspect - 1) < _FIELD_TOLERANCE
    has_field = np.abs(ratio / expected_ratio - 1) < _FIELD_TOLERANCE
    is_odd = is_pinhole & ~(has_field & is_square)
    message = "K is not that of a pinhole camera"
    yield from _camera_findings(subject, agent, "intrinsic-form", ~is_pinhole, message)
    message = "the focal length does not fit the field of view"
    yield from _camera_findings(subject, agent, "intrinsic-odd", is_odd, message)


def _check_cameras(subject: Subject, agent: int) -> Findings:
    pose = subject.files.calibs.camera_from_lidar[_frames_of(subject, agent)]
    # Direction of the optical axis in the LiDAR frame.
    forward = pose[..., 2, :3]
    yaw = np.degrees(np.arctan2(forward[..., 1], forward[..., 0]))
    expected_yaw = [CAMERA_YAW_DEG[camera] for camera in CAMERAS]
    yaw_error = np.abs((yaw - expected_yaw + 180) % 360 - 180)
    position = -np.einsum("...ji,...j->...i", pose[..., :3, :3], pose[..., :3, 3])
    is_misplaced: BoolArray = np.linalg.norm(position, axis=-1) > _MAX_CAMERA_DISTANCE_M
    # A pole's cameras may point down; other cameras are neither rolled nor pitched.
    if not subject.is_pole(agent):
        is_rolled = np.abs(pose[..., 0, 2]) > _MAX_TILT_SINE
        is_pitched = np.abs(forward[..., 2]) > _MAX_TILT_SINE
        is_misplaced |= is_rolled | is_pitched
    height = position[..., 2]
    median_height = np.median(height, axis=-1, keepdims=True)
    is_misplaced |= np.abs(height - median_height) > _CAMERA_HEIGHT_TOLERANCE_M
    is_misplaced |= yaw_error > _YAW_TOLERANCE_DEG
    message = "looks in an unexpected direction, or is far from the LiDAR"
    yield from _camera_findings(subject, agent, "camera-misplaced", is_misplaced, message)


def _camera_findings(
    subject: Subject, agent: int, code: str, mask: BoolArray, message: str
) -> Findings:
    """Yield a finding for each camera with frames in the mask (F, 6)."""
    for camera, frames in zip(CAMERAS, mask.T, strict=True):
        if frames.any():
            location = f"{subject.kind_folder(agent, 'calib')}: {camera}"
            yield subject.finding(code, location, f"{message}, {_frames_in_mask(frames)}")


def _check_mounts(subject: Subject, agent: int) -> Findings:
    calibs = subject.files.calibs
    frames = _frames_of(subject, agent)
    location = subject.kind_folder(agent, "calib")
    lidar = calibs.ego_from_lidar[frames]
    height = lidar[:, 2, 3]
    if subject.is_pole(agent):
        deviation = np.abs(lidar - np.eye(4)).max(axis=(1, 2))
        is_odd = deviation > _POLE_MOUNT_TOLERANCE
        expected = "expected the identity, as the agent is a pole"
    else:
        low, high = _LIDAR_HEIGHTS_M
        is_odd = (height < low) | (height > high)
        expected = f"expected a LiDAR {low} to {high} m above the road"
    if is_odd.any():
        yield subject.finding("lidar-height", location, f"{expected}, {_frames_in_mask(is_odd)}")
    cameras = calibs.camera_from_lidar[frames]
    for name, pose in {"lidar_to_ego": lidar, "lidar_to_Camera": cameras}.items():
        change = np.abs(pose - np.median(pose, axis=0))
        shift = change[..., :3, 3].reshape(len(pose), -1).max(axis=1)
        turn = change[..., :3, :3].reshape(len(pose), -1).max(axis=1)
        is_changed = (shift > TRANSLATION_TOLERANCE) | (turn > ROTATION_TOLERANCE)
        if is_changed.any():
            message = f"{name} changes by up to {1000 * shift.max():.0f} mm"
            message += f" and {turn.max():.2g} in its rotation, {_frames_in_mask(is_changed)}"
            yield subject.finding("calib-changes", location, message)
    intrinsic = calibs.intrinsic[frames]
    intrinsic_change = np.abs(intrinsic - intrinsic[0])
    if (intrinsic_change > 1.0).any():
        yield subject.finding("calib-changes", location, "the intrinsics change")


def _check_path(subject: Subject, agent: int) -> Findings:
    location = subject.kind_folder(agent, "calib")
    pose = subject.files.calibs.world_from_ego[_frames_of(subject, agent)]
    is_tilted = pose[:, 2, 2] < np.cos(np.radians(45))
    if is_tilted.any():
        message = f"tilted by more than 45° in {_frames_in_mask(is_tilted)}"
        yield subject.finding("pose-tilted", location, message)
    if subject.is_pole(agent):
        change = np.abs(pose - np.median(pose, axis=0)).max(axis=(1, 2))
        is_moved = change > _POLE_POSE_TOLERANCE
        if is_moved.any():
            yield subject.finding("pole-moves", location, _frames_in_mask(is_moved))
        return
    position = subject.positions[agent]
    second_difference = position[2:] - 2 * position[1:-1] + position[:-2]
    bend = np.linalg.norm(second_difference, axis=1) / 2
    jumps = np.flatnonzero(bend > _MAX_JUMP_M) + 2
    jumps = jumps[jumps <= subject.num_frames - 1 - _IMPACT_FRAMES]
    if len(jumps):
        message = f"more than {_MAX_JUMP_M} m from the neighbouring frames, {frames_text(jumps)}"
        yield subject.finding("pose-jump", location, message)


def _check_speed(subject: Subject, agent: int) -> Findings:
    """Compare each label's first line with the agent's displacement, except in the last frames.

    Displacements are central differences.
    """
    name = subject.agents[agent]
    labelled_agents = list(subject.labelled)
    if name not in labelled_agents:
        return
    num_frames = subject.num_frames
    start = labelled_agents.index(name) * num_frames
    labelled = subject.files.labels.agent_velocity[start : start + num_frames]
    measured = differentiate(subject.positions[agent, :, :2])
    error = np.linalg.norm(labelled - measured, axis=1)
    speed = np.linalg.norm(measured, axis=1)
    tolerance = _SPEED_TOLERANCE_MPS + _SPEED_TOLERANCE_SHARE * speed
    # Written so that NaN fails, too.
    differs = ~(error <= tolerance)
    num_judged = max(num_frames // 2, num_frames - _IMPACT_FRAMES)
    differs[num_judged:] = False
    if differs.any():
        message = f"the speed in the first line is more than {_SPEED_TOLERANCE_MPS:.0f} m/s away "
        message += "from the displacement"
        message += f", {_frames_in_mask(differs)}"
        yield subject.label_finding("speed-off", agent, message)


_POSE_CHECKS: tuple[Callable[[Subject, int], Findings], ...] = (
    _check_intrinsics,
    _check_cameras,
    _check_mounts,
    _check_path,
    _check_speed,
)


def check_velocities(subject: Subject, fit: VelocityFit) -> Findings:
    """Find labels with velocities in an unusual frame, and actors that do not fit that frame."""
    if fit.boxes < MIN_BOXES:
        return
    if fit.best is not None:
        yield from _check_actor_velocities(subject, fit.best)
    if fit.best == RELEASED_VELOCITY_FRAME:
        return
    message = fit.to_text()
    code = "velocity-unexplained"
    if fit.best:
        message = f"they are in {VELOCITY_FRAMES[fit.best]}; {message}"
        code = "velocity-frame"
    yield subject.finding(code, subject.token, message)


def _check_actor_velocities(subject: Subject, frame: str) -> Findings:
    """Find tracks whose velocities mostly do not fit the frame of the other tracks."""
    rows, matches = match_velocities(subject.boxes, subject.velocity)
    keys = np.column_stack([subject.boxes.agent[rows], subject.label_id[rows]])
    tracks, track_of_row = np.unique(keys, axis=0, return_inverse=True)
    track_of_row = track_of_row.reshape(-1)
    is_wrong = ~matches[frame]
    counts = np.bincount(track_of_row, minlength=len(tracks))
    wrong_counts = np.bincount(track_of_row[is_wrong], minlength=len(tracks))
    has_many = wrong_counts >= _MIN_WRONG_BOXES
    is_bad_track = has_many & (wrong_counts >= _MIN_WRONG_SHARE * counts)
    wrong_boxes = subject.mask(rows[is_bad_track[track_of_row] & is_wrong])
    message = "the velocities do not fit the displacement"
    yield from subject.box_findings("velocity-off", wrong_boxes, message)


def check_untracked(subject: Subject) -> Findings:
    """Find labels that lost their ids, and agents that lost them in every label."""
    boxes = subject.boxes
    shape = (len(subject.agents), subject.num_frames)
    num_samples = shape[0] * shape[1]
    tracked = np.bincount(boxes.sample[subject.tracked], minlength=num_samples).reshape(shape)
    has_no_track = (tracked == 0)[boxes.agent, boxes.frame - 1]
    rows = np.flatnonzero((subject.label_id == UNTRACKED_ID) & has_no_track)
    rows = rows[_is_trackable(subject, rows)]
    trackable = np.bincount(boxes.sample[rows], minlength=num_samples).reshape(shape)
    for agent, counts in enumerate(trackable):
        frames = np.flatnonzero(counts >= _MIN_TRACKABLE_BOXES) + 1
        if not tracked[agent].any() and counts.sum() >= _MIN_TRACKABLE_BOXES:
            message = f"every id in the labels is {UNTRACKED_ID}"
            message += f", even for {counts.sum()} boxes that the agent should track"
        elif len(frames):
            message = f"every id is {UNTRACKED_ID}, even for actors that the agent should track"
            message += f", {frames_text(frames)}"
        else:
            continue
        yield subject.label_finding("ids-untracked", agent, message)


def _is_trackable(subject: Subject, rows: IntArray) -> BoolArray:
    """Return which untracked boxes (M,) their agent saw and should have tracked.

    These are near vehicles, and actors that another agent, no nearer to them, tracks.
    """
    boxes = subject.boxes
    labels = boxes.labels
    distance = np.linalg.norm(labels.center[:, :2], axis=1)
    is_vehicle = np.isin(labels.category[rows], CAR_CODES)
    is_trackable: BoolArray = is_vehicle & (distance[rows] < _TRACKING_RADIUS_M)
    tracked_rows = np.flatnonzero(subject.tracked)
    if len(rows) and len(tracked_rows):
        all_rows = np.concatenate([rows, tracked_rows])
        pairs, _ = near_pairs(subject.centers[all_rows], boxes.frame[all_rows], SAME_POSITION_M)
        pairs = np.sort(pairs, axis=1)
        is_mixed = (pairs[:, 0] < len(rows)) & (pairs[:, 1] >= len(rows))
        pairs = pairs[is_mixed]
        untracked_distance, tracked_distance = distance[all_rows[pairs]].T
        no_nearer = tracked_distance >= untracked_distance
        is_trackable[pairs[no_nearer, 0]] = True
    is_seen = (labels.num_lidar_pts[rows] > 0) | labels.camera_visible[rows]
    return is_trackable & is_seen
