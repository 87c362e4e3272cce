"""Images, point clouds and BEV arrays."""

import io
from collections.abc import Callable

import numpy as np

from deepaccident_devkit.taxonomy import BEV_CAMERA, CAMERAS, LIDAR
from fault_injection.kinds import Apply, Group, Matrix, cut, emptied, garbage, in_file
from fault_injection.place import Place

IMAGES = Group("images", deep=True)
LIDARS = Group("lidar", deep=True)
BEVS = Group("bev camera", deep=True)
_FAR_APART = 3
"""Frames between two pictures that are to differ visibly."""
_LOOK = (
    "only a person who looks at the pictures can find it: each file is sound, and no "
    "two in the scenario are equal"
)
_WALL = "a wall or a truck that fills the view looks the same"


def _camera(rng: np.random.Generator) -> str:
    return str(rng.choice(CAMERAS))


def _in_image(change: Matrix) -> Apply:
    """Change the pixels of an image of any camera."""
    return in_file("Camera", lambda content, _: _jpeg(change(_pixels(content))))


def _in_array(
    channel: str, change: Callable[[np.ndarray, np.random.Generator], np.ndarray]
) -> Apply:
    """Change the array of a point cloud or BEV file."""

    def apply(place: Place, rng: np.random.Generator) -> None:
        agent, frame = place.any_agent(rng), place.any_frame(rng)
        place.write_array(agent, channel, frame, change(place.array(agent, channel, frame), rng))

    return apply


def _of_agent(place: Place, rng: np.random.Generator, channel: str) -> None:
    """Replace an agent's file by another agent's of the same frame."""
    (agent, other), frame = place.two_agents(rng), place.any_frame(rng)
    place.take(agent, channel, frame, other, frame)


def _two_frames(place: Place, rng: np.random.Generator) -> tuple[int, int]:
    while True:
        one, other = map(int, rng.choice(place.frames, size=2, replace=False))
        if abs(one - other) >= _FAR_APART:
            return one, other


def _of_frame(place: Place, rng: np.random.Generator, channel: str) -> None:
    """Replace a moving agent's file by its own of another frame."""
    agent, (frame, other) = place.moving_agent(rng), _two_frames(place, rng)
    place.take(agent, channel, frame, agent, other)


def _exchange_frames(place: Place, rng: np.random.Generator, channel: str) -> None:
    agent, frames = place.moving_agent(rng), _two_frames(place, rng)
    place.exchange(*(place.file(agent, channel, frame) for frame in frames))


def _exchange_agents(place: Place, rng: np.random.Generator, channel: str) -> None:
    place.exchange_agents(place.two_agents(rng), channel, place.frames)


def _jpeg(image: np.ndarray) -> bytes:
    from PIL import Image

    content = io.BytesIO()
    Image.fromarray(image).save(content, "JPEG", quality=90)
    return content.getvalue()


def _pixels(content: bytes) -> np.ndarray:
    from PIL import Image

    return np.array(Image.open(io.BytesIO(content)))


