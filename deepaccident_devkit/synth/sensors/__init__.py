"""What the agents of a scenario record: point clouds, images, BEV pictures and labels of one moment after another.

The parts, from below: `placing` (bodies set on the terrain), `caster` (rays against surfaces), `setting` (what stands
still, made once a scenario), `scene` (one moment), `agents` (who records, and how the sensors are mounted), `windows`
and `turn` (which rays can meet whom), `lidar`, `visibility` and `annotate` (point clouds and labels),
`single_precision` (calib files), `bev`, `images` (the cameras), and `rig` (all of them together).
"""
