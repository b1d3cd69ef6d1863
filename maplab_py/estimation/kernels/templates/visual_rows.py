"""Estimated line delays: takes the place of `add_time_offset` of the template `visual`.

Row v of a rolling shutter is read v line delays l after the first one, so the residual gets
uv_motion (t + v l), where t is the delay of the image; a row of uv_motion is [px/s, px/s, v]. Source: Li,
Kim and Mourikis, Real-time motion tracking on a cellphone using inertial sensing and a rolling-shutter
camera, ICRA 2013, section IV, to first order in the time within an image.

In a module this follows `visual`, and the later definition counts. Cameras whose line delay is not
estimated have kernels without it.
"""

# ruff: noqa: F821
# mypy: ignore-errors
# --- kernels ---
ESTIMATES_LINE_DELAYS = True


@njit(cache=True, error_model="numpy", fastmath={"contract", "nsz"}, forceinline=True)
def add_time_offset(out, uv_motion, timing, o, c):
    """Shift the residual by the time of the pixel's row and write the columns of both delays."""
    row = uv_motion[o, 2]
    delay = timing[c, 0] + timing[c, 1] * row
    for i in range(2):
        out[i] += uv_motion[o, i] * delay
        out[TIME_OFFSET + i] = uv_motion[o, i]
        out[TIME_OFFSET + 2 + i] = uv_motion[o, i] * row
