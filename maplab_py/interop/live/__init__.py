"""Topics of running robots: ROS 2, ROS 1 and Foxglove, without an installation of ROS.

`opening.open_transport` connects; `source.LiveRecording` is a recording that is still going on,
`publishing` tells others where the odometry is, `playing` publishes a recording.
"""
