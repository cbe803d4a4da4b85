"""Weights: kernels against their twins, footprint against counted rays, and the invariants of a linear operator."""

from dataclasses import replace

import numpy as np
import pytest
from support.ideal_rig import IdealCamera, IdealRig, lattice, optics, rotation, two_cameras

import lfpiv
from lfpiv.lightfield.decoder import disc_fraction
from lfpiv.lightfield.microimage_layout import microimage_centres, microimages_of
from lfpiv.warn import Code, collected
from lfpiv.weights import blocks as weightblocks
from lfpiv.weights import choice, counting
from lfpiv.weights.blocks import WHOLE, PackedCamera, blocks_of
from lfpiv.weights.checks import compare_with_count, estimate_memory
from lfpiv.weights.choice import choose_cuts, choose_form, form_errors
from lfpiv.weights.counting import CountedVoxels, add_entries, count_voxels
from lfpiv.weights.ray_fit import NEAR_PITCH, grid_models, ray_models
from lfpiv.weights.stored_grid import StoredGrid
from lfpiv_kernels import native, reference, runtime
from lfpiv_kernels.rays import count as trace
from lfpiv_kernels.rays.lattice import cell_frame, cell_rectangles, pack_lattice
from lfpiv_kernels.reconstruction.pixel_rays import ALL, RayMap, RaySets
from lfpiv_kernels.weights import footprint, microimages
from lfpiv_kernels.weights import ray_model as raymodel
from lfpiv_kernels.weights.microimages import LAYERS

VOXEL_MM = 0.1
LEVEL = 0.5 / raymodel.LEVELS * 1.1  # rounding to 8 bits, in units of the largest weight; the bound is 4-10 % above it
TOLERANCE_TWIN = 2e-3  # float32 polynomials against float64, of the largest weight
TOLERANCE_SHARE = 2e-6  # [pixel] float32 distances of up to 20 pixels: twice half a unit in the last place
TOLERANCE_EDGE = {
    "pixels": 0.006,
    "profiles": 0.012,
}  # relative L2: profiles know in steps of LAYER_FALL how weights fall there
TOLERANCE_EDGES = 0.002  # of a projected edge: what interpolated rays, half a voxel more apart, make of NEAR_PITCH
FOOTPRINT_MEAN, FOOTPRINT_WORST = 0.02, 0.035  # relative L2 against a converged count: the project's goal
POINTS, SAMPLES = 12, 30  # per voxel edge and pupil axis: noise below 1 %, subtracted by the two counts' difference
TOLERANCE_PARTS = 0.004  # relative L2: parts share the voxel's slopes and edges of the pupil; a voxel is 1/2000 of so
TOLERANCE_ESTIMATE = 0.06  # of a thousand sampled voxels' mean bytes: they vary by a third of it, on a regular grid
SPHERICAL = 0.12  # [pitch at the pupil's edge] third order, which profiles do not follow

VOXELS_MM = np.array([(0.0, 0.0, 0.05), (0.13, 0.2, 0.9), (0.5, 0.6, -0.7), (-0.6, -0.5, 0.8)])


class Spherical(IdealCamera):
    """A camera with a third-order aberration."""

    def map(self, points, pupil):
        unit = np.asarray(pupil) / self.optics.pupil_radius_mm
        return super().map(points, pupil) + SPHERICAL * self.lattice.pitch_mm * unit * (unit**2).sum(-1, keepdims=True)


