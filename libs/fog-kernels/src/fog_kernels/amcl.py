"""Kernels of a particle filter for localization: move, score, resample, estimate.

Particles are a structure of arrays: x, y (m) and theta (rad) in `map`, float32; weights float64, adding up to 1.
Randomness comes from an explicit generator state (xoshiro256++, Blackman and Vigna 2019), made by `rng_state` and
advanced in place: the same seed gives the same particles bit for bit.

Methods: odometry motion model (Thrun, Burgard and Fox 2005, table 5.6); likelihood field with AMCL's sum of cubes
(chapter 6.4); sample size by Kullback-Leibler distance (Fox 2001), drawn with low variance (chapter 4.3).

One module, although long: kernels that share helpers, each with the wrapper that checks its arrays.
"""

# Kernels take arrays and scalars, typed by their compiled signatures, and are single functions where a call per cell
# would cost more than its work.
# ruff: noqa: ANN401, C901, PLR0912, PLR0913, PLR0915

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numba import float32, float64, int64, njit, types, void

from fog_kernels import _arrays

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

KLD_Z = 2.326  # the 0.99 quantile of the normal distribution
BIN_XY = 0.5
BIN_THETA = math.radians(10.0)

_TWO_PI = 2.0 * math.pi


class Resampled(NamedTuple):
    """New particles with equal weights: x, y, theta float32 (n,), weights float64 (n,)."""

    x: NDArray[np.float32]
    y: NDArray[np.float32]
    theta: NDArray[np.float32]
    weights: NDArray[np.float64]


class Estimate(NamedTuple):
    """Mean pose and covariance (3, 3) over x, y (m) and theta (rad, circular mean)."""

    x: float
    y: float
    theta: float
    covariance: NDArray[np.float64]


class Cluster(NamedTuple):
    """Particles in adjacent bins: their share of the total weight and their estimate."""

    share: float
    estimate: Estimate


@njit(cache=True, nogil=True)
def _draw(s0: Any, s1: Any, s2: Any, s3: Any) -> Any:
    """Return the next four words of state and a number in [0, 1) with 53 random bits. Scalars only: they inline."""
    total = s0 + s3
    value = ((total << np.uint64(23)) | (total >> np.uint64(41))) + s0
    shifted = s1 << np.uint64(17)
    s2 ^= s0
    s3 ^= s1
    s1 ^= s2
    s0 ^= s3
    s2 ^= shifted
    s3 = (s3 << np.uint64(45)) | (s3 >> np.uint64(19))
    return s0, s1, s2, s3, float(value >> np.uint64(11)) * 1.1102230246251565e-16


@njit(cache=True, nogil=True)
def _normals(s0: Any, s1: Any, s2: Any, s3: Any) -> Any:
    """Return the next state and two normal numbers (polar method, Marsaglia and Bray 1964)."""
    while True:
        s0, s1, s2, s3, u = _draw(s0, s1, s2, s3)
        s0, s1, s2, s3, v = _draw(s0, s1, s2, s3)
        u = 2.0 * u - 1.0
        v = 2.0 * v - 1.0
        square = u * u + v * v
        if 0.0 < square < 1.0:
            scale = math.sqrt(-2.0 * math.log(square) / square)
            return s0, s1, s2, s3, u * scale, v * scale


@njit(cache=True, nogil=True)
def _wrap(angle: Any) -> Any:
    return angle - _TWO_PI * math.floor((angle + math.pi) / _TWO_PI)


@njit(cache=True, nogil=True)
def _bin_key(x: Any, y: Any, theta: Any, bin_xy: Any, n_theta: Any) -> Any:
    """Return one number per bin: 24 bits each for x and y, 12 for the heading."""
    column = np.int64(math.floor(x / bin_xy)) + (1 << 23)
    row = np.int64(math.floor(y / bin_xy)) + (1 << 23)
    turns = theta / _TWO_PI
    heading = min(np.int64((turns - math.floor(turns)) * n_theta), n_theta - 1)
    return (column << 36) | (row << 12) | heading


@njit(cache=True, nogil=True)
def _hash(key: Any, mask: Any) -> Any:
    mixed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    return np.int64(mixed >> np.uint64(20)) & mask


