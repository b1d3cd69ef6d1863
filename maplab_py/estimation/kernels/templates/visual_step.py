"""Steps of landmarks for given steps of poses and cameras, and what becomes of the cost; see `visual`.

This file is a template: it is compiled in the module of `visual` (see `codegen.kernels`).
"""

# ruff: noqa: F821
# mypy: ignore-errors
# --- kernels ---
MISSING, NEGLIGIBLE = 0.1, 1e-6
"""Shares of the promised decrease and of the cost that a landmark may miss before it is refined."""
REFINEMENTS, CONVERGED = 5, 0.01


@compiled(fastmath={"contract", "nsz"})
def landmark_cost(landmark, data, at, axes, prior, loss_kind, columns, room):
    """Return the sum of rho of a landmark's observations and its prior."""
    out, h, _, g, _ = room
    total = begin_landmark(at.p_G, prior, landmark, h, g)
    for o in range(data.start[landmark], data.start[landmark + 1]):
        weight = data.inverse_sigma[o]
        if weight == 0.0:
            continue
        c = data.camera[o]
        cameras = (axes, at.parameters)
        reproject_only(at.T_G_I, data.vertex[o], cameras, c, at.p_G, landmark, data.uv_px, o, out)
        if columns > 0:
            add_delay(out, data.uv_motion, at.timing_s, o, c)
        s = (out[0] * out[0] + out[1] * out[1]) * weight * weight
        total += rho_and_weight(loss_kind, s, data.scale2[o])[0]
    return total


@compiled(fastmath={"contract", "nsz"})
def refine_landmark(landmark, data, at, axes, prior, loss_kind, room, rho):
    """Lower the cost `rho` of a landmark while all else is held; return what is left.

    Without these inner iterations few landmarks, of little parallax or seen wrongly, limit the steps of
    all states (Ruhe and Wedin, Algorithms for separable nonlinear least squares problems, 1980). Not where
    cameras are estimated: with pure rotation landmarks would come so near that the cameras' positions
    seem to be determined.
    """
    out, h, f, g, d = room
    points, damping = at.p_G, 1e-3
    for _ in range(REFINEMENTS):
        begin_landmark(points, prior, landmark, h, g)
        for o in range(data.start[landmark], data.start[landmark + 1]):
            if data.inverse_sigma[o] == 0.0:
                continue
            c, cameras = data.camera[o], (axes, at.parameters)
            reproject(at.T_G_I, data.vertex[o], cameras, c, points, landmark, data.uv_px, o, out, 0)
            weighted(out, data.inverse_sigma[o], loss_kind, data.scale2[o])
            add_landmark_sums(out, h, g)
        factor_3x3(h, damping, f)
        promised = step_landmark(h, f, g, d)
        for j in range(3):
            points[landmark, j] += d[j]
        new = landmark_cost(landmark, data, at, axes, prior, loss_kind, 0, room)
        if new < rho:
            rho, damping = new, 0.1 * damping
        else:
            damping *= 10.0
            for j in range(3):
                points[landmark, j] -= d[j]
        if promised < CONVERGED * rho:
            break
    return rho


@compiled(parallel=True, fastmath={"contract", "nsz"})
def substitute(data, at, prior, rule, pose_step, camera_step, chunk_start, new, sums):
    """Step the landmarks for given steps of poses (P, 6) and cameras (C, W).

    In: `new` is what `at` becomes with these steps. Out: new.points (L, 3); sums (chunks, 2): new
    sum of rho, and twice the decrease of the quadratic model. Row 0 of sums holds the sum over all
    chunks at the end.
    """
    start, pose_of, camera_of, uv, inverse_sigma, scale2, uv_motion = data
    poses, extrinsics, parameters, points, timing = at
    new_extrinsics, new_points = new.T_I_C, new.p_G
    loss_kind, damping, move_points = rule
    chunks, columns = sums.shape[0], camera_step.shape[1]
    axes, new_axes = camera_axes(extrinsics), camera_axes(new_extrinsics)
    for chunk in prange(chunks):
        out = np.empty(NUM_OUT + 2 * columns)
        h, f, g = np.empty(6), np.empty(6), np.empty(3)
        d = np.zeros(3)
        room = (out, h, f, g, d)
        new_cost, decrease = 0.0, 0.0
        for landmark in range(chunk_start[chunk], chunk_start[chunk + 1]):
            first, last = start[landmark], start[landmark + 1]
            before, gain = begin_landmark(points, prior, landmark, h, g), 0.0
            for o in range(first, last):
                if inverse_sigma[o] == 0.0:
                    continue
                k, c = pose_of[o], camera_of[o]
                reproject(poses, k, (axes, parameters), c, points, landmark, uv, o, out, columns)
                if columns > 0:
                    add_delay(out, uv_motion, timing, o, c)
                    add_delay_columns(out, uv_motion, timing, o)
                loss, factor = weighted(out, inverse_sigma[o], loss_kind, scale2[o])
                before += loss
                gain += out[0] * out[0] + out[1] * out[1]
                for e in range(6):
                    out[0] += out[POSE + 2 * e] * pose_step[k, e]
                    out[1] += out[POSE + 2 * e + 1] * pose_step[k, e]
                for w in range(columns):
                    out[0] += factor * out[CAMERA + 2 * w] * camera_step[c, w]
                    out[1] += factor * out[CAMERA + 2 * w + 1] * camera_step[c, w]
                gain -= out[0] * out[0] + out[1] * out[1]
                add_landmark_sums(out, h, g)
            d[:] = 0.0
            if move_points:
                factor_3x3(h, damping, f)
                gain += step_landmark(h, f, g, d)
            decrease += gain
            for j in range(3):
                new_points[landmark, j] = points[landmark, j] + d[j]
            rho = landmark_cost(landmark, data, new, new_axes, prior, loss_kind, columns, room)
            missing = rho - before + gain
            is_spoilt = missing > MISSING * abs(gain) + NEGLIGIBLE * before
            if move_points and columns == 0 and is_spoilt:
                rho = refine_landmark(landmark, data, new, new_axes, prior, loss_kind, room, rho)
            new_cost += rho
        sums[chunk, 0] = new_cost
        sums[chunk, 1] = decrease
    for chunk in range(1, chunks):
        sums[0, 0] += sums[chunk, 0]
        sums[0, 1] += sums[chunk, 1]
