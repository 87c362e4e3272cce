"""The recordings of a scenario's agents: point clouds, images, BEV pictures and labels.

The modules, lowest layer first: `caster` (rays against surfaces), `scene` (the static world, and
one moment), `agents` (the agents, the mounting of their sensors, calib files), `lidar` and
`annotate` (point clouds, labels, visibility), `light`, `paint`, `shadows` and `render` (the
cameras' pictures), and `rig` (all of them, and the BEV pictures).
"""
