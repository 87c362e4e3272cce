"""The settings of a synthetic release."""

from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, get_args

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.support.text import settle_choices
from deepaccident_devkit.synth.spec import DESIGN_NUMBERS, View
from deepaccident_devkit.taxonomy import Layout

Sensors = Literal["all", "cameras", "none"]
"""Which sensors' files a release has: of all, the images alone, or of none."""
MAX_FRAMES = 999
MIN_IMAGE_SIZE = (16, 9)
IMAGE_SIZE: Final = (480, 270)
"""The default size of images, pixels; small, because larger ones take long."""
RELEASED_IMAGE_SIZE: Final = (1600, 900)
"""The size of the real images, pixels. The released code does not read the size: it assumes this one."""
DESIGN_ROUND: Final = (1, 7, 2, 8, 3, 9, 4, 10, 5, 11, 6, 12)
"""All designs in the order of use: with and without traffic lights by turns, so that two pairs have both."""
HIDDEN_DESIGN_ROUND: Final = (1, 7)
"""The designs in which a house on a street corner can hide the two colliding vehicles from each other to the end."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SynthConfig:
    """A synthetic release; checked when made, raises ConfigError.

    Attributes:
        scenarios: how many; they alternate between an accident and its normal twin.
        frames: recorded frames of each scenario, at 10 Hz: the last ones before its end. None records from the moment
            when the cars set off to the end, 40 to 100 frames.
        image_size: width and height of the camera images, pixels; None for 480×270, or 1600×900 with
            `for_released_code`. The real images have 1600×900. The released code assumes this size: with another
            one it computes wrong camera geometry.
        layout: `A`, all splits in one folder, or `B`, one folder for each split.
        seed: the same seed gives the same bytes (on the same machine with the same package versions).
        sensors: what to write besides labels, calib and meta: `all` sensors' files, with `cameras` the images alone (no
            point clouds, no BEV arrays), or `none`. Files that two of them write are the same. True and False mean
            `all` and `none`.
        view: `hidden` puts a house on the kerb of the corner between ego and other, who drive a little faster than
            with the view `open`. They see each other only about a second before they meet; the infrastructure sees
            both all the time. With None the scenario files decide.
        designs: which of the paper's twelve are used by turns, in this order; empty for all (with the view `hidden`,
            for all in which a house can hide the two from each other).
        unplanned: share of accidents that differ from the design: with a pedestrian or a third vehicle. It is 0
            where `spec` or the view `hidden` asks for one certain accident.
        spec: a scenario file (docs/scenarios.md) to use instead of the designs; every pair is one draw from it.
        unlabelled_test: whether the test split lacks labels, BEV arrays and meta, as the real one does.
        exact: whether calib files are the same at each frame, and `num_lidar_pts` is the exact number of points. If
            not, both are a little wrong, as in the real release.
        for_released_code: whether the released code must be able to read the release: images of 1600×900, layout `A`,
            a labelled test split, and split files under `split_txt_files/` too. Settings that contradict it are
            refused.
    """

    scenarios: int = 4
    frames: int | None = 40
    image_size: tuple[int, int] | None = None
    layout: Layout = "A"
    seed: int = 0
    sensors: Sensors | bool = "all"
    view: View | None = None
    designs: tuple[int, ...] = ()
    unplanned: float = 0.1
    spec: Path | None = None
    unlabelled_test: bool = False
    exact: bool = False
    for_released_code: bool = False

    def __post_init__(self) -> None:
        """Check every field."""
        _check_range("scenarios", self.scenarios, 1, None)
        if self.frames is not None:
            _check_range("frames", self.frames, 1, MAX_FRAMES)
        _check_range("seed", self.seed, 0, None)
        if isinstance(self.sensors, bool):
            object.__setattr__(self, "sensors", "all" if self.sensors else "none")
        words = {"layout": get_args(Layout), "sensors": get_args(Sensors), "view": (None, *get_args(View))}
        settle_choices(self, words, error=ConfigError)
        if len(self.pixels) != 2:
            raise ConfigError(f"image_size: expected (width, height), found {self.image_size!r}")
        for name, value, least in zip(("width", "height"), self.pixels, MIN_IMAGE_SIZE, strict=True):
            _check_range(f"image_size: {name}", value, least, 8192)
        for design in self.designs:
            _check_range("designs", design, DESIGN_NUMBERS[0], DESIGN_NUMBERS[-1])
        if not 0 <= self.unplanned <= 1:
            raise ConfigError(f"unplanned: {self.unplanned} is not a share; choose a number from 0 to 1")
        if self.spec is not None and self.designs:
            raise ConfigError(
                "spec, designs: a release is made of a scenario file or of designs; choose one of the two"
            )
        if self.for_released_code:
            self._check_for_released_code()

    @property
    def pixels(self) -> tuple[int, int]:
        """Width and height of the camera images that are made."""
        if self.image_size is not None:
            return self.image_size
        return RELEASED_IMAGE_SIZE if self.for_released_code else IMAGE_SIZE

    @property
    def design_round(self) -> tuple[int, ...]:
        """The designs that are used by turns."""
        return self.designs or (HIDDEN_DESIGN_ROUND if self.view == "hidden" else DESIGN_ROUND)

    def _check_for_released_code(self) -> None:
        """Refuse what the released code cannot read, or reads wrongly."""
        needed = {
            "image_size": (RELEASED_IMAGE_SIZE, self.pixels),
            "layout": ("A", self.layout),
            "unlabelled_test": (False, self.unlabelled_test),
        }
        for name, (wanted, found) in needed.items():
            if found != wanted:
                raise ConfigError(
                    f"{name}, for_released_code: the released code needs {wanted}, found {found} (docs/synth.md says "
                    "why); leave one of the two out"
                )


def _check_range(name: str, value: int, least: int, most: int | None) -> None:
    if value < least or (most is not None and value > most):
        span = f"from {least} to {most}" if most is not None else f"of at least {least}"
        raise ConfigError(f"{name}: {value} is not possible; choose a number {span}")
