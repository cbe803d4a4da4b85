"""Counted weights of a grid: kernel against its twin, noise, threads, batches, and a count that was killed."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from support.ideal_rig import IdealCamera, IdealRig, lattice, optics, rotation

import lfpiv
from lfpiv.errors import InputError
from lfpiv.runs import pipeline
from lfpiv.settings.processing import Compute
from lfpiv.weights.counting import count_voxels
from lfpiv.weights.forms import counted
from lfpiv.weights.forms.counted import counter_of
from lfpiv.weights.ray_fit import ray_models
from lfpiv_kernels import reference, runtime
from lfpiv_kernels.rays import counted_blocks

VOXEL_MM = 0.1
RIGS = {
    "square": IdealCamera("square", rotation(45)),
    "hexagonal": IdealCamera(
        "hexagonal", rotation(-45), optics=optics(layout="hexagonal"), lattice=lattice("hexagonal", roll_deg=0.4)
    ),
    "any angle": IdealCamera("any angle", rotation(30, -30, 25), coma=0.01, lattice=lattice(roll_deg=-20.0)),
}
PLACES_MM = {"in focus": (0.02, 0.03, 0.05), "far": (0.1, 0.05, 4.0), "at an edge": (1.25, 0.95, 0.1)}
"""In a camera's own frame."""
EDGES = 2e-3  # of the rays lie within float32's reach of an edge of a lens or a pixel
EXACT = 3e-4  # [pitch] second-order terms within a voxel of 1/2000 of the object distance; found: 1.8e-4
BETTER = 0.8  # of the noise of random rays; Sobol's points had 0.5 to 0.75 of it
NOISE = {4096: 0.37, 131072: 0.04}  # relative L2 per voxel; found: 0.20 to 0.33 and 0.02 to 0.036
GRID = lfpiv.Grid(shape=(4, 3, 5), voxel_mm=VOXEL_MM, first_centre_mm=(0.1, -0.1, -0.2))


def images_of(blocks):
    """Return the weights of every voxel, shape (voxel, pixel)."""
    return reference.dense(blocks).T


def centre_of(camera, place):
    """Return a voxel's centre (x, y, z) [mm]."""
    return tuple(np.array(PLACES_MM[place]) @ camera.pose)


def of_voxel(camera, centre, rays):
    grid = lfpiv.Grid(shape=(1, 1, 1), voxel_mm=VOXEL_MM, first_centre_mm=centre[::-1])
    return lfpiv.build_weights(IdealRig({camera.name: camera}), grid, "count", rays=rays).image(camera.name, (0, 0, 0))


def same(first, second):
    names = "first_block first_value ray height width value scale even_blocks even_values".split()
    return all(getattr(first, name).tobytes() == getattr(second, name).tobytes() for name in names)


def count(camera=RIGS["square"], grid=GRID, **more):
    return lfpiv.build_weights(IdealRig({camera.name: camera}), grid, "count", **more).projector(camera.name).blocks


