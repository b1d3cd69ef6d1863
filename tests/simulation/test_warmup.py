"""After the warmup, rendering compiles nothing."""

import dataclasses
from pathlib import Path

from maplab_py.simulation import raw_data, ray_caster
from maplab_py.simulation import scenario as sim
from maplab_py.simulation.shading_kernels import pack_texels
from maplab_py.simulation.simulate import simulate
from maplab_py.warmup import jobs

CAMERA = sim.CameraOptions(intrinsics=(40.0, 40.0, 40.0, 30.0), width_px=80, height_px=60)


def test_rendering_compiles_nothing_after_the_warmup(tmp_path: Path) -> None:
    jobs()["image rendering"]()
    before = [list(kernel.signatures) for kernel in (ray_caster.cast_rays, pack_texels)]
    assert all(before)
    scenario = sim.Scenario(
        world=sim.WorldOptions(landmarks_per_room=300),
        cameras=(CAMERA, dataclasses.replace(CAMERA, line_delay_s=1e-5)),
        measurement=sim.MeasurementOptions(frame_rate_hz=2.0),
        images=sim.ImageOptions(render=True, texel_m=0.05),
        sessions=(
            sim.SessionOptions(
                kind="loop",
                duration_s=1.0,
                turns=0.02,
                images=sim.SessionImages(light=0.5, repainted_share=0.1),
            ),
        ),
    )
    raw_data.write_raw_data(scenario, simulate(scenario), tmp_path)
    assert [list(kernel.signatures) for kernel in (ray_caster.cast_rays, pack_texels)] == before
