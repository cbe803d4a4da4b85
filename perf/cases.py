"""Benchmark cases: each names an operation, its settings and a scale.

The function of an operation prepares its inputs and returns a `Work`: the timed call, the check of its result, and the
same work by other software. Calls of users are in `calls`.
"""

from __future__ import annotations

import tempfile

import numpy as np
from inputs import explicit, grid, nonzeros, rig
from scipy import ndimage, optimize
from threadpoolctl import threadpool_limits
from work import BARE_CORRELATION, SHIFT, Work, particles, require

import lfpiv
from lfpiv.calibration.training import TrainingSettings, train
from lfpiv.geometry.grid import Grid
from lfpiv.settings.processing import Compute
from lfpiv.weights.checks import compare_with_count
from lfpiv_kernels import runtime
from lfpiv_kernels.correlation import correlate, deform
from lfpiv_kernels.rays import mapping

SCALES = {
    "small": {"voxels": 32, "sensor": (720, 1000), "rays": 4_000_000, "volume": (48, 64, 64), "samples": 8_000},
    "medium": {"voxels": 64, "sensor": (1360, 1880), "rays": 20_000_000, "volume": (70, 140, 140), "samples": 40_000},
    "paper": {"voxels": 100, "sensor": (2048, 2800), "rays": 40_000_000, "volume": (100, 100, 100), "samples": 197_570},
}
"""Edge of the cubic grid of 0.1 mm voxels, sensor (rows, columns), rays through the mapping, particle volumes of the
correlation (z, y, x), training samples. "paper": the published case, 3e9 weights."""

PEER_VOXELS = 32
"""Largest volume edge whose weights are also written as an explicit sparse matrix."""
NEAR = 2e-4
"""Largest error of the single-precision mapping [microlens pitch]."""
FOOTPRINT = 0.025
"""Largest mean relative L2 difference of footprint from counted weights: the goal of 0.02 and the count's noise."""
ADJOINT = 1e-5
"""Largest relative difference of the two products, sums of positive float32 terms in vector lanes and eight chunks."""
PEER_F32, PEER_SMART = 1e-5, 1e-3
"""Largest relative difference from an explicit float32 matrix, of one pass and of ten iterations."""
BIAS_VOXEL = {8: 0.02, 16: 0.01}
"""Largest bias of the displacement by window edge: the project's goals [voxel]."""
LABEL_NOISE = 0.04
"""Noise of the training labels per axis [microlens pitch]."""
DEMO_VOXEL = 0.5
"""Largest mean displacement error of the demo [voxel]."""

BARE_SMART = {"intensity_cap": 0.0, "sieve_voxel": 0.0, "subsets": 1, "tolerance": 0.0}
"""SMART as the peers do it, in a given number of iterations, whatever the defaults are."""


def prepare(name: str) -> Work:
    """Prepare a case. This is not timed."""
    maker, settings, scale = CASES[name]
    return maker(SCALES[scale], **settings)


def relative(found, expected, limit: float) -> dict[str, float]:
    """Return the relative L2 difference of two arrays. Require it to be below the limit."""
    difference = float(np.linalg.norm(found - expected) / np.linalg.norm(expected))
    require(difference < limit, f"a relative difference of {difference:.1e}")
    return {"difference": difference}


