"""Images, point clouds and BEV arrays."""

import io
from collections.abc import Callable

import numpy as np

from deepaccident_devkit.taxonomy import BEV_CAMERA, CAMERAS, LIDAR
from fault_injection.editor import UndoableEditor
from fault_injection.kinds import Apply, Group, MatrixEdit, cut, edit_file, empty, garbage

IMAGES = Group("images", deep=True)
LIDARS = Group("lidar", deep=True)
BEVS = Group("bev camera", deep=True)
_MIN_FRAME_DISTANCE = 3
"""Frames after which two pictures of a moving camera differ visibly."""
_ONLY_VISIBLE = (
    "only a person who looks at the pictures can find it: each file is sound, and no "
    "two in the scenario are equal"
)
_JPEG_START_OF_SCAN = b"\xff\xda"
_JPEG_SCAN_HEADER_BYTES = 14
_LOOKS_LIKE_A_WALL = "a wall or a truck that fills the view looks the same"


def _any_camera(rng: np.random.Generator) -> str:
    return str(rng.choice(CAMERAS))


def _edit_pixels(change: MatrixEdit) -> Apply:
    """Change the pixels of an image of any camera."""
    return edit_file("Camera", lambda content, _: _encode_jpeg(change(_decode_jpeg(content))))


def _edit_array(
    channel: str, change: Callable[[np.ndarray, np.random.Generator], np.ndarray]
) -> Apply:
    """Change the array of a point cloud or BEV file."""

    def apply(editor: UndoableEditor, rng: np.random.Generator) -> None:
        agent, frame = editor.any_agent(rng), editor.any_frame(rng)
        array = editor.array(agent, channel, frame)
        editor.write_array(agent, channel, frame, change(array, rng))

    return apply


def _take_from_other_agent(editor: UndoableEditor, rng: np.random.Generator, channel: str) -> None:
    """Replace an agent's file by another agent's of the same frame."""
    agent, other = editor.two_agents(rng)
    frame = editor.any_frame(rng)
    editor.take(agent, channel, frame, other, frame)


def _choose_two_frames(editor: UndoableEditor, rng: np.random.Generator) -> tuple[int, int]:
    while True:
        frame, other = map(int, rng.choice(editor.frames, size=2, replace=False))
        if abs(frame - other) >= _MIN_FRAME_DISTANCE:
            return frame, other


def _take_from_other_frame(editor: UndoableEditor, rng: np.random.Generator, channel: str) -> None:
    """Replace a moving agent's file by its own of another frame."""
    agent = editor.moving_agent(rng)
    frame, other = _choose_two_frames(editor, rng)
    editor.take(agent, channel, frame, agent, other)


def _exchange_frames(editor: UndoableEditor, rng: np.random.Generator, channel: str) -> None:
    agent = editor.moving_agent(rng)
    frame, other = _choose_two_frames(editor, rng)
    editor.exchange(editor.file(agent, channel, frame), editor.file(agent, channel, other))


def _exchange_agents(editor: UndoableEditor, rng: np.random.Generator, channel: str) -> None:
    editor.exchange_agents(editor.two_agents(rng), channel, editor.frames)


def _encode_jpeg(image: np.ndarray) -> bytes:
    from PIL import Image

    content = io.BytesIO()
    Image.fromarray(image).save(content, "JPEG", quality=90)
    return content.getvalue()


def _decode_jpeg(content: bytes) -> np.ndarray:
    from PIL import Image

    return np.array(Image.open(io.BytesIO(content)))


def _find_coded_data(content: bytes) -> int:
    """Return the index of the first byte of a JPEG file's coded data."""
    return content.index(_JPEG_START_OF_SCAN) + _JPEG_SCAN_HEADER_BYTES


def _end_early(content: bytes, rng: np.random.Generator) -> bytes:
    start = _find_coded_data(content)
    max_end = start + (len(content) - start) * 9 // 10
    end = rng.integers(start, max_end)
    return content[:end] + b"\xff\xd9"


