"""Made cases: complete or absent, reproducible, with a truth in plain form that agrees with the simulator's."""

import csv
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import tifffile
import xarray as xr

from lfpiv.benchmark import cases, fingerprint, plain_truth
from lfpiv.benchmark.make import keep_tracers, make
from lfpiv.cli import commands
from lfpiv.errors import InputError
from lfpiv.experiment.opening import open_experiment
from lfpiv.simulation.flows import window_mean

ROOT = Path(__file__).resolve().parents[2]
WORDS_OF_THE_TRUTH = r"true_|seed|peak_mm|truth_sha256|intensity"
"""What no file of a data set may contain when its truth lies apart."""


@pytest.fixture(scope="module")
def made(tmp_path_factory, device):
    """The smallest case with its truth apart."""
    folder = tmp_path_factory.mktemp("made")
    (one,) = make(["trial"], folder / "data", truth=folder / "secret")
    return one


@pytest.fixture(scope="module")
def scene():
    return cases.scene_of(cases.case_of("trial"))


def files_of(folder):
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_an_experiment_can_be_opened_from_the_images(made):
    experiment = open_experiment(made.folder / "experiment.toml")
    assert [camera.name for camera in experiment.cameras] == ["left", "right"]
    assert not (made.folder / "truth").exists() and {path.name for path in made.folder.parent.iterdir()} == {
        "data",
        "secret",
    }


def test_nothing_of_the_truth_is_in_the_data_set(made):
    texts = {name: text for name, text in files_of(made.folder).items() if not name.endswith(".tif")}
    assert set(texts) == {"README.txt", "benchmark.json", "experiment.toml"}
    for name, text in texts.items():
        assert not re.search(WORDS_OF_THE_TRUTH, text.decode()), name


def test_it_is_as_recorded_and_says_which_case_it_is(made, scene):
    assert made.verdict in ("identical", "equal within rounding"), made.reason
    public, secret = (json.loads((place / "benchmark.json").read_text()) for place in (made.folder, made.truth))
    assert (public["benchmark"], public["case"]) == (cases.case_list().version, "trial")
    assert public.items() <= secret.items() and secret["seed"] == scene.seed
    with np.load(made.truth / "particles.npz") as arrays:
        assert secret["truth_sha256"] == fingerprint.truth_sha256(arrays)
    assert public["grid"]["window_mm"] == pytest.approx(1.2) and public["pairs"] == [0]


@pytest.mark.slow
def test_another_process_with_other_threads_makes_the_same_bits(made, tmp_path):
    script = (
        "from lfpiv_kernels import runtime; runtime.start('cpu', threads=3);"
        "from lfpiv.benchmark.make import make; import sys; make(['trial'], sys.argv[1])"
    )
    subprocess.run([sys.executable, "-c", script, tmp_path / "again"], check=True, cwd=ROOT, env={**os.environ})
    first, second = files_of(made.folder), files_of(tmp_path / "again")
    assert len(first) > 12 and all(second[name] == first[name] for name in first)
    assert all(
        second[f"truth/{name}"] == text
        for name, text in files_of(made.truth).items()
        if name.endswith((".csv", ".json"))
    )


def test_the_flow_is_the_mean_over_the_windows(made, scene):
    with xr.open_dataset(made.truth / "flow.nc", engine="h5netcdf") as flow:
        assert flow["u"].dims == ("pair", "z", "y", "x") and flow["x"].attrs["units"] == "mm"
        at = dict(pair=0, z=-1, y=0, x=1)
        point = [[float(flow[axis][at[axis]]) for axis in "xyz"]]
        expected = window_mean(scene.flow_of(0), np.array(point), flow.attrs["window_mm"])[0]
        found = [float(flow[name][at]) for name in "uvw"]
        np.testing.assert_allclose(found, expected / scene.dt_s / 1000, atol=1e-9)
        shift = [float(flow[f"displacement_{axis}"][at]) for axis in "xyz"]
        np.testing.assert_allclose(shift, expected / scene.volume.voxel_mm, atol=1e-6)


def test_windows_of_the_recommended_grid_lie_in_the_volume():
    for name in ("base", "trial", "paper-size"):
        scene = cases.scene_of(cases.case_of(name))
        grid = plain_truth.recommended_grid(scene)
        reach = np.abs(grid.centres_mm - scene.volume.centre_mm).max(0) + grid.window_mm / 2
        half = np.array(scene.volume.size_mm) / 2
        assert (reach <= half + 1e-9).all() and (reach > half - grid.spacing_mm).all()


