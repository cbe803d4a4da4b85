"""The whole job on a small simulated experiment: right vectors, complete files, and only what changed done anew."""

import base64
import io
import json
import re

import numpy as np
import pytest

from lfpiv import dataset, figures, pipeline, report
from lfpiv.simulate import simulate

DISPLACEMENT_VOXEL = (0.8, -0.6, 0.4)
"""Uniform flow along x, y, z: off whole voxels on every axis."""

TOLERANCE_VOXEL = 0.2
"""Mean of the valid vectors against the flow. Particles are few and two cameras blur depth; a wrong sign, axis, frame
order or scale misses by 0.4 voxel or more."""

KEY_LENGTH = 0.02
"""The arrow of the scale against the vectors' own: what the eye cannot tell."""

SCENE = """
name = "small"
seed = 3
dt_s = 1e-3
[board]
dots = [5, 5]
spacing_mm = 0.5
dot_diameter_mm = 0.1
planes_mm = [-0.8, -0.4, 0.0, 0.4, 0.8]
[volume]
centre_mm = [0.0, 0.0, 0.0]
size_mm = [2.0, 2.0, 1.2]
voxel_mm = 0.1
[particles]
count = 120
pairs = 2
sigma_mm = 0.05
[flow]
kind = "uniform"
displacement_mm = [0.08, -0.06, 0.04]
[correlation]
windows = [[12, 16, 16], [12, 12, 12]]
[smart]
iterations = 8
[network]
hidden = [12]
epochs = 60
"""

CAMERA = """
[[camera]]
name = "{name}"
focal_length_mm = 100.0
magnification = -1.0
f_number = 4.0
microlens_pitch_mm = 0.1
microlens_focal_length_mm = 0.8
pixel_um = 8.0
sensor_width_px = 400
sensor_height_px = 400
nominal_angle_deg = {angle}
true_yaw_deg = {true_angle}
true_array_roll_deg = 0.05
"""

STAGES = ("calibration", "network_training", "weights", "reconstruction", "correlation", "total")


@pytest.fixture(scope="module")
def finished(tmp_path_factory, device):
    """Experiment file, output folder and summary of a complete run that kept its volumes."""
    folder = tmp_path_factory.mktemp("pipeline")
    scene = SCENE + "".join(
        CAMERA.format(name=name, angle=angle, true_angle=angle - 0.5) for name, angle in (("left", 40), ("right", -40))
    )
    (folder / "scene.toml").write_text(scene)
    experiment = simulate(folder / "scene.toml", folder / "data")
    summary = pipeline.run(experiment, folder / "out", device=device.kind, keep_volumes=True)
    return experiment, folder / "out", summary


def test_the_flow_comes_out(finished):
    _, out, _ = finished
    for pair in range(2):
        vectors = dataset.read_vectors(out / "vectors" / f"pair_{pair:04d}.nc")
        assert vectors["u"].dims == ("z", "y", "x") and vectors.attrs["dt_s"] == 1e-3
        for axis, velocity, truth in zip("xyz", "uvw", DISPLACEMENT_VOXEL, strict=True):
            displacement = vectors[f"displacement_{axis}"]
            assert np.isfinite(displacement).all()
            assert float(displacement.where(vectors["valid"]).mean()) == pytest.approx(truth, abs=TOLERANCE_VOXEL)
            np.testing.assert_allclose(
                vectors[velocity], displacement * 0.1e-3 / 1e-3, rtol=1e-6
            )  # voxel 0.1 mm, dt 1 ms


def test_every_file_of_the_contract_is_there_and_whole(finished):
    _, out, summary = finished
    names = sorted(str(path.relative_to(out)) for path in out.rglob("*") if path.is_file())
    assert names == [
        "calibration.h5",
        "report.html",
        "summary.json",
        "vectors/pair_0000.nc",
        "vectors/pair_0001.nc",
        *(f"volumes/pair_000{pair}_{frame}.nc" for pair in range(2) for frame in "ab"),
    ]
    assert json.loads((out / "summary.json").read_text()) == dataset.plain(summary)
    timings = summary["timings_s"]
    assert all(timings[stage] > 0 for stage in STAGES)
    parts = sum(timings[stage] for stage in ("calibration", "weights", "reconstruction", "correlation"))
    assert timings["network_training"] < timings["calibration"] and parts < timings["total"]
    assert summary["peak_memory_mib"] > 50
    for camera in ("left", "right"):
        figures = summary["calibration"][camera]
        assert {"sigma_nor_test", "dots_found", "dots_expected", "lens_array_rms_px"} <= set(figures)
        assert 0 < figures["dots_found"] <= figures["dots_expected"] <= 5 * 5 * 5
        assert 0 < figures["network_correction_pitch"] < 0.1  # rendered by an ideal lens: hardly anything is left
    assert [len(pair["residual"]["a"]) for pair in summary["pairs"]] == [9, 9]
    assert all(set(pair["structure"]["b"]) == {"left", "right"} for pair in summary["pairs"])
    assert not any("noise" in text for text in summary["warnings"])