@pytest.mark.parametrize("name", RIGS)
def test_count_kernel_equals_its_twin(name):
    camera, first, rays = RIGS[name], 7, 4096
    runtime.device()
    models = ray_models(camera, np.array([centre_of(camera, place) for place in PLACES_MM]), VOXEL_MM, "count")
    counter, microimages = counter_of(camera, rays)
    (part,) = counter.compute(models, first)
    blocks, values, even_blocks, _, scale, ray, height, width, value = part
    twin = reference.counted(
        *(models, first, counted_blocks.sobol_points(rays), counted_blocks.BITS),
        optics=camera.optics,
        lattice=camera.lattice,
    )
    starts = [np.concatenate([[0], np.cumsum(counts)]) for counts in (blocks, values)]
    dense = images_of(
        counted.Blocks(
            form="pixels",
            first_block=starts[0],
            first_value=starts[1],
            **{"ray": ray, "height": height, "width": width, "value": value, "scale": scale},
            microimages=microimages,
        )
    )
    assert dense.sum(axis=1)[:2] == pytest.approx(1.0, abs=0.01)  # all rays arrive; levels are rounded
    for own, expected in zip(dense, twin, strict=True):
        level = expected.max() / 510 * 1.01  # half a level, and float32's rounding of the scale
        assert (np.abs(own - expected) > level).sum() <= 2 * EDGES * rays
        assert np.abs(own - expected)[np.abs(own - expected) > level].sum() <= 2 * EDGES
    lens = ray // microimages.edge**2
    odd = (lens % microimages.lenses + lens // microimages.lenses // counted_blocks.LAYERS) % 2
    for voxel, even in enumerate(even_blocks):
        own = odd[starts[0][voxel] : starts[0][voxel + 1]]
        assert not own[:even].any() and own[even:].all()


@pytest.mark.parametrize("name", RIGS)
def test_rays_of_the_models_are_those_of_the_mapping(name):
    camera, rng = RIGS[name], np.random.default_rng(1)
    for centre in (centre_of(camera, place) for place in PLACES_MM):
        own = ray_models(camera, np.array([centre]), VOXEL_MM, "count")[0].astype(float)
        inside, pupil = rng.uniform(-0.5, 0.5, (500, 3)), rng.normal(size=(500, 2))
        pupil *= camera.optics.pupil_radius_mm / np.maximum(np.hypot(*pupil.T), 1)[:, None]
        st = reference.position(own, pupil)
        for axis in range(3):
            slope = own[18 + 4 * axis : 22 + 4 * axis].reshape(2, 2)
            st += inside[:, axis, None] * (own[12 + 2 * axis : 14 + 2 * axis] + pupil @ slope.T)
        exact = camera.map(np.array(centre) + inside * VOXEL_MM, pupil)
        assert np.abs(st - exact).max() <= EXACT * camera.lattice.pitch_mm


@pytest.mark.parametrize("name", RIGS)
@pytest.mark.parametrize("place", ["in focus", "far"])
def test_noise_is_below_that_of_random_rays(name, place):
    camera, centre = RIGS[name], centre_of(RIGS[name], place)
    counts, total, corner = count_voxels(camera, np.array([centre]), VOXEL_MM, samples=72, points=16)
    truth = np.zeros(camera.optics.sensor_shape)
    rows, columns = np.nonzero(counts[0])
    truth[rows + corner[0, 1], columns + corner[0, 0]] = counts[0][rows, columns] / total[0]
    for rays, limit in NOISE.items():
        noise = np.linalg.norm(of_voxel(camera, centre, rays) - truth) / np.linalg.norm(truth)
        random = np.sqrt((truth * (1 - truth)).sum() / rays) / np.linalg.norm(truth)
        whole = np.linalg.norm(np.rint(truth * rays) - truth * rays) / np.linalg.norm(truth * rays)
        assert noise <= min(limit, BETTER * random)
        if rays == 4096:
            assert whole > 0.05  # what whole numbers of 4,096 rays differ at least: 2 % cannot be had


def test_neighbours_have_errors_of_their_own():
    """The same voxel twice, as two voxels of different numbers."""
    camera = RIGS["square"]
    models = np.repeat(ray_models(camera, np.array([centre_of(camera, "far")]), VOXEL_MM, "count"), 2, axis=0)
    twin = reference.counted(
        *(models, 0, counted_blocks.sobol_points(4096), counted_blocks.BITS),
        optics=camera.optics,
        lattice=camera.lattice,
    )
    finest = reference.counted(
        *(models[:1], 5, counted_blocks.sobol_points(1 << 17), counted_blocks.BITS),
        optics=camera.optics,
        lattice=camera.lattice,
    )
    first, second = twin - finest
    assert abs(first @ second) <= 0.2 * np.linalg.norm(first) * np.linalg.norm(second)


def test_counts_do_not_depend_on_threads_lanes_batches_or_room(monkeypatch):
    for camera in RIGS.values():
        expected = count(camera, rays=1024)
        for change in ({"threads": 1}, {"threads": 3}, {"form": "gpu"}):
            other = replace(runtime.device(), **change)
            with monkeypatch.context() as patch:
                patch.setattr(counted_blocks.runtime, "device_of_taichi", lambda other=other: other)
                assert same(count(camera, rays=1024), expected), change
        with monkeypatch.context() as patch:
            patch.setattr(counted, "BATCH_VOXELS", 1)
            patch.setattr(counted_blocks, "CHUNK_VOXELS", 4)
            patch.setattr(counted_blocks, "FIRST_ROOM", (1, 1))
            assert same(count(camera, rays=1024), expected)


BUSY_THREADS = """
from pathlib import Path
import numpy as np
from support.ideal_rig import IdealCamera, rotation
from lfpiv.weights.forms.counted import counter_of
from lfpiv.weights.ray_fit import ray_models
from lfpiv_kernels import runtime
from lfpiv_kernels.rays import counted_blocks

def work():  # of each thread [ns]
    return {task.name: int((task / "schedstat").read_text().split()[0]) for task in Path("/proc/self/task").iterdir()}

runtime.start("cpu", threads=3)
camera = IdealCamera("square", rotation(45))
models = ray_models(camera, np.tile((0.02, 0.03, 0.05) @ camera.pose, (60, 1)), 0.1, "count")
counter, _ = counter_of(camera, counted_blocks.MOST_RAYS)
list(counter.compute(models[:1]))  # compile
before = work()
list(counter.compute(models))
spent = np.array([after - before.get(thread, 0) for thread, after in work().items()])
print((spent >= 0.25 * spent.max()).sum())
"""
"""Program that counts with three threads and prints how many of them worked at least a quarter as long as another."""


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/schedstat").exists(), reason="the system does not tell the work of a thread")
def test_several_threads_count():
    """A loop of few turns runs on one of Taichi's threads, see `runtime.TAICHI_SHARE`. A test process has one core."""
    tests = Path(__file__).resolve().parents[1]
    variables = {name: value for name, value in os.environ.items() if not name.startswith("LFPIV_")}
    variables["PYTHONPATH"] = os.pathsep.join([str(tests), *filter(None, sys.path)])
    done = subprocess.run([sys.executable, "-c", BUSY_THREADS], env=variables, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout.split()[-1]) > 1  # on one core a thread may take the part of another one, too


def test_too_large_weights_are_refused_before_they_are_counted():
    with pytest.raises(InputError, match=r"weights of 4 x 3 x 5 voxels .* need .* GiB as pixels"):
        count(rays=1024, limit_bytes=1000)
    with pytest.raises(ValueError, match=r"rays: expected a power of 2 from 16 to 131072, got 4093\."):
        count(rays=4093)


def test_the_setting_offers_what_the_kernel_can():
    for rays in Compute.model_fields["count_rays"].annotation.__args__:
        assert counted_blocks.BATCH <= rays <= counted_blocks.MOST_RAYS and not rays & (rays - 1)


@pytest.mark.slow
def test_a_run_with_counted_weights_measures_the_same_vectors(small_run, tmp_path, device, brief_run):
    experiment, out = small_run.images(tmp_path / "data"), small_run.calibrated(tmp_path / "out")
    text = experiment.read_text().replace("[smart]\n", "[smart]\nrefinement = 1.0\n")  # a count of few voxels
    experiment.write_text(text + '\n[compute]\nweights = "count"\n')
    summary = pipeline.run(experiment, out, device=device.kind, pairs=(0, 1))
    assert summary["weights"]["method"] == "count"
    assert 0.05 < np.mean(summary["weights"]["count_check_l2"]) < NOISE[4096]  # footprints differ by some 0.01
    apart = []
    for path in sorted((out / "vectors").iterdir()):
        found, known = (
            xr.load_dataset(folder / "vectors" / path.name, engine="h5netcdf") for folder in (out, small_run.out)
        )
        valid = found["valid"].values.astype(bool) & known["valid"].values.astype(bool)
        difference = [found[f"displacement_{axis}"].values - known[f"displacement_{axis}"].values for axis in "xyz"]
        apart.append(np.linalg.norm(difference, axis=0)[valid])
    assert np.median(np.concatenate(apart)) < 0.1  # [voxel]
