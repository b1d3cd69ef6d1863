"""Loop closures between point clouds of a lidar."""