def _ends_early(content: bytes, rng: np.random.Generator) -> bytes:
    start = content.index(b"\xff\xda") + 14
    return content[: rng.integers(start, start + (len(content) - start) * 9 // 10)] + b"\xff\xd9"


def _zeros(content: bytes, rng: np.random.Generator) -> bytes:
    start = content.index(b"\xff\xda") + 14
    length = min(512, (len(content) - start) // 2)
    start = int(rng.integers(start, len(content) - length))
    return content[:start] + bytes(length) + content[start + length :]


IMAGES.add(
    {
        "image_cut": ("An image file ends at a random byte.", in_file("Camera", cut)),
        "image_ends_early": (
            (
                "A part of an image's coded data before its end marker is gone; "
                "decoders do not report this."
            ),
            in_file("Camera", _ends_early),
        ),
        "image_emptied": ("An image file is empty.", in_file("Camera", emptied)),
        "image_zeros": (
            "A part of an image's coded data is zero bytes; decoders do not report this.",
            in_file("Camera", _zeros),
        ),
        "image_garbage": (
            "An image file holds random bytes.",
            in_file("Camera", garbage),
        ),
        "image_size": (
            "An image has half the size of the others.",
            _in_image(lambda pixels: pixels[::2, ::2]),
        ),
    },
)
IMAGES.add(
    {
        "image_grey": (
            "All of an image has one grey.",
            _in_image(lambda pixels: np.full_like(pixels, 128)),
        )
    },
    beyond=_WALL,
)


def _of_camera(place: Place, rng: np.random.Generator) -> None:
    agent, frame = place.any_agent(rng), place.any_frame(rng)
    one, other = (
        place.file(agent, str(camera), frame)
        for camera in rng.choice(CAMERAS, size=2, replace=False)
    )
    place.write(one, other.read_bytes())


def _of_twin(place: Place, rng: np.random.Generator) -> None:
    of_type = place.scenario.scenario_type
    kind = of_type.rsplit("_", 1)[1]
    (agent, other), (frame, other_frame), camera = (
        place.two_agents(rng),
        _two_frames(place, rng),
        _camera(rng),
    )
    path = place.file(other, camera, other_frame).relative_to(place.root / of_type)
    twin = (
        place.root
        / of_type.replace(kind, {"accident": "normal", "normal": "accident"}[kind])
        / path
    )
    place.write(place.file(agent, camera, frame), twin.read_bytes())


def _exchange_cameras(place: Place, rng: np.random.Generator) -> None:
    agent, cameras = place.any_agent(rng), rng.choice(CAMERAS, size=2, replace=False)
    for frame in place.frames:
        place.exchange(*(place.file(agent, str(camera), frame) for camera in cameras))


IMAGES.add(
    {
        "image_of_camera": (
            "An image is another camera's of the same agent and frame.",
            _of_camera,
        ),
        "image_of_agent": (
            "An image is another agent's of the same camera and frame.",
            lambda place, rng: _of_agent(place, rng, _camera(rng)),
        ),
        "image_of_frame": (
            "An image is that of another frame of the same, moving, camera.",
            lambda place, rng: _of_frame(place, rng, _camera(rng)),
        ),
    },
)
IMAGES.add(
    {
        "image_of_twin": (
            "An image is replaced by one of another agent and frame from the scenario's twin.",
            _of_twin,
        ),
        "images_of_two_frames_exchanged": (
            "Two images of a moving camera are exchanged.",
            lambda place, rng: _exchange_frames(place, rng, _camera(rng)),
        ),
        "images_of_two_cameras_exchanged": (
            "All images of two cameras of an agent are exchanged.",
            _exchange_cameras,
        ),
        "images_of_two_agents_exchanged": (
            "All images of one camera of two agents are exchanged.",
            lambda place, rng: _exchange_agents(place, rng, _camera(rng)),
        ),
        "image_mirrored": ("An image is mirrored.", _in_image(lambda pixels: pixels[:, ::-1])),
    },
    beyond=_LOOK,
)


def _bit_flipped(content: bytes, rng: np.random.Generator) -> bytes:
    middle = int(rng.integers(len(content) // 4, 3 * len(content) // 4))
    return content[:middle] + bytes([content[middle] ^ 0x10]) + content[middle + 1 :]


def _with_nan(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    broken = points.copy()
    broken[rng.choice(len(points), size=100, replace=False), :3] = np.nan
    return broken


LIDARS.add(
    {
        "lidar_cut": ("A point cloud's file ends at a random byte.", in_file(LIDAR, cut)),
        "lidar_with_more_bytes": (
            "Bytes follow the end of a point cloud's file.",
            in_file(LIDAR, lambda content, rng: content + garbage(bytes(100), rng)),
        ),
        "lidar_emptied": ("A point cloud's file is empty.", in_file(LIDAR, emptied)),
        "lidar_bit_flipped": (
            "A byte in the middle of a point cloud's file is wrong.",
            in_file(LIDAR, _bit_flipped),
        ),
        "lidar_wrong_shape": (
            "A point cloud lacks the intensity.",
            _in_array(LIDAR, lambda points, _: points[:, :3]),
        ),
        "lidar_nan": ("A hundred points of a cloud are NaN.", _in_array(LIDAR, _with_nan)),
        "lidar_without_points": (
            "A cloud has no points.",
            _in_array(LIDAR, lambda points, _: points[:0]),
        ),
        "lidar_halved": (
            "Half of a cloud's points are missing.",
            _in_array(LIDAR, lambda points, _: points[: len(points) // 2]),
        ),
        "lidar_of_agent": (
            "A point cloud is another agent's of the same frame.",
            lambda place, rng: _of_agent(place, rng, LIDAR),
        ),
        "lidar_of_frame": (
            "A moving agent's point cloud is that of another frame.",
            lambda place, rng: _of_frame(place, rng, LIDAR),
        ),
        "lidars_shifted": (
            "All point clouds of a moving agent are one frame early; the last one is there twice.",
            lambda place, rng: place.one_frame_early(place.moving_agent(rng), LIDAR),
        ),
        "lidars_of_two_frames_exchanged": (
            "Two point clouds of a moving agent are exchanged.",
            lambda place, rng: _exchange_frames(place, rng, LIDAR),
        ),
        "lidars_of_two_agents_exchanged": (
            "All point clouds of two agents are exchanged.",
            lambda place, rng: _exchange_agents(place, rng, LIDAR),
        ),
        "lidar_y_flipped": (
            "A cloud's y has the other sign.",
            _in_array(LIDAR, lambda points, _: points * np.float32([1, -1, 1, 1])),
        ),
        "lidar_scaled": (
            "A cloud is 10 % too large.",
            _in_array(LIDAR, lambda points, _: points * np.float32([1.1, 1.1, 1.1, 1])),
        ),
        "lidar_turned": (
            "A cloud is turned by 90°.",
            _in_array(LIDAR, lambda points, _: points[:, [1, 0, 2, 3]] * np.float32([-1, 1, 1, 1])),
        ),
    },
)


def _all_flipped(place: Place, rng: np.random.Generator) -> None:
    agent = place.any_agent(rng)
    for frame in place.frames:
        place.write_array(agent, BEV_CAMERA, frame, place.array(agent, BEV_CAMERA, frame)[:, ::-1])


BEVS.add(
    {
        "bev_cut": ("A BEV file ends at a random byte.", in_file(BEV_CAMERA, cut)),
        "bev_wrong_shape": (
            "A BEV array has half the rows.",
            _in_array(BEV_CAMERA, lambda picture, _: picture[::2]),
        ),
        "bev_channels_reversed": (
            "A BEV array's channels are in the reverse order.",
            _in_array(BEV_CAMERA, lambda picture, _: picture[..., ::-1]),
        ),
        "bev_flipped": (
            "A BEV array is flipped left to right.",
            _in_array(BEV_CAMERA, lambda picture, _: picture[:, ::-1]),
        ),
        "bev_turned": (
            "A BEV array is turned by 90° or 180°.",
            _in_array(BEV_CAMERA, lambda picture, rng: np.rot90(picture, rng.choice([1, 2, 3]))),
        ),
        "bevs_flipped": ("All BEV arrays of an agent are flipped left to right.", _all_flipped),
        "bev_zoomed": (
            "A BEV array shows 30 m instead of 60 m to each side.",
            _in_array(
                BEV_CAMERA,
                lambda picture, _: picture[300:900, 300:900].repeat(2, axis=0).repeat(2, axis=1),
            ),
        ),
        "bev_of_agent": (
            "A BEV array is another agent's of the same frame.",
            lambda place, rng: _of_agent(place, rng, BEV_CAMERA),
        ),
        "bev_of_frame": (
            "A moving agent's BEV array is that of another frame.",
            lambda place, rng: _of_frame(place, rng, BEV_CAMERA),
        ),
        "bevs_of_two_agents_exchanged": (
            "All BEV arrays of two agents are exchanged.",
            lambda place, rng: _exchange_agents(place, rng, BEV_CAMERA),
        ),
    },
)