def test_the_table_has_every_particle(made):
    with (made.truth / "particles.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    with np.load(made.truth / "particles.npz") as arrays:
        position, moved = arrays["pair_0000_positions_mm"], arrays["pair_0000_displacement_mm"]
    assert {row["pair"] for row in rows} == {"0"}
    found = np.array([[float(row[f"{name} [mm]"]) for name in ("x", "y", "z", "dx", "dy", "dz")] for row in rows])
    np.testing.assert_allclose(found, np.hstack([position, moved]), atol=1e-7)


def test_instants_without_partner_have_no_displacement_in_the_table(tmp_path):
    arrays = {
        "instant_000000_positions_mm": np.ones((2, 3)),
        "instant_000000_displacement_mm": np.full((2, 3), 0.1),
        "instant_000000_intensity": np.ones(2),
        "instant_000000_index": np.array([4, 9]),
        "instant_000001_positions_mm": np.ones((1, 3)),
        "instant_000001_intensity": np.ones(1),
        "instant_000001_index": np.array([9]),
    }
    plain_truth.write_particles(arrays, tmp_path / "particles.csv")
    head, *rows = csv.reader((tmp_path / "particles.csv").open(newline=""))
    assert head[:2] == ["instant", "index"] and [row[:2] for row in rows] == [["0", "4"], ["0", "9"], ["1", "9"]]
    assert rows[0][5] == "0.1000000" and rows[2][5:8] == ["", "", ""]


def test_tracers_go_with_the_truth_and_no_path_of_the_machine_does(tmp_path):
    file, truth = tmp_path / "rayleigh.npz", tmp_path / "truth"
    np.savez(file, positions=np.zeros((2, 3, 3)))
    truth.mkdir()
    (truth / "spec.json").write_text(json.dumps({"name": "dns", "flow": {"kind": "tracers", "file": str(file)}}))
    keep_tracers(file, truth)
    assert json.loads((truth / "spec.json").read_text())["flow"] == {"kind": "tracers", "file": "tracers.npz"}
    assert (truth / "tracers.npz").read_bytes() == file.read_bytes()


def test_a_complete_case_is_kept_and_another_is_refused(made):
    before = {path: path.stat().st_mtime_ns for path in made.folder.rglob("*")}
    (again,) = make(["trial"], made.folder, truth=made.truth)
    assert again == made and {path: path.stat().st_mtime_ns for path in made.folder.rglob("*")} == before
    with pytest.raises(InputError, match="expected an empty or absent folder"):
        make(["trial"], made.folder, truth=made.truth, seed=3)
    with pytest.raises(InputError, match="expected an empty or absent folder"):
        make(["base"], made.folder, truth=made.truth)


def test_an_interrupted_case_leaves_nothing(tmp_path):
    def stop(step, fraction):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make(["trial"], tmp_path / "data", truth=tmp_path / "secret", progress=stop)
    assert not list(tmp_path.iterdir())


def test_a_truth_that_a_killed_command_left_does_not_stop_the_same_command(made, tmp_path):
    def stop(step, fraction):
        raise KeyboardInterrupt

    shutil.copytree(made.truth, tmp_path / "secret")
    with pytest.raises(KeyboardInterrupt):
        make(["trial"], tmp_path / "data", truth=tmp_path / "secret", progress=stop)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_case_that_another_command_made_meanwhile_stays(made, tmp_path):
    def other(step, fraction):
        if not (tmp_path / "data").exists():
            shutil.copytree(made.folder, tmp_path / "data")

    with pytest.raises(InputError, match="expected an empty or absent folder"):
        make(["trial"], tmp_path / "data", truth=tmp_path / "secret", progress=other)
    assert [path.name for path in tmp_path.iterdir()] == ["data"]


def test_folders_that_cannot_be_are_refused_before_work(tmp_path):
    for out, truth in (("data", "data/secret"), ("data", "data"), ("secret/data", "secret")):
        with pytest.raises(InputError, match="outside"):
            make(["trial"], tmp_path / out, truth=tmp_path / truth)
    with pytest.raises(InputError, match="expected the name of a case, or all"):
        make([], tmp_path / "data")
    with pytest.raises(InputError, match="needs none"):
        make(["trial"], tmp_path / "data", tracers=tmp_path / "tracers.npz")
    assert not list(tmp_path.iterdir())


def test_the_command_line_lists_and_makes(made, capfd):
    assert commands.call(["benchmark", "list"]) == 0
    lines = capfd.readouterr().out.splitlines()
    assert lines[0].split()[:3] == ["case", "varies", "cameras"]
    assert {line.split()[0] for line in lines[1:]} >= set(cases.names())
    arguments = ["benchmark", "make", "trial", "-o", str(made.folder), "--truth", str(made.truth)]
    assert commands.call([*arguments, "--json"]) == 0
    (row,) = json.loads(capfd.readouterr().out)
    assert row == {name: value if isinstance(value, str) else str(value) for name, value in vars(made).items()}
    assert commands.call([*arguments, "--seed", "4"]) == 2


def test_fingerprints_tell_rounding_from_another_draw(made, tmp_path):
    known = fingerprint.record().cases["trial"]
    found = fingerprint.fingerprint_of(made.folder, made.truth)
    rng = np.random.default_rng(3)
    for name in files_of(made.folder):
        if name.endswith(".tif"):
            image = tifffile.imread(made.folder / name).astype(float)
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            noisy = np.rint(np.clip(image + np.sqrt(9 + 0.41 * image) * rng.standard_normal(image.shape), 0, 4095))
            tifffile.imwrite(path, noisy.astype(np.uint16))
    noisy = fingerprint.fingerprint_of(tmp_path, made.truth)
    assert fingerprint.compare(found, found) == "identical"
    assert fingerprint.compare(noisy, found) == "equal within rounding" and noisy.images_sha256 != found.images_sha256
    dimmer = {name: tuple(0.98 * value for value in blocks) for name, blocks in found.images.items()}
    assert fingerprint.compare(found.model_copy(update={"images": dimmer, "images_sha256": "0"}), found) == "differs"
    moved = {name: (value[0], *(one + 1e-4 for one in value[1:])) for name, value in known.truth.items()}
    assert fingerprint.compare(found.model_copy(update={"truth": moved, "truth_sha256": "0"}), found) == "differs"


def test_the_checksum_of_the_truth_sees_a_nanometre_and_no_rounding(made):
    with np.load(made.truth / "particles.npz") as arrays:
        particles = dict(arrays)
    known, name = fingerprint.truth_sha256(particles), "pair_0000_positions_mm"
    exact = np.rint(particles[name] / 1e-9) * 1e-9
    assert fingerprint.truth_sha256(particles | {name: exact + 1e-15}) == known
    assert fingerprint.truth_sha256(particles | {name: exact + 2e-9}) != known
    assert fingerprint.truth_sha256(particles | {"pair_0000_intensity": np.zeros(3)}) == known
