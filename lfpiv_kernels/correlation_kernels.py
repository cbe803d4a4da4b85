"""Warp kernels of the window correlation; `correlate` launches them.

Vectors of eight lags along x come from one unaligned load: the padded second volume is viewed as rows that start at
every element.
"""

import warp as wp

wp.set_module_options(
    {
        "enable_backward": False,
        "max_unroll": 0,
        "cpu_compiler_flags": wp.config.cpu_compiler_flags + " -ffp-contract=fast",  # fused multiply-add
    }
)

LANES = 8
"""Lags along x per vector, and lag rows along y per thread."""
Row = wp.types.vector(length=LANES, dtype=float)


@wp.func
def _unravel(index: int, shape: wp.vec3i):
    """Index triple (z, y, x) of a linear C-order index."""
    x = index % shape[2]
    y = (index // shape[2]) % shape[1]
    return wp.vec3i(index // (shape[2] * shape[1]), y, x)


@wp.kernel
def _correlate_blocks(
    # in
    first: wp.array(dtype=float),  # first volume, flat, (z * y * x + one spare row,)
    second: wp.array(dtype=Row),  # second volume, padded, as overlapping rows: [i] holds floats i .. i + 7
    first_pitch: wp.vec2i,  # elements per layer and per row of `first`
    second_pitch: wp.vec2i,  # the same of `second`
    grid: wp.vec3i,  # number of blocks per axis
    origin: wp.vec3i,  # first voxel of block (0, 0, 0)
    stride: wp.vec3i,  # distance of blocks [voxel]
    block: wp.vec3i,  # edges of a block [voxel]
    first_block: int,
    # out
    score_out: wp.array4d(dtype=Row),  # sums of products, (block, lag z, lag y, lag x / 8)
):
    index, lag_z, group_y, group_x = wp.tid()
    cell = _unravel(first_block + index, grid)
    z0 = origin[0] + cell[0] * stride[0]
    y0 = origin[1] + cell[1] * stride[1]
    x0 = origin[2] + cell[2] * stride[2]
    row = second_pitch[1]
    s0 = Row()
    s1 = Row()
    s2 = Row()
    s3 = Row()
    s4 = Row()
    s5 = Row()
    s6 = Row()
    s7 = Row()
    for z in range(block[0]):
        for half in range((block[1] + 1) // 2):  # two rows of the block at once share seven of nine loads
            y = 2 * half
            keep = wp.float32(1.0)
            if y + 1 == block[1]:
                keep = wp.float32(0.0)
            i = (z0 + z) * first_pitch[0] + (y0 + y) * first_pitch[1] + x0
            j = (z0 + z + lag_z) * second_pitch[0] + (y0 + y + 8 * group_y) * row + x0 + 8 * group_x
            for x in range(block[2]):
                f = first[i + x]
                g = keep * first[i + x + first_pitch[1]]
                r0 = second[j + x]
                r1 = second[j + x + row]
                r2 = second[j + x + 2 * row]
                r3 = second[j + x + 3 * row]
                r4 = second[j + x + 4 * row]
                r5 = second[j + x + 5 * row]
                r6 = second[j + x + 6 * row]
                r7 = second[j + x + 7 * row]
                r8 = second[j + x + 8 * row]
                s0 += f * r0
                s1 += f * r1
                s2 += f * r2
                s3 += f * r3
                s4 += f * r4
                s5 += f * r5
                s6 += f * r6
                s7 += f * r7
                s0 += g * r1
                s1 += g * r2
                s2 += g * r3
                s3 += g * r4
                s4 += g * r5
                s5 += g * r6
                s6 += g * r7
                s7 += g * r8
    b = first_block + index
    y = 8 * group_y
    score_out[b, lag_z, y, group_x] = s0
    score_out[b, lag_z, y + 1, group_x] = s1
    score_out[b, lag_z, y + 2, group_x] = s2
    score_out[b, lag_z, y + 3, group_x] = s3
    score_out[b, lag_z, y + 4, group_x] = s4
    score_out[b, lag_z, y + 5, group_x] = s5
    score_out[b, lag_z, y + 6, group_x] = s6
    score_out[b, lag_z, y + 7, group_x] = s7


@wp.kernel
def _box_sum(
    # in
    source: wp.array(dtype=Row),  # overlapping rows of a flat volume
    pitch: int,  # distance of the terms [element]
    terms: int,
    rows: int,  # rows of `sum_out`
    batch: int,  # rows per thread
    first_batch: int,
    # out
    sum_out: wp.array(dtype=Row),  # every eighth overlapping row: [i] holds floats 8 i .. 8 i + 7
):
    begin = (first_batch + wp.tid()) * batch
    for index in range(begin, wp.min(begin + batch, rows)):
        total = source[8 * index]
        for k in range(1, terms):
            total += source[8 * index + k * pitch]
        sum_out[index] = total


@wp.kernel
def _normalise(
    # in
    block_score: wp.array4d(dtype=Row),  # sums of products of blocks, (block, lag z, lag y, lag x / 8)
    second_mean: wp.array(dtype=Row),  # window means of the second volume, overlapping rows, padded
    second_scale: wp.array(dtype=Row),  # 1 / sqrt(window sum of squared deviations), the same layout
    first_sum: wp.array(dtype=float),  # window sums of the first volume, (window,)
    first_scale: wp.array(dtype=float),  # as `second_scale`, (window,)
    pitch: wp.vec2i,  # elements per layer and per row of the padded volume
    lags_y: int,
    window_grid: wp.vec3i,  # windows per axis
    block_grid: wp.vec3i,  # blocks per axis
    origin: wp.vec3i,  # first voxel of window (0, 0, 0)
    step: wp.vec3i,  # distance of windows [voxel]
    block_step: wp.vec3i,  # distance of windows [block]
    block_count: wp.vec3i,  # blocks per window and axis
    mirrored: int,  # 1: volumes are swapped and mirrored, windows run backwards; average with what is there
    first_window: int,
    # out
    score_out: wp.array4d(dtype=Row),  # correlation coefficients, (window, lag z, lag y, lag x / 8)
):
    index, lag_z, group_x = wp.tid()
    written = first_window + index
    window = written
    if mirrored == 1:
        window = window_grid[0] * window_grid[1] * window_grid[2] - 1 - written
    cell = _unravel(window, window_grid)
    corner = cell[0] * block_step[0] * block_grid[1] + cell[1] * block_step[1]
    corner = corner * block_grid[2] + cell[2] * block_step[2]
    z = origin[0] + cell[0] * step[0] + lag_z
    y = origin[1] + cell[1] * step[1]
    row = z * pitch[0] + y * pitch[1] + origin[2] + cell[2] * step[2] + 8 * group_x
    mean = first_sum[window]
    scale = first_scale[window]
    for lag_y in range(lags_y):
        total = Row()
        for bz in range(block_count[0]):
            for by in range(block_count[1]):
                b = corner + (bz * block_grid[1] + by) * block_grid[2]
                for bx in range(block_count[2]):
                    total += block_score[b + bx, lag_z, lag_y, group_x]
        j = row + lag_y * pitch[1]
        total -= mean * second_mean[j]
        total = scale * wp.cw_mul(total, second_scale[j])
        if mirrored == 1:
            total = 0.5 * (total + score_out[written, lag_z, lag_y, group_x])
        score_out[written, lag_z, lag_y, group_x] = total


@wp.func
def _three_point(left: float, centre: float, right: float):
    """Offset of a peak from its three values: Gaussian fit, parabola where a neighbour is not positive."""
    a = left
    b = centre
    c = right
    if left > 0.0 and right > 0.0:
        a = wp.log(left)
        b = wp.log(centre)
        c = wp.log(right)
    curvature = a - 2.0 * b + c
    if curvature >= 0.0:
        return wp.float32(0.0)
    return 0.5 * (a - c) / curvature


@wp.func
def _refine(score: wp.array4d(dtype=float), window: int, lag: wp.vec3i, search: wp.vec3i):
    """Displacement (z, y, x) of the peak at a lag inside the search range."""
    z = lag[0]
    y = lag[1]
    x = lag[2]
    centre = score[window, z, y, x]
    return wp.vec3(
        float(z - search[0]) + _three_point(score[window, z - 1, y, x], centre, score[window, z + 1, y, x]),
        float(y - search[1]) + _three_point(score[window, z, y - 1, x], centre, score[window, z, y + 1, x]),
        float(x - search[2]) + _three_point(score[window, z, y, x - 1], centre, score[window, z, y, x + 1]),
    )


@wp.kernel
def _find_peaks(
    # in
    score: wp.array4d(dtype=float),  # correlation coefficients, (window, lag z, lag y, lag x), rows padded
    search: wp.vec3i,  # largest lag per axis
    first_window: int,
    # out
    displacement_out: wp.array2d(dtype=wp.vec3),  # (window, 2): first and second peak
    correlation_out: wp.array2d(dtype=float),  # (window, 2): highest peak, highest more than 2 lags away from it
    found_out: wp.array2d(dtype=int),  # (window, 2): 1 where the peak exists and is not on the border
):
    w = first_window + wp.tid()
    top = wp.vec3i(2 * search[0], 2 * search[1], 2 * search[2])
    best = wp.float32(0.0)
    lag = wp.vec3i(0, 0, 0)
    for z in range(top[0] + 1):
        for y in range(top[1] + 1):
            for x in range(top[2] + 1):
                if score[w, z, y, x] > best:
                    best = score[w, z, y, x]
                    lag = wp.vec3i(z, y, x)
    rival = wp.float32(0.0)
    second = wp.float32(0.0)
    second_lag = wp.vec3i(0, 0, 0)
    for z in range(top[0] + 1):
        for y in range(top[1] + 1):
            for x in range(top[2] + 1):
                value = score[w, z, y, x]
                if value > wp.min(rival, second):
                    distance = wp.max(wp.max(wp.abs(z - lag[0]), wp.abs(y - lag[1])), wp.abs(x - lag[2]))
                    if distance > 2:
                        rival = wp.max(rival, value)
                    inner = z > 0 and y > 0 and x > 0 and z < top[0] and y < top[1] and x < top[2]
                    if inner and distance > 1 and value > second:
                        if (
                            value >= score[w, z - 1, y, x]
                            and value >= score[w, z + 1, y, x]
                            and value >= score[w, z, y - 1, x]
                            and value >= score[w, z, y + 1, x]
                            and value >= score[w, z, y, x - 1]
                            and value >= score[w, z, y, x + 1]
                        ):
                            second = value
                            second_lag = wp.vec3i(z, y, x)
    correlation_out[w, 0] = best
    correlation_out[w, 1] = rival
    inside = wp.min(wp.min(lag[0], lag[1]), lag[2]) > 0
    inside = inside and lag[0] < top[0] and lag[1] < top[1] and lag[2] < top[2]
    found_out[w, 0] = 0
    found_out[w, 1] = 0
    if inside:
        found_out[w, 0] = 1
        displacement_out[w, 0] = _refine(score, w, lag, search)
    if second > 0.0:
        found_out[w, 1] = 1
        displacement_out[w, 1] = _refine(score, w, second_lag, search)
