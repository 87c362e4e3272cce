"""Images, point clouds and BEV arrays."""

import io
from collections.abc import Callable

import numpy as np

from deepaccident_devkit.taxonomy import BEV_CAMERA, CAMERAS, LIDAR
from fault_injection.kinds import Apply, Group, cut, garbage
from fault_injection.place import Place

IMAGES = Group("images", deep=True)
LIDARS = Group("lidar", deep=True)
BEVS = Group("bev camera", deep=True)
_FAR_APART = 3
"""Frames between two pictures that are to differ visibly."""
_LOOK = "only a person who looks at the pictures can find it: each file is sound, and no two in the scenario are equal"
_WALL = "a wall or a truck that fills the view looks the same"


def _camera(rng: np.random.Generator) -> str:
    return str(rng.choice(CAMERAS))


def _in_file(channel: str | None, change: Callable[[bytes, np.random.Generator], bytes]) -> Apply:
    """Change the bytes of a file; channel None stands for any camera."""

    def apply(place: Place, rng: np.random.Generator) -> str:
        name = channel or _camera(rng)
        agent, frame = place.any_agent(rng), place.any_frame(rng)
        path = place.file(agent, name, frame)
        place.write(path, change(path.read_bytes(), rng))
        return f"{agent} {name} {frame}: {path.stat().st_size} bytes"

    return apply


def _in_image(change: Callable[[np.ndarray], np.ndarray]) -> Apply:
    """Change the pixels of an image of any camera."""
    return _in_file(None, lambda content, _: _jpeg(change(_pixels(content))))


def _in_array(channel: str, change: Callable[[np.ndarray, np.random.Generator], np.ndarray]) -> Apply:
    """Change the array of a point cloud or BEV file."""

    def apply(place: Place, rng: np.random.Generator) -> str:
        agent, frame = place.any_agent(rng), place.any_frame(rng)
        place.write_array(agent, channel, frame, change(place.array(agent, channel, frame), rng))
        return f"{agent} {channel} {frame}"

    return apply


def _of_agent(place: Place, rng: np.random.Generator, channel: str) -> str:
    """Replace an agent's file by another agent's of the same frame."""
    (agent, other), frame = place.two_agents(rng), place.any_frame(rng)
    place.write(place.file(agent, channel, frame), place.file(other, channel, frame).read_bytes())
    return f"{agent} {channel} {frame}: {other}'s"


def _two_frames(place: Place, rng: np.random.Generator) -> tuple[int, int]:
    while True:
        one, other = map(int, rng.choice(place.frames, size=2, replace=False))
        if abs(one - other) >= _FAR_APART:
            return one, other


def _of_frame(place: Place, rng: np.random.Generator, channel: str) -> str:
    """Replace a moving agent's file by its own of another frame."""
    agent, (frame, other) = place.moving_agent(rng), _two_frames(place, rng)
    place.write(place.file(agent, channel, frame), place.file(agent, channel, other).read_bytes())
    return f"{agent} {channel} {frame}: {other}'s"


def _exchange_frames(place: Place, rng: np.random.Generator, channel: str) -> str:
    agent, (frame, other) = place.moving_agent(rng), _two_frames(place, rng)
    place.exchange(place.file(agent, channel, frame), place.file(agent, channel, other))
    return f"{agent} {channel}: {frame} and {other}"


def _exchange_agents(place: Place, rng: np.random.Generator, channel: str) -> str:
    one, other = place.two_agents(rng)
    for frame in place.frames:
        place.exchange(place.file(one, channel, frame), place.file(other, channel, frame))
    return f"{channel} of {one} and {other}"


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
        "image_cut": ("An image file ends at a random byte.", _in_file(None, cut)),
        "image_ends_early": (
            "A part of an image's coded data before its end marker is gone; decoders do not report this.",
            _in_file(None, _ends_early),
        ),
        "image_emptied": ("An image file is empty.", _in_file(None, lambda *_: b"")),
        "image_zeros": (
            "A part of an image's coded data is zero bytes; decoders do not report this.",
            _in_file(None, _zeros),
        ),
        "image_garbage": (
            "An image file holds random bytes.",
            _in_file(None, lambda content, rng: garbage(rng, len(content))),
        ),
        "image_size": ("An image has half the size of the others.", _in_image(lambda pixels: pixels[::2, ::2])),
    },
)
IMAGES.add(
    {"image_grey": ("All of an image has one grey.", _in_image(lambda pixels: np.full_like(pixels, 128)))},
    beyond=_WALL,
)