def test_the_report_holds_its_pictures(finished):
    from matplotlib.image import imread

    _, out, summary = finished
    page = (out / "report.html").read_text("utf-8")
    pictures = re.findall(r'src="data:image/png;base64,([^"]+)"', page)
    assert (
        len(pictures) == 2 * 2 + 6
    )  # lens centres and dots of each camera; errors, projections, residuals, three of the vectors
    for picture in pictures:
        assert np.ptp(imread(io.BytesIO(base64.b64decode(picture)))) > 0.5
        width = imread(io.BytesIO(base64.b64decode(picture))).shape[1]
        assert f'width="{round(width * report.CSS_DPI / figures.DPI)}"' in page
    assert page.count('<label class="zoom"') == len(pictures)  # each opens at full size and scrolls on small screens
    assert not re.search(r'(src|href)="(?!data:)', page), "the page refers to something outside itself"
    for text in (
        "left",
        "right",
        "2 cameras",
        "correction, rms [pitch]",
        *(text.split(":")[0] for text in summary["warnings"]),
    ):
        assert text in page


def test_arrows_have_a_scale(finished, monkeypatch):
    """The key's arrow is as long as one of the round speed it names; a field at rest has none."""
    from matplotlib.axes import Axes

    _, out, _ = finished
    vectors = dataset.read_vectors(out / "vectors" / "pair_0000.nc")
    drawn, quiverkey = {}, Axes.quiverkey

    def keep(axes, quiver, x, y, speed, label, **settings):
        drawn.update(quiver=quiver, speed=speed, label=label)
        drawn["key"] = quiverkey(axes, quiver, x, y, speed, label, **settings)
        return drawn["key"]

    monkeypatch.setattr(Axes, "quiverkey", keep)
    figures.vector_slices(vectors)
    fastest = float(np.hypot(vectors["u"], vectors["v"]).max())
    assert 0.3 * fastest < drawn["speed"] <= fastest and f"{drawn['speed']:g} m/s" in drawn["label"]
    axes = drawn["quiver"].axes
    pixels_per_mm = axes.bbox.width / np.ptp(axes.get_xlim())
    arrow = drawn["key"].vector
    length = np.ptp(arrow.get_transform().transform(arrow.get_paths()[0].vertices)[:, 0])
    assert length == pytest.approx(drawn["speed"] / drawn["quiver"].scale * pixels_per_mm, rel=KEY_LENGTH)
    assert [figures._round_below(value) for value in (0.0, 0.0199, 1.0, 7e3, np.nan)] == [0, 0.01, 1, 5000, 0]
    still = vectors.assign({name: 0 * vectors[name] for name in "uvw"})
    drawn.clear()
    assert figures.vector_slices(still) and not drawn


def test_a_second_run_does_nothing_anew(finished):
    experiment, out, first = finished
    written = {path: path.stat().st_mtime_ns for path in out.rglob("*.[hn][5c]")}
    second = pipeline.run(experiment, out, keep_volumes=True)
    assert second["reused"] == ["calibration", "vectors of pair 0", "vectors of pair 1"]
    assert {path: path.stat().st_mtime_ns for path in written} == written
    for stage in STAGES[:-1]:
        assert second["timings_s"][stage] == pytest.approx(first["timings_s"][stage]), stage
    assert second["pairs"] == first["pairs"] and second["timings_s"]["total"] < first["timings_s"]["total"]


def test_steps_one_at_a_time_give_the_same(finished):
    experiment, out, _ = finished
    path = out / "vectors" / "pair_0001.nc"
    before = dataset.read_vectors(path)
    path.unlink()
    summary = pipeline.correlate(experiment, out)
    assert "vectors of pair 0" in summary["reused"] and "vectors of pair 1" not in summary["reused"]
    after = dataset.read_vectors(path)
    assert after.equals(before)
    assert pipeline.report(experiment, out)["pairs"][1]["valid_fraction"] == float(before["valid"].mean())


def test_only_what_changed_is_done_anew_and_a_failure_leaves_no_part(finished, monkeypatch):
    experiment, out, _ = finished
    text = experiment.read_text()
    files = {path: path.stat().st_mtime_ns for path in out.rglob("*.[hn][5c]")}
    changed = experiment.with_name("changed.toml")
    changed.write_text(text.replace("[correlation]", "[correlation]\nmax_displacement_voxel = 3.0"))

    import lfpiv

    def fail(*volumes, **settings):
        raise RuntimeError("the power went off")

    with monkeypatch.context() as patch, pytest.raises(RuntimeError):
        patch.setattr(lfpiv, "correlate", fail, raising=False)
        pipeline.run(changed, out, keep_volumes=True)
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*.[hn][5c]")} == files
    assert not list(out.rglob("*.tmp"))
    pipeline.run(changed, out, pairs=(0, 1), keep_volumes=True)
    redone = {path for path, time in files.items() if path.stat().st_mtime_ns != time}
    assert redone == {out / "vectors" / "pair_0000.nc"}
