"""Build a map from a recorded flight: ``python build_map.py BAG PARAMETERS START.yaml OUT.yaml``.

START.yaml holds one fixed marker whose pose was measured; OUT.yaml gets all that the flight has seen often enough.
"""

import sys

from thermal_fiducial import Camera, ImuSample, load_config, load_dictionary, load_map, Pipeline, read_bag, save_map


def main(bag: str, parameters: str, start: str, out: str) -> None:
    """Map, and print where the markers are."""
    config = load_config(parameters, mode='mapping')
    pipeline = Pipeline(config, load_dictionary(config.aruco_detector.dictionary), load_map(start))
    for item in read_bag(bag):
        if isinstance(item, Camera):
            pipeline.camera = item
        elif isinstance(item, ImuSample):
            pipeline.add_imu(item)
        else:
            pipeline.add_image(item.stamp_ns, item.counts)
    pipeline.finish()
    marker_map = pipeline.mapper.map
    save_map(out, marker_map)
    for marker in marker_map.markers.values():
        x, y, z = marker.T_map_marker[:3, 3]
        print(f'marker {marker.id}: ({x:.3f}, {y:.3f}, {z:.3f}) m, fixed: {marker.fixed}')


if __name__ == '__main__':
    if len(sys.argv) != 5:
        sys.exit('usage: python build_map.py BAG PARAMETERS START.yaml OUT.yaml')
    main(*sys.argv[1:])
