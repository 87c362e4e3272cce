"""`deepaccident cache`: resizes images for training, and stores them in a folder."""

import re
from typing import Any

import click

from deepaccident_devkit.cli.export import bulk_parameters, run_export
from deepaccident_devkit.cli.options import channels_parameter, pixel_size, split_words
from deepaccident_devkit.cli.verbs import advanced, field_option, verb
from deepaccident_devkit.export.images import ImageConfig
from deepaccident_devkit.taxonomy import CAMERAS
from deepaccident_devkit.training.image_cache import CachedImages


def _parse_crop(
    context: click.Context, parameter: click.Parameter, value: str | None
) -> tuple[int, int, int, int] | None:
    """Parse `LEFT,TOP,WIDTH,HEIGHT` as (top, left, height, width); None stays None."""
    if value is None:
        return None
    match = re.fullmatch(r"(\d+),(\d+),(\d+),(\d+)", value.replace(" ", ""))
    if match is None:
        raise click.BadParameter(
            f"expected left, top, width and height such as 0,140,704,256, found {value!r}",
            context,
            parameter,
        )
    left, top, width, height = map(int, match.groups())
    return top, left, height, width


@verb()
@bulk_parameters()
@click.option(
    "--size",
    "resize",
    required=True,
    callback=pixel_size,
    metavar="WxH",
    help="Size to which each image is resized before it is cropped, such as 704x396.",
)
@click.option(
    "--crop",
    callback=_parse_crop,
    metavar="LEFT,TOP,WIDTH,HEIGHT",
    help="Part of the resized image to keep.  [default: all]",
)
@channels_parameter
@field_option(ImageConfig, "decode", option=advanced)
@field_option(CachedImages, "codec", option=advanced)
def cache(
    resize: tuple[int, int],
    crop: tuple[int, int, int, int] | None,
    channels: tuple[str, ...],
    decode: Any,
    codec: Any,
    **options: Any,
) -> None:
    """Write resized images of the release in DATAROOT, for V2XConfig(images_cache=FOLDER).

    Select scenarios with --split or --where: all images at 704x256 take 0.9 TB as raw pixels.
    --dry-run prints the size of your selection. If a run is interrupted, the same command continues
    it.
    """
    cameras = tuple(split_words(channels)) or CAMERAS
    images = ImageConfig(resize=resize[::-1], crop=crop, cameras=cameras, decode=decode)
    run_export(CachedImages, {"images": images, "codec": codec}, **options)
