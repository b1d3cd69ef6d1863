"""Types of ROS 2 messages as DDS knows them.

ROS's `sensor_msgs/msg/Image` is the type `sensor_msgs::msg::dds_::Image_` of DDS: the module `dds_`
between, an underscore behind; final, without key. Source: design.ros2.org, "Topic and Service name
mapping to DDS", and OMG IDL 4.2. The types only declare: messages pass as bytes, because decoding
an image by its type makes a Python list of its pixels.
"""

from __future__ import annotations

import dataclasses
import functools
import types as class_types
from typing import Any

from maplab_py.errors import UserError
from maplab_py.interop.recordings.bag_files import message_types

_BASE, _NAME, _ARRAY = 1, 2, 3
"""Kinds of fields in the definitions of the library rosbags; what remains are sequences."""
_SCALARS = {"bool": bool, "string": str}


def dds_type_name(kind: str) -> str:
    """Return the name that DDS has for a type of ROS, its modules separated by dots."""
    package, _, name = kind.split("/")
    return f"{package}.msg.dds_.{name}_"


def ros_type_name(dds_name: str) -> str:
    """Return the name that ROS has for a type of DDS; another type's name as it is."""
    words = dds_name.replace("::", ".").split(".")
    is_ros = len(words) == 4 and words[1:3] == ["msg", "dds_"]
    return f"{words[0]}/msg/{words[3].removesuffix('_')}" if is_ros else dds_name


@functools.cache
def type_hash(kind: str) -> str:
    """Return the hash of a standard message (REP 2011); tools of ROS 2 show it."""
    return str(message_types(is_ros_2=True).hash_rihs01(kind))


@functools.cache
def dds_type(kind: str) -> Any:
    """Return the class that declares a standard message of ROS 2 to DDS.

    Raises:
        UserError: The type is no standard message.
    """
    from cyclonedds.idl import IdlStruct
    from cyclonedds.idl.annotations import final

    definitions = message_types(is_ros_2=True).fielddefs
    if kind not in definitions:
        raise UserError(
            f"messages of type {kind} are not known: choose topics of standard messages"
        )
    fields = {name: _field_type(field) for name, field in definitions[kind][1]}
    name = dds_type_name(kind)
    made = class_types.new_class(
        name.rsplit(".", 1)[1],
        (IdlStruct,),
        {"typename": name},
        lambda body: body.update({"__annotations__": fields}),
    )
    return final(dataclasses.dataclass(made))


def _field_type(field: tuple[Any, Any]) -> Any:
    """Return the annotation of a field: (kind, (content, ...))."""
    from cyclonedds.idl import types

    idl: Any = types  # its `array` and `sequence` are indexed, which the library's hints deny
    kind, content = field
    if kind == _BASE:
        return _SCALARS.get(content[0]) or getattr(idl, content[0])
    if kind == _NAME:
        return dds_type(content)
    element, length = _field_type(content[0]), content[1]
    return idl.array[element, length] if kind == _ARRAY else idl.sequence[element]
