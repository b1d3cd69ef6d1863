"""Cameras in a painted room: images with known depth, for tests of tracking."""

import dataclasses
from functools import cache

import numpy as np

from maplab_py.array_types import F64, U8
from maplab_py.geometry import se3, so3
from maplab_py.sensors import Camera, Distortion, Projection, projection
from maplab_py.simulation.imaging import pixel_rays
from maplab_py.simulation.ray_caster import RayCaster, painted_boxes
from maplab_py.simulation.scenario import ImageOptions
from maplab_py.simulation.scene import make_scene

WIDTH, HEIGHT = 376, 240
# optical axis along +x of the body, image right along -y
Q_I_C = so3.from_matrix(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))


def camera(number: int = 0) -> Camera:
    return Camera(
        f"{number:032x}",
        Projection.PINHOLE,
        Distortion.RADTAN,
        np.array([230.0, 229.0, 187.0, 121.0]),
        np.array([-0.28, 0.07, 2e-4, 1e-5]),
        WIDTH,
        HEIGHT,
    )


@dataclasses.dataclass(frozen=True, eq=False)
class Rig:
    cameras: tuple[Camera, ...]
    T_I_C: F64

    def images(self, T_G_I: F64) -> tuple[U8, ...]:
        return tuple(image_at(se3.compose(T_G_I, T)) for T in self.T_I_C)


def mono() -> Rig:
    return Rig((camera(),), se3.make(Q_I_C, np.array([0.02, 0.01, 0.03]))[None])


def stereo(baseline_m: float = 0.12) -> Rig:
    p = np.array([[0.0, 0.5 * baseline_m, 0.0], [0.0, -0.5 * baseline_m, 0.0]])
    return Rig((camera(0), camera(1)), se3.make(np.tile(Q_I_C, (2, 1)), p))


def back_to_back() -> Rig:
    behind = so3.multiply(so3.exp(np.array([0.0, 0.0, np.pi])), Q_I_C)
    p = np.array([[0.05, 0.0, 0.0], [-0.05, 0.0, 0.0]])
    return Rig((camera(0), camera(1)), se3.make(np.stack([Q_I_C, behind]), p))


@cache
def caster() -> RayCaster:
    bounds = np.array([[-3.0, -2.5, 0.0], [3.0, 2.5, 2.6]])
    boxes = np.array([[[1.2, 0.6, 0.0], [1.7, 1.1, 1.6]], [[1.0, -1.2, 0.0], [1.6, -0.7, 1.1]]])
    scene = make_scene(bounds, boxes, ImageOptions(texel_m=0.006), np.random.default_rng(5))
    return RayCaster.of(painted_boxes(scene), pixel_rays(camera()), 230.0)


@cache
def _rendered(T_G_C: bytes) -> tuple[U8, F64]:
    pose = np.frombuffer(T_G_C, dtype=np.float64)
    grey, depth = caster().render(pose[None])
    return np.clip(np.round(grey), 0, 255).astype(np.uint8), depth.astype(np.float64)


def image_at(T_G_C: F64) -> U8:
    return _rendered(np.ascontiguousarray(T_G_C).tobytes())[0]


def points_at(T_G_C: F64, uv_px: F64) -> F64:
    """Return the points (K, 3) in G that pixels (K, 2) show, depth interpolated."""
    depth = _rendered(np.ascontiguousarray(T_G_C).tobytes())[1]
    u, v = uv_px[:, 0], uv_px[:, 1]
    u0, v0 = np.floor(u).astype(int), np.floor(v).astype(int)
    du, dv = u - u0, v - v0
    z = (1 - dv) * ((1 - du) * depth[v0, u0] + du * depth[v0, u0 + 1])
    z += dv * ((1 - du) * depth[v0 + 1, u0] + du * depth[v0 + 1, u0 + 1])
    ray, exists = projection.back_project(camera(), uv_px)
    assert exists.all()
    return se3.transform(T_G_C, ray / ray[:, 2:] * z[:, None])


def pixels_at(T_G_C: F64, p_G: F64) -> F64:
    return projection.project(camera(), se3.transform(se3.inverse(T_G_C), p_G))[0]


def pose(x: float = 0.0, y: float = 0.0, yaw: float = 0.0, roll: float = 0.0) -> F64:
    q = so3.multiply(so3.exp(np.array([0.0, 0.0, yaw])), so3.exp(np.array([roll, 0.0, 0.0])))
    return se3.make(q, np.array([-1.0 + x, y, 1.3]))


def turn(T_G_I0: F64, T_G_I1: F64) -> F64:
    return so3.to_matrix(so3.multiply(so3.inverse(T_G_I0[:4]), T_G_I1[:4]))
