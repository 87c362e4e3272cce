"""What the agents of a scenario record at each moment: point clouds, images, BEV pictures and labels.

The parts, lowest layer first: `caster` (rays against surfaces), `setting` (what stands still, made once a scenario, and
bodies on the terrain), `scene` (one moment), `agents` (who records, how the sensors are mounted, calib files), `lidar`,
`visibility` and `annotate` (point clouds and labels), `bev`, `images` (the cameras), and `rig` (all of them together).
"""
