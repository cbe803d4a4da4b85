"""Scores of vectors with known errors: perfect ones score 0, known offsets and slopes are found, gaps are counted."""

import json
import shutil

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from support import known_truth

from lfpiv import metrics
from lfpiv.benchmark.figures import all_figures, keys_of
from lfpiv.benchmark.page import cell
from lfpiv.benchmark.readers import ReadOptions, read_result
from lfpiv.benchmark.sample import Sample, pair_errors
from lfpiv.benchmark.score import ScoreOptions, report, score_results
from lfpiv.benchmark.truth import open_truth
from lfpiv.cli import commands
from lfpiv.errors import InputError
from lfpiv.files import plain

WINDOW = (1.2, 1.2, 1.2)
QUICK = ScoreOptions(resamples=20)
NOISE_MM = 0.02
"""Standard deviation of noise on each component [mm], a fifth of a voxel."""
ROUNDING = 1e-9
"""Largest error of figures that are exact but for rounding."""


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    return known_truth.write_truth(tmp_path_factory.mktemp("known") / "data")


def score_of(truth, path, **options):
    (score,) = score_results(truth, [path], ScoreOptions(resamples=20, **options))
    return score


def noise_of(seed):
    """Return a function that adds noise to displacements [mm]."""
    rng = np.random.default_rng(seed)
    return lambda moved: moved + NOISE_MM * rng.standard_normal(moved.shape)


def values_of(score):
    return {key: found.value for key, found in score.figures.items()}


def both_pairs(truth, folder, **options):
    datasets = [known_truth.true_vectors(truth, pair, **options) for pair in truth.numbers]
    return known_truth.write_pairs(folder, datasets)


def test_perfect_vectors_have_no_error(truth, tmp_path):
    found = values_of(score_of(truth, both_pairs(truth, tmp_path / "result", window_mm=WINDOW)))
    zero = ("error", "rms", "median", "error_mm", "error_at_90", "rms_x", "rms_z", "offset_y", "outliers")
    assert max(abs(found[key]) for key in zero) < ROUNDING
    assert [found[f"slope_{axis}"] for axis in "xyz"] == pytest.approx([1, 1, 1], abs=1e-9)
    assert found["completeness"] == 1
    assert found["error_point"] > 0.01  # a window averages, which is seen against the values at points


def test_without_a_window_the_truth_is_that_of_the_points(truth, tmp_path):
    score = score_of(truth, both_pairs(truth, tmp_path / "result"))
    assert values_of(score)["error"] < ROUNDING
    assert values_of(score)["error_point"] == values_of(score)["error"]
    assert any("no window" in note for note in score.notes)


def test_known_slope_and_offset_are_found(truth, tmp_path):
    def change(moved):
        fluctuation = moved - moved.mean(0)
        return moved + np.array([-0.1, 0.0, 0.2]) * fluctuation + np.array([0.03, -0.02, 0.0])

    found = values_of(score_of(truth, both_pairs(truth, tmp_path / "result", change=change)))
    assert [found[f"slope_{axis}"] for axis in "xyz"] == pytest.approx([0.9, 1.0, 1.2], abs=1e-9)
    assert [found[f"offset_{axis}"] for axis in "xyz"] == pytest.approx([0.3, -0.2, 0.0], abs=1e-9)


def test_a_constant_error_has_its_length_and_no_scatter(truth, tmp_path):
    shift = np.array([0.03, 0.0, 0.04])  # half a voxel
    score = score_of(truth, both_pairs(truth, tmp_path / "result", change=lambda moved: moved + shift))
    found = score.figures
    assert found["error"].value == pytest.approx(0.5) and found["error_mm"].value == pytest.approx(0.05)
    assert found["error"].standard_error == pytest.approx(0, abs=1e-9)
    assert found["error_percent"].value == pytest.approx(0.05 / truth.peak_mm)
    assert found["error_at_50"].value == pytest.approx(0.5)
    (strict,) = score_results(truth, [tmp_path / "result"], ScoreOptions(resamples=4, outlier_voxel=0.4))
    assert found["outliers"].value == 0 and strict.figures["outliers"].value == 1


def test_leaving_out_a_half_scores_a_completeness_of_a_half(truth, tmp_path):
    datasets = []
    for pair in truth.numbers:
        vectors = known_truth.true_vectors(truth, pair)
        datasets.append(vectors.where(vectors["x"] < 0))
    found = values_of(score_of(truth, known_truth.write_pairs(tmp_path / "result", datasets)))
    assert found["completeness"] == pytest.approx(0.5, abs=0.01)
    assert (found["error"] < ROUNDING and found["error_at_50"] < 1e-6) or np.isnan(found["error_at_50"])
    assert np.isnan(found["error_at_80"])  # leaving vectors out does not pay


