"""Images, point clouds and BEV arrays."""

import io
from collections.abc import Callable

import numpy as np

from deepaccident_devkit.taxonomy import BEV_CAMERA, CAMERAS, LIDAR
from fault_injection.kinds import Group, cut, garbage
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


def _replace_file(place: Place, rng: np.random.Generator, channel: str, change: Callable[[bytes], bytes]) -> str:
    agent, frame = place.any_agent(rng), place.any_frame(rng)
    path = place.file(agent, channel, frame)
    place.write(path, change(path.read_bytes()))
    return f"{agent} {channel} {frame}: {path.stat().st_size} bytes"


def _replace_array(
    place: Place, rng: np.random.Generator, channel: str, change: Callable[[np.ndarray], np.ndarray]
) -> str:
    agent, frame = place.any_agent(rng), place.any_frame(rng)
    place.write_array(agent, channel, frame, change(place.array(agent, channel, frame)))
    return f"{agent} {channel} {frame}"


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


@IMAGES.kind()
def image_cut(place: Place, rng: np.random.Generator) -> str:
    """An image file ends at a random byte."""
    return _replace_file(place, rng, _camera(rng), lambda content: cut(content, rng))


@IMAGES.kind()
def image_ends_early(place: Place, rng: np.random.Generator) -> str:
    """A part of an image's coded data before its end marker is gone; decoders do not report this."""

    def change(content: bytes) -> bytes:
        start = content.index(b"\xff\xda") + 14
        return content[: rng.integers(start, start + (len(content) - start) * 9 // 10)] + b"\xff\xd9"

    return _replace_file(place, rng, _camera(rng), change)


@IMAGES.kind()
def image_emptied(place: Place, rng: np.random.Generator) -> str:
    """An image file is empty."""
    return _replace_file(place, rng, _camera(rng), lambda _: b"")


@IMAGES.kind()
def image_zeros(place: Place, rng: np.random.Generator) -> str:
    """A part of an image's coded data is zero bytes; decoders do not report this."""

    def change(content: bytes) -> bytes:
        start = content.index(b"\xff\xda") + 14
        length = min(512, (len(content) - start) // 2)
        start = int(rng.integers(start, len(content) - length))
        return content[:start] + bytes(length) + content[start + length :]

    return _replace_file(place, rng, _camera(rng), change)


IMAGES.add(
    {
        "image_garbage": (
            "An image file holds random bytes.",
            lambda place, rng: _replace_file(place, rng, _camera(rng), lambda content: garbage(rng, len(content))),
        ),
        "image_size": (
            "An image has half the size of the others.",
            lambda place, rng: _replace_file(
                place, rng, _camera(rng), lambda content: _jpeg(_pixels(content)[::2, ::2])
            ),
        ),
    },
)


@IMAGES.kind(beyond=_WALL)
def image_grey(place: Place, rng: np.random.Generator) -> str:
    """All of an image has one grey."""
    return _replace_file(place, rng, _camera(rng), lambda content: _jpeg(np.full_like(_pixels(content), 128)))


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
        "image_mirrored": (
            "An image is mirrored.",
            lambda place, rng: _replace_file(
                place, rng, _camera(rng), lambda content: _jpeg(_pixels(content)[:, ::-1])
            ),
        ),
    },
    beyond=_LOOK,
)


LIDARS.add(
    {
        "lidar_cut": (
            "A point cloud's file ends at a random byte.",
            lambda place, rng: _replace_file(place, rng, LIDAR, lambda content: cut(content, rng)),
        ),
        "lidar_with_more_bytes": (
            "Bytes follow the end of a point cloud's file.",
            lambda place, rng: _replace_file(place, rng, LIDAR, lambda content: content + garbage(rng, 100)),
        ),
        "lidar_emptied": (
            "A point cloud's file is empty.",
            lambda place, rng: _replace_file(place, rng, LIDAR, lambda _: b""),
        ),
    },
)


@LIDARS.kind()
def lidar_bit_flipped(place: Place, rng: np.random.Generator) -> str:
    """A byte in the middle of a point cloud's file is wrong."""

    def change(content: bytes) -> bytes:
        middle = int(rng.integers(len(content) // 4, 3 * len(content) // 4))
        return content[:middle] + bytes([content[middle] ^ 0x10]) + content[middle + 1 :]

    return _replace_file(place, rng, LIDAR, change)


@LIDARS.kind()
def lidar_wrong_shape(place: Place, rng: np.random.Generator) -> str:
    """A point cloud lacks the intensity."""
    return _replace_array(place, rng, LIDAR, lambda points: points[:, :3])


@LIDARS.kind()
def lidar_nan(place: Place, rng: np.random.Generator) -> str:
    """A hundred points of a cloud are NaN."""

    def change(points: np.ndarray) -> np.ndarray:
        broken = points.copy()
        broken[rng.choice(len(points), size=100, replace=False), :3] = np.nan
        return broken

    return _replace_array(place, rng, LIDAR, change)


LIDARS.add(
    {
        "lidar_without_points": (
            "A cloud has no points.",
            lambda place, rng: _replace_array(place, rng, LIDAR, lambda points: points[:0]),
        ),
        "lidar_halved": (
            "Half of a cloud's points are missing.",
            lambda place, rng: _replace_array(place, rng, LIDAR, lambda points: points[: len(points) // 2]),
        ),
        "lidar_of_agent": (
            "A point cloud is another agent's of the same frame.",
            lambda place, rng: _of_agent(place, rng, LIDAR),
        ),
        "lidar_of_frame": (
            "A moving agent's point cloud is that of another frame.",
            lambda place, rng: _of_frame(place, rng, LIDAR),
        ),
    },
)


@LIDARS.kind()
def lidars_shifted(place: Place, rng: np.random.Generator) -> str:
    """All point clouds of a moving agent are one frame early; the last one is there twice."""
    agent = place.moving_agent(rng)
    for frame in place.frames[:-1]:
        place.write(place.file(agent, LIDAR, frame), place.file(agent, LIDAR, frame + 1).read_bytes())
    return agent


LIDARS.add(
    {
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
            lambda place, rng: _replace_array(place, rng, LIDAR, lambda points: points * np.float32([1, -1, 1, 1])),
        ),
        "lidar_scaled": (
            "A cloud is 10 % too large.",
            lambda place, rng: _replace_array(
                place, rng, LIDAR, lambda points: points * np.float32([1.1, 1.1, 1.1, 1])
            ),
        ),
        "lidar_turned": (
            "A cloud is turned by 90°.",
            lambda place, rng: _replace_array(
                place, rng, LIDAR, lambda points: points[:, [1, 0, 2, 3]] * np.float32([-1, 1, 1, 1])
            ),
        ),
    },
)


BEVS.add(
    {
        "bev_cut": (
            "A BEV file ends at a random byte.",
            lambda place, rng: _replace_file(place, rng, BEV_CAMERA, lambda content: cut(content, rng)),
        ),
        "bev_wrong_shape": (
            "A BEV array has half the rows.",
            lambda place, rng: _replace_array(place, rng, BEV_CAMERA, lambda picture: picture[::2]),
        ),
        "bev_channels_reversed": (
            "A BEV array's channels are in the reverse order.",
            lambda place, rng: _replace_array(place, rng, BEV_CAMERA, lambda picture: picture[..., ::-1]),
        ),
        "bev_flipped": (
            "A BEV array is flipped left to right.",
            lambda place, rng: _replace_array(place, rng, BEV_CAMERA, lambda picture: picture[:, ::-1]),
        ),
    },
)


@BEVS.kind()
def bev_turned(place: Place, rng: np.random.Generator) -> str:
    """A BEV array is turned by 90° or 180°."""
    turns = int(rng.choice([1, 2, 3]))
    return _replace_array(place, rng, BEV_CAMERA, lambda picture: np.rot90(picture, turns))


@BEVS.kind()
def bevs_flipped(place: Place, rng: np.random.Generator) -> str:
    """All BEV arrays of an agent are flipped left to right."""
    agent = place.any_agent(rng)
    for frame in place.frames:
        place.write_array(agent, BEV_CAMERA, frame, place.array(agent, BEV_CAMERA, frame)[:, ::-1])
    return agent


BEVS.add(
    {
        "bev_zoomed": (
            "A BEV array shows 30 m instead of 60 m to each side.",
            lambda place, rng: _replace_array(
                place, rng, BEV_CAMERA, lambda picture: picture[300:900, 300:900].repeat(2, axis=0).repeat(2, axis=1)
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
