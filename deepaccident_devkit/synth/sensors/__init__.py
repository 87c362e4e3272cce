"""What the agents of a scenario record: point clouds, images, BEV pictures and labels of one moment after another.

The parts, from below: `caster` (rays against surfaces), `setting` (what stands still, made once a scenario, and bodies
set on the terrain), `scene` (one moment), `agents` (who records, how the sensors are mounted, calib files), `lidar`,
`visibility` and `annotate` (point clouds and labels), `bev`, `images` (the cameras), and `rig` (all of them together).
"""