def test_hiding_bad_vectors_does_not_lower_the_error_at_equal_completeness(truth, tmp_path):
    rng = np.random.default_rng(1)

    def noisy(pair):
        return known_truth.true_vectors(
            truth, pair, change=lambda moved: moved + 0.02 * rng.standard_normal(moved.shape)
        )

    open_ones = [noisy(pair) for pair in truth.numbers]
    hidden = []
    for pair, vectors in enumerate(open_ones):
        off = sum((vectors[name] - known_truth.true_vectors(truth, pair)[name]) ** 2 for name in "uvw")
        hidden.append(vectors.where(off < off.quantile(0.7)))
    shown = values_of(score_of(truth, known_truth.write_pairs(tmp_path / "open", open_ones)))
    less = values_of(score_of(truth, known_truth.write_pairs(tmp_path / "hidden", hidden)))
    assert less["error"] < shown["error"]
    assert less["error_at_50"] == pytest.approx(shown["error_at_50"])
    assert np.isnan(less["error_at_90"]) and np.isfinite(shown["error_at_90"])


def test_a_draw_of_vectors_measures_as_much_as_they_stand_for(truth, tmp_path):
    fields = read_result(both_pairs(truth, tmp_path / "result", change=noise_of(3)), truth, ReadOptions())
    sample = Sample([pair_errors(one, truth) for one in fields], truth)
    half = (np.arange(len(sample.length)) % 2).astype(float)
    part, all_of_them = (sample.statistics(weight) for weight in (half, np.ones_like(half)))
    assert np.isnan(part["error_at_90"]) and np.isfinite(all_of_them["error_at_90"])
    assert part["median"] < part["error_at_50"] <= sample.length.max()


def test_a_lattice_a_little_off_is_scored_in_full(truth, tmp_path):
    axes = [axis + 0.4 * truth.voxel_mm for axis in known_truth.grid_axes(truth)]
    found = score_of(truth, both_pairs(truth, tmp_path / "result", axes=axes))
    assert found.sample.scored.all() and values_of(found)["completeness"] > 0.95


def test_a_missing_pair_counts_as_not_measured_unless_it_is_not_scored(truth, tmp_path):
    path = known_truth.write_pairs(tmp_path / "result", [known_truth.true_vectors(truth, 0)])
    assert values_of(score_of(truth, path))["completeness"] == pytest.approx(0.5)
    assert values_of(score_of(truth, path, pairs=(0, 1)))["completeness"] == 1


def test_vectors_marked_as_not_valid_are_missing_but_count_in_the_error_of_all(truth, tmp_path):
    datasets = []
    for pair in truth.numbers:
        vectors = known_truth.true_vectors(truth, pair)
        bad = (vectors["x"] > 0) & (vectors["u"] == vectors["u"])
        vectors["u"] = vectors["u"].where(~bad, vectors["u"] + 0.1)  # 0.1 m/s is a voxel in a millisecond
        vectors["u"].attrs["units"] = "m/s"
        datasets.append(vectors.assign(valid=(~bad).astype(np.int8)))
    found = values_of(score_of(truth, known_truth.write_pairs(tmp_path / "result", datasets)))
    assert found["error"] < ROUNDING and found["completeness"] == pytest.approx(0.5, abs=0.01)
    assert found["error_all"] == pytest.approx(0.5, abs=0.06)


def test_uncertainties_of_normal_errors_are_judged_right(truth, tmp_path):
    rng, datasets = np.random.default_rng(2), []
    for pair in truth.numbers:
        vectors = known_truth.true_vectors(
            truth, pair, change=lambda moved: moved + 0.02 * rng.standard_normal(moved.shape)
        )
        for axis in "xyz":
            vectors[f"uncertainty_{axis}"] = xr.full_like(
                vectors["u"], 0.01
            )  # m/s: a tenth of a voxel, half of the truth
            vectors[f"uncertainty_{axis}"].attrs["units"] = "m/s"
        datasets.append(vectors)
    found = score_of(truth, known_truth.write_pairs(tmp_path / "result", datasets)).figures
    assert found["sigma_width"].value == pytest.approx(2.0, abs=4 * found["sigma_width"].standard_error)
    assert found["within_two"].value == pytest.approx(0.683, abs=4 * found["within_two"].standard_error)


