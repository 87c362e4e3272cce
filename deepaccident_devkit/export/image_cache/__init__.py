"""Camera images, resized once and kept in a file for each scenario: training reads them in place of the release's.

`CachedImages` is the format that `deepaccident cache` writes, `ImageCache` reads it.
"""

from deepaccident_devkit.export.image_cache.format import CachedImages, Codec
from deepaccident_devkit.export.image_cache.reader import ImageCache

__all__ = ["CachedImages", "Codec", "ImageCache"]
