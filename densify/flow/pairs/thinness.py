# SPDX-License-Identifier: MIT
"""How thin the surfaces of an object are once all its points are brought to one time, compiled:
see `densify.flow.pairs.refine`."""

from __future__ import annotations

import numpy as np

from densify.geometry.compiled import Kernel, inlined
from densify.geometry.types import Bool, Float, Int

_MIN_NEIGHBORS = 6
_MIN_WIDTH_M2 = 0.05**2  # neighbours on one ring alone tell no plane
_SIGMA_M2 = 0.02**2  # noise of a surface point


@Kernel
def settle(
    points: Float,
    share: Float,
    sampling: Int,
    judges: Bool,
    centre: Float,
    reach_m: float,
    gates_m: Float,
    limit_m: float,
    max_weight: float,
    precision: Float,
    state: Float,
    told: Float,
) -> None:
    """Gauss-Newton steps of ``state`` (4,), in place, towards the motion that makes the surfaces
    thin: x y z (m) and yaw (rad) about ``centre`` from time 0 to time 1.

    points: (n,3), as measured after ``share`` (n,) of the motion. A point's distance is that from
    the plane of the points within ``reach_m`` whose sampling judges its own: sampling: (n,),
    judges: (samplings, samplings). gates_m: for each step,
    the distance from which on a point counts nothing. precision: (4,) inverse variance of the state
    about where it starts; ``max_weight`` so many points count at most against it. told: (2,) filled
    with the mean distance, at most ``limit_m``, which is also that of points without a plane, and
    with the share of points that have one.
    """
    H, g = np.empty((4, 4)), np.empty(4)
    start, at = state.copy(), np.empty_like(points)
    for gate_m in gates_m:
        _bring_back(points, share, centre, state, at)
        total = _add_up(at, share, sampling, judges, centre, reach_m, gate_m, limit_m, H, g, told)
        if total <= 0:
            break
        scale = min(1.0, max_weight / total) / _SIGMA_M2
        for m in range(4):
            g[m] = scale * g[m] + precision[m] * (state[m] - start[m])
            for n in range(4):
                H[m, n] = scale * H[m, n] + precision[m] * (m == n)
        state -= np.linalg.solve(H, g)
    _bring_back(points, share, centre, state, at)
    _add_up(at, share, sampling, judges, centre, reach_m, limit_m, limit_m, H, g, told)


@inlined
def _bring_back(points, share, centre, state, at):  # type: ignore[no-untyped-def]
    """Fill ``at`` with where the points are at time 0."""
    for i in range(len(points)):
        yaw = share[i] * state[3]
        c, s = np.cos(yaw), np.sin(yaw)
        dx = points[i, 0] - centre[0] - share[i] * state[0]
        dy = points[i, 1] - centre[1] - share[i] * state[1]
        at[i, 0] = c * dx + s * dy + centre[0]
        at[i, 1] = c * dy - s * dx + centre[1]
        at[i, 2] = points[i, 2] - share[i] * state[2]


@inlined
def _add(H, g, J, weight, off_m):  # type: ignore[no-untyped-def]
    """One residual, by its derivatives J (4,), to the normal equations."""
    for m in range(4):
        g[m] += weight * J[m] * off_m
        for n in range(4):
            H[m, n] += weight * J[m] * J[n]