def test_noise_is_seen_as_divergence(truth, tmp_path):
    noisy = both_pairs(truth, tmp_path / "noisy", change=noise_of(3))
    expected = 0.2 / (2 * 4) * np.sqrt(2 * 3)  # central differences over two spacings of four voxels, three components
    assert values_of(score_of(truth, noisy))["divergence"] == pytest.approx(expected, rel=0.15)
    assert values_of(score_of(truth, both_pairs(truth, tmp_path / "clean")))["divergence"] < 1e-6


def test_the_standard_error_is_about_that_of_independent_errors(truth, tmp_path):
    path = both_pairs(truth, tmp_path / "result", change=noise_of(4))
    (score,) = score_results(truth, [path], ScoreOptions(resamples=200))
    found = score.figures["offset_x"]
    assert found.standard_error == pytest.approx(0.2 / np.sqrt(score.sample.scored.sum()), rel=0.4)
    assert found.low < 0 < found.high


def test_steady_and_unsteady_errors_are_told_apart(tmp_path):
    truth = known_truth.write_truth(tmp_path / "data", known_truth.known_scene(particles={"count": 50, "pairs": 3}))
    shifts = iter([0.02, 0.05, 0.08])
    path = both_pairs(truth, tmp_path / "result", change=lambda moved: moved + (next(shifts), 0.0, 0.0))
    found = values_of(score_of(truth, path))
    assert found["error_steady"] == pytest.approx(0.5)
    assert found["error_unsteady"] == pytest.approx(0.3 * np.sqrt(2 / 3))


def test_scattered_particles_are_matched_with_the_true_ones(truth, tmp_path):
    tables, shift, names = [], 0.03, ("x", "y", "z", "dx", "dy", "dz")
    for pair in truth.numbers:
        true = truth.particles(pair)
        inside = truth.inside(true.positions_mm)
        place, moved = true.positions_mm[inside], true.displacement_mm[inside]
        kept = np.arange(len(place)) % 4 != 0  # every fourth one is missing
        ghosts = np.random.default_rng(5).uniform(-0.02, 0.02, (30, 3))  # nearer to each other than to any particle
        place = np.concatenate([place[kept] + (shift, 0, 0), ghosts])
        moved = np.concatenate([moved[kept], np.zeros((30, 3))])
        rows = np.column_stack([np.full(len(place), pair), place, moved])
        tables.append(pd.DataFrame(rows, columns=["pair", *(f"{name} [mm]" for name in names)]))
    path = tmp_path / "particles.csv"
    pd.concat(tables).to_csv(path, index=False)
    score = score_of(truth, path)
    found = values_of(score)
    assert score.kind == "particles"
    assert found["found"] == pytest.approx(0.75, abs=0.01)
    assert found["false"] == pytest.approx(30 / 330, abs=0.02)
    assert found["position_x"] == pytest.approx(10 * shift, abs=0.05) and found["matched_error"] < 0.1


def test_volumes_of_the_true_particles_have_the_highest_quality(truth, tmp_path):
    path = both_pairs(truth, tmp_path / "result")
    positions, light = truth.frame(1, 1)
    volume = metrics.truth_volume(positions, light, truth.grid, 0.7).rename("light")
    (tmp_path / "volumes").mkdir()
    stranger = volume.transpose("x", "z", "y").to_dataset()
    for axis in "xyz":
        stranger[axis] = (axis, stranger[axis].values / 1000, {"units": "m"})
    stranger.to_netcdf(tmp_path / "volumes" / "pair_0001_b.nc", engine="h5netcdf")
    good = values_of(score_of(truth, path, volumes=tmp_path / "volumes"))
    assert good["quality"] == pytest.approx(1, abs=1e-4) and good["ghosts"] < 0.05
    (tmp_path / "volumes" / "pair_0001_b.nc").rename(tmp_path / "volumes" / "pair_0001_a.nc")
    assert values_of(score_of(truth, path, volumes=tmp_path / "volumes"))["quality"] < 0.9


def test_vectors_outside_the_volume_are_refused_with_a_hint(truth, tmp_path):
    vectors = known_truth.true_vectors(truth, 0)
    path = known_truth.write_pairs(
        tmp_path / "result", [vectors.assign_coords(x=vectors["x"].copy(data=vectors["x"] + 50))]
    )
    dataset = xr.load_dataset(path / "pair_0000.nc")
    dataset["x"].attrs["units"] = "mm"
    dataset.to_netcdf(path / "pair_0000.nc", engine="h5netcdf")
    with pytest.raises(InputError, match="measurable region, found none of 0 in the volume"):
        score_of(truth, path)


