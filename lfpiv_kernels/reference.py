"""Slow, obvious NumPy twins of the kernels: their specification and the oracle of their tests. Do not optimise them."""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr

from lfpiv_kernels.weights.microimages import LAYERS


def position(model: np.ndarray, pupil: np.ndarray) -> np.ndarray:
    """Return (s, t) [mm] of a voxel's rays through pupil points, shape (..., 2); `model`: ``ray_model.MODEL_SIZE``."""
    u, v = pupil[..., 0], pupil[..., 1]
    terms = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v, u**3, u * u * v, u * v * v, v**3], axis=-1)
    return np.stack([terms @ np.append(model[:6], model[30:34]), terms @ np.append(model[6:12], model[34:])], axis=-1)


def slope(model: np.ndarray, pupil: np.ndarray) -> np.ndarray:
    """Return K = d(s, t)/d(u, v) at one pupil point, shape (2, 2)."""
    u, v = pupil
    along_u = np.array([0, 1, 0, 2 * u, v, 0, 3 * u * u, 2 * u * v, v * v, 0])
    along_v = np.array([0, 0, 1, 0, u, 2 * v, 0, u * u, 2 * u * v, 3 * v * v])
    both = np.append(model[:6], model[30:34]), np.append(model[6:12], model[34:])
    return np.array([[along_u @ c, along_v @ c] for c in both])


def smeared_step(x, widths):
    """Return the integral from -infinity to x of a unit mass smeared by two boxes, the wider one first."""
    wide, narrow = widths

    def ramp(y):
        return np.where(y > narrow / 2, y, np.where(y < -narrow / 2, 0.0, (y + narrow / 2) ** 2 / (2 * narrow)))

    return (ramp(x + wide / 2) - ramp(x - wide / 2)) / wide


def two_widths(smears):
    """Return the widest smear and one box with the variance of the others, the wider one first."""
    smears = np.sort(np.abs(smears))
    rest = np.sqrt((smears[:-1] ** 2).sum())
    return max(smears[-1], rest, 1e-4), max(min(smears[-1], rest), 1e-4)


