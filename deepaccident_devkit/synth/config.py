"""What a synthetic release should be like."""

from dataclasses import dataclass
from typing import Literal, get_args

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.taxonomy import Layout

View = Literal["open", "hidden"]

MAX_FRAMES = 999
MIN_IMAGE_SIZE = (16, 9)


@dataclass(frozen=True, slots=True, kw_only=True)
class SynthConfig:
    """A synthetic release; checked when made, raises ConfigError.

    Attributes:
        scenarios: how many; they alternate between an accident and its normal twin.
        frames: recorded frames of each scenario, at 10 Hz.
        image_size: width and height of the camera images, pixels (the real ones have 1600×900).
        layout: `A`, all splits in one folder, or `B`, a folder a split.
        seed: the same seed gives the same bytes (on the same machine with the same package versions).
        sensors: whether to write images, point clouds and BEV arrays besides labels, calib and meta.
        view: `hidden` puts a house on the kerb of the corner between ego and other, who drive a little faster than
            where the view is `open`: they see each other about a second before they meet, the pole all the time.
    """

    scenarios: int = 4
    frames: int = 40
    image_size: tuple[int, int] = (480, 270)
    layout: Layout = "A"
    seed: int = 0
    sensors: bool = True
    view: View = "open"

    def __post_init__(self) -> None:
        """Check every field."""
        _check_range("scenarios", self.scenarios, 1, None)
        _check_range("frames", self.frames, 1, MAX_FRAMES)
        _check_range("seed", self.seed, 0, None)
        if self.layout not in get_args(Layout):
            raise ConfigError(f"layout: expected one of {', '.join(get_args(Layout))}, found {self.layout!r}")
        if self.view not in get_args(View):
            raise ConfigError(f"view: expected one of {', '.join(get_args(View))}, found {self.view!r}")
        if len(self.image_size) != 2:
            raise ConfigError(f"image_size: expected (width, height), found {self.image_size!r}")
        for name, value, least in zip(("width", "height"), self.image_size, MIN_IMAGE_SIZE, strict=True):
            _check_range(f"image_size: {name}", value, least, 8192)


def _check_range(name: str, value: int, least: int, most: int | None) -> None:
    if value < least or (most is not None and value > most):
        span = f"from {least} to {most}" if most is not None else f"of at least {least}"
        raise ConfigError(f"{name}: {value} is not possible; choose a number {span}")
