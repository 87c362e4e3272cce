"""Camera images.

The parts, from below: `light` (time of day and weather), `sky`, `shadows` and `ground` (pictures made for a scenario
or a moment), `lamplight`, `signals` and `paint` (colours of surfaces), `buffers` (what each pixel shows), `facades`,
`wall_shadows` and `shading` (its colour), `rain` and `render` (the picture).
"""