@njit(
    void(
        _arrays.F32_OUT, _arrays.F32_OUT, _arrays.F32_OUT, float64, float64, float64, _arrays.F64_FLAT, _arrays.U64_OUT
    ),
    cache=True,
    nogil=True,
)
def _move(x: Any, y: Any, theta: Any, rot1: float, trans: float, rot2: float, alphas: Any, state: Any) -> None:
    # In this model a reversing robot rotates by nearly pi twice; the noise is that of its actual small rotation.
    rotation1 = min(abs(_wrap(rot1)), abs(_wrap(rot1 - math.pi)))
    rotation2 = min(abs(_wrap(rot2)), abs(_wrap(rot2 - math.pi)))
    spread1 = math.sqrt(alphas[0] * rotation1 * rotation1 + alphas[1] * trans * trans)
    spread_trans = math.sqrt(alphas[2] * trans * trans + alphas[3] * (rotation1 * rotation1 + rotation2 * rotation2))
    spread2 = math.sqrt(alphas[0] * rotation2 * rotation2 + alphas[1] * trans * trans)
    s0, s1, s2, s3 = state[0], state[1], state[2], state[3]
    spare = 0.0
    for i in range(x.size):
        s0, s1, s2, s3, a, b = _normals(s0, s1, s2, s3)
        if i & 1:
            c = spare
        else:
            s0, s1, s2, s3, c, spare = _normals(s0, s1, s2, s3)
        heading = theta[i] + rot1 - spread1 * a
        length = trans - spread_trans * b
        x[i] += length * math.cos(heading)
        y[i] += length * math.sin(heading)
        theta[i] = _wrap(heading + rot2 - spread2 * c)
    state[0], state[1], state[2], state[3] = s0, s1, s2, s3


_BEAM_ARGUMENTS = (_arrays.F32_GRID, float32, float32, float32, _arrays.F32_FLAT, _arrays.F32_FLAT)
_BLOCK = 2048  # poses scored together: what is kept of them stays in the processor's nearest caches


@njit(
    void(_arrays.F64_FLAT, _arrays.F64_FLAT, _arrays.F64_FLAT, *_BEAM_ARGUMENTS, _arrays.F64_OUT),
    cache=True,
    nogil=True,
)
def _score(
    xs: Any,
    ys: Any,
    thetas: Any,
    field: Any,
    inverse: Any,
    origin_x: Any,
    origin_y: Any,
    end_x: Any,
    end_y: Any,
    out: Any,
) -> None:
    """Beam by beam: first the cells where it ends for all poses of a block, which vectorizes, then their values.

    Each pose's sum adds the beams in their order, so it does not depend on the machine's vectors or on the block.
    """
    height, width = field.shape
    cells = field.ravel()
    columns, rows, stride = np.float32(width), np.float32(height), np.int32(width)
    zero = np.float32(0.0)
    size = min(xs.size, _BLOCK)
    cos, sin, base_x, base_y = (
        np.empty(size, np.float32),
        np.empty(size, np.float32),
        np.empty(size, np.float32),
        np.empty(size, np.float32),
    )
    match = np.empty(size, np.float32)
    ends = np.empty(size, np.int32)
    for first in range(0, xs.size, _BLOCK):
        count = min(_BLOCK, xs.size - first)
        for i in range(count):
            cos[i] = math.cos(thetas[first + i])
            sin[i] = math.sin(thetas[first + i])
            base_x[i] = (np.float32(xs[first + i]) - origin_x) * inverse
            base_y[i] = (np.float32(ys[first + i]) - origin_y) * inverse
            match[i] = zero
        for k in range(end_x.size):
            ahead, left = end_x[k], end_y[k]
            for i in range(count):
                column = base_x[i] + cos[i] * ahead - sin[i] * left
                row = base_y[i] + sin[i] * ahead + cos[i] * left
                inside = (column >= zero) & (row >= zero) & (column < columns) & (row < rows)
                end = np.int32(np.int32(row) * stride + np.int32(column))
                ends[i] = end if inside else np.int32(-1)
            for i in range(count):
                if ends[i] >= 0:
                    match[i] += cells[np.uint32(ends[i])]
        for i in range(count):
            out[first + i] = match[i] / end_x.size