RIGS = {
    "aligned": IdealCamera("aligned", rotation(45)),
    "misaligned": IdealCamera("misaligned", rotation(33, 3, 2), lattice=lattice(roll_deg=1.0)),
    "elevated": IdealCamera("elevated", rotation(35, 20, 5)),
    "hexagonal": IdealCamera(
        "hexagonal", rotation(-45), optics=optics(layout="hexagonal"), lattice=lattice("hexagonal", roll_deg=0.4)
    ),
    "mild coma": IdealCamera("mild coma", rotation(45), coma=0.01),
    "spherical": Spherical("spherical", rotation(45)),
    "rolled 12": IdealCamera("rolled 12", rotation(45, 0, 12)),
    "rolled 40": IdealCamera("rolled 40", rotation(45, 0, 40)),
    "any angle": IdealCamera("any angle", rotation(30, -30, 25), lattice=lattice(roll_deg=-20.0)),
} | {
    f"hexagonal {roll}": IdealCamera(
        f"hexagonal {roll}", rotation(45), optics=optics(layout="hexagonal"), lattice=lattice("hexagonal", roll)
    )
    for roll in (15, 30, 60)  # lens rows stand or lie along the sensor, by either neighbour, and half way between
}


def whole(image, window, corner):
    """Put a window of the sensor into a whole image."""
    padded = np.zeros((image.shape[0] + 2000, image.shape[1] + 2000))
    column, row = corner + 1000
    padded[row : row + window.shape[0], column : column + window.shape[1]] = window
    return padded[1000:-1000, 1000:-1000]


def counted(camera, centre, seed, voxel_mm):
    counts, total, corner = count_voxels(camera, centre[None], voxel_mm, samples=SAMPLES, points=POINTS, seed=seed)
    return whole(camera.gain, counts[0] / total[0], corner[0])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "microlenses"), [*((name, 1) for name in RIGS), ("rolled 40", 0.5), ("rolled 40", 2), ("hexagonal 15", 2)]
)
def test_footprint_agrees_with_a_converged_count(name, microlenses):
    """At any angle of camera, array and pose, for voxels from half a microlens to two."""
    camera, voxel_mm = RIGS[name], VOXEL_MM * microlenses
    errors = []
    for centre in VOXELS_MM:
        grid = lfpiv.Grid(shape=(1, 1, 1), voxel_mm=voxel_mm, first_centre_mm=tuple(centre[::-1]))
        weights = lfpiv.build_weights(IdealRig({name: camera}), grid)
        image = weights.image(name, (0, 0, 0)).astype(float)
        first, second = (counted(camera, centre, seed, voxel_mm) for seed in (1, 2))
        reference_image = (first + second) / 2
        noise = np.linalg.norm(first - second) / 2  # of the mean of two independent counts
        error = np.sqrt(max(np.linalg.norm(image - reference_image) ** 2 - noise**2, 0.0))
        errors.append(error / np.linalg.norm(reference_image))
        assert image.sum() == pytest.approx(reference_image.sum(), rel=0.01)  # no light gained or lost
    assert np.mean(errors) <= FOOTPRINT_MEAN, errors
    assert np.max(errors) <= FOOTPRINT_WORST, errors


@pytest.mark.slow(but="aligned-pixels")
@pytest.mark.parametrize(
    ("name", "form"),
    [
        ("aligned", "pixels"),
        ("hexagonal", "pixels"),
        ("mild coma", "pixels"),
        ("spherical", "pixels"),
        ("aligned", "profiles"),
    ],
)
def test_footprint_kernel_equals_its_twin(name, form):
    camera = RIGS[name]
    centre = VOXELS_MM[1]
    grid = lfpiv.Grid(shape=(1, 1, 1), voxel_mm=VOXEL_MM, first_centre_mm=tuple(centre[::-1]))
    image = lfpiv.build_weights(IdealRig({name: camera}), grid, form=form).image(name, (0, 0, 0))
    twin = reference.footprint(
        ray_models(camera, centre[None], VOXEL_MM, form)[0],
        optics=camera.optics,
        lattice=camera.lattice,
        frame=cell_frame(camera.lattice.basis_mm, camera.lattice.layout),
        rectangles=cell_rectangles(camera.lattice.layout),
        local=form == "pixels",
    )
    rays = camera.microimages
    whole = np.ones(camera.optics.sensor_shape, bool)  # pixels that lie inside the pupil altogether
    whole.ravel()[rays.pixel[(rays.share > 0) & (rays.share < 1)]] = False
    levels = (1 if form == "pixels" else 2) * LEVEL  # a product of two rounded profiles
    assert np.abs(image - twin)[whole].max() <= (levels + TOLERANCE_TWIN) * twin.max()
    assert np.linalg.norm(image - twin) <= TOLERANCE_EDGE[form] * np.linalg.norm(twin)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "cuts"), [("any angle", (2, 1, 1)), ("hexagonal 15", (1, 1, 2))])
