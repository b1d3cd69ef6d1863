"""Scale of wheel odometry: reported distances / driven distances, a key of the sensor's entry.

maplab has no such number; its entry of sensors.yaml gets a key `wheel_scale`, which C++ maplab ignores.
"""

import dataclasses

from maplab_py.errors import MapError
from maplab_py.sensors.sensor_set import OtherSensor, SensorSet
from maplab_py.sensors.yaml_entry import Entry

WHEEL_ODOMETRY = "WHEEL_ODOMETRY"
"""Sensor type in sensors.yaml."""
_KEY = "wheel_scale"


def wheel_scale(sensors: SensorSet, sensor_id: str) -> float:
    """Return the scale of a wheel sensor; 1 where its entry has none.

    Raises:
        MapError: The entry's scale is no positive number.
    """
    sensor = sensors.sensors.get(sensor_id)
    if not isinstance(sensor, OtherSensor):
        return 1.0
    return Entry(sensor.keys, f"sensors.yaml: sensor {sensor_id}").number(_KEY, 1.0, positive=True)


def with_wheel_scale(sensors: SensorSet, sensor_id: str, scale: float) -> SensorSet:
    """Return the sensors with another scale of a wheel sensor.

    Raises:
        MapError: There is no such sensor.
    """
    sensor = sensors.sensors.get(sensor_id)
    if not isinstance(sensor, OtherSensor):
        raise MapError(f"sensors.yaml has no wheel sensor with id {sensor_id}")
    scaled = dataclasses.replace(sensor, keys={**sensor.keys, _KEY: float(scale)})
    return dataclasses.replace(sensors, sensors={**sensors.sensors, sensor_id: scaled})