@njit(
    int64(
        _arrays.F32_FLAT,
        _arrays.F32_FLAT,
        _arrays.F32_FLAT,
        _arrays.F64_FLAT,
        int64,
        int64,
        float64,
        float64,
        float64,
        int64,
        _arrays.U64_OUT,
    ),
    cache=True,
    nogil=True,
)
def _sample_size(
    x: Any,
    y: Any,
    theta: Any,
    cumulated: Any,
    n_min: int,
    n_max: int,
    error: float,
    quantile: float,
    bin_xy: float,
    n_theta: int,
    state: Any,
) -> int:
    """Draw particles until their number suffices for the number of bins that they occupy (Fox 2001)."""
    if n_min >= n_max:
        return n_max
    size = 1024
    while size < 4 * n_max:
        size *= 2
    keys = np.full(size, -1, np.int64)
    mask = size - 1
    bins = 0
    needed = n_min
    drawn = 0
    total = cumulated[cumulated.size - 1]
    s0, s1, s2, s3 = state[0], state[1], state[2], state[3]
    while drawn < needed:
        s0, s1, s2, s3, u = _draw(s0, s1, s2, s3)
        target = u * total
        low = 0
        high = cumulated.size - 1
        while low < high:
            middle = (low + high) // 2
            if cumulated[middle] > target:
                high = middle
            else:
                low = middle + 1
        drawn += 1
        key = _bin_key(x[low], y[low], theta[low], bin_xy, n_theta)
        slot = _hash(key, mask)
        while keys[slot] >= 0 and keys[slot] != key:
            slot = (slot + 1) & mask
        if keys[slot] < 0:
            keys[slot] = key
            bins += 1
            if bins > 1:
                rest = 2.0 / (9.0 * (bins - 1))
                bound = (bins - 1) / (2.0 * error) * (1.0 - rest + math.sqrt(rest) * quantile) ** 3
                needed = max(n_min, min(n_max, math.ceil(bound)))
    state[0], state[1], state[2], state[3] = s0, s1, s2, s3
    return drawn


@njit(
    void(
        _arrays.F32_FLAT,
        _arrays.F32_FLAT,
        _arrays.F32_FLAT,
        _arrays.F64_FLAT,
        _arrays.F32_OUT,
        _arrays.F32_OUT,
        _arrays.F32_OUT,
        _arrays.U64_OUT,
    ),
    cache=True,
    nogil=True,
)
def _draw_low_variance(
    x: Any,
    y: Any,
    theta: Any,
    cumulated: Any,
    new_x: Any,
    new_y: Any,
    new_theta: Any,
    state: Any,
) -> None:
    n = new_x.size
    last = x.size - 1
    s0, s1, s2, s3 = state[0], state[1], state[2], state[3]
    s0, s1, s2, s3, offset = _draw(s0, s1, s2, s3)
    step = cumulated[last] / n
    source = 0
    for i in range(n):
        target = (i + offset) * step
        while source < last and cumulated[source] <= target:
            source += 1
        new_x[i] = x[source]
        new_y[i] = y[source]
        new_theta[i] = theta[source]
    state[0], state[1], state[2], state[3] = s0, s1, s2, s3


