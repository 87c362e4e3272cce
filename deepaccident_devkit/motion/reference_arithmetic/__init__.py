"""Arithmetic of other libraries, bit-exact and pinned by golden files.

Users of the devkit need not read this package. The released code calls these libraries, and its
labels and scores depend on their last bits. Each rule is written out here for one version of the
library, so that results do not depend on the installed version.

| module | library | content |
|---|---|---|
| `polygon_fill` | OpenCV 4.7 | the cells that polygons cover |
| `contours` | OpenCV 4.7 | outlines of masks, convex hulls, smallest rectangles, redrawn boxes |
| `outlines` | scikit-image 0.20 | outlines of instances, simplified, and the gaps between them |
| `single_precision` | torch 2.13 | small float32 matrices, sampling points of the released warps |
| `peaks` | torch 2.13 | the highest cells of a map, and the nearest of them for each point |

Nothing here depends on the devkit's types: functions take and return arrays and numbers.
"""