def test_footprints_of_parts_equal_the_twins_of_smaller_voxels(name, cuts):
    coarse = replace(RIGS[name].optics, pixel_mm=0.011, sensor_shape=(200, 240))  # the twin takes its time
    camera = replace(RIGS[name], optics=coarse)
    model = ray_models(camera, VOXELS_MM[1:2], VOXEL_MM)
    image = np.zeros(camera.optics.sensor_shape, np.float32)
    add_entries(image, blocks_of(PackedCamera.from_camera(camera), [model], "pixels", cuts=cuts), 0)
    twin = np.zeros(image.shape)
    edges = model[0, 12:18].reshape(3, 2), model[0, 18:30].reshape(3, 2, 2)
    for part in np.ndindex(*cuts):
        place = (np.array(part) + 0.5) / cuts - 0.5  # of the part in the voxel, in edges
        smaller = model[0].astype(float)
        smaller[[0, 6]] += place @ edges[0]
        smaller[[[1, 2], [7, 8]]] += np.einsum("a,apu->pu", place, edges[1])
        smaller[12:18] /= np.repeat(cuts, 2)
        smaller[18:30] /= np.repeat(cuts, 4)
        twin += reference.footprint(
            smaller,
            optics=camera.optics,
            lattice=camera.lattice,
            frame=cell_frame(camera.lattice.basis_mm, camera.lattice.layout),
            rectangles=cell_rectangles(camera.lattice.layout),
            local=True,
        ) / np.prod(cuts)
    assert np.linalg.norm(image - twin) <= (TOLERANCE_EDGE["pixels"] + TOLERANCE_PARTS) * np.linalg.norm(twin)


@pytest.mark.parametrize(("waves", "step"), [(0, 8), (1, 2), (7, 1)], ids=["smooth", "curved", "rough"])
def test_ray_models_of_a_grid_are_those_of_its_voxels(waves, step, monkeypatch):
    """Interpolated as coarsely as the mapping allows; `waves` of a tenth of a pitch over the grid's length."""
    camera, shape = RIGS["mild coma"], (20, 6, 9)
    ideal, asked = camera.map_fan, []

    def rippled(points, pupil):
        asked.append(len(points))
        wave = np.sin(2 * np.pi * waves * points[:, None, 2:] / (shape[0] * VOXEL_MM))
        return ideal(points, pupil) + np.float32(0.1 * camera.lattice.pitch_mm) * wave.astype(np.float32)

    monkeypatch.setattr(camera, "map_fan", rippled)
    grid = lfpiv.Grid(shape=shape, voxel_mm=VOXEL_MM, first_centre_mm=(-1.0, 0.2, -0.3))
    stored = StoredGrid(grid, (1, 0, 2))
    found = np.concatenate(list(grid_models(camera, stored.shape, stored.positions_mm, (1, 2, 0))))
    assert asked[-1] == np.prod([np.ceil((n + 1) / step) + 1 for n in shape])
    exact = ray_models(camera, stored.centres_mm(np.arange(grid.size)), VOXEL_MM)
    radius = camera.optics.pupil_radius_mm
    powers = np.array([1, radius, radius, radius**2, radius**2, radius**2])
    rays = np.abs((found - exact)[:, :12].reshape(-1, 2, 6) * powers).sum(-1)
    assert rays.max() <= 2 * NEAR_PITCH * camera.lattice.pitch_mm  # a few voxels may be further off than those probed
    if step > 1:  # half the difference of neighbours is not that of opposite faces on waves of three voxels
        assert np.abs((found - exact)[:, 12:18]).max() <= TOLERANCE_EDGES * VOXEL_MM