@njit(
    types.Array(types.float64, 2, "C")(
        _arrays.F32_FLAT, _arrays.F32_FLAT, _arrays.F32_FLAT, _arrays.F64_FLAT, float64, int64
    ),
    cache=True,
    nogil=True,
)
def _clusters(x: Any, y: Any, theta: Any, weights: Any, bin_xy: float, n_theta: int) -> Any:
    """Return rows of share, x, y, theta and covariance (9), one per group of adjacent bins."""
    n = x.size
    size = 64
    while size < 2 * n:
        size *= 2
    mask = size - 1
    keys = np.full(size, -1, np.int64)
    numbers = np.empty(size, np.int64)
    bin_of = np.empty(n, np.int64)
    bin_keys = np.empty(n, np.int64)
    sums = np.zeros((n, 4))
    bin_theta = _TWO_PI / n_theta
    bins = 0
    for i in range(n):
        key = _bin_key(x[i], y[i], theta[i], bin_xy, n_theta)
        slot = _hash(key, mask)
        while keys[slot] >= 0 and keys[slot] != key:
            slot = (slot + 1) & mask
        if keys[slot] < 0:
            keys[slot] = key
            numbers[slot] = bins
            bin_keys[bins] = key
            bins += 1
        number = numbers[slot]
        bin_of[i] = number
        sums[number, 0] += weights[i]
        sums[number, 1] += weights[i] * x[i]
        sums[number, 2] += weights[i] * y[i]
        sums[number, 3] += weights[i] * _wrap(theta[i] - ((key & 0xFFF) + 0.5) * bin_theta)

    parent = np.arange(bins)
    for number in range(bins):
        key = bin_keys[number]
        heading = key & 0xFFF
        # Half of the neighbours: each of the others finds this bin among its own.
        for dx in range(2):
            for dy in range(-dx, 2):
                for dt in range(-1 if dx > 0 or dy > 0 else 1, 2):
                    other = (
                        (((key >> 36) + dx) << 36)
                        | ((((key >> 12) & 0xFFFFFF) + dy) << 12)
                        | ((heading + dt + n_theta) % n_theta)
                    )
                    slot = _hash(other, mask)
                    while keys[slot] >= 0 and keys[slot] != other:
                        slot = (slot + 1) & mask
                    if keys[slot] < 0:
                        continue
                    a = number
                    while parent[a] != a:
                        parent[a] = parent[parent[a]]
                        a = parent[a]
                    b = numbers[slot]
                    while parent[b] != b:
                        parent[b] = parent[parent[b]]
                        b = parent[b]
                    parent[max(a, b)] = min(a, b)

    index = np.full(bins, -1, np.int64)
    count = 0
    for number in range(bins):
        root = number
        while parent[root] != root:
            root = parent[root]
        if index[root] < 0:
            index[root] = count
            count += 1
        index[number] = index[root]
    table = np.zeros((count, 13))
    heading_sums = np.zeros((count, 2))
    for number in range(bins):
        group = index[number]
        for k in range(3):
            table[group, k] += sums[number, k]
        # The mean within a bin needs no sines; that of the bins is circular.
        share = sums[number, 0]
        if share > 0.0:
            heading_mean = ((bin_keys[number] & 0xFFF) + 0.5) * bin_theta + sums[number, 3] / share
            heading_sums[group, 0] += share * math.cos(heading_mean)
            heading_sums[group, 1] += share * math.sin(heading_mean)
    for group in range(count):
        share = table[group, 0]
        if share > 0.0:
            table[group, 1] /= share
            table[group, 2] /= share
        table[group, 3] = math.atan2(heading_sums[group, 1], heading_sums[group, 0])
    for i in range(n):
        group = index[bin_of[i]]
        share = table[group, 0]
        if share <= 0.0:
            continue
        part = weights[i] / share
        dx_mean = x[i] - table[group, 1]
        dy_mean = y[i] - table[group, 2]
        dtheta_mean = _wrap(theta[i] - table[group, 3])
        table[group, 4] += part * dx_mean * dx_mean
        table[group, 5] += part * dx_mean * dy_mean
        table[group, 6] += part * dx_mean * dtheta_mean
        table[group, 8] += part * dy_mean * dy_mean
        table[group, 9] += part * dy_mean * dtheta_mean
        table[group, 12] += part * dtheta_mean * dtheta_mean
    for group in range(count):
        table[group, 7] = table[group, 5]
        table[group, 10] = table[group, 6]
        table[group, 11] = table[group, 9]
    return table


def rng_state(seed: int) -> NDArray[np.uint64]:
    """Return a generator state, uint64 (4,), from any integer seed (expanded by splitmix64, as its authors advise)."""
    mask = (1 << 64) - 1
    value = seed & mask
    words = []
    for _ in range(4):
        value = (value + 0x9E3779B97F4A7C15) & mask
        mixed = ((value ^ (value >> 30)) * 0xBF58476D1CE4E5B9) & mask
        mixed = ((mixed ^ (mixed >> 27)) * 0x94D049BB133111EB) & mask
        words.append(mixed ^ (mixed >> 31))
    return np.array(words, np.uint64)