def footprint(model, *, optics, lattice, frame, rectangles, local=False):
    """Return the sensor image of one voxel's weights: the formulas of ``weights.footprint`` pixel by pixel.

    Parameters
    ----------
    model : ndarray, shape (38,)
        Ray model.
    optics, lattice
        Values with the attributes of ``lfpiv.geometry.optics.Optics`` and ``LensLattice``.
    frame, rectangles
        From ``lattice.cell_frame`` and ``lattice.cell_rectangles``.
    local : bool
        Take each pixel's slope for its offset in place of the slope at the middle of what the lens sees. Smears follow
        from the middle.
    """
    model = np.asarray(model, float)
    r, pixel, radius = optics.sensor_per_pupil, optics.pixel_mm, optics.pupil_radius_mm
    width = pixel / r
    image = np.zeros(optics.sensor_shape)
    rows, columns = optics.sensor_shape
    row, column = np.mgrid[:rows, :columns]
    position_mm = np.stack([(column + 0.5 - columns / 2) * pixel, (row + 0.5 - rows / 2) * pixel], axis=-1)
    middle = lattice.nearest(position(model, np.zeros(2)))
    reach = 2 + int(np.ceil(np.abs(slope(model, np.zeros(2))).max() * radius / lattice.pitch_mm * 1.3))
    for i in range(middle[0] - reach, middle[0] + reach + 1):
        for j in range(middle[1] - reach, middle[1] + reach + 1):
            centre = lattice.centres_mm(np.array([i, j]))
            pupil = ((1 + r) * centre - position_mm) / r
            near = (np.abs(pupil) < radius + 2 * width).all(-1)
            if not near.any():
                continue
            points = pupil[near]
            offset = position(model, points) - centre
            weight = np.zeros(len(points))
            jacobian0 = np.linalg.inv(np.eye(2) - slope(model, np.zeros(2)))
            rough = np.abs((offset @ jacobian0.T) @ np.asarray(frame).T).max(-1)
            if rough.min() > 4:
                continue
            seen = rough < 4
            lit = rough < 1  # rays in the lens's cell, smeared
            at = points[lit if lit.any() else seen].mean(0)
            at *= min(1.0, radius / max(np.linalg.norm(at), 1e-9))
            k_slope = slope(model, at)
            turn = np.asarray(frame) @ np.linalg.inv(np.eye(2) - k_slope)
            edges = [
                model[12 + 2 * a : 14 + 2 * a] + model[18 + 4 * a : 22 + 4 * a].reshape(2, 2) @ at for a in range(3)
            ]
            smear = np.stack([turn @ edge for edge in edges] + list((turn @ k_slope * width).T), axis=1)
            widths = [two_widths(smear[0]), two_widths(smear[1])]
            for k in np.flatnonzero(seen):
                distance = np.linalg.norm(points[k])
                normal = np.sort(np.abs(points[k]) / max(distance, 1e-9))[::-1]
                bent = width / (24 * radius)  # the edge is taken as straight, moved by its mean curvature
                covered = float(
                    np.clip(smeared_step((radius - distance) / width - bent, np.maximum(normal, 1e-4)), 0, 1)
                )
                if covered <= 0:
                    continue
                # the middle of the part of the pixel inside the pupil
                seen_at = points[k] * (1 - (1 - covered) / 2 * width / max(distance, width))
                jacobian = np.linalg.inv(np.eye(2) - slope(model, seen_at if local else at))
                a, b = np.asarray(frame) @ jacobian @ (position(model, seen_at) - centre)
                inside = sum(
                    (smeared_step(q[1] - a, widths[0]) - smeared_step(q[0] - a, widths[0]))
                    * (smeared_step(q[3] - b, widths[1]) - smeared_step(q[2] - b, widths[1]))
                    for q in np.asarray(rectangles, float)
                )
                weight[k] = covered * inside * width**2 / (np.pi * radius**2) * abs(np.linalg.det(jacobian))
            image[near] += weight
    return image


def count(rays, shift, window, first_pixel, *, optics, lattice, samples, shape):
    """Count the rays per pixel, ray by ray; arguments and results as in ``rays.count.count_rays``."""
    counts = np.zeros((len(first_pixel), *shape), np.int64)
    total = np.zeros(len(first_pixel), np.int64)
    step = 2 * optics.pupil_radius_mm / samples
    rows, columns = optics.sensor_shape
    a, b = np.mgrid[:samples, :samples]
    for point in range(len(rays)):
        u = (a + shift[point, 0]) * step - optics.pupil_radius_mm
        v = (b + shift[point, 1]) * step - optics.pupil_radius_mm
        seen = u * u + v * v <= optics.pupil_radius_mm**2
        u, v = u[seen], v[seen]
        terms = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v, u**3, u * u * v, u * v * v, v**3])
        st = (np.asarray(rays[point], float) @ terms).T
        centre = lattice.centres_mm(lattice.nearest(st))
        x = (centre + optics.sensor_per_pupil * (st - np.stack([u, v], axis=1))) / optics.pixel_mm
        column = np.floor(x[:, 0] + columns / 2).astype(int) - first_pixel[window[point], 0]
        row = np.floor(x[:, 1] + rows / 2).astype(int) - first_pixel[window[point], 1]
        hit = (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])
        np.add.at(counts, (window[point], row[hit], column[hit]), 1)
        total[window[point]] += len(u)
    return counts, total


