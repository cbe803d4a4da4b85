"""Forged, damaged and foreign results in a folder: named, and made again with the same numbers."""

import shutil

import h5py
import pytest
from support.small_run import PAIRS, same_vectors
from support.stored import rewrite

import lfpiv
from lfpiv.errors import DamagedFile, InputError, StorageError
from lfpiv.results.provenance import read_marks
from lfpiv.runs import pipeline


def change(name, apply):
    def forge(path):
        rewrite(path, lambda file: file[name].__setitem__(..., apply(file[name][()])))

    return forge


def flip(path):
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 4
    path.write_bytes(content)


def doubled(path):
    change("u", lambda values: 2 * values)(path)


def cut(path):
    path.write_bytes(path.read_bytes()[:-3000])


def of_pair(number):
    def forge(path):
        shutil.copy2(path.with_name(f"pair_{number:04d}.nc"), path)

    return forge


@pytest.fixture
def out(coarse_run, tmp_path):
    return coarse_run.results(tmp_path / "out")


def rejected(caplog):
    """Return the names of the files that the log names as damaged or foreign; it names each once in a run."""
    lines = [message for message in caplog.messages if "damaged or foreign, not used" in message]
    assert len(lines) == len(set(lines))
    return sorted({line.split(": damaged")[0].rsplit("/", 1)[1] for line in lines})


@pytest.mark.slow
def test_forged_vectors_are_named_and_made_again(coarse_run, out, caplog):
    """The volumes are whole, so that only the correlation is done again."""
    reference = coarse_run.out
    forgeries = {0: doubled, 1: of_pair(2), 3: flip}
    for pair, forge in forgeries.items():
        forge(out / "vectors" / f"pair_{pair:04d}.nc")
    with pytest.raises(DamagedFile, match=r"pair_000[013]\.nc"):
        lfpiv.open_results(out).u.load()
    with pytest.raises(DamagedFile, match=r"pair_0000\.nc.*Run `lfpiv run`, which makes it again"):
        pipeline.report(coarse_run.experiment, out)
    caplog.clear()
    with caplog.at_level("INFO", "lfpiv"):
        summary = pipeline.correlate(coarse_run.experiment, out)
    assert rejected(caplog) == [f"pair_{pair:04d}.nc" for pair in forgeries]
    assert len(summary["pairs"]) == PAIRS and not summary["failed"]
    assert same_vectors(out, reference) == PAIRS
    caplog.clear()
    assert len(pipeline.correlate(coarse_run.experiment, out)["pairs"]) == PAIRS
    assert not rejected(caplog)


def test_volumes_of_other_pairs_and_frames_are_not_correlated(coarse_run, out, caplog):
    shutil.rmtree(out / "vectors")
    volumes = out / "volumes"
    shutil.copy2(volumes / "pair_0000_b.nc", volumes / "pair_0000_a.nc")
    shutil.copy2(volumes / "pair_0002_a.nc", volumes / "pair_0001_a.nc")
    change("intensity", lambda values: 0 * values)(volumes / "pair_0002_b.nc")
    shutil.copy2(volumes / "pair_0003_b.nc", volumes / "pair_0003_a.nc")
    with pytest.raises(lfpiv.InputError, match="expected the two volumes"):
        pipeline.correlate(coarse_run.experiment, out)
    assert rejected(caplog) == [f"pair_000{name}.nc" for name in ("0_a", "1_a", "2_b", "3_a")]


@pytest.mark.slow
@pytest.mark.parametrize("step", ["weights", "image pairs"])
def test_a_folder_that_is_removed_during_the_run_ends_it(coarse_run, tmp_path, step):
    out = coarse_run.prepared(tmp_path / "out")

    def remove(now, fraction):
        if now == step and fraction > 0:
            shutil.rmtree(out, ignore_errors=True)

    with pytest.raises(StorageError, match=r"out.*removed or renamed .*run the command again"):
        pipeline.run(coarse_run.experiment, out, pairs=(0, 2), progress=remove)


def swap_cameras(path):
    rewrite(path, lambda file: [file.move(f"camera/{one}", f"camera/{other}") for one, other in SWAPS])


SWAPS = (("left", "kept"), ("right", "left"), ("kept", "right"))


def link(path):
    def change(file):
        del file["camera/left"]
        file["camera/left"] = h5py.ExternalLink("other.h5", "/camera/left")

    rewrite(path, change)


@pytest.mark.parametrize("forge", [swap_cameras, link, flip, cut])
def test_a_forged_calibration_is_refused_where_it_is_not_made(coarse_run, out, forge):
    path = out / "calibration.h5"
    forge(path)
    for step in (pipeline.correlate, pipeline.report):
        with pytest.raises(DamagedFile, match=r"calibration\.h5.*make it again"):
            step(coarse_run.experiment, out)
    assert read_marks(path) is None


@pytest.mark.slow
def test_a_run_mends_a_folder_with_equal_numbers(small_run, tmp_path, caplog):
    """Calibration, background, guard layers, refinement, a volume and vectors at once."""
    out = small_run.results(tmp_path / "out")
    for name in ("calibration.h5", "background.h5", "guard.json", "refinement.json"):
        flip(out / name)
    flip(out / "volumes" / "pair_0001_b.nc")
    doubled(out / "vectors" / "pair_0001.nc")
    summary = pipeline.run(small_run.experiment, out, keep_volumes=True)
    wanted = {"calibration.h5", "background.h5", "guard.json", "refinement.json", "pair_0001.nc"}
    assert wanted <= set(rejected(caplog)) and not summary["failed"]
    assert same_vectors(out, small_run.out) == PAIRS
    caplog.clear()
    pipeline.run(small_run.experiment, out, keep_volumes=True)
    assert not rejected(caplog)


def test_vectors_of_links_are_not_made_from_volumes(coarse_run, tmp_path):
    """Volumes hold no linked particles."""
    experiment, out = coarse_run.images(tmp_path / "data"), coarse_run.results(tmp_path / "out")
    experiment.write_text(experiment.read_text("utf-8") + '\n[tracking]\nvectors = "links"\n', "utf-8")
    with pytest.raises(InputError, match=r"tracking.vectors .* Use `lfpiv run`"):
        pipeline.correlate(experiment, out)