@inlined
def _add_up(at, share, sampling, judges, centre, reach_m, gate_m, limit_m, H, g, told):  # type: ignore[no-untyped-def]
    """Fill the normal equations, by Tukey's weights, and ``told``; returns the weights' sum."""
    H[:], g[:] = 0.0, 0.0
    total, distance_m, num_planes, first = 0.0, 0.0, 0, 0
    squared_reach = reach_m * reach_m
    J = np.empty(4)
    order = np.argsort(at[:, 0])
    px, py, pz = at[order, 0], at[order, 1], at[order, 2]
    when, kind = share[order], sampling[order]
    for k in range(len(px)):
        x, y, z = px[k], py[k], pz[k]
        while x - px[first] > reach_m:
            first += 1
        W, t, num = 0.0, 0.0, 0
        mx = my = mz = xx = xy = xz = yy = yz = zz = 0.0
        for j in range(first, len(px)):
            dx = px[j] - x
            if dx > reach_m:
                break
            dy, dz = py[j] - y, pz[j] - z
            squared = dx * dx + dy * dy + dz * dz
            if squared >= squared_reach or not judges[kind[k], kind[j]]:
                continue
            w = 1 - squared / squared_reach
            w *= w
            num += 1
            W += w
            t += w * when[j]
            mx += w * dx
            my += w * dy
            mz += w * dz
            xx += w * dx * dx
            xy += w * dx * dy
            xz += w * dx * dz
            yy += w * dy * dy
            yz += w * dy * dz
            zz += w * dz * dz
        if num < _MIN_NEIGHBORS:
            distance_m += limit_m
            continue
        t, mx, my, mz = t / W, mx / W, my / W, mz / W
        xx, xy, xz = xx / W - mx * mx, xy / W - mx * my, xz / W - mx * mz
        yy, yz, zz = yy / W - my * my, yz / W - my * mz, zz / W - mz * mz
        thick, wide, a, b, c = _plane(xx, xy, xz, yy, yz, zz)
        if wide < _MIN_WIDTH_M2:
            distance_m += limit_m
            continue
        off_m = -(a * mx + b * my + c * mz)
        distance_m += min(abs(off_m), limit_m)
        num_planes += 1
        if abs(off_m) >= gate_m:
            continue
        weight = (1 - (off_m / gate_m) ** 2) ** 2 * _SIGMA_M2 / (_SIGMA_M2 + thick)
        # The more of the motion the plane was seen after than the point, the farther it is back.
        later = t - when[k]
        J[0], J[1], J[2] = a * later, b * later, c * later
        J[3] = (b * (x - centre[0]) - a * (y - centre[1])) * later
        total += weight
        _add(H, g, J, weight, off_m)
    told[0], told[1] = distance_m / len(px), num_planes / len(px)
    return total


@inlined
def _plane(xx, xy, xz, yy, yz, zz):  # type: ignore[no-untyped-def]
    """The least two eigenvalues of a symmetric matrix, and the unit vector of the least (Smith,
    "Eigenvalues of a symmetric 3 x 3 matrix", CACM 1961)."""
    mean = (xx + yy + zz) / 3
    u, v, w = xx - mean, yy - mean, zz - mean
    p = np.sqrt((u * u + v * v + w * w + 2 * (xy * xy + xz * xz + yz * yz)) / 6)
    if p <= 0:
        return mean, mean, 0.0, 0.0, 1.0
    det = u * (v * w - yz * yz) - xy * (xy * w - yz * xz) + xz * (xy * yz - v * xz)
    angle = np.arccos(min(1.0, max(-1.0, det / (2 * p * p * p)))) / 3
    most = mean + 2 * p * np.cos(angle)
    least = mean + 2 * p * np.cos(angle + 2 * np.pi / 3)
    u, v, w = xx - least, yy - least, zz - least
    # The longest product of two rows is the most exact.
    ax, ay, az = xy * yz - xz * v, xz * xy - u * yz, u * v - xy * xy
    bx, by, bz = xy * w - xz * yz, xz * xz - u * w, u * yz - xy * xz
    cx, cy, cz = v * w - yz * yz, yz * xz - xy * w, xy * yz - v * xz
    aa = ax * ax + ay * ay + az * az
    bb = bx * bx + by * by + bz * bz
    cc = cx * cx + cy * cy + cz * cz
    if bb > aa:
        ax, ay, az, aa = bx, by, bz, bb
    if cc > aa:
        ax, ay, az, aa = cx, cy, cz, cc
    if aa <= 0:
        return least, 3 * mean - most - least, 0.0, 0.0, 1.0
    length = np.sqrt(aa)
    return least, 3 * mean - most - least, ax / length, ay / length, az / length
