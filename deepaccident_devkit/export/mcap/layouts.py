"""Initial views of an MCAP file: a layout for Foxglove, and a script with a blueprint for rerun."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from deepaccident_devkit.support.files import write_bytes
from deepaccident_devkit.support.values import NamedValues
from deepaccident_devkit.taxonomy import LIDAR

_RERUN_TEMPLATE = '''\
"""Open the recording beside this script in rerun (0.41) with a layout; needs: pip install \
rerun-sdk."""

from pathlib import Path

import rerun
from rerun import blueprint as show
from rerun.blueprint import encodings

scene = show.Spatial3DView(
    name="scene", contents={scene}, \
spatial_information=show.SpatialInformation(target_frame="world")
)
cameras = [
    show.Spatial2DView(
        name=each, origin=each, \
spatial_information=show.SpatialInformation(target_frame=f"{{each[1:-6]}}_image_plane")
    )
    for each in {cameras}
]
number = encodings.VisualizerComponentMapping(
    "Scalars:scalars",
    encodings.ComponentSourceKind.SourceComponent,
    source_component="google.protobuf.DoubleValue:message",
    selector=".value",
)
curves = {{each: rerun.SeriesLines().visualizer(mappings=[number]) for each in {values}}}
values = show.TimeSeriesView(name="speeds (m/s), time to impact (s), alarms", \
contents=list(curves), overrides=curves)
blueprint = show.Blueprint(show.Horizontal(scene, show.Vertical(*cameras, values), \
column_shares=[3, 2]))
if __name__ == "__main__":
    rerun.init("deepaccident", spawn=True, default_blueprint=blueprint)
    rerun.log_file_from_path(Path(__file__).with_name({file!a}))
'''


def write_layouts(path: Path, topics: Sequence[str]) -> None:
    """Write the layouts next to an MCAP file that has these topics.

    Their suffixes `.foxglove.json` and `.rerun.py` replace the suffix of the file. They show the
    road, clouds, actors and predictions, the front cameras, and the speeds, the time to the impact
    and the scores of alarms as curves.
    """
    clouds = [topic for topic in topics if topic.endswith(f"/{LIDAR}/points")]
    cameras = [topic for topic in topics if topic.endswith("/Camera_Front/image")][:2]
    predicted_points = [
        topic for topic in topics if "/prediction/" in topic and topic.endswith("/points")
    ]
    curve_ends = ("/speed", "/time_to_impact", "/prediction/alarm")
    values = [topic for topic in topics if topic.endswith(curve_ends)]
    scene_topics: NamedValues = {
        "/road/points": {"visible": True, "colorMode": "rgba-fields", "pointSize": 4},
        "/actors": {"visible": True},
    }
    for topic in clouds:
        scene_topics[topic] = {"visible": True, "colorMode": "colormap", "colorField": "z"}
    for topic in topics:
        if f"{topic}/points" in predicted_points or topic.endswith("/motion/points"):
            scene_topics[topic] = {"visible": True}
    paths = [{"value": f"{topic}.value", "enabled": True} for topic in values]
    panels: NamedValues = {
        "3D!scene": {"followMode": "follow-none", "followTf": "world", "topics": scene_topics},
        "Plot!values": {"paths": paths},
    }
    side: Any = "Plot!values"
    for number, topic in enumerate(cameras):
        panel = f"Image!{number}"
        calibration = topic.replace("/image", "/calibration")
        panels[panel] = {"imageMode": {"imageTopic": topic, "calibrationTopic": calibration}}
        side = {"direction": "column", "first": panel, "second": side}
    layout = {"direction": "row", "first": "3D!scene", "second": side, "splitPercentage": 60}
    foxglove = {"configById": panels, "globalVariables": {}, "userNodes": {}, "layout": layout}
    write_bytes(path.with_suffix(".foxglove.json"), json.dumps(foxglove, indent=1).encode())
    scene = ["/road/points", "/actors/points", "/tf", *clouds, *predicted_points]
    script = _RERUN_TEMPLATE.format(file=path.name, scene=scene, cameras=cameras, values=values)
    write_bytes(path.with_suffix(".rerun.py"), script.encode())
