"""Files of linked particles: written, read, refused, exported."""

import csv
from xml.etree import ElementTree

import numpy as np
import pytest

import lfpiv
from lfpiv.errors import InputError
from lfpiv.results import particles, tables
from lfpiv.tracking.found import FoundParticles


def table(shift, count=5):
    at = np.random.default_rng(0).uniform(-1, 1, (count, 3))
    first, second = (
        FoundParticles(
            positions_mm=place,
            errors_mm=np.full((count, 3), 0.01),
            light=np.ones(count),
            residual=np.ones(count),
            sigma_voxel=0.7,
            voxel_mm=0.1,
            explained=0.9,
            crowding=0.1,
            hidden=0.1,
            per_microlens=0.05,
            signal_to_noise=np.full(count, 30.0),
        )
        for place in (at, at + shift)
    )
    return lfpiv.link_particles(first, second, dt_s=1e-3)


@pytest.fixture
def folder(tmp_path):
    for pair in (0, 2):
        path = tmp_path / "particles" / f"pair_{pair:04d}.nc"
        particles.write_particles(table(0.01 * pair), path, attributes={"pair": pair})
    return tmp_path


def test_all_pairs_are_one_table(folder):
    found = lfpiv.open_particles(folder)
    assert found["pair"].values.tolist() == [0] * 5 + [2] * 5
    assert np.allclose(found["displacement_x"][5:], 0.2) and found.attrs["dt_s"] == 1e-3
    assert lfpiv.open_particles(folder, pairs=(1, None)).sizes["particle"] == 5


def test_a_folder_without_particles_is_named(tmp_path):
    with pytest.raises(InputError, match="tracking"):
        lfpiv.open_particles(tmp_path)


def test_damage_is_noticed(folder):
    path = folder / "particles" / "pair_0002.nc"
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    with pytest.raises(InputError, match="pair_0002"):
        lfpiv.open_particles(folder)


def test_tables_of_another_form_are_refused(tmp_path):
    wrong = table(0.0).drop_vars("w")
    with pytest.raises(ValueError, match="'w'"):
        particles.write_particles(wrong, tmp_path / "pair_0000.nc", attributes={})


def test_figures_stand_in_the_summary(folder):
    found = particles.figures(folder / "particles" / "pair_0000.nc")["particles"]
    assert found["found"] == [5, 5] and found["linked"] == 5 and found["explained"] == [0.9, 0.9]
    assert particles.figures(folder / "particles" / "pair_0009.nc") == {}


def test_text_and_poly_data_hold_the_table(tmp_path):
    wanted = table(0.02)
    tables.write_columns(wanted.to_dataframe(), tmp_path / "a.csv", particles.PARTICLE_UNITS)
    rows = list(csv.DictReader((tmp_path / "a.csv").open()))
    assert len(rows) == 5 and np.allclose([float(row["u [m/s]"]) for row in rows], wanted["u"])
    particles.write_vtp(wanted, tmp_path / "a.vtp")
    root = ElementTree.parse(tmp_path / "a.vtp").getroot()
    arrays = {one.get("Name"): np.array(one.text.split(), float) for one in root.iter("DataArray")}
    assert np.allclose(arrays["position"].reshape(-1, 3)[:, 2], wanted["z"])
    assert np.allclose(arrays["velocity"].reshape(-1, 3)[:, 0], wanted["u"])
    assert arrays["offsets"].tolist() == [1, 2, 3, 4, 5]