def _check_particles(x: NDArray[np.float32], y: NDArray[np.float32], theta: NDArray[np.float32]) -> None:
    for name, array in (("x", x), ("y", y), ("theta", theta)):
        _arrays.exact(array, np.float32, 1, name)
    if not x.size == y.size == theta.size or x.size == 0:
        raise ValueError(f"x, y and theta must have one length above 0, not {x.size}, {y.size} and {theta.size}")


def _check_weights(weights: NDArray[np.float64], n: int) -> None:
    _arrays.exact(weights, np.float64, 1, "weights")
    if weights.size != n:
        raise ValueError(f"weights must have {n} entries, not {weights.size}")


def _check_state(state: NDArray[np.uint64]) -> None:
    _arrays.exact(state, np.uint64, 1, "rng_state")
    if state.size != 4 or not state.any():
        raise ValueError("rng_state must be four words, not all zero: make it with fog_kernels.amcl.rng_state")


def odometry_delta(old: tuple[float, float, float], new: tuple[float, float, float]) -> tuple[float, float, float]:
    """Split the motion between two odometry poses (x, y, theta) into rot1, trans, rot2 (rad, m, rad).

    Below a centimetre the direction of travel is noise: the whole rotation then counts as rot2.
    """
    dx, dy = new[0] - old[0], new[1] - old[1]
    trans = math.hypot(dx, dy)
    rot1 = 0.0 if trans < 0.01 else math.remainder(math.atan2(dy, dx) - old[2], _TWO_PI)
    return rot1, trans, math.remainder(new[2] - old[2] - rot1, _TWO_PI)


def motion_update(
    x: NDArray[np.float32],
    y: NDArray[np.float32],
    theta: NDArray[np.float32],
    delta_rot1: float,
    delta_trans: float,
    delta_rot2: float,
    alphas: ArrayLike,
    rng_state: NDArray[np.uint64],
) -> None:
    """Move all particles in place by a noisy odometry step (rad, m, rad); `alphas` are the model's four.

    alpha1: rotation noise from rotation, alpha2: rotation noise from translation, alpha3: translation noise from
    translation, alpha4: translation noise from rotation (all are variances per squared motion). Raises TypeError or
    ValueError for wrong arrays.
    """
    _check_particles(x, y, theta)
    _check_state(rng_state)
    noise = _arrays.vector(alphas, "alphas")
    step = (float(delta_rot1), float(delta_trans), float(delta_rot2))
    if noise.size != 4 or not (noise >= 0.0).all() or not all(map(math.isfinite, step)):
        raise ValueError("alphas must be four numbers of at least 0, and the motion finite")
    _move(x, y, theta, *step, noise, rng_state)