def counted(model, first_voxel, points, bits, *, optics, lattice):
    """Return the share of each voxel's rays that reaches each pixel, shape (voxel, rows * columns).

    `points` are those of ``counted_blocks.sobol_points``, with `bits` bits; `model` and `first_voxel` are as in
    ``counted_blocks.CountedBlocks.compute``.
    """
    rows, columns = optics.sensor_shape
    images = np.zeros((len(model), rows * columns))
    for number, own in enumerate(np.asarray(model, float)):
        shift = np.arange(5, dtype=np.uint64) + np.uint64(5 * (first_voxel + number))
        for bits_down, factor in ((16, 0x85EBCA6B), (13, 0xC2B2AE35)):
            shift = ((shift ^ (shift >> np.uint64(bits_down))) * np.uint64(factor)) & np.uint64(0xFFFFFFFF)
        shift = (shift ^ (shift >> np.uint64(16))) >> np.uint64(32 - bits)
        at = (points ^ shift.astype(np.int64)[:, None]) / 2.0**bits + 2.0**-25
        a, b = 2 * at[3] - 1, 2 * at[4] - 1
        wide = np.abs(a) > np.abs(b)
        radius = np.where(wide, a, b)
        angle = np.pi / 4 * np.where(wide, b, a) / radius
        u, v = radius * np.cos(angle), radius * np.sin(angle)
        u, v = optics.pupil_radius_mm * np.where(wide, u, v), optics.pupil_radius_mm * np.where(wide, v, u)
        st = position(own, np.stack([u, v], axis=1)).T
        for axis in range(3):
            edge = own[12 + 2 * axis : 14 + 2 * axis, None]
            slope = own[18 + 4 * axis : 22 + 4 * axis].reshape(2, 2)
            st = st + (at[axis] - 0.5) * (edge + slope @ np.stack([u, v]))
        st = st.T
        centre = lattice.centres_mm(lattice.nearest(st))
        x = (centre + optics.sensor_per_pupil * (st - np.stack([u, v], axis=1))) / optics.pixel_mm
        column, row = np.floor(x + (columns / 2, rows / 2)).astype(int).T
        seen = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        np.add.at(images[number], row[seen] * columns + column[seen], 1 / points.shape[1])
    return images


