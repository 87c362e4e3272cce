"""The names of coordinate frames in records."""

from deepaccident_devkit.errors import GeometryError


def checked_frame(name: str, frame: object) -> str:
    """`frame` if it can be the name of a coordinate frame, known or not; raises GeometryError."""
    if not isinstance(frame, str) or not frame:
        raise GeometryError(f"{name}: expected the name of a frame, such as 'world', 'ego' or 'lidar', found {frame!r}")
    return frame
