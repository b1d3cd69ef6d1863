"""IMU messages written into bags and read again, against rosbags with message objects.

python -m benchmarks.bags [--messages 20000] [--repeats 3]
"""

import argparse
import dataclasses
import tempfile
import time
from pathlib import Path

import numpy as np

from maplab_py.interop.bags.sensor_messages import MessageMaker
from maplab_py.interop.recordings.bag_files import opened_bag
from maplab_py.interop.recordings.bag_writing import BagFormat, messages_of_topic, write_bag
from maplab_py.interop.recordings.bags import BagRecording
from maplab_py.interop.recordings.protocol import ImuBatch, RecordedSensors
from maplab_py.sensors import CameraRig, Imu, SensorSet
from tests.interop.recordings.written import START_NS, Content
from tests.interop.recordings.written import write_bag as write_bag_of_objects

MESSAGES = 20_000
_TOPIC, _TYPE = "/imu0", "sensor_msgs/msg/Imu"


@dataclasses.dataclass(frozen=True)
class BagFigures:
    """Wall times [s], the best of some runs."""

    format: str
    write_s: float
    read_s: float
    objects_write_s: float  # rosbags, message by message
    objects_read_s: float
    is_equal: bool  # every stamp and sample, to the last bit


def make_samples(messages: int) -> Content:
    """Return samples at 200 Hz."""
    rng = np.random.default_rng(0)
    times_ns = START_NS + np.arange(messages) * 5_000_000
    return Content(times_ns, rng.normal(size=(messages, 6)), (), ())


def make_device() -> RecordedSensors:
    """Return an IMU and a rig without cameras."""
    imu, rig = Imu("a" * 32, topic=_TOPIC), CameraRig("b" * 32, (), np.zeros((0, 7)))
    return RecordedSensors(SensorSet({imu.id: imu, rig.id: rig}, {}), rig.id, imu.id)


def measure(kind: BagFormat, messages: int = MESSAGES, repeats: int = 3) -> BagFigures:
    """Write and read bags of a format."""
    content, device = make_samples(messages), make_device()
    times: list[list[float]] = []
    is_equal = True
    for _ in range(repeats):
        with tempfile.TemporaryDirectory() as folder:
            path, other = (
                Path(folder) / (name if kind.is_ros_2 else f"{name}.bag")
                for name in ("ours", "objects")
            )
            marks = [time.process_time()]
            rows = MessageMaker(is_ros_2=kind.is_ros_2).imu(
                content.imu_ns, content.accel_gyro, "imu"
            )
            write_bag(path, kind, messages_of_topic(content.imu_ns, _TOPIC, _TYPE, rows))
            marks.append(time.process_time())
            batches = [b for b in BagRecording(path, device).items() if isinstance(b, ImuBatch)]
            marks.append(time.process_time())
            version = 2 if kind.is_ros_2 else 1
            write_bag_of_objects(content, other, version=version, storage=kind.value)
            marks.append(time.process_time())
            with opened_bag(other) as reader:
                for connection, _, data in reader.messages():
                    reader.deserialize(data, connection.msgtype)
            marks.append(time.process_time())
        times.append(np.diff(marks).tolist())
        read_ns = np.concatenate([batch.times_ns for batch in batches])
        read = np.concatenate([batch.accel_gyro for batch in batches])
        is_equal &= np.array_equal(read_ns, content.imu_ns)
        is_equal &= read.tobytes() == content.accel_gyro.tobytes()
    best = np.min(times, axis=0).tolist()
    return BagFigures(kind.value, *best, is_equal=is_equal)


def main() -> None:
    """Measure all formats and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--messages", type=int, default=MESSAGES)
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    print(f"{arguments.messages} IMU messages, wall time [s], the best of {arguments.repeats} runs")
    print("| format | write | read | rosbags write | rosbags read | equal |")
    print("|---|---|---|---|---|---|")
    for kind in BagFormat:
        f = measure(kind, arguments.messages, arguments.repeats)
        times = (f.write_s, f.read_s, f.objects_write_s, f.objects_read_s)
        cells = " | ".join(f"{seconds:.2f}" for seconds in times)
        print(f"| {f.format} | {cells} | {f.is_equal} |", flush=True)


if __name__ == "__main__":
    main()