def gaussian_image(trace, point, sigma_mm, *, optics, lattice, microimages, frame, rectangles):
    """Return the image of a Gaussian particle pixel by pixel, shape (rows * columns,); see ``weights.gaussian``.

    ``trace(points, pupil)`` is the exact mapping (x, y, z), (u, v) -> (s, t).
    """
    ratio, cell = optics.sensor_per_pupil, optics.pixel_mm / optics.sensor_per_pupil
    rows, columns = optics.sensor_shape
    image, edge, step = np.zeros(rows * columns), microimages.edge, 1e-3
    turned_lenses = microimages.corner.shape[:2]
    for j in range(turned_lenses[0]):
        for i in range(turned_lenses[1]):
            first = (j * LAYERS + 1) * turned_lenses[1] * edge**2 + i * edge**2
            ray = np.arange(first, first + edge**2)
            ray = ray[(microimages.share[ray] > 0) & (microimages.pixel[ray] >= 0)]
            if not len(ray):
                continue
            pixel, share = microimages.pixel[ray], microimages.share[ray].astype(float)
            centre = lattice.centres_mm(np.array([i, j]) + np.asarray(microimages.first_lens))
            sensor = np.stack([pixel % columns + 0.5 - columns / 2, pixel // columns + 0.5 - rows / 2], axis=1)
            pupil = (centre * (1 + ratio) - sensor * optics.pixel_mm) / ratio
            radius = np.maximum(np.linalg.norm(pupil, axis=1), cell)
            pupil *= (1 - (1 - share) * 0.5 * cell / radius)[:, None]
            here = np.repeat(np.asarray(point, float)[None], len(ray), axis=0)
            slope = [trace(here, pupil + step * unit) - trace(here, pupil - step * unit) for unit in np.eye(2)]
            slope = np.stack(slope, axis=2) / (2 * step)
            back = np.linalg.inv(np.eye(2) - slope)
            to_cell = np.asarray(frame, float) @ back
            at = np.einsum("nij,nj->ni", to_cell, trace(here, pupil) - centre)
            variance = np.square(to_cell @ slope).sum(2) * cell**2 / 12
            for unit in np.eye(3):
                moved = (trace(here + step * unit, pupil) - trace(here - step * unit, pupil)) / (2 * step)
                variance += np.square(np.einsum("nij,nj->ni", to_cell, moved) * sigma_mm)
            sigma, inside = np.sqrt(variance), 0.0
            for low_a, high_a, low_b, high_b in rectangles:
                along_a = ndtr((high_a - at[:, 0]) / sigma[:, 0]) - ndtr((low_a - at[:, 0]) / sigma[:, 0])
                along_b = ndtr((high_b - at[:, 1]) / sigma[:, 1]) - ndtr((low_b - at[:, 1]) / sigma[:, 1])
                inside = inside + along_a * along_b
            area = cell**2 / (np.pi * optics.pupil_radius_mm**2)
            np.add.at(image, pixel, inside * area * np.abs(np.linalg.det(back)) * share)
    return image


def dense(blocks) -> np.ndarray:
    """Return a ``projector.Blocks`` as a matrix, shape (sensor pixel, voxel), float64: weights of rays times shares."""
    rays = blocks.microimages
    matrix = np.zeros((rays.sensor_shape[0] * rays.sensor_shape[1], len(blocks.scale)))
    for voxel in range(len(blocks.scale)):
        value = blocks.first_value[voxel]
        for block in range(blocks.first_block[voxel], blocks.first_block[voxel + 1]):
            width, height = int(blocks.width[block]), int(blocks.height[block])
            for y in range(height):
                for x in range(width):
                    if blocks.form == "profiles":
                        level = float(blocks.value[value + x]) * float(blocks.value[value + width + y])
                    else:
                        level = float(blocks.value[value + width * y + x])
                    ray = blocks.ray[block] + y * rays.edge + x
                    if rays.share[ray] > 0:
                        matrix[rays.pixel[ray], voxel] += level * blocks.scale[voxel] * rays.share[ray]
            value += width + height if blocks.form == "profiles" else width * height
    return matrix


def separable(weights) -> np.ndarray:
    """Return `SeparableWeights` as a matrix from voxels (z, y, x in memory) to rays, shape (ray, voxel), float64."""
    (rows, planes, columns), blocks = weights.shape, weights.blocks
    strip_rows, parts, block, rim_levels = 16, 2, 16, 400
    rays = np.zeros(
        (weights.ray_rows, weights.strips, weights.lenses, weights.pixels, strip_rows, rows, planes, columns)
    )
    rim = weights.rim.reshape(rays.shape[:5]).astype(float) / rim_levels
    for plane, ray_row, strip in np.ndindex(planes, weights.ray_rows, weights.strips):
        taps = int(weights.down_taps[plane])
        size = weights.ray_rows * weights.strips * blocks * strip_rows * taps * block
        start = weights.down_start[plane]
        down = weights.down[start : start + size].reshape(
            weights.ray_rows, weights.strips, blocks, strip_rows, taps, block
        )
        line = np.zeros(
            (columns, strip_rows, rows, columns)
        )  # weight of a voxel of the plane on each element of the line
        for column, lane, tap in np.ndindex(columns, strip_rows, taps):
            first = int(weights.down_first[plane, ray_row, strip, column // block, lane])
            if 0 <= first and first + tap < rows:
                level = float(down[ray_row, strip, column // block, lane, tap, column % block])
                line[column, lane, first + tap, column] = level * weights.down_scale[plane]
        lane = np.arange(strip_rows)
        lens_row = lane // parts - (strip_rows // parts - 1) / 2
        row = ray_row + 0.5 - weights.middle[strip * strip_rows + lane]
        along = (weights.turn[plane, strip, 0] * lens_row + weights.turn[plane, strip, 1] * row)[:, None, None]
        before, behind = np.zeros_like(line), np.zeros_like(line)
        before[1:], behind[:-1] = line[:-1], line[1:]
        line = along * (along + 1) / 2 * before + (1 - along**2) * line + along * (along - 1) / 2 * behind
        count, taps = int(weights.lens_count[plane, strip]), int(weights.taps[plane, strip])
        first = weights.first[weights.first_start[plane, strip] :][: count * weights.pixels]
        level = weights.level[weights.level_start[plane, strip] :][: count * weights.pixels * taps * parts]
        level = level.reshape(count, weights.pixels, taps, parts).astype(float)
        for lens, pixel, tap in np.ndindex(count, weights.pixels, taps):
            column = int(first.reshape(count, -1)[lens, pixel]) + tap
            if column < columns:
                value = level[lens, pixel, tap, lane % parts][:, None, None]
                at = ray_row, strip, weights.lens[plane, strip] + lens, pixel
                rays[at][:, :, plane] += value * line[column]
    behind, before = np.zeros_like(rays), np.zeros_like(rays)
    behind[:, :, :, :-1], before[:, :, :, 1:] = rays[:, :, :, 1:], rays[:, :, :, :-1]
    rays = rays + rim[..., None, None, None] * (behind - before)
    order = [5 + weights.axes.index(axis) for axis in range(3)]
    return rays.transpose(0, 1, 2, 3, 4, *order).reshape(weights.rim.size, -1)


def smart(matrix, image, volume, *, iterations, relaxation=1.0, floor=0.0, paper=False):
    """Return SMART's volume with a dense matrix (pixel, voxel): Eq. 5 normalised by column, or as printed (`paper`)."""
    column_sum = matrix.sum(0)
    pixels = (matrix > 0).sum(0)
    for _ in range(iterations):
        projected = matrix @ volume
        seen = projected + floor > 0
        ratio = np.zeros_like(projected)
        ratio[seen] = np.log((image[seen] + floor) / (projected[seen] + floor))
        exponent = matrix.T @ ratio
        scale = matrix.max() * pixels if paper else column_sum
        volume = volume * np.exp(relaxation * exponent / scale)
    return volume


def ordered_subsets(matrices, images, volume, *, column_sum, epochs, floor, shortening, momentum, extrapolation):
    """Return SMART's volume after epochs over subsets with momentum, each subset a dense matrix (pixel, voxel).

    Parameters
    ----------
    matrices, images : list of ndarray
        Rows of the weights, shape (pixel, voxel), and their counts, shape (pixel,), of each subset.
    volume : ndarray, shape (voxel,)
        First guess, above zero.
    column_sum : ndarray, shape (voxel,)
        Sum of each voxel's weights over all pixels, those of no subset included.
    epochs : int
        Passes over all subsets.
    floor, shortening, momentum, extrapolation : float
        Noise floor, `SHORTENING`, momentum's largest exponent, largest ratio of two iterates that it repeats.
    """
    ahead = last = volume
    time = 1.0
    for epoch in range(epochs):
        for matrix, image in zip(matrices, images, strict=True):
            exponent = matrix.T @ np.log((image + floor) / (matrix @ ahead + floor))
            step = 1 / np.maximum(matrix.sum(0), column_sum / len(matrices)) / (1 + shortening * epoch)
            following = ahead * np.exp(step * exponent)
            later = (1 + np.sqrt(1 + 4 * time**2)) / 2
            ratio = np.clip(following / last, 1 / extrapolation, extrapolation)
            ahead, last = following * ratio ** min((time - 1) / later, momentum), following
            time = later
    return ahead


def transport(moved, share=1.0):
    """Matrix of `lfpiv_kernels.reconstruction.transport`: column k is voxel k moved by share * moved, (3, z, y, x)."""
    shape = moved.shape[1:]
    columns = []
    for voxel, d in zip(np.ndindex(*shape), share * moved.reshape(3, -1).T.astype(float), strict=True):
        weights = []
        for place, count in zip(np.add(voxel, d), shape, strict=True):
            far = np.abs(np.arange(count) - place)
            weights.append(np.where(far < 1, 2 / 3 - far**2 + far**3 / 2, np.maximum(2 - far, 0) ** 3 / 6))
        columns.append(np.einsum("z,y,x->zyx", *weights).ravel())
    return np.stack(columns, axis=1)
