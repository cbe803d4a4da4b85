"""`perf/accuracy/reconstruction_bench.py` on a tiny volume."""

import json

import numpy as np
import pytest
import reconstruction_bench
import reconstruction_cases
from reconstruction_cases import Case
from reconstruction_ways import WAYS, Measured, Way, true_particles

EXACT = 0.25  # voxel: few particles in a tiny volume
BACKWARDS = -0.5  # slope of a field that is turned round is -1


def clear():
    """Forget rigs and recordings of other sizes."""
    reconstruction_cases.make_rig.cache_clear()
    reconstruction_cases.record.cache_clear()


@pytest.fixture
def tiny(monkeypatch, tmp_path):
    """Folder of results; the small volume has 1.6 x 1.6 x 1.4 mm."""
    clear()
    monkeypatch.setitem(reconstruction_cases.SIZE_MM, "small", (1.6, 1.6, 1.4))
    monkeypatch.setitem(reconstruction_cases.WINDOWS, "small", (12, 8))
    yield tmp_path
    clear()


def backwards(rig, recorded, settings):
    """Return the true particles in the wrong order."""
    found = true_particles(rig, recorded, settings)
    return Measured(volumes=found.volumes[::-1], passes=0.0, misfit=float("nan"), cpu_s=0.0)


def test_true_particles_measure_the_flow_and_reversed_ones_its_opposite(tiny):
    case = Case(flow="shear", ppm=1.0)
    truth = reconstruction_bench.measure(case, WAYS["truth"], tiny)
    turned = reconstruction_bench.measure(case, Way(label="backwards", reconstruct=backwards), tiny)
    assert truth["error"] < EXACT and truth["q"] == pytest.approx(1.0)
    assert np.isnan(truth["slope_x"]) and turned["slope_z"] < BACKWARDS < -BACKWARDS < truth["slope_z"]


@pytest.mark.slow
def test_realistic_images_are_harder_and_are_recorded_once(tiny):
    clean, real = (reconstruction_cases.record(Case(condition=name), tiny) for name in ("clean", "real"))
    assert real.light[0].std() > clean.light[0].std() == 0
    assert len(real.positions_mm[0]) > len(clean.positions_mm[0])  # also beyond the faces
    stamps = {path: path.stat().st_mtime_ns for path in tiny.glob("*.npz")}
    reconstruction_cases.record.cache_clear()
    again = reconstruction_cases.record(Case(condition="real"), tiny)
    assert {path: path.stat().st_mtime_ns for path in tiny.glob("*.npz")} == stamps
    assert all(np.array_equal(again.images[1][name], image) for name, image in real.images[1].items())


def test_frames_of_a_series_follow_the_flow(tiny):
    case = Case(flow="uniform", frames=3)
    recorded = reconstruction_cases.record(case, tiny)
    moved = reconstruction_cases.make_flow(case)(recorded.positions_mm[0])
    for first, second in zip(recorded.positions_mm[:-1], recorded.positions_mm[1:], strict=True):
        assert np.allclose(second - first, moved)


@pytest.mark.slow
def test_command_line_states_differences_to_the_reference(tiny, capsys):
    out = tiny / "figures.json"
    options = ["--flows", "shear", "--seeds", "1,2", "--set", "smart.iterations=1", "--against", "smart.iterations=6"]
    assert reconstruction_bench.main([*options, "--cache", str(tiny), "--json", str(out)]) == 0
    reference, few = json.loads(out.read_text())
    assert few["figures"]["passes"][0] == 1 and reference["figures"]["passes"][0] == 6
    assert few["figures"]["misfit"][0] > reference["figures"]["misfit"][0]
    gap = few["figures"]["q"][0] - reference["figures"]["q"][0]
    assert few["differences"]["q"][0] == pytest.approx(gap)
    assert reference["differences"]["q"] == [0.0, 0.0]
    assert "all 2 cases, smart.iterations=1 - smart.iterations=6" in capsys.readouterr().out


def test_unknown_way_is_refused():
    with pytest.raises(ValueError, match="ours"):
        reconstruction_bench.parse_way(["nobody"])
