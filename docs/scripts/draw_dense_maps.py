"""Draw docs/images/dense_maps.png: image, depth, mesh and distances of the simulated stereo room.

python docs/scripts/draw_dense_maps.py
"""

import tempfile
from pathlib import Path

import cv2
import numpy as np

from maplab_py.algorithms.dense.field import load_fields
from maplab_py.algorithms.dense.meshing import map_mesh, vertex_colours
from maplab_py.array_types import F64, I32, U8
from maplab_py.console.session.session import Session
from maplab_py.geometry import se3
from maplab_py.simulation.raw_data import write_maps
from maplab_py.simulation.scenario_file import load_scenario
from maplab_py.viewer import colours
from maplab_py.viewer.resource_clouds import VertexImages

TARGET = Path(__file__).resolve().parents[1] / "images" / "dense_maps.png"
WIDTH_PX, HEIGHT_PX = 564, 360
VERTEX = 30
GROUND = 245


def shaded(p_G: F64, faces: I32, colour: U8) -> U8:
    """Return the mesh as seen from above its free side, without the surfaces that show their back."""
    corners = p_G[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    middle = 0.5 * (p_G.min(axis=0) + p_G.max(axis=0))
    backward = normal.sum(axis=0)
    backward[2] = 0.55 * np.linalg.norm(backward[:2])
    backward /= np.linalg.norm(backward)
    right = np.cross([0.0, 0.0, 1.0], backward)
    right /= np.linalg.norm(right)
    axes = np.stack([right, -np.cross(backward, right), backward])
    p = (p_G - middle) @ axes.T
    scale = 0.94 * min(WIDTH_PX / np.ptp(p[:, 0]), HEIGHT_PX / np.ptp(p[:, 1]))
    pixels = np.round(8.0 * (p[:, :2] * scale + [WIDTH_PX / 2, HEIGHT_PX / 2])).astype(np.int32)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    light = np.clip(0.55 + 0.45 * normal @ [0.2, -0.3, 0.93], 0.2, 1.0)
    face_colour = colour[faces].mean(axis=1) * light[:, None]
    picture = np.full((HEIGHT_PX, WIDTH_PX, 3), GROUND, dtype=np.uint8)
    facing = np.flatnonzero(normal @ backward > 0.0)
    for face in facing[np.argsort(p[faces[facing], 2].mean(axis=1))].tolist():
        red, green, blue = face_colour[face].tolist()
        cv2.fillConvexPoly(picture, pixels[faces[face]], (red, green, blue), cv2.LINE_AA, 3)
    return picture


def sliced(session: Session) -> U8:
    """Return a slice of the distance field at the height of the cameras."""
    (_, field), *_ = load_fields(session.vi_map, Path())
    z = float(np.median(session.vi_map.vertices.T_M_I[:, 6]))
    low, high = (8 * field.coordinates.min(axis=0)[:2], 8 * field.coordinates.max(axis=0)[:2] + 8)
    x, y = (np.arange(low[a], high[a]) + 0.5 for a in (0, 1))
    grid = np.stack(np.meshgrid(x, y[::-1]), axis=-1) * field.voxel_size_m
    p = np.concatenate([grid, np.full((*grid.shape[:2], 1), z)], axis=-1)
    distance = field.at(p.reshape(-1, 3)).reshape(grid.shape[:2])
    part = distance / np.nanmax(distance)
    picture = colours.ramp(part, colours.SEQUENTIAL[::-1])
    picture[np.isnan(distance)] = GROUND
    picture[distance < 0.0] = 60
    scale = min(WIDTH_PX / picture.shape[1], HEIGHT_PX / picture.shape[0])
    size = round(picture.shape[1] * scale), round(picture.shape[0] * scale)
    result = np.full((HEIGHT_PX, WIDTH_PX, 3), GROUND, dtype=np.uint8)
    top, left = (HEIGHT_PX - size[1]) // 2, (WIDTH_PX - size[0]) // 2
    part_of = cv2.resize(picture, size, interpolation=cv2.INTER_NEAREST)
    result[top : top + size[1], left : left + size[0]] = part_of
    return result


def main() -> None:
    """Simulate, reconstruct and draw."""
    with tempfile.TemporaryDirectory() as temporary, Session() as session:
        folder = Path(temporary) / "room"
        write_maps(load_scenario("stereo_room"), folder, raw_data=True)
        session.run("load", map_folder=folder / "session_1")
        session.run("import_images", dataset_folder=folder / "raw" / "session_1")
        session.run("stereo_dense_reconstruction")
        session.run("tsdf", dense_tsdf_voxel_size_m=0.05)
        session.run("esdf", dense_tsdf_voxel_size_m=0.05)
        vi_map = session.vi_map
        both = VertexImages(vi_map, Path(), with_depth=True)(VERTEX)
        assert both is not None
        image, depth = np.split(both, 2)
        mesh, _ = map_mesh(vi_map, Path())
        colour = vertex_colours(vi_map, Path(), mesh.p)
        p_M = se3.transform(se3.inverse(vi_map.T_G_M[0]), mesh.p)
        size = WIDTH_PX, HEIGHT_PX
        top = [cv2.resize(part, size, interpolation=cv2.INTER_AREA) for part in (image, depth)]
        bottom = [shaded(p_M, mesh.faces, colour), sliced(session)]
    picture = np.vstack([np.hstack(top), np.hstack(bottom)])
    cv2.imwrite(str(TARGET), picture[:, :, ::-1])


if __name__ == "__main__":
    main()
