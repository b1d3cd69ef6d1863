"""COLMAP's own library reads the model; it runs in a process of its own, which has not imported cv2."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np

from maplab_py.geometry import se3, so3
from maplab_py.interop.mvs import MvsScene, bundler_text, projection_text

READ = """
import json, sys
import pycolmap
r = pycolmap.Reconstruction(sys.argv[1])
r.check() if hasattr(r, "check") else None
images = {i.name: i for i in r.images.values()}
print(json.dumps({
    "cameras": {c.camera_id: [c.model.name, c.width, c.height, *c.params] for c in r.cameras.values()},
    "images": {
        name: [
            i.cam_from_world().matrix().tolist() if callable(i.cam_from_world)
            else i.cam_from_world.matrix().tolist(),
            [[*p.xy, p.point3D_id] for p in i.points2D],
        ]
        for name, i in images.items()
    },
    "points": {
        k: [*p.xyz, *[int(c) for c in p.color], p.error,
            sorted([r.images[e.image_id].name, e.point2D_idx] for e in p.track.elements)]
        for k, p in r.points3D.items()
    },
}))
"""


def scene() -> MvsScene:
    """Return two cameras, three images and four points with tracks of two and three observations."""
    rng = np.random.default_rng(4)
    view = np.array([2, 0, 1, 0, 1, 2, 0, 1, 2, 1])
    landmark = np.array([0, 0, 1, 1, 2, 2, 3, 3, 3, 0])
    poses = se3.make(so3.exp(rng.normal(0.0, 0.5, (3, 3))), rng.normal(0.0, 1.0, (3, 3)))
    return MvsScene(
        np.array([[640, 480], [320, 200]]),
        np.array([[500.0, 500.0, 319.0, 241.0], [250.0, 250.0, 160.0, 99.0]]),
        np.array([0, 1, 0]),
        ["a.png", "b.png", "c.png"],
        poses,
        rng.normal(0.0, 3.0, (4, 3)),
        rng.integers(0, 256, (4, 3)).astype(np.uint8),
        landmark,
        view,
        rng.uniform(0.0, 200.0, (10, 2)),
        rng.uniform(0.0, 1.0, 4),
    )


def read_by_colmap(folder: Path) -> dict:
    result = subprocess.run(
        [sys.executable, "-c", READ, str(folder)], capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout.splitlines()[-1])


def test_projections_of_pmvs_and_bundler_agree() -> None:
    model = scene()
    P = np.loadtxt(projection_text(model, 1).splitlines()[1:])
    p = P @ np.append(model.p_G[2], 1.0)
    lines = bundler_text(model).splitlines()
    assert lines[1] == "3 4"
    camera = [np.array(line.split(), dtype=float) for line in lines[2 + 5 : 2 + 10]]
    p_B = np.array(camera[1:4]) @ model.p_G[2] + camera[4]
    # Bundler's cameras look along -z, its pixels count from the centre and upwards
    x, y = -camera[0][0] * p_B[:2] / p_B[2]
    np.testing.assert_allclose(p[:2] / p[2], [160.0 + x, 99.0 - y], rtol=1e-8)
    track = lines[2 + 15 + 2].split()
    assert track[0] == "3"
    assert sorted(track[1::4]) == ["0", "1", "2"]