def _mapping(scale) -> Work:
    camera = rig(scale["sensor"]).cameras["cam1"]
    rng, fan = np.random.default_rng(1), 19
    pupil = rng.uniform(-8, 8, (fan, 2)).astype(np.float32)
    points = rng.uniform(-5, 5, (scale["rays"] // fan, 3)).astype(np.float32)
    arrays, out = camera.network.to_arrays() | camera.baseline.to_arrays(), np.empty((len(points), fan, 2), np.float32)

    def check(rays):
        exact = camera.map(np.repeat(points[:500], fan, 0), np.tile(pupil, (500, 1)))
        error = float(np.abs(rays[:500].reshape(-1, 2) - exact).max() / camera.lattice.pitch_mm)
        require(error < NEAR, f"rays are off by {error:.1e} pitch")
        return {"largest_error_pitch": error}

    count = len(points) * fan  # multiply-adds of a 5-20-2 network, and an exponential of eleven operations per node
    run = lambda: mapping.evaluate(arrays, points, pupil, out=out)  # noqa: E731
    return Work(run, check, {"rays": count}, read_bytes=8 * count, flops=count * (2 * 140 + 20 * 14))


def _count(scale, edge) -> Work:
    calibration = rig(scale["sensor"])
    voxels = Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(0.1 * edge,) * 3, voxel_mm=0.1)

    def check(weights):
        loss = float(np.abs(weights.column_sum / 2 - 1).max())
        require(loss < 0.02, f"a voxel's counts are {loss:.3f} off one per camera")  # rounded to levels
        return {"lost_share": loss, "stored_bytes": weights.memory_bytes}

    run = lambda: lfpiv.build_weights(calibration, voxels, "count")  # noqa: E731
    return Work(run, check, {"rays": 2 * voxels.size * Compute().count_rays})


def _footprint(scale, form, bent_mm=0.0) -> Work:
    calibration, voxels = rig(scale["sensor"], bent_mm), grid(scale)
    amounts: dict[str, float] = {"voxel_camera": 2 * voxels.size}
    work = Work(lambda: lfpiv.build_weights(calibration, voxels, form=form), lambda _: {}, amounts)

    def check(weights):
        sums = np.abs(weights.column_sum / 2 - 1)
        require(float(np.median(sums)) < 0.01, f"a voxel's weights sum to 1 +- {np.median(sums):.3f} per camera")
        error = float(np.mean(list(compare_with_count(weights).values())))
        require(error < FOOTPRINT, f"footprint differs from counted rays by {error:.3f}")
        amounts["weights"] = nonzeros(weights)
        work.read_bytes = weights.memory_bytes
        return {"difference_from_count": error, "stored_bytes": weights.memory_bytes}

    work.check = check
    return work


def _weights(scale, form):
    """Build the weights: where peers do the same work, those of all voxels, which are an explicit matrix."""
    return lfpiv.build_weights(rig(scale["sensor"]), grid(scale), form=form, planes=scale["voxels"] > PEER_VOXELS)


def _projection(scale, forward, form="profiles") -> Work:
    weights, rng = _weights(scale, form), np.random.default_rng(3)
    volume = rng.random(weights.grid.shape, np.float32)
    images = {name: rng.random(camera.gain.shape, np.float32) for name, camera in weights.cameras.items()}
    forth, back = weights(volume), weights.T(images)

    def check(_):
        products = [np.vdot(forth[name].astype(float), images[name]) for name in images]
        gap = abs(float(sum(products) / np.vdot(back.astype(float), volume)) - 1)
        require(gap < ADJOINT, f"projection and back projection are not adjoint: {gap:.1e}")
        return {"adjoint_gap": gap, "stored_bytes": weights.memory_bytes}

    count = nonzeros(weights)
    work = Work(
        (lambda: weights(volume, out=forth)) if forward else (lambda: weights.T(images, out=back)),
        check,
        {"voxel_camera": 2 * weights.grid.size, "weights": count},
        read_bytes=weights.memory_bytes,
        flops=2 * count,
    )
    if scale["voxels"] <= PEER_VOXELS:
        matrices, flat = explicit(weights), weights.stored.store(volume)
        if forward:
            work.peers["scipy_csr"] = lambda: {name: matrix @ flat for name, (_, matrix) in matrices.items()}
            work.peer_check = lambda done: relative(done["cam1"], forth["cam1"].ravel(), PEER_F32)
        else:
            work.peers["scipy_csr"] = lambda: sum(
                matrix @ images[name].ravel() for name, (matrix, _) in matrices.items()
            )
            work.peer_check = lambda done: relative(done, weights.stored.store(back), PEER_F32)
    return work


def _smart(scale, iterations, form="profiles") -> Work:
    weights = _weights(scale, form)
    truth = 1e4 * particles(weights.grid.shape)
    images = weights(truth)
    first = np.full(weights.grid.shape, float(truth.mean()), np.float32)
    bare = {"accelerate": False, "floor_share": 0.0, **BARE_SMART}  # as the peer; momentum costs the same per iteration
    require(bool((weights.column_sum > 0).all()), "a voxel is seen by no camera")  # all voxels active

    def check(volume):
        misfit = np.array(volume.attrs["misfit"])
        require(len(misfit) == iterations + 1 and (np.diff(misfit) < 0).all(), "the misfit does not fall")
        return {"residual": volume.attrs["residual"][-1], "stored_bytes": weights.memory_bytes}

    work = Work(
        lambda: lfpiv.reconstruct(weights, images, iterations, first=first, floor=1.0, **bare),
        check,
        {"iterations": iterations, "voxel_camera": 2 * weights.grid.size * iterations},
        read_bytes=(2 * iterations + 1) * weights.memory_bytes,
        flops=(2 * iterations + 1) * 2 * nonzeros(weights),
    )
    if scale["voxels"] <= PEER_VOXELS:
        ours, matrices = weights.stored.store(work.run()), explicit(weights)
        step, start = 1 / weights.stored.store(weights.column_sum), weights.stored.store(first)

        def peer():
            volume = start
            for _ in range(iterations):
                ratios = {name: (images[name].ravel() + 1) / (m @ volume + 1) for name, (_, m) in matrices.items()}
                volume = volume * np.exp(
                    step * sum(matrices[name][0] @ np.log(ratio) for name, ratio in ratios.items())
                )
            return volume

        work.peers["scipy_csr"], work.peer_check = peer, lambda volume: relative(volume, ours, PEER_SMART)
    return work


def _smart_subsets(scale, passes, plain) -> Work:
    """Prepare a reconstruction by ordered subsets; as many passes over all rays must fit better than plain SMART."""
    weights = lfpiv.build_weights(rig(scale["sensor"]), grid(scale), form="profiles")
    images, rng = weights(2e4 * particles(weights.grid.shape)), np.random.default_rng(2)
    noisy = {name: (image + rng.normal(0, 3, image.shape)).astype(np.float32) for name, image in images.items()}
    keywords = {**BARE_SMART, "sieve_voxel": 0.6}

    def check(volume):
        before = lfpiv.reconstruct(weights, noisy, plain, **keywords).attrs["misfit"][-1]
        ratio = volume.attrs["misfit"][-1] / before
        require(ratio < 1, f"a misfit {ratio:.4f} times that of {plain} plain iterations")
        return {"misfit_ratio": ratio, "stored_bytes": weights.memory_bytes}

    return Work(
        lambda: lfpiv.reconstruct(weights, noisy, passes, **{**keywords, "subsets": "auto"}),
        check,
        {"passes": passes},
        read_bytes=2 * passes * weights.memory_bytes,
        flops=4 * passes * nonzeros(weights),
    )


def _correlate(scale, window, search=None) -> Work:
    """Prepare the kernel, or without `search` the public function with one pass, its own range and validation."""
    first, second = particles(scale["volume"]), particles(scale["volume"], SHIFT)
    cube = (window,) * 3

    def run():
        if search is None:
            vectors = lfpiv.correlate(first, second, dt_s=1.0, voxel_mm=0.1, windows=(window,), **BARE_CORRELATION)
            return np.stack([vectors[f"displacement_{axis}"].values for axis in "zyx"], -1)
        peaks = correlate.correlate_windows(first, second, window=cube, step=(window // 2,) * 3, search=(search,) * 3)
        return peaks.displacement

    def bias(displacement):
        vectors = displacement.reshape(-1, 3)
        found = vectors[np.linalg.norm(vectors - SHIFT, axis=1) < 1]  # without spurious vectors
        require(len(found) > 0.8 * len(vectors), f"only {len(found)} of {len(vectors)} vectors are right")
        return {"bias_voxel": float(np.abs(found.mean(0) - SHIFT).max()), "right": len(found) / len(vectors)}

    def check(displacement):
        figures = bias(displacement)
        require(figures["bias_voxel"] < BIAS_VOXEL[window], f"bias of {figures['bias_voxel']:.3f} voxel")
        return figures

    count = correlate.window_grid(first.shape, cube, (window // 2,) * 3)[1]
    work = Work(run, check, {"vectors": int(np.prod(count))}, peer_check=bias)
    try:
        from openpiv.pyprocess3D import extended_search_area_piv3D
    except ImportError:
        return work
    low = tuple(slice(0, min(n, 4 * window)) for n in first.shape)  # its time per vector does not depend on the volume
    part = [volume[low] for volume in (first, second)]
    size = correlate.window_grid(part[0].shape, cube, (window // 2,) * 3)[1]
    work.peer_share = np.prod(size) / np.prod(count)

    def openpiv():
        x, y, z, *_ = extended_search_area_piv3D(
            *part, window_size=cube, overlap=(window // 2,) * 3, search_area_size=cube, dt=(1, 1, 1)
        )
        return np.stack([np.asarray(y), -np.asarray(x), np.asarray(z)], -1)  # its names and signs, our axes

    work.peers["openpiv"] = openpiv
    return work


def _deform(scale) -> Work:
    volumes = particles(scale["volume"]), particles(scale["volume"], SHIFT)
    coefficients = [deform.spline_coefficients(volume) for volume in volumes]
    shape, spacing = scale["volume"], (4.0,) * 3
    nodes = np.stack(np.meshgrid(*[4.0 * np.arange(-(-n // 4) + 1) for n in shape], indexing="ij"), -1)
    displacement = (SHIFT + 0.01 * (nodes - nodes.mean((0, 1, 2)))).astype(np.float32)  # linear: exact between nodes

    def at(indices, sign):
        place = indices + deform.OFFSET
        return place + sign * 0.5 * (SHIFT + 0.01 * (place - nodes.mean((0, 1, 2)))) + deform.MARGIN

    def sampled(indices):
        pairs = zip(coefficients, (-1, 1), strict=True)
        return [
            ndimage.map_coordinates(c, at(indices, s).T, order=3, prefilter=False, mode="nearest") for c, s in pairs
        ]

    def check(result):
        indices = np.random.default_rng(4).integers(8, np.array(shape) - 8, (20_000, 3))
        error = max(float(np.abs(a[tuple(indices.T)] - b).max()) for a, b in zip(result, sampled(indices), strict=True))
        require(error < 1e-3, f"differs from SciPy's spline by {error:.1e}")
        return {"largest_difference": error}

    every = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1).reshape(-1, 3)
    return Work(
        lambda: deform.deform_pair(*coefficients, displacement, spacing),
        check,
        {"voxels": 2 * np.prod(shape)},
        read_bytes=16 * np.prod(shape),
        flops=2 * np.prod(shape) * 200,
        peers={"scipy_map_coordinates": lambda: sampled(every)},
        peer_check=lambda _: {},
    )


def _vectors(scale) -> Work:
    volumes = particles(scale["volume"]), particles(scale["volume"], SHIFT)

    def check(vectors):
        found = np.stack([vectors[f"displacement_{axis}"].values for axis in "zyx"], -1)[1:-1, 1:-1, 1:-1]
        error = float(np.linalg.norm(found - SHIFT, axis=-1).mean())
        require(error < 0.1, f"mean displacement error of {error:.3f} voxel")
        return {"mean_error_voxel": error, "vectors": int(vectors["valid"].size)}

    return Work(lambda: lfpiv.correlate(*volumes, dt_s=1.0, voxel_mm=0.1, **BARE_CORRELATION), check, {"pairs": 1})


def _train(scale, epochs) -> Work:
    camera, rng, count = rig(scale["sensor"], 0.1).cameras["cam1"], np.random.default_rng(5), scale["samples"]
    inputs = rng.uniform(-1, 1, (count, 5)) * [3, 3, 3, 8, 8]
    outputs = camera.map(inputs[:, :3], inputs[:, 3:]) + rng.normal(0, 0.1 * LABEL_NOISE, (count, 2))

    def run(epochs=epochs):
        return train(inputs, outputs, TrainingSettings(epochs=epochs, patience=epochs), unit=camera.lattice.pitch_mm)

    def check(training):
        require(training.epochs == epochs, f"stopped after {training.epochs} epochs")
        whole = train(inputs, outputs, unit=camera.lattice.pitch_mm)  # to its end
        floor = LABEL_NOISE * np.sqrt(np.pi / 2)  # mean length of the labels' noise
        require(whole.sigma_nor < 1.1 * floor, f"sigma_nor {whole.sigma_nor:.4f}, the labels' noise is {floor:.4f}")
        return {"sigma_nor": whole.sigma_nor, "whole_training_s": whole.seconds, "whole_training_epochs": whole.epochs}

    scaled, aim = np.hstack([inputs / [3, 3, 3, 8, 8], np.ones((count, 1))]), outputs / np.abs(outputs).max()
    first = np.concatenate([layer.ravel() for layer in run(1).network.layers()])

    def parts(theta):
        hidden = np.tanh(scaled @ theta[:120].reshape(6, 20))
        return hidden, np.hstack([hidden, scaled[:, 5:]]), theta[120:].reshape(21, 2)

    def residual(theta):
        return np.subtract(parts(theta)[1] @ parts(theta)[2], aim).T.ravel()

    def jacobian(theta):
        hidden, output_inputs, second = parts(theta)
        matrix = np.zeros((2, count, 162))
        for o in range(2):
            inner = (1 - hidden**2) * second[:20, o]
            matrix[o, :, :120] = (scaled[:, :, None] * inner[:, None]).reshape(count, 120)
            matrix[o, :, 120 + o :: 2] = output_inputs
        return matrix.reshape(-1, 162)

    def evaluations(fit):
        work.peer_share = fit.njev / epochs / 0.7  # it uses all samples, ours 70 %
        return {"peer_epochs": fit.njev}

    def peer():
        with threadpool_limits(limits=1, user_api="blas"):  # as ours
            return optimize.least_squares(residual, first, jacobian, method="trf", x_scale="jac", max_nfev=epochs)

    work = Work(run, check, {"epochs": epochs, "samples": epochs * count}, flops=epochs * 0.7 * count * 2 * 162**2)
    work.peers, work.peer_check = {"scipy_least_squares": peer} if count < 20_000 else {}, evaluations
    return work


def _demo(_) -> Work:
    from lfpiv.cli import demo

    def run():
        with tempfile.TemporaryDirectory() as folder:
            return demo.run(folder, device=runtime.device().kind)

    def check(summary):
        error = summary["demo"]["mean_error_voxel"]
        require(error < DEMO_VOXEL, f"mean displacement error of {error:.3f} voxel")
        return {"mean_error_voxel": error}

    return Work(run, check, {"jobs": 1})


OPERATIONS = {
    "mapping": (_mapping, {}),
    "count": (_count, {"edge": 12}),
    "footprint": (_footprint, {"form": "profiles"}),
    "footprint_pixels": (_footprint, {"form": "pixels"}),
    "footprint_bent": (_footprint, {"form": "pixels", "bent_mm": 0.03}),
    "project": (_projection, {"forward": True}),
    "back_project": (_projection, {"forward": False}),
    "smart": (_smart, {"iterations": 10}),
    "smart_subsets": (_smart_subsets, {"passes": 14, "plain": 40}),
    "smart_pixels": (_smart, {"iterations": 10, "form": "pixels"}),
    "correlate_8": (_correlate, {"window": 8, "search": 4}),
    "correlate_16": (_correlate, {"window": 16, "search": 8}),
    "correlate_16_quarter": (_correlate, {"window": 16, "search": 4}),
    "correlate_user_8": (_correlate, {"window": 8}),
    "correlate_user_16": (_correlate, {"window": 16}),
    "deform": (_deform, {}),
    "vectors": (_vectors, {}),
    "train": (_train, {"epochs": 10}),
}
CASES = {f"{name}_{scale}": (*how, scale) for scale in SCALES for name, how in OPERATIONS.items()}
CASES["count_paper"] = (_count, {"edge": SCALES["paper"]["voxels"]}, "paper")  # 8.2e9 rays
CASES["demo"] = (_demo, {}, "small")
"""Name -> the function that prepares the case, its settings, its scale."""
