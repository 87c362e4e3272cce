"""From boxes to maps: `box_polygons` (footprints), `polygon_fill` (cells), `from_boxes` (ids, flow), `label_maps`."""