def _beam_ends(
    beam_angles: ArrayLike, beam_ranges: ArrayLike, resolution: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return where the valid beams end, in cells from the robot's centre in its frame."""
    angles = _arrays.vector(beam_angles, "beam_angles")
    ranges = _arrays.vector(beam_ranges, "beam_ranges")
    if angles.size != ranges.size:
        raise ValueError(f"beam_angles and beam_ranges must have one length, not {angles.size} and {ranges.size}")
    valid = np.isfinite(ranges) & (ranges > 0.0) & np.isfinite(angles)
    ends_x = ranges[valid] * np.cos(angles[valid]) / resolution
    ends_y = ranges[valid] * np.sin(angles[valid]) / resolution
    return ends_x.astype(np.float32), ends_y.astype(np.float32)


def score_poses(
    xs: ArrayLike,
    ys: ArrayLike,
    thetas: ArrayLike,
    field: NDArray[np.float32],
    resolution: float,
    origin_x: float,
    origin_y: float,
    beam_angles: ArrayLike,
    beam_ranges: ArrayLike,
) -> NDArray[np.float64]:
    """Return the mean field value at the beams' ends for each candidate pose, float64 (n,).

    `field`: `likelihood_field` of the map whose lower-left corner is (origin_x, origin_y) in `map`, its cells
    `resolution` wide (m). Beams are radians and metres from the robot's centre, in its frame; ranges that aren't finite
    or above 0 are left out (pass nan for what hit nothing), ends off the map add nothing. Zeros when no beam is valid.
    Raises TypeError or ValueError for wrong types or shapes.
    """
    poses = [_arrays.vector(values, name) for values, name in ((xs, "xs"), (ys, "ys"), (thetas, "thetas"))]
    if not poses[0].size == poses[1].size == poses[2].size:
        raise ValueError("xs, ys and thetas must have one length")
    _arrays.exact(field, np.float32, 2, "field")
    resolution = _arrays.positive(resolution, "resolution")
    ends_x, ends_y = _beam_ends(beam_angles, beam_ranges, resolution)
    out = np.zeros(poses[0].size)
    if ends_x.size:
        _score(
            poses[0], poses[1], poses[2], field, 1.0 / resolution, float(origin_x), float(origin_y), ends_x, ends_y, out
        )
    return out


def _theta_bins(bin_theta: float) -> int:
    return min(max(round(_TWO_PI / _arrays.positive(bin_theta, "bin_theta")), 3), 4096)


def resample(
    x: NDArray[np.float32],
    y: NDArray[np.float32],
    theta: NDArray[np.float32],
    weights: NDArray[np.float64],
    n_min: int,
    n_max: int,
    kld_err: float,
    rng_state: NDArray[np.uint64],
    kld_z: float = KLD_Z,
    bin_xy: float = BIN_XY,
    bin_theta: float = BIN_THETA,
) -> Resampled:
    """Draw new particles in proportion to the weights; their number, n_min..n_max, depends on their spread.

    With this number the Kullback-Leibler distance between the samples and the distribution over bins stays below
    `kld_err` with the confidence of the quantile `kld_z` (Fox 2001); the draw is systematic, with low variance.
    n_min = n_max gives a fixed number.
    Raises TypeError or ValueError for wrong types, shapes or ranges, and when no weight is above 0.
    """
    _check_particles(x, y, theta)
    _check_weights(weights, x.size)
    _check_state(rng_state)
    if not 1 <= n_min <= n_max:
        raise ValueError(f"n_min must be at least 1 and at most n_max, not {n_min} and {n_max}")
    cumulated = np.cumsum(weights)
    if not (np.isfinite(cumulated[-1]) and cumulated[-1] > 0.0 and weights.min() >= 0.0):
        raise ValueError("weights must be at least 0 and not all 0")
    n = int(
        _sample_size(
            x,
            y,
            theta,
            cumulated,
            n_min,
            n_max,
            _arrays.positive(kld_err, "kld_err"),
            float(kld_z),
            _arrays.positive(bin_xy, "bin_xy"),
            _theta_bins(bin_theta),
            rng_state,
        )
    )
    new_x, new_y, new_theta = (np.empty(n, np.float32) for _ in range(3))
    _draw_low_variance(x, y, theta, cumulated, new_x, new_y, new_theta, rng_state)
    return Resampled(new_x, new_y, new_theta, np.full(n, 1.0 / n))


def clusters(
    x: NDArray[np.float32],
    y: NDArray[np.float32],
    theta: NDArray[np.float32],
    weights: NDArray[np.float64],
    bin_xy: float = BIN_XY,
    bin_theta: float = BIN_THETA,
) -> list[Cluster]:
    """Group particles in adjacent bins and return the groups, highest weight first.

    Raises TypeError or ValueError for wrong types or shapes, and when no weight is above 0.
    """
    _check_particles(x, y, theta)
    _check_weights(weights, x.size)
    table = _clusters(x, y, theta, weights, _arrays.positive(bin_xy, "bin_xy"), _theta_bins(bin_theta))
    total = float(table[:, 0].sum())
    if not (math.isfinite(total) and total > 0.0):
        raise ValueError("weights must be finite and not all 0")
    return [
        Cluster(
            share=float(row[0]) / total,
            estimate=Estimate(float(row[1]), float(row[2]), float(row[3]), row[4:].reshape(3, 3).copy()),
        )
        for row in table[np.argsort(-table[:, 0], kind="stable")]
    ]


def estimate(
    x: NDArray[np.float32],
    y: NDArray[np.float32],
    theta: NDArray[np.float32],
    weights: NDArray[np.float64],
    bin_xy: float = BIN_XY,
    bin_theta: float = BIN_THETA,
) -> Estimate:
    """Return mean and covariance of the cluster with the highest weight; errors as for `clusters`."""
    return clusters(x, y, theta, weights, bin_xy, bin_theta)[0].estimate