def _zero_some_bytes(content: bytes, rng: np.random.Generator) -> bytes:
    data_start = _find_coded_data(content)
    length = min(512, (len(content) - data_start) // 2)
    start = int(rng.integers(data_start, len(content) - length))
    return content[:start] + bytes(length) + content[start + length :]


IMAGES.add(
    {
        "image_cut": ("An image file ends at a random byte.", edit_file("Camera", cut)),
        "image_ends_early": (
            (
                "A part of an image's coded data before its end marker is gone; "
                "decoders do not report this."
            ),
            edit_file("Camera", _end_early),
        ),
        "image_emptied": ("An image file is empty.", edit_file("Camera", empty)),
        "image_zeros": (
            "A part of an image's coded data is zero bytes; decoders do not report this.",
            edit_file("Camera", _zero_some_bytes),
        ),
        "image_garbage": (
            "An image file holds random bytes.",
            edit_file("Camera", garbage),
        ),
        "image_size": (
            "An image has half the size of the others.",
            _edit_pixels(lambda pixels: pixels[::2, ::2]),
        ),
    },
)
IMAGES.add(
    {
        "image_grey": (
            "All of an image has one grey.",
            _edit_pixels(lambda pixels: np.full_like(pixels, 128)),
        )
    },
    beyond=_LOOKS_LIKE_A_WALL,
)


def _take_from_other_camera(editor: UndoableEditor, rng: np.random.Generator) -> None:
    agent, frame = editor.any_agent(rng), editor.any_frame(rng)
    camera, other = map(str, rng.choice(CAMERAS, size=2, replace=False))
    content = editor.file(agent, other, frame).read_bytes()
    editor.write(editor.file(agent, camera, frame), content)


def _take_from_twin(editor: UndoableEditor, rng: np.random.Generator) -> None:
    scenario_type = editor.scenario.scenario_type
    if scenario_type.endswith("_accident"):
        type_of_twin = scenario_type.replace("accident", "normal")
    else:
        type_of_twin = scenario_type.replace("normal", "accident")
    agent, other = editor.two_agents(rng)
    frame, other_frame = _choose_two_frames(editor, rng)
    camera = _any_camera(rng)

    path = editor.file(other, camera, other_frame).relative_to(editor.root / scenario_type)
    content = (editor.root / type_of_twin / path).read_bytes()
    editor.write(editor.file(agent, camera, frame), content)


def _exchange_cameras(editor: UndoableEditor, rng: np.random.Generator) -> None:
    agent = editor.any_agent(rng)
    camera, other = map(str, rng.choice(CAMERAS, size=2, replace=False))
    for frame in editor.frames:
        editor.exchange(editor.file(agent, camera, frame), editor.file(agent, other, frame))


IMAGES.add(
    {
        "image_of_camera": (
            "An image is another camera's of the same agent and frame.",
            _take_from_other_camera,
        ),
        "image_of_agent": (
            "An image is another agent's of the same camera and frame.",
            lambda editor, rng: _take_from_other_agent(editor, rng, _any_camera(rng)),
        ),
        "image_of_frame": (
            "An image is that of another frame of the same, moving, camera.",
            lambda editor, rng: _take_from_other_frame(editor, rng, _any_camera(rng)),
        ),
    },
)
IMAGES.add(
    {
        "image_of_twin": (
            "An image is replaced by one of another agent and frame from the scenario's twin.",
            _take_from_twin,
        ),
        "images_of_two_frames_exchanged": (
            "Two images of a moving camera are exchanged.",
            lambda editor, rng: _exchange_frames(editor, rng, _any_camera(rng)),
        ),
        "images_of_two_cameras_exchanged": (
            "All images of two cameras of an agent are exchanged.",
            _exchange_cameras,
        ),
        "images_of_two_agents_exchanged": (
            "All images of one camera of two agents are exchanged.",
            lambda editor, rng: _exchange_agents(editor, rng, _any_camera(rng)),
        ),
        "image_mirrored": ("An image is mirrored.", _edit_pixels(lambda pixels: pixels[:, ::-1])),
    },
    beyond=_ONLY_VISIBLE,
)


def _flip_bit(content: bytes, rng: np.random.Generator) -> bytes:
    index = int(rng.integers(len(content) // 4, 3 * len(content) // 4))
    changed_content = bytearray(content)
    changed_content[index] ^= 0x10
    return bytes(changed_content)


def _add_nan(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    indices = rng.choice(len(points), size=100, replace=False)
    broken_points = points.copy()
    broken_points[indices, :3] = np.nan
    return broken_points


LIDARS.add(
    {
        "lidar_cut": ("A point cloud's file ends at a random byte.", edit_file(LIDAR, cut)),
        "lidar_with_more_bytes": (
            "Bytes follow the end of a point cloud's file.",
            edit_file(LIDAR, lambda content, rng: content + garbage(bytes(100), rng)),
        ),
        "lidar_emptied": ("A point cloud's file is empty.", edit_file(LIDAR, empty)),
        "lidar_bit_flipped": (
            "A byte in the middle of a point cloud's file is wrong.",
            edit_file(LIDAR, _flip_bit),
        ),
        "lidar_wrong_shape": (
            "A point cloud lacks the intensity.",
            _edit_array(LIDAR, lambda points, _: points[:, :3]),
        ),
        "lidar_nan": ("A hundred points of a cloud are NaN.", _edit_array(LIDAR, _add_nan)),
        "lidar_without_points": (
            "A cloud has no points.",
            _edit_array(LIDAR, lambda points, _: points[:0]),
        ),
        "lidar_halved": (
            "Half of a cloud's points are missing.",
            _edit_array(LIDAR, lambda points, _: points[: len(points) // 2]),
        ),
        "lidar_of_agent": (
            "A point cloud is another agent's of the same frame.",
            lambda editor, rng: _take_from_other_agent(editor, rng, LIDAR),
        ),
        "lidar_of_frame": (
            "A moving agent's point cloud is that of another frame.",
            lambda editor, rng: _take_from_other_frame(editor, rng, LIDAR),
        ),
        "lidars_shifted": (
            "All point clouds of a moving agent are one frame early; the last one appears twice.",
            lambda editor, rng: editor.shift_one_frame_early(editor.moving_agent(rng), LIDAR),
        ),
        "lidars_of_two_frames_exchanged": (
            "Two point clouds of a moving agent are exchanged.",
            lambda editor, rng: _exchange_frames(editor, rng, LIDAR),
        ),
        "lidars_of_two_agents_exchanged": (
            "All point clouds of two agents are exchanged.",
            lambda editor, rng: _exchange_agents(editor, rng, LIDAR),
        ),
        "lidar_y_flipped": (
            "A cloud's y has the other sign.",
            _edit_array(LIDAR, lambda points, _: points * np.float32([1, -1, 1, 1])),
        ),
        "lidar_scaled": (
            "A cloud is 10 % too large.",
            _edit_array(LIDAR, lambda points, _: points * np.float32([1.1, 1.1, 1.1, 1])),
        ),
        "lidar_turned": (
            "A cloud is turned by 90°.",
            _edit_array(
                LIDAR, lambda points, _: points[:, [1, 0, 2, 3]] * np.float32([-1, 1, 1, 1])
            ),
        ),
    },
)


def _flip_all_bevs(editor: UndoableEditor, rng: np.random.Generator) -> None:
    agent = editor.any_agent(rng)
    for frame in editor.frames:
        picture = editor.array(agent, BEV_CAMERA, frame)
        editor.write_array(agent, BEV_CAMERA, frame, picture[:, ::-1])


BEVS.add(
    {
        "bev_cut": ("A BEV file ends at a random byte.", edit_file(BEV_CAMERA, cut)),
        "bev_wrong_shape": (
            "A BEV array has half the rows.",
            _edit_array(BEV_CAMERA, lambda picture, _: picture[::2]),
        ),
        "bev_channels_reversed": (
            "A BEV array's channels are in the reverse order.",
            _edit_array(BEV_CAMERA, lambda picture, _: picture[..., ::-1]),
        ),
        "bev_flipped": (
            "A BEV array is flipped left to right.",
            _edit_array(BEV_CAMERA, lambda picture, _: picture[:, ::-1]),
        ),
        "bev_turned": (
            "A BEV array is turned by 90° or 180°.",
            _edit_array(BEV_CAMERA, lambda picture, rng: np.rot90(picture, rng.choice([1, 2, 3]))),
        ),
        "bevs_flipped": ("All BEV arrays of an agent are flipped left to right.", _flip_all_bevs),
        "bev_zoomed": (
            "A BEV array shows 30 m instead of 60 m to each side.",
            _edit_array(
                BEV_CAMERA,
                lambda picture, _: picture[300:900, 300:900].repeat(2, axis=0).repeat(2, axis=1),
            ),
        ),
        "bev_of_agent": (
            "A BEV array is another agent's of the same frame.",
            lambda editor, rng: _take_from_other_agent(editor, rng, BEV_CAMERA),
        ),
        "bev_of_frame": (
            "A moving agent's BEV array is that of another frame.",
            lambda editor, rng: _take_from_other_frame(editor, rng, BEV_CAMERA),
        ),
        "bevs_of_two_agents_exchanged": (
            "All BEV arrays of two agents are exchanged.",
            lambda editor, rng: _exchange_agents(editor, rng, BEV_CAMERA),
        ),
    },
)
