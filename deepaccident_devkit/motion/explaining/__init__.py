"""Why a cell of motion labels has its values; `cells` puts it together from boxes, `samples` from a release.

`sources` follows the warp, `boxes` finds who covers the cell, `quirks` which switches acted, `predictions` what a model
put there.
"""
