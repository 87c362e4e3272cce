"""Camera images.

The parts, lowest layer first: `light` (time of day, weather, sky and rain), `shadows` and `ground` (pictures made for a
scenario or a moment), `lamplight` and `paint` (colours of surfaces), `buffers` (what each pixel shows), `facades` and
`shading` (its colour), and `render` (the picture).
"""