@pytest.mark.parametrize("layout", ["square", "hexagonal"])
@pytest.mark.parametrize("f_number", [2.5, 4.0, 16.0])  # microimages overlap, touch, are a few pixels wide
def test_rays_lie_where_their_lenses_put_them(layout, f_number):
    eye, lenses = replace(optics(90, 130, layout), f_number=f_number), lattice(layout, roll_deg=2.0)
    radius = eye.pupil_radius_mm * eye.sensor_per_pupil / eye.pixel_mm
    rays = microimages_of(eye, lenses)
    first, centre = microimage_centres(eye, lenses, radius + 1)
    assert tuple(first) == rays.first_lens
    step = np.arange(rays.edge)
    column = rays.corner[..., None, None, 0] + step
    row = rays.corner[..., None, None, 1] + step[:, None]
    seen = (column >= 0) & (column < 130) & (row >= 0) & (row < 90)
    offset = np.stack(np.broadcast_arrays(column, row), -1) + 0.5 - centre[..., None, None, :]
    inside = np.where(seen, disc_fraction(offset.astype(np.float32), radius)[0], 0.0)
    shape = (len(centre), microimages.LAYERS, *inside.shape[1:])
    pixel, share = (array[: np.prod(shape)].reshape(shape) for array in (rays.pixel, rays.share))
    for layer in range(microimages.LAYERS):
        fall = native.constant("microimages.h", "LAYER_FALL") * (layer - microimages.LAYERS // 2)
        np.testing.assert_array_equal(pixel[:, layer], np.where(seen, 130 * row + column, -1))
        np.testing.assert_allclose(share[:, layer], inside * (1 + fall * (1 - inside) / 2), atol=TOLERANCE_SHARE)
    assert (rays.pixel[np.prod(shape) :] == -1).all() and not rays.share[np.prod(shape) :].any()
    covered = np.bincount(rays.pixel[rays.share > 0], minlength=90 * 130)  # no lens is missing
    lit = np.hypot(*np.moveaxis(offset, -1, 0)) < radius
    assert (covered[(row * 130 + column)[seen & lit]] > 0).all()


@pytest.mark.parametrize("divided", ["not at all", "by lenses", "at random"])
def test_a_pixel_knows_its_rays(small, divided):
    """Light of the camera's rays in three parts of memory, of which neighbours overlap."""
    rays = small.cameras["cam1"].microimages
    row, column = np.divmod(np.arange(rays.size) // rays.edge**2, rays.lenses)
    if divided == "not at all":
        sets, set_of = RaySets.single(rays.size), np.zeros(rays.size, int)
    elif divided == "by lenses":
        odd = np.indices(rays.corner.shape[:2]).sum(0) % 2  # (lens along j, lens along i)
        sets, set_of = RaySets.of_lenses(rays), odd[row // LAYERS % len(odd), column]  # rays beyond the last lens
    else:
        of_group = np.random.default_rng(10).integers(0, 5, -(-rays.size // 77)).astype(np.uint8)
        sets, set_of = RaySets(of_group, 77, 5), np.repeat(of_group, 77)[: rays.size].astype(int)
    third = rays.size // 3
    starts, ends = np.array([0, third - 900, 2 * third - 900]), np.array([third, 2 * third, rays.size])
    parts = np.concatenate([[0], np.cumsum(ends - starts)])
    light = (np.random.default_rng(9).random(parts[-1]) < 0.2).astype(np.float32)
    ray_map = RayMap(rays, light, parts, starts, sets=sets)
    found, place = ray_map.rays, np.flatnonzero(light)
    part = np.searchsorted(parts, place, side="right") - 1
    ray = place - parts[part] + starts[part]
    assert len(np.unique(ray)) < len(ray)
    lit = rays.share[ray] > 0
    np.testing.assert_array_equal(found.dark.numpy(), place[~lit])
    pixel, first = np.unique(rays.pixel[ray[lit]], return_index=True)
    sees = np.stack([np.isin(pixel, rays.pixel[ray[lit]][set_of[ray[lit]] == one]) for one in range(sets.count)])
    own = np.where(sees.sum(0) == 1, sees.argmax(0), sets.count)  # those that see several sets are last
    assert (np.bincount(own, minlength=sets.count)[: sets.count] > 0).all() and own.max() == (
        sets.count > 1
    ) * sets.count
    np.testing.assert_array_equal(ray_map.pixel, pixel[np.lexsort((first, own))])
    for number in range(sets.count):
        one = ray_map.rays_of(number)
        np.testing.assert_array_equal(np.sort(ray_map.pixel[one.start : one.end]), pixel[own == number])
    ends = np.cumsum(np.bincount(own, minlength=sets.count)[: sets.count]).tolist()
    assert [(one.start, one.end) for one in ray_map.of_sets] == list(zip([0, *ends], ends, strict=False))
    assert (ray_map.rays_of(ALL).start, ray_map.rays_of(ALL).end) == (0, len(pixel))
    counts = np.diff(found.first.numpy())
    assert found.first.numpy()[0] == 0 and counts.min() > 0
    order = np.lexsort((found.place.numpy(), np.repeat(ray_map.pixel, counts)))
    expected = np.lexsort((place[lit], rays.pixel[ray[lit]]))
    np.testing.assert_array_equal(found.place.numpy()[order], place[lit][expected])
    np.testing.assert_array_equal(found.share.numpy()[order], rays.share[ray[lit]][expected])


@pytest.mark.parametrize("form", footprint.FORMS)
def test_microimages_may_be_higher_than_a_block(form):
    fine = replace(optics(700, 700), pixel_mm=0.0014)  # 71 pixels across a microimage
    grid = lfpiv.Grid(shape=(1, 1, 2), voxel_mm=VOXEL_MM, first_centre_mm=(0.05, 0.0, 0.0))
    weights = lfpiv.build_weights(
        IdealRig({"fine": IdealCamera("fine", rotation(0, 3, 2), optics=fine)}), grid, form=form
    )
    blocks = weights.projector("fine").blocks
    assert blocks.height.max() == footprint.TALLEST and blocks.microimages.edge > footprint.TALLEST
    rays, weight = blocks.entries(0)
    rays = rays[weight > 0]
    assert len(np.unique(rays)) == len(rays)  # blocks do not overlap but where zeros fill them up
    assert weights.image("fine", (0, 0, 0)).sum() == pytest.approx(1.0, rel=0.01)
    assert np.max(compare_with_count(weights)["fine"]) <= FOOTPRINT_WORST


@pytest.mark.parametrize("form", footprint.FORMS)
def test_blocks_do_not_depend_on_how_the_voxels_are_cut(form, monkeypatch):
    grid = lfpiv.Grid.from_extent(centre_mm=(0.1, -0.1, 0.2), size_mm=(0.6, 0.5, 0.4), voxel_mm=VOXEL_MM)
    rig = IdealRig({"mild coma": RIGS["mild coma"]})
    whole = lfpiv.build_weights(rig, grid, form=form).projector("mild coma").blocks
    monkeypatch.setattr(footprint, "SCRATCH_BYTES", 5000)  # a few voxels
    monkeypatch.setattr(weightblocks, "CHUNK_VOXELS", 1)  # a plane of them
    monkeypatch.setattr(weightblocks, "SAMPLED_VOXELS", 1)  # far from the mean: the arrays have to grow
    cut = lfpiv.build_weights(rig, grid, form=form).projector("mild coma").blocks
    for name in ("first_block", "first_value", "ray", "height", "width", "value", "scale"):
        assert getattr(cut, name).tobytes() == getattr(whole, name).tobytes(), name


@pytest.mark.parametrize("layout", ["square", "hexagonal"])
def test_count_kernel_equals_its_twin(layout):
    runtime.device()
    rng = np.random.default_rng(3)
    setup, lenses = optics(layout=layout), lattice(layout, roll_deg=0.7)
    rays = np.zeros((6, 2, 10), np.float32)
    rays[:, :, 0] = rng.uniform(-0.3, 0.3, (6, 2))
    rays[:, [0, 1], [1, 2]] = rng.uniform(0.005, 0.02, (6, 2))
    rays[:, :, 3:6] = rng.normal(0, 1e-5, (6, 2, 3))
    rays[:, :, 6:] = rng.normal(0, 1e-6, (6, 2, 4))
    shift = rng.random((6, 2)).astype(np.float32)
    window, corner = np.array([0, 0, 0, 1, 1, 1], np.int32), np.array([(100, 80), (130, 90)], np.int32)
    count, total = trace.count_rays(
        rays,
        shift,
        window,
        corner,
        raymodel.pack_optics(
            sensor_per_pupil=setup.sensor_per_pupil,
            pixel_mm=setup.pixel_mm,
            sensor_shape=setup.sensor_shape,
            pupil_radius_mm=setup.pupil_radius_mm,
        ),
        pack_lattice(lenses.origin_mm, lenses.basis_mm),
        hexagonal=layout == "hexagonal",
        samples=60,
        shape=(260, 240),
    )
    twin, twin_total = reference.count(
        rays, shift, window, corner, optics=setup, lattice=lenses, samples=60, shape=(260, 240)
    )
    assert count.sum() > 0.9 * total.sum()
    # a ray within float32's reach of an edge may fall to the other side: a few in 17,000
    assert np.abs(total - twin_total).max() <= 4
    assert np.abs(count - twin).sum() <= 2e-3 * total.sum()


@pytest.fixture(scope="module")
def small():
    """A 5 x 6 x 7 grid seen by two misaligned cameras with uneven gain."""
    rig = two_cameras()
    rng = np.random.default_rng(0)
    for camera in rig.cameras.values():
        camera.gain[:] = rng.uniform(0.7, 1.2, camera.gain.shape)
        camera.gain[100:110, 200:220] = 0.0
    grid = lfpiv.Grid.from_extent(centre_mm=(0.1, -0.1, 0.2), size_mm=(0.7, 0.6, 0.5), voxel_mm=VOXEL_MM)
    return lfpiv.build_weights(rig, grid)


@pytest.mark.parametrize("form", footprint.FORMS)
def test_memory_estimate_tells_what_the_weights_themselves_take(form):
    """Rays, which do not depend on the grid, take the larger part of an estimate: without them."""
    rig = two_cameras(optics=optics(rows=100, columns=110))
    grid = lfpiv.Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(0.6, 0.8, 2.0), voxel_mm=0.05)
    nothing = lfpiv.Grid(shape=(1, 1, 1), voxel_mm=0.05, first_centre_mm=(0.0, 50.0, 0.0))
    estimate = estimate_memory(rig, grid, form) - estimate_memory(rig, nothing, form)
    assert estimate == pytest.approx(lfpiv.build_weights(rig, grid, form=form).memory_bytes, rel=TOLERANCE_ESTIMATE)


@pytest.mark.parametrize("form", footprint.FORMS)
def test_largest_weight_is_that_of_a_ray(small, form):
    weights = lfpiv.build_weights(IdealRig(small.cameras), small.grid, form=form)
    largest, bound = [], []
    for name in small.cameras:
        blocks = weights.projector(name).blocks
        entries = [blocks.entries(voxel) for voxel in range(small.grid.size)]
        largest += [(weight * blocks.microimages.share[ray]).max() for ray, weight in entries]
        bound.append(blocks.scale.max() * raymodel.LEVELS ** (2 if form == "profiles" else 1))
    assert weights.largest == pytest.approx(max(largest), rel=1e-12)
    assert max(bound) > 1.03 * weights.largest  # what no weight exceeds is not what one reaches


def test_more_blocks_than_numbers_are_refused(small, monkeypatch):
    camera = small.cameras["cam1"]
    model = ray_models(camera, VOXELS_MM, VOXEL_MM)
    blocks = len(blocks_of(PackedCamera.from_camera(camera), [model], "profiles").ray)
    monkeypatch.setattr(weightblocks, "MOST_BLOCKS", blocks - 1)
    with pytest.raises(ValueError, match="voxels on one camera need"):
        blocks_of(PackedCamera.from_camera(camera), [model], "profiles")
    with pytest.raises(ValueError, match=r"5 x 6 x 7 voxels .* blocks.*Raise volume.voxel_mm"):
        lfpiv.build_weights(IdealRig(small.cameras), small.grid, form="profiles")


@pytest.mark.slow
def test_memory_estimate_holds_before_building():
    rig = two_cameras(optics=optics(rows=100, columns=110))
    grid = lfpiv.Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(2.0, 2.0, 2.0), voxel_mm=0.05)
    weights = lfpiv.build_weights(rig, grid)
    estimate = estimate_memory(rig, grid)
    assert weights.memory_bytes <= 1.1 * estimate
    huge = lfpiv.Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(900, 900, 900), voxel_mm=0.1)
    assert estimate_memory(rig, huge) > estimate  # and nothing of that size was allocated


@pytest.mark.slow
def test_form_follows_the_optics_and_the_limit_is_kept():
    grid = lfpiv.Grid.from_extent(centre_mm=(0.1, -0.1, 0.2), size_mm=(0.4, 0.4, 0.4), voxel_mm=VOXEL_MM)
    cameras = {"straight": RIGS["misaligned"], "bent": IdealCamera("bent", rotation(-45), coma=0.02)}
    cameras |= {"hexagonal": RIGS["hexagonal"], "rolled": RIGS["rolled 40"]}
    weights = lfpiv.build_weights(IdealRig(cameras), grid)
    assert choose_form(weights.counted("straight")).form == "profiles"  # by itself; a rig has one form
    assert set(weights.forms.values()) == {"pixels"}
    assert {name for name, cuts in weights.cuts.items() if cuts != WHOLE} == {"rolled"}  # parts only where they tell
    plain = form_errors(weights.counted("rolled"), "pixels")
    assert np.mean(plain) > 0.9 * np.mean(weights.profile_errors["rolled"])  # pixels alone would be bought for nothing
    assert min(weights.profile_errors["bent"]) > FOOTPRINT_MEAN
    for name, errors in compare_with_count(weights).items():
        assert errors and np.mean(errors) <= FOOTPRINT_MEAN and max(errors) <= FOOTPRINT_WORST, name
    with pytest.raises(ValueError, match=r"camera 'bent'.* as pixels.*weights_form to 'profiles'"):
        lfpiv.build_weights(IdealRig(cameras), grid, limit_bytes=weights.memory_bytes // 4)


def test_the_form_that_a_rig_takes_is_judged_and_no_other(monkeypatch):
    """By itself the bent camera would take profiles that are not accurate; beside a hexagonal one it takes pixels."""
    monkeypatch.setattr(choice, "PIXELS_GAIN", 0.0)
    grid = lfpiv.Grid.from_extent(centre_mm=(0.1, -0.1, 0.2), size_mm=(0.2, 0.2, 0.2), voxel_mm=VOXEL_MM)
    bent = {"bent": IdealCamera("bent", rotation(-45), coma=0.02)}
    for others, forms in (({}, ["profiles"]), ({"hexagonal": RIGS["hexagonal"]}, [])):
        with collected() as told:
            lfpiv.build_weights(IdealRig(bent | others), grid)
        assert [one.figures["form"] for one in told if one.code is Code.WEIGHTS_DIFFER] == forms


def test_a_voxel_is_cut_only_along_edges_that_matter():
    grid = lfpiv.Grid.from_extent(centre_mm=(0.0, 0.0, 0.2), size_mm=(1.2, 1.2, 1.2), voxel_mm=2 * VOXEL_MM)
    stored = StoredGrid(grid, (1, 0, 2))
    for pose, cut in [((45, 0, 0), ""), ((0, 0, 30), "xy"), ((45, 30, 0), "xz"), ((45, 0, 25), "xyz")]:
        cuts = choose_cuts(stored, IdealCamera("c", rotation(*pose)))
        assert "".join(axis for axis, parts in zip("xyz", cuts, strict=True) if parts > 1) == cut, pose


@pytest.mark.slow
def test_bent_rays_are_followed_to_third_order_and_asked_for_profiles_are_warned_of():
    grid = lfpiv.Grid.from_extent(centre_mm=(0.1, -0.1, 0.2), size_mm=(0.4, 0.4, 0.4), voxel_mm=VOXEL_MM)
    with collected() as texts:
        weights = lfpiv.build_weights(IdealRig({name: RIGS[name] for name in ("spherical", "rolled 40")}), grid)
    assert set(weights.forms.values()) == {"pixels"} and not texts
    assert min(weights.profile_errors["spherical"]) > FOOTPRINT_MEAN
    with collected() as texts:
        compare_with_count(lfpiv.build_weights(IdealRig({"rolled": RIGS["rolled 40"]}), grid, form="profiles"))
    assert len(texts) == 1 and "set compute.weights_form to 'auto'" in texts[0].sentence


@pytest.mark.parametrize("seed", range(3))
def test_only_voxels_that_are_seen_judge(seed):
    """A camera that sees a small part of a volume judges by that part."""
    camera = IdealCamera("bent", rotation(45), coma=0.03)
    grid = lfpiv.Grid.from_extent(centre_mm=(1.2, 0.8, 0), size_mm=(12.0, 10.0, 1.6), voxel_mm=VOXEL_MM)
    stored = StoredGrid(grid, (1, 0, 2))
    chief = camera.map(grid.centres_mm(), np.zeros((grid.size, 2)))
    assert (np.abs(chief) < 1.1).all(1).mean() < 0.1  # six voxels at random would mostly show nothing
    judge = CountedVoxels(stored, camera, seed)
    choice = choose_form(judge)
    assert len(choice.profile_errors) == counting.VOXELS and choice.form == "pixels"


def test_weights_that_nothing_judges_say_so():
    grid = lfpiv.Grid(shape=(1, 1, 2), voxel_mm=VOXEL_MM, first_centre_mm=(0.0, 9.0, 0.0))
    with collected() as texts:
        weights = lfpiv.build_weights(two_cameras(), grid)
    assert len(texts) == 2 and all("unchecked" in warning.sentence for warning in texts)
    assert compare_with_count(weights) == {"cam1": [], "cam2": []}


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda w: lfpiv.build_weights(IdealRig(w.cameras), w.grid, form="exact"), "form: expected one of"),
        (lambda w: lfpiv.build_weights(IdealRig(RIGS), w.grid, form="profiles"), "those of camera 'hexagonal'"),
        (lambda w: w(np.zeros(w.grid.shape), out={n: np.zeros(c.gain.shape) for n, c in w.cameras.items()}), "out"),
        (lambda w: w(np.zeros((2, 2, 2))), r"volume: expected shape \(5, 6, 7\)"),
        (lambda w: w.T({"cam1": np.zeros((400, 480))}), "camera 'cam2' is missing"),
        (lambda w: w.T({"cam1": np.zeros((4, 4)), "cam2": np.zeros((4, 4))}), r"expected shape \(400, 480\)"),
        (lambda w: w.image("cam3", (0, 0, 0)), "expected one of cam1, cam2"),
        (lambda w: w.image("cam1", (0, 0, 9)), "inside the grid"),
    ],
)
def test_wrong_arguments_are_named(small, call, message):
    with pytest.raises(ValueError, match=message):
        call(small)
