"""Cases of the benchmark: each opens as a scene, varies what it says, and has the particles that are recorded."""

import collections

import numpy as np
import pytest

from lfpiv.benchmark import cases, fingerprint, listing, plain_truth
from lfpiv.errors import InputError

SEEDINGS = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0)
"""Particles per microlens that the benchmark covers."""
MOST_VOXELS_MOVED = 4.0
"""Largest displacement of a case [voxel]: a quarter of a window of 16 voxels, which any first pass finds."""
WITHOUT_FILES = [name for name in cases.names() if cases.case_of(name).tracers is None]


def scene(name, **options):
    return cases.scene_of(cases.case_of(name), **options)


def tracer_file(folder):
    """Write tracers that move along x in the unit cube, at 12 instants; return the file."""
    start = np.random.default_rng(0).random((400, 3)) * (0.9, 1, 1)
    path = folder / "tracers.npz"
    np.savez(path, positions=start + 0.005 * np.arange(12)[:, None, None] * (1, 0, 0))
    return path


@pytest.mark.parametrize("name", WITHOUT_FILES)
def test_a_case_is_a_scene_that_moves_by_what_windows_can_follow(name):
    case = scene(name)
    points = np.random.default_rng(1).uniform(-0.5, 0.5, (500, 3)) * case.volume.size_mm
    moved = np.linalg.norm(case.flow_of(0)(points), axis=1) / case.volume.voxel_mm
    assert case.name == name and 0.5 < moved.max() <= MOST_VOXELS_MOVED


@pytest.mark.parametrize("name", WITHOUT_FILES)
def test_the_truth_is_the_recorded_one(name):
    found = fingerprint.truth_sha256(plain_truth.true_particles(scene(name)))
    assert found == fingerprint.record().cases[name].truth_sha256


def test_the_record_has_all_cases_of_this_version():
    assert set(fingerprint.record().cases) == set(cases.names())
    assert fingerprint.record().benchmark == cases.case_list().version


def test_seedings_cameras_and_flows_are_covered():
    rows = {row["case"]: row for row in listing.rows()}
    seedings = [row["per_microlens"] for row in rows.values() if row["varies"] in ("base", "seeding")]
    assert sorted(seedings) == list(SEEDINGS)
    assert {row["cameras"] for row in rows.values() if row["varies"] in ("base", "cameras")} == {1, 2, 3, 4}
    assert {row["flow"] for row in rows.values()} >= {"ring", "shear", "turbulence", "DNS"}
    assert rows["paper-size"]["voxels"] == [140, 140, 70]
    assert all("instants" in row for row in rows.values() if row["varies"] == "sequence")


@pytest.mark.parametrize("name", [name for name in WITHOUT_FILES if cases.case_of(name).varies != "size"])
def test_a_case_changes_only_what_it_varies(name):
    case = cases.case_of(name)
    own, parent = (cases.tables_of(one) for one in (case, cases.case_of(case.parent)))
    differing = {key for key in {*own, *parent} if own.get(key) != parent.get(key)}
    allowed = {"seeding": {"particles"}, "cameras": {"camera"}, "flow": {"flow", "turbulence"}}
    allowed |= {"sequence": {"particles", "flow", "turbulence"}, "base": set()}
    if case.varies in allowed:
        assert differing <= allowed[case.varies]
    else:
        assert differing and "volume" not in differing and own["particles"]["per_microlens"] == 0.2


def test_the_seed_changes_particles_and_keeps_the_rig():
    first, second = scene("trial"), scene("trial", seed=5)
    places = [plain_truth.true_particles(one)["pair_0000_positions_mm"] for one in (first, second)]
    assert places[0].shape == places[1].shape and np.abs(places[0] - places[1]).max() > 0.1
    assert first.camera == second.camera and first.flow == second.flow


def test_tracers_are_asked_for_with_their_source_and_taken_from_a_file(tmp_path):
    with pytest.raises(InputError, match=r"--tracers FILE.*github\.com/RobinBarta/proPTV.*MIT.*SHA-256 [0-9a-f]{64}"):
        scene("sequence-dns")
    with pytest.raises(InputError, match="base needs none"):
        scene("base", tracers=tracer_file(tmp_path))
    with pytest.raises(InputError, match="no file"):
        scene("sequence-dns", tracers=tmp_path / "absent.npz")
    found = scene("sequence-dns", tracers=tracer_file(tmp_path))
    moved = found.flow_of(3)(np.zeros((1, 3)))
    np.testing.assert_allclose(moved, [[0.005 * found.flow.size_mm[0], 0, 0]], atol=1e-9)


@pytest.mark.sample_data
def test_the_recorded_tracers_give_the_recorded_truth(sample_data):
    path = sample_data / "dns-tracers" / "rayleigh_benard_series.npz"
    found = fingerprint.truth_sha256(plain_truth.true_particles(scene("sequence-dns", tracers=path)))
    assert found == fingerprint.record().cases["sequence-dns"].truth_sha256


def test_unknown_names_and_seeds_are_refused_in_one_line():
    with pytest.raises(InputError, match=r"'bse': expected the name of a case, base, trial"):
        cases.case_of("bse")
    with pytest.raises(InputError, match=r"--seed: seed"):
        scene("trial", seed=-1)


def test_names_differ_and_purposes_are_sentences():
    every = cases.case_list().case
    assert max(collections.Counter(case.name for case in every).values()) == 1
    assert all(case.purpose[0].isupper() and case.purpose.endswith(".") for case in every)


def test_a_case_must_follow_its_parent():
    one = {"name": "base", "varies": "base", "purpose": "P.", "cameras": ["left"], "pairs": 1}
    child = {"name": "child", "varies": "flow", "purpose": "P."}
    assert cases.CaseList.model_validate({"version": "1", "case": [one, child]})
    for wrong in ([child, one], [one, one], [one, child | {"pairs": 1, "instants": 2}]):
        with pytest.raises(ValueError, match="case"):
            cases.CaseList.model_validate({"version": "1", "case": wrong})