@IMAGES.kind()
def image_of_camera(place: Place, rng: np.random.Generator) -> str:
    """An image is another camera's of the same agent and frame."""
    agent, frame = place.any_agent(rng), place.any_frame(rng)
    one, other = (str(camera) for camera in rng.choice(CAMERAS, size=2, replace=False))
    place.write(place.file(agent, one, frame), place.file(agent, other, frame).read_bytes())
    return f"{agent} {frame}: {one} is {other}"


IMAGES.add(
    {
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


@IMAGES.kind(beyond=_LOOK)
def image_of_twin(place: Place, rng: np.random.Generator) -> str:
    """An image is replaced by one of another agent and frame from the scenario's twin."""
    twins = {"accident": "normal", "normal": "accident"}
    kind = place.scenario.scenario_type.rsplit("_", 1)[1]
    (agent, other), (frame, other_frame), camera = place.two_agents(rng), _two_frames(place, rng), _camera(rng)
    path = place.file(other, camera, other_frame)
    twin = (
        place.root
        / place.scenario.scenario_type.replace(kind, twins[kind])
        / path.relative_to(place.root / place.scenario.scenario_type)
    )
    place.write(place.file(agent, camera, frame), twin.read_bytes())
    return f"{agent} {camera} {frame}: {other}'s {other_frame} of the twin"


@IMAGES.kind(beyond=_LOOK)
def images_of_two_frames_exchanged(place: Place, rng: np.random.Generator) -> str:
    """Two images of a moving camera are exchanged."""
    return _exchange_frames(place, rng, _camera(rng))


@IMAGES.kind(beyond=_LOOK)
def images_of_two_cameras_exchanged(place: Place, rng: np.random.Generator) -> str:
    """All images of two cameras of an agent are exchanged."""
    agent = place.any_agent(rng)
    one, other = (str(camera) for camera in rng.choice(CAMERAS, size=2, replace=False))
    for frame in place.frames:
        place.exchange(place.file(agent, one, frame), place.file(agent, other, frame))
    return f"{agent}: {one} and {other}"


IMAGES.add(
    {
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
        "lidar_cut": ("A point cloud's file ends at a random byte.", _in_file(LIDAR, cut)),
        "lidar_with_more_bytes": (
            "Bytes follow the end of a point cloud's file.",
            _in_file(LIDAR, lambda content, rng: content + garbage(rng, 100)),
        ),
        "lidar_emptied": ("A point cloud's file is empty.", _in_file(LIDAR, lambda *_: b"")),
        "lidar_bit_flipped": (
            "A byte in the middle of a point cloud's file is wrong.",
            _in_file(LIDAR, _bit_flipped),
        ),
        "lidar_wrong_shape": (
            "A point cloud lacks the intensity.",
            _in_array(LIDAR, lambda points, _: points[:, :3]),
        ),
        "lidar_nan": ("A hundred points of a cloud are NaN.", _in_array(LIDAR, _with_nan)),
        "lidar_without_points": ("A cloud has no points.", _in_array(LIDAR, lambda points, _: points[:0])),
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


def _all_flipped(place: Place, rng: np.random.Generator) -> str:
    agent = place.any_agent(rng)
    for frame in place.frames:
        place.write_array(agent, BEV_CAMERA, frame, place.array(agent, BEV_CAMERA, frame)[:, ::-1])
    return agent


BEVS.add(
    {
        "bev_cut": ("A BEV file ends at a random byte.", _in_file(BEV_CAMERA, cut)),
        "bev_wrong_shape": ("A BEV array has half the rows.", _in_array(BEV_CAMERA, lambda picture, _: picture[::2])),
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
            _in_array(BEV_CAMERA, lambda picture, _: picture[300:900, 300:900].repeat(2, axis=0).repeat(2, axis=1)),
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