def test_the_command_prints_a_table_and_writes_page_and_json(truth, tmp_path, capfd):
    path = both_pairs(truth, tmp_path / "mine", window_mm=WINDOW)
    data, page, numbers = str(truth.folder.parent), tmp_path / "score.html", tmp_path / "score.json"
    assert (
        commands.call(
            ["benchmark", "score", data, str(path), str(path), "--label", "a", "--label", "b", "-o", str(page)]
        )
        == 0
    )
    shown = capfd.readouterr().out
    assert "completeness [%]" in shown and "slope z" in shown
    text = page.read_text("utf-8")
    assert text.count("<svg") >= 9 and "Kähler" in text and "<script" not in text
    drawn = text[text.index("<main>") :]
    assert "#000000" not in drawn and "nan" not in drawn  # ink is the page's, light or dark
    assert commands.call(["benchmark", "score", data, str(path), "--json", "--out", str(numbers)]) == 0
    printed = json.loads(capfd.readouterr().out)
    assert printed == json.loads(numbers.read_text("utf-8"))
    assert printed["results"][0]["figures"]["error"]["value"] == pytest.approx(0, abs=1e-6)
    assert commands.call(["benchmark", "score", data, str(path), "--window-mm", "0"]) == 2
    assert capfd.readouterr().err.count("\n") == 1


def test_a_label_may_look_like_a_formula(truth, tmp_path, capfd):
    path = both_pairs(truth, tmp_path / "result")
    page = tmp_path / "score.html"
    labels = ["--label", r"$\frac{a}$", "--label", "5 $ of _{"]
    command = ["benchmark", "score", str(truth.folder.parent), str(path), str(path), *labels, "--out", str(page)]
    assert commands.call(command) == 0, capfd.readouterr().err
    assert r"$\frac{a}$" in page.read_text("utf-8")


def test_a_place_for_the_page_is_asked_for_before_work(tmp_path, capfd):
    out = tmp_path / "missing" / "score.html"
    assert commands.call(["benchmark", "score", "no data", "no result", "--out", str(out)]) == 2
    assert f"no folder {out.parent}. Make it first" in capfd.readouterr().err


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("mark", [1e300, 1e36, -np.inf])
def test_marks_of_missing_values_are_no_vectors(truth, tmp_path, mark):
    vectors = known_truth.true_vectors(truth, 0)
    order = np.arange(vectors["u"].size).reshape(vectors["u"].shape)
    vectors["v"] = vectors["v"].where(xr.DataArray(order % 2 == 0, dims=("z", "y", "x")), mark)
    score = score_of(truth, known_truth.write_pairs(tmp_path / "result", [vectors]), pairs=(0, 1))
    assert values_of(score)["error"] < ROUNDING and values_of(score)["completeness"] == pytest.approx(0.5, abs=0.03)


def test_every_figure_of_a_score_is_defined(truth, tmp_path):
    score = score_of(truth, both_pairs(truth, tmp_path / "result"))
    defined = [key for figure in all_figures() for key in keys_of(figure)]
    assert len(set(defined)) == len(defined)
    assert set(score.figures) <= set(defined)
    assert json.loads(json.dumps(plain(report(truth, [score])), allow_nan=False))["case"] == "known"


@pytest.mark.parametrize("damage", ["missing", "spec", "particles"])
def test_a_missing_or_damaged_truth_is_refused(truth, tmp_path, damage):
    folder = tmp_path / "data"
    shutil.copytree(truth.folder.parent, folder)
    if damage == "missing":
        shutil.rmtree(folder / "truth")
    elif damage == "spec":
        (folder / "truth" / "spec.json").write_text('{"name": 3}', "utf-8")
    else:
        (folder / "truth" / "particles.npz").write_bytes(b"PK\x03\x04 no archive")
    with pytest.raises(InputError, match="truth of a simulated data set"):
        open_truth(folder)


def test_options_of_one_result_are_not_used_silently_for_none(truth, tmp_path):
    path = both_pairs(truth, tmp_path / "result")
    with pytest.raises(InputError, match="--label"):
        score_results(truth, [path], QUICK, labels=["a", "b"])
    with pytest.raises(InputError, match="--pairs"):
        score_of(truth, path, pairs=(7, None))
    with pytest.raises(InputError, match="expected it in mm or m"):
        score_of(truth, path, reading=ReadOptions(units={"position": "voxel"}))


