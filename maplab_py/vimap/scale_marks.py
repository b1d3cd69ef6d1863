"""Marks of missions whose scale and direction of gravity are arbitrary, as those of COLMAP models are.

The mark is a key of the mission's odometry sensor, which stands for the model. It is saved in sensors.yaml;
C++ maplab ignores it.
"""

from __future__ import annotations

from maplab_py.sensors.sensor_set import OtherSensor
from maplab_py.vimap.queries import mission_sensor_id
from maplab_py.vimap.tables import MissionSensor
from maplab_py.vimap.vi_map import VIMap

KEY = "is_scale_and_gravity_arbitrary"


def is_metric(vi_map: VIMap, mission: int) -> bool:
    """Return whether scale and direction of gravity of a mission (row) are known."""
    sensor_id = mission_sensor_id(vi_map, mission, MissionSensor.ODOMETRY_6DOF)
    sensor = vi_map.sensors.sensors.get(sensor_id)
    return not (isinstance(sensor, OtherSensor) and sensor.keys.get(KEY) is True)
