"""Other libraries' arithmetic, bit-exact and pinned by golden files: you need not read this.

The released code calls these libraries, and its labels and scores depend on their last bits. Each rule is written out
here for a version of theirs, so that results are the same with whatever is installed.

| module | whose | what |
|---|---|---|
| `polygon_fill` | OpenCV 4.7 | the cells that polygons cover |
| `contours` | OpenCV 4.7 | outlines of masks, convex hulls, smallest rectangles, and boxes redrawn by these |
| `outlines` | scikit-image 0.20 | outlines of instances, simplified, and the gaps between them |
| `single_precision` | torch 2.13 | small matrices in float32, and where the released warps sample a raster |
| `peaks` | torch 2.13 | the highest cells of a map, and for each point the nearest of them |

Nothing here knows the devkit: arrays and numbers go in and come out.
"""