def test_instants_of_a_series_are_scored_midway_in_time(tmp_path):
    scene = known_truth.known_scene(particles={"count": 300, "instants": 4})
    truth = known_truth.write_truth(tmp_path / "data", scene)
    assert truth.numbers == (0, 1, 2) and truth.noun == "instant"
    datasets = [known_truth.true_vectors(truth, number) for number in truth.numbers]
    empty = datasets[0].where(False)  # the last instant has no partner
    both = xr.concat([*datasets, empty], "instant").assign_coords(instant=[0, 1, 2, 3])
    both.to_netcdf(tmp_path / "series.nc", engine="h5netcdf")
    score = score_of(truth, tmp_path / "series.nc")
    assert values_of(score)["error"] < ROUNDING and values_of(score)["completeness"] == pytest.approx(1)
    assert [one["number"] for one in score.instants] == [0, 1, 2]
    rows = []
    for number in truth.numbers:
        true = truth.particles(number)
        rows.append(np.column_stack([np.full(len(true.intensity), number), true.positions_mm, true.displacement_mm]))
    names = ["instant", *(f"{name} [mm]" for name in ("x", "y", "z", "dx", "dy", "dz"))]
    pd.DataFrame(np.concatenate(rows), columns=names).to_csv(tmp_path / "tracks.csv", index=False)
    found = values_of(score_of(truth, tmp_path / "tracks.csv"))
    assert found["found"] == 1 and found["false"] == 0 and found["matched_error"] < 1e-6
    assert found["error"] < 0.02  # a curved path is not the flow at its middle


def test_without_the_file_of_the_flow_the_particles_are_the_truth(tmp_path):
    rng = np.random.default_rng(6)
    start = rng.uniform(0, 1, (400, 3))
    np.savez(tmp_path / "tracers.npz", t0=start, t1=start + (0.02, 0.0, -0.01))
    flow = {"kind": "tracers", "file": str(tmp_path / "tracers.npz"), "size_mm": known_truth.SIZE_MM, "as_given": True}
    truth = known_truth.write_truth(tmp_path / "data", known_truth.known_scene(flow=flow))
    path = both_pairs(truth, tmp_path / "result")
    assert score_of(truth, path).figures["error"].value < ROUNDING
    spec = tmp_path / "data" / "truth" / "spec.json"
    spec.write_text(spec.read_text("utf-8").replace(str(tmp_path / "tracers.npz"), "with_truth.npz"), "utf-8")
    (tmp_path / "tracers.npz").rename(spec.with_name("with_truth.npz"))
    assert not any("true particles" in note for note in score_of(open_truth(tmp_path / "data"), path).notes)
    spec.write_text(spec.read_text("utf-8").replace("with_truth.npz", "absent.npz"), "utf-8")
    score = score_of(open_truth(tmp_path / "data"), path)
    assert values_of(score)["error"] == pytest.approx(0, abs=1e-6)
    assert any("mean of the true particles" in note for note in score.notes)


def test_the_truth_of_another_case_is_refused(truth, tmp_path):
    data, apart = tmp_path / "data", tmp_path / "apart"
    shutil.copytree(truth.folder, apart)
    data.mkdir()
    for folder, digest in ((data, "a"), (apart, "b")):
        (folder / "benchmark.json").write_text(json.dumps({"case": digest, "images_sha256": digest}), "utf-8")
    with pytest.raises(InputError, match="found that of others"):
        open_truth(data, apart)
    (data / "benchmark.json").write_text(json.dumps({"case": "b", "images_sha256": "b"}), "utf-8")
    assert open_truth(data, apart).about["case"] == "b"


@pytest.mark.parametrize(
    ("value", "spread", "text"),
    [
        (1.02000001, 2e-16, "1.02"),
        (0.41834, 0.0112, "0.418 ± 0.011"),
        (1e-17, 1e-18, "0.000000 ± 0.000000"),
        (0.5, float("nan"), "0.5"),
        (-0.25, 0.1, "\N{MINUS SIGN}0.25 ± 0.10"),
    ],
)
def test_figures_have_as_many_digits_as_their_error_allows(value, spread, text):
    slope = next(figure for figure in all_figures() if figure.unit == "1")
    assert cell(slope, metrics.Estimate(value=value, standard_error=spread, low=value, high=value)) == text
