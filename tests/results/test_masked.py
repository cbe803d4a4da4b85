"""Masked vectors in files, exports, figures and the report."""

import csv

import numpy as np
import pytest
import xarray as xr
from support.vector_sets import random_vectors

import lfpiv
from lfpiv.experiment.opening import open_experiment, read_experiment
from lfpiv.quantities import scale_of
from lfpiv.report import flow, slice_panels
from lfpiv.report import vectors as report
from lfpiv.results import netcdf, provenance, stamps
from lfpiv.results.stamps import Inputs
from lfpiv.runs import pair_figures

DIMS = ("z", "y", "x")


def masked_vectors(seed=0):
    vectors = random_vectors(seed)
    masked = np.zeros(vectors["u"].shape, bool)
    masked[..., :2] = True
    hidden = vectors.where(~masked).assign(valid=vectors["valid"] & ~xr.DataArray(masked, dims=DIMS))
    attributes = {"verdict": "", "reconstruction_s": 1.0, "correlation_s": 1.0, "seen_fraction": 1.0}
    attributes |= {"measurable_fraction": 0.9, "unseeded_fraction": 0.2}
    return hidden.assign(masked=(DIMS, masked)).assign_attrs(vectors.attrs | attributes), masked


@pytest.fixture
def run(tmp_path):
    vectors, masked = masked_vectors()
    netcdf.write_vectors(vectors, tmp_path / "vectors" / "pair_0000.nc", attributes={"pair": 0})
    return tmp_path, masked


def test_files_hold_the_flag_with_its_meaning(run):
    folder, masked = run
    read = netcdf.read_vectors(folder / "vectors" / "pair_0000.nc")
    assert read["masked"].dtype == bool and read["masked"].attrs["flag_meanings"] == "fluid masked"
    np.testing.assert_array_equal(lfpiv.open_results(folder)["masked"].values[0], masked)


def test_a_table_has_the_flag_and_no_numbers_where_masked(run):
    folder, masked = run
    (path,) = lfpiv.export_results(folder, "csv")
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    np.testing.assert_array_equal([row["masked"] == "1" for row in rows], masked.ravel())
    assert {row["masked"] for row in rows} == {"0", "1"}
    assert all((row["u [m/s]"] == "") == (row["masked"] == "1") for row in rows)


def test_planes_tell_masked_from_replaced(run):
    folder, masked = run
    path = lfpiv.export_results(folder, "pivpy")[0]
    with xr.open_dataset(path) as plane:
        np.testing.assert_array_equal(plane["chc"].isel(t=0).values == -1, masked[0])
        assert "-1: masked" in plane["chc"].attrs["long_name"]


def test_images_hold_the_flag(run):
    pyvista = pytest.importorskip("pyvista")
    folder, masked = run
    lfpiv.export_results(folder, "vti")
    image = pyvista.read(folder / "export" / "pair_0000.vti")
    np.testing.assert_array_equal(np.asarray(image.point_data["masked"]) == 1, masked.ravel())


def test_figures_leave_masked_vectors_out_and_name_unseeded_ones():
    vectors, masked = masked_vectors()
    figures = pair_figures.measure(vectors, None, ())
    assert figures.valid_fraction == vectors["valid"].values[~masked].mean() and figures.finite_fraction == 1
    assert figures.masked_fraction == pytest.approx(masked.mean())
    assert figures.lost_unseeded == pytest.approx(0.1)
    assert figures.valid_share == pytest.approx(min(figures.valid_fraction / 0.9, 1))
    sentence = figures.unseeded_warning(3).sentence
    assert sentence.startswith("pair 3: 20 % of the volume holds no particles; 10 % of the vectors")


def test_slices_hatch_masked_cells_only():
    vectors, masked = masked_vectors()
    kinds = flow.describe(vectors)
    whole, parts = (flow.shown(field, kinds) for field in (vectors.drop_vars("masked"), vectors))
    place = int(np.argmax(masked.any((1, 2))))
    assert "<pattern" not in slice_panels.slice_panel(whole, kinds, "z", place, "w", "arrows")
    panel = slice_panels.slice_panel(parts, kinds, "z", place, "w", "arrows")
    assert "<pattern" in panel and slice_panels.MASKED_FILL in panel
    rows = report.depth_rows(vectors, scale_of(1.0, "m/s"))
    assert [row[1] for row in rows] == [str(n) for n in (~masked).sum((1, 2))]


def test_another_mask_makes_another_volume(tiny_experiment):
    plain = open_experiment(tiny_experiment)
    box = '[[volume.solid]]\nkind = "box"\ncentre_mm = [0.4, 0.3, {z}]\nsize_mm = [0.2, 0.2, 0.2]\n'
    text = tiny_experiment.read_text()
    found = [stamps.of_pair(plain, Inputs(""), 0)]
    for z in (0.3, 0.25):
        tiny_experiment.write_text(text.replace("[particles]", box.format(z=z) + "\n[particles]"))
        found.append(stamps.of_pair(open_experiment(tiny_experiment), Inputs(""), 0))
    assert len({stamp.volumes[0].hash for stamp in found}) == 3
    assert "mask" in found[1].volumes[0].changes(provenance.Marks(**found[2].volumes[0].attributes))


@pytest.mark.parametrize(
    ("kind", "changed"),
    [("pairs", [5]), ("series", [4, 5]), ("predicted series", [*range(1, 11)])],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_changed_mask_of_a_frame_concerns_its_pairs_only(tiny_experiment, kind, changed):
    """A predicted instant depends on those before it, and on the three after it that correct it."""
    text = tiny_experiment.read_text()
    pattern = "{pair}" if kind == "pairs" else "{instant}"
    numbers = "pairs = 12" if kind == "pairs" else "instants = 12"
    if kind != "pairs":
        text = text.replace("{pair:04d}{frame}", "{instant}")
    text = text.replace("pairs = 2", numbers).replace("voxel_mm = 0.05\n", f'voxel_mm = 0.05\nmask = "{pattern}.nc"\n')
    tiny_experiment.write_text(f"{text}\n[smart]\npredict = {str(kind.startswith('predicted')).lower()}\n")
    axes = {axis: np.arange(-0.5, 0.5, 0.1) for axis in DIMS}
    body = xr.DataArray(np.zeros((10, 10, 10), bool), axes, DIMS, "mask")
    for number in range(12):
        body[4, 4, number % 10] = True
        body.to_netcdf(tiny_experiment.parent / f"{number}.nc", engine="h5netcdf")
    experiment = read_experiment(tiny_experiment)
    pairs = [pair for pair in experiment.numbers if pair != 0]

    def made():
        return {pair: stamps.of_pair(experiment, Inputs(""), pair).vectors for pair in pairs}

    before = {pair: provenance.Marks(**stamp.attributes) for pair, stamp in made().items()}
    file = tiny_experiment.parent / "5.nc"
    content = file.read_bytes()
    file.unlink()
    file.write_bytes(content)  # a copy: other times
    assert all(stamp.fits(before[pair]) for pair, stamp in made().items())
    file.unlink()
    (~body).to_netcdf(file, engine="h5netcdf")
    found = {pair: stamp.changes(before[pair]) for pair, stamp in made().items()}
    assert {pair: names for pair, names in found.items() if names} == {pair: ["mask_files"] for pair in changed}
