"""Scenes in the viewer Rerun, or in its files: layers as they are, bodies and images over time.

Needs the library rerun-sdk (the extra `rerun`). Layers are those that the browser shows, from the same scene;
poses and images have the times of their vertices.
"""

import importlib.util
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.array_types import F64
from maplab_py.cancellation import check_cancelled
from maplab_py.errors import UserError
from maplab_py.output_files import check_writable, copy_file
from maplab_py.sensors import Camera
from maplab_py.viewer.building import Subject, make_checked_drawing, scene_of
from maplab_py.viewer.drawing import Drawing, axis_lines
from maplab_py.viewer.layers.cameras import frustum_points, mission_cameras
from maplab_py.viewer.resource_clouds import VertexImages
from maplab_py.viewer.scene import WHOLE_MAP, Axes, Mesh, Part, Points, Scene

_ROOT = "map"
_TIME = "time"


def show_in_rerun(
    subject: Subject, images: VertexImages | None, file: Path | None, *, overwrite: bool = False
) -> Scene:
    """Open Rerun with a subject, or write it to a file; return its scene.

    Args:
        images: Images of its vertices, if there are any.
        file: File .rrd to write in place of opening the viewer.

    Raises:
        UserError: The library is missing, the subject cannot be shown, or the file not written.
    """
    if importlib.util.find_spec("rerun") is None:
        raise UserError(
            "--viewer=rerun needs the library rerun-sdk: install it with `pip install 'maplab-py[rerun]'`"
        )
    check_writable(file, overwrite=overwrite)
    import rerun as rr

    drawing = make_checked_drawing(subject)
    scene = scene_of(drawing, subject)
    recording = rr.RecordingStream("maplab", recording_id=subject.title)
    if file is None:
        recording.spawn()
        _log(recording, scene, drawing, images)
        return scene
    with tempfile.TemporaryDirectory() as folder:
        written = Path(folder) / "map.rrd"
        recording.save(written)
        _log(recording, scene, drawing, images)
        recording.disconnect()
        copy_file(written, file, overwrite=overwrite)
    return scene


def _log(recording: Any, scene: Scene, drawing: Drawing, images: VertexImages | None) -> None:
    import rerun as rr
    import rerun.blueprint as blueprint

    recording.set_log_time_enabled(False)
    recording.set_log_tick_enabled(False)
    recording.log(_ROOT, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    names = {mission.id: mission.name for mission in scene.missions}
    if len(set(names.values())) < len(names):
        names = {mission_id: mission_id for mission_id in names}
    for layer in scene.layers:
        for mission_id, part in layer.parts.items():
            check_cancelled()
            last = [] if mission_id == WHOLE_MAP else [names[mission_id]]
            recording.log([_ROOT, layer.title, *last], _archetype(part), static=True)
    for mission, mission_id in enumerate(drawing.mission_ids):
        if mission_id in names:
            _log_mission(recording, drawing, mission, names[mission_id], images)
    hidden: dict[Any, Any] = {
        rr.new_entity_path([_ROOT, layer.title]): blueprint.EntityBehavior(visible=False)
        for layer in scene.layers
        if not layer.is_visible
    }
    recording.send_blueprint(blueprint.Blueprint(blueprint.Spatial3DView(overrides=hidden)))


def _archetype(part: Part) -> Any:
    """Return what Rerun draws for a part of a scene; widths of lines are pixels in both."""
    import rerun as rr

    if isinstance(part, Points):
        labels = part.labels or None
        return rr.Points3D(part.p, radii=0.5 * part.size_m, colors=part.colours, labels=labels)
    if isinstance(part, Mesh):
        colours = np.broadcast_to(part.colours, part.p.shape)
        return rr.Mesh3D(
            vertex_positions=part.p, triangle_indices=part.faces, vertex_colors=colours
        )
    if isinstance(part, Axes):
        part = axis_lines(part.T, np.arange(len(part)), part.length_m)
    radius = rr.Radius.ui_points(0.5 * part.width_px)
    return rr.LineStrips3D(part.ends, radii=radius, colors=part.colours)


def _log_mission(
    recording: Any, drawing: Drawing, mission: int, name: str, images: VertexImages | None
) -> None:
    """Log the poses of the body of a mission and its images, at the times of the vertices."""
    import rerun as rr

    vi_map = drawing.vi_map
    rows = np.arange(*vi_map.vertex_start[mission : mission + 2].tolist())
    if not len(rows) or not np.isfinite(drawing.p_vertices[rows]).all():
        return
    body = rr.new_entity_path([_ROOT, "Body", name])
    times = vi_map.vertices.timestamp_ns[rows].astype("datetime64[ns]")
    rr.send_columns(
        body,
        [rr.TimeColumn(_TIME, timestamp=times)],
        rr.Transform3D.columns(
            translation=drawing.p_vertices[rows], quaternion=vi_map.T_G_I[rows, :4]
        ),
        recording=recording,
    )
    cameras = mission_cameras(vi_map, mission)
    for mounted in cameras:
        place = f"{body}/cam{mounted.index}"
        T_I_C = rr.Transform3D(
            translation=mounted.T_I_C[4:], rotation=rr.Quaternion(xyzw=mounted.T_I_C[:4])
        )
        recording.log(place, T_I_C, static=True)
        recording.log(place, _pinhole(mounted.camera, 0.03 * drawing.unit_m), static=True)
    if images is None or not cameras:
        return
    for vertex, time in zip(rows.tolist(), times, strict=True):
        check_cancelled()
        picture = images.image(vertex)
        if picture is not None:
            camera = int(vi_map.frames.camera_index[images.frame(vertex)])
            recording.set_time(_TIME, timestamp=time)
            recording.log(f"{body}/cam{camera}", rr.Image(picture).compress())


def _pinhole(camera: Camera, depth_m: float) -> Any:
    """Return the pinhole camera whose image has the corners of a camera; distortion is not drawn."""
    import rerun as rr

    corners = frustum_points(camera, 1.0)[[1, 3]]  # upper left, lower right
    upper_left, lower_right = corners[:, :2] / corners[:, 2:]
    size: F64 = np.array([camera.width_px, camera.height_px], dtype=np.float64)
    focal_px = size / (lower_right - upper_left)
    return rr.Pinhole(
        resolution=size,
        focal_length=focal_px,
        principal_point=-focal_px * upper_left,
        image_plane_distance=depth_m,
    )
