"""maplab's visualisation plugin: the selected map in the browser, beside the console."""

from maplab_plugins.visualization.clouds import (
    visualize_optimized_depth_map_pointclouds,
    visualize_raw_depth_map_pointclouds,
    visualize_xyz_pointclouds,
    visualize_xyzi_pointclouds,
    visualize_xyzi_pointclouds_from_mission,
    visualize_xyzi_pointclouds_sequentially,
    visualize_xyzrgbn_pointclouds,
)
from maplab_plugins.visualization.images import (
    visualize_disparity_maps,
    visualize_optimized_depth_maps,
    visualize_raw_color_images,
    visualize_raw_depth_maps,
    visualize_raw_images,
    visualize_undistorted_color_images,
    visualize_undistorted_images,
)
from maplab_plugins.visualization.maps import (
    visualize,
    visualize_changes,
    visualize_difference,
    visualize_landmark_observers,
    visualize_loop_closures,
    visualize_sensor_extrinsics,
    visualize_sequentially,
)
from maplab_plugins.visualization.meshes import visualize_esdf, visualize_mesh
from maplab_plugins.visualization.output import (
    export_view,
    save_view,
    viewer_go_to,
    viewer_keep,
    viewer_stop,
)

__all__ = [
    "export_view",
    "save_view",
    "viewer_go_to",
    "viewer_keep",
    "viewer_stop",
    "visualize",
    "visualize_changes",
    "visualize_difference",
    "visualize_disparity_maps",
    "visualize_esdf",
    "visualize_landmark_observers",
    "visualize_loop_closures",
    "visualize_mesh",
    "visualize_optimized_depth_map_pointclouds",
    "visualize_optimized_depth_maps",
    "visualize_raw_color_images",
    "visualize_raw_depth_map_pointclouds",
    "visualize_raw_depth_maps",
    "visualize_raw_images",
    "visualize_sensor_extrinsics",
    "visualize_sequentially",
    "visualize_undistorted_color_images",
    "visualize_undistorted_images",
    "visualize_xyz_pointclouds",
    "visualize_xyzi_pointclouds",
    "visualize_xyzi_pointclouds_from_mission",
    "visualize_xyzi_pointclouds_sequentially",
    "visualize_xyzrgbn_pointclouds",
]
