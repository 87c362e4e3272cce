"""Every default and constant of V2X is the one written out here."""

import numpy as np
from support.default_values import package_values

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.geometry import SE3, Boxes
from deepaccident_devkit.v2x import agent_motion, cooperative_view, relative_pose_to_ego
from deepaccident_devkit.v2x.clouds import moved_points
from deepaccident_devkit.v2x.collisions import labelled_pair
from deepaccident_devkit.v2x.tracks import scenario_tracks

EXPECTED_DEFAULTS = {
    "agent_motion.MIN_CURVATURE_SPEED": "0.5",
    "agents.SHEER_CURTAINS": "('Town05_type001_subtype0002_scenario00035', "
    "'Town05_type001_subtype0002_scenario00004')",
    "agents.VISIBILITIES": "('visible', 'partial', 'invisible')",
    "agents.AVAILABLE": "'available'",
    "agents.AGENT_SETS": (
        "('single', '+behind', '+other', '+infrastructure', '+behind+other', "
        "'vehicles', 'all', 'available')"
    ),
    "agents.AgentConfig": "partners=()",
    "agents.AgentConfig.agents_for": "side='ego_vehicle'",
    "agents.cooperating_agents": "agents=None",
    "agents.accident_visible_mask": "collision=True, exempt=False",
    "agents.pair_in_view": "own_id=None",
    "clouds.aggregate_point_cloud": "agents=None, sweeps=1, frame='world', compensate=False, "
    "link=None, on_missing='raise'",
    "collisions.CONTACT_GAP": "1.5",
    "cooperation.SAME_ACTOR_DISTANCE": "0.5",
    "cooperation.visible_instances": "agents=None, link=None",
    "cooperation.visible_actors": "agents=None, link=None",
    "cooperation.cooperative_boxes": "agents=None, frame='world', visible=None, link=None",
    "cooperation.cooperative_view": "agents=None, frame='world', visible=None, link=None",
    "cooperation.seen_actors": "agents='single', link=None, frame='ego'",
    "messages.POINT_BYTES": "16",
    "messages.BOX_BYTES": "45",
    "messages.POSE_BYTES": "24",
    "messages.PoseNoise": "mean=0.0, std=0.02, heading_std=0.0",
    "messages.Link": "latency=0.0, pose_noise=None, packet_loss=0.0, seed=0, "
    "budget=None, payload=None",
    "messages.message_sizes": (
        "agents=None, bev_shape=(64, 200, 200), bev_dtype=<class 'numpy.float32'>, clouds=True, "
        "link=None, on_missing='raise'"
    ),
    "messages.messages": "agents=None, link=None, sweeps=1",
    "poses.transform": "target='ego', source='ego'",
    "poses.future_egomotion": "valid=None",
    "poses.project_to_image": "frame=None, colors=True",
    "poses.map_pointcloud_to_image": "sample=None, colors=True",
    "track_window.TrackWindow.write_av2": "focal=None",
    "track_window.argoverse_table": "focal=None",
    "windows.ACTOR_FRAME": "'actor'",
    "windows.WindowConfig": "past=2.0, future=3.0, step=0.1, agents=None, visible=None, "
    "actors='present'",
    "windows.configured_window": "frame='ego'",
    "windows.count_units": "minimum=0.0",
    "windows.window": "past=2.0, future=3.0, step=0.1, agents=None, visible=None, frame='ego', "
    "actors='present'",
    "tracks.Trajectory": "present=None",
    "tracks.trajectory": "sample=None, frame='world'",
}


def test_every_default_and_constant_written_out(da_b: DeepAccident) -> None:
    assert package_values("deepaccident_devkit.v2x") == EXPECTED_DEFAULTS
    # one call into each module, because the mutation runner picks the tests that execute a line
    no_boxes = Boxes.from_arrays(np.zeros((0, 3)), np.zeros((0, 3)), [])
    assert len(moved_points(np.zeros((0, 3)), no_boxes, no_boxes)) == 0
    assert len(relative_pose_to_ego([SE3.identity()])) == 1
    assert len(agent_motion(da_b, da_b.agent[0]).time) > 0
    assert labelled_pair(None, np.zeros(1)) is None
    assert len(cooperative_view(da_b, da_b.sample[0]).source) > 0
    assert len(scenario_tracks(da_b, da_b.scenario[0]).index) > 0
