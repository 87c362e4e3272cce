"""What the agents of a scenario record at each moment: point clouds, images, BEV pictures and labels.

The parts, lowest layer first: `caster` (rays against surfaces), `scene` (what stands still, and one moment), `agents`
(who records, how the sensors are mounted, calib files), `lidar` and `annotate` (point clouds, labels, who is seen),
`light`, `paint`, `shadows` and `render` (the cameras' pictures), and `rig` (all of them, and the BEV pictures).
"""
