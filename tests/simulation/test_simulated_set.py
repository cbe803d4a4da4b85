"""Simulator: the data set on disk, what it promises, and what it refuses."""

import json
import os

import numpy as np
import pytest
import tifffile
from scipy.ndimage import gaussian_filter
from support.simulated_cameras import MONTE_CARLO, ROUNDING, SMALL_SCENE, refusal

from lfpiv.errors import InputError
from lfpiv.experiment.opening import open_experiment
from lfpiv.simulation.camera_images import render_camera
from lfpiv.simulation.scene import Scene, open_scene
from lfpiv.simulation.simulator import simulate
from lfpiv_kernels.rendering import render


@pytest.fixture(scope="module")
def small(tmp_path_factory, device):
    folder = tmp_path_factory.mktemp("scene")
    (folder / "scene.toml").write_text(SMALL_SCENE)
    steps = []
    path = simulate(folder / "scene.toml", folder / "data", progress=lambda *step: steps.append(step))
    return folder, path, steps


def test_data_set_is_a_valid_experiment_with_truth(small):
    folder, path, steps = small
    experiment = open_experiment(path)
    assert path == folder / "data" / "experiment.toml" and sorted(os.listdir(folder)) == ["data", "scene.toml"]
    assert [c.optics.sensor_shape for c in experiment.cameras] == [(130, 170), (150, 140)]
    assert experiment.cameras[1].optics.layout == "hexagonal" and experiment.grid.shape == (4, 5, 6)
    assert experiment.smart.iterations == 3 and experiment.dt_s == 2e-4
    assert "true" not in path.read_text()  # the truth stays hidden
    assert steps[-1] == ("simulated images", 1.0) and len(list(path.parent.rglob("*.tif"))) == len(steps) == 15
    dark = experiment.dark("two")
    assert abs(dark.mean() - 40) < MONTE_CARLO * 3 / np.sqrt(dark.size) and experiment.dark("one") is None

    scene = open_scene(folder / "scene.toml")
    spec = json.loads((path.parent / "truth" / "spec.json").read_text())
    again = Scene.model_validate(spec)
    assert again.camera == scene.camera and again.flow == scene.flow and again.noise == scene.noise
    with np.load(path.parent / "truth" / "particles.npz") as truth:
        first, second = truth["pair_0000_positions_mm"], truth["pair_0001_positions_mm"]
        assert len(first) == round(0.5 * 6 * 5) and not np.array_equal(first, second)
        assert (np.abs(first) <= np.array([0.3, 0.25, 0.2])).all()
        assert np.allclose(truth["pair_0000_displacement_mm"], scene.flow(first), atol=ROUNDING)
        assert truth["pair_0000_intensity"].min() >= 0.3


def test_particle_images_show_the_truth_at_both_instants(small):
    """Frame a is the truth at -displacement/2, frame b at +displacement/2, and not the other way round."""
    folder, path, _ = small
    experiment, scene = open_experiment(path), open_scene(folder / "scene.toml")
    with np.load(path.parent / "truth" / "particles.npz") as truth:
        position, moved, intensity = (
            truth[f"pair_0001_{key}"] for key in ("positions_mm", "displacement_mm", "intensity")
        )
    rays = render.ray_table(16384, "gaussian", 99)
    for number, name in enumerate(("one", "two")):
        renderer = render_camera(scene.camera[number], seed=[scene.seed, 3, number])
        frames = {
            sign: gaussian_filter(
                render.render_sources(
                    renderer,
                    position + sign * moved,
                    600 * renderer.microimage_px * intensity,
                    0.02,
                    rays,
                    rng=np.random.default_rng(1),
                ),
                scene.camera[number].blur_px,
            )
            for sign in (-0.5, 0.5)
        }
        for frame, sign in (("a", -0.5), ("b", 0.5)):
            recorded = experiment.particle_image(name, 1, frame) - 40
            error = np.linalg.norm(recorded - frames[sign]) / np.linalg.norm(frames[sign])
            other = np.linalg.norm(recorded - frames[-sign]) / np.linalg.norm(frames[sign])
            assert error < 0.2 and other > 2 * error  # rays of two tables, shot and read noise leave 10 to 15 %


def test_equal_seeds_give_equal_files_and_a_flip_mirrors(small, tmp_path):
    folder, path, _ = small
    text = SMALL_SCENE.replace('name = "two"', 'name = "two"\nimage_flip = "both"')
    text = text.replace('name = "one"', 'name = "one"\nimage_flip = "vertical"')
    (tmp_path / "flipped.toml").write_text(text)
    flipped = open_experiment(simulate(tmp_path / "flipped.toml", tmp_path / "flipped"))
    straight = open_experiment(path)
    raw = tifffile.imread(flipped.cameras[0].white_path)
    assert np.array_equal(raw[::-1], tifffile.imread(straight.cameras[0].white_path))
    for name in ("one", "two"):
        assert np.array_equal(flipped.white(name), straight.white(name))
        assert np.array_equal(flipped.board_image(name, 1), straight.board_image(name, 1))
        assert np.array_equal(flipped.particle_image(name, 1, "b"), straight.particle_image(name, 1, "b"))
    other = simulate(open_scene(folder / "scene.toml").model_copy(update={"seed": 6}), tmp_path / "other")
    assert not np.array_equal(open_experiment(other).white("one"), straight.white("one"))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("f_number = 4.0", "f_numer = 4.0", "f_numer"),
        ('kind = "swirl"', 'kind = "whirl"', "'uniform' or 'shear' or 'ring' or 'swirl' or 'swirling_jet'"),
        ("core_mm = 0.2", "core = 0.2", "flow.core: unknown key. Did you mean 'core_mm'?"),
        ("per_microlens = 0.5", "per_microlens = 0.5\ncount = 3", "either per_microlens or count"),
        ("per_microlens = 0.5", "per_microlens = 1e-9", "at least one particle"),
        ("seed = 5", 'seed = "5"', "seed"),
        ("pixel_um = 5.5", "pixel_um = -5.5", "pixel_um"),
        ('name = "two"', 'name = "one"', "a different name"),
        ("planes_mm = [-0.2, 0.2]", "planes_mm = [-0.2, 150.0]", "board.planes_mm"),
        (
            'kind = "swirl"\npeak_mm = 0.05\ncore_mm = 0.2',
            'kind = "tracers"\nfile = "t.npz"\nsize_mm = [1, 1, 1]',
            "t.npz",
        ),
    ],
)
def test_a_bad_scene_is_refused_before_any_work(tmp_path, old, new, message):
    assert old in SMALL_SCENE
    assert message in refusal(SMALL_SCENE.replace(old, new, 1), tmp_path)


def test_a_folder_with_files_is_left_alone(small, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine").write_text("kept")
    with pytest.raises(InputError, match="empty or absent folder"):
        simulate(small[0] / "scene.toml", tmp_path / "out")
    assert os.listdir(tmp_path / "out") == ["mine"] and os.listdir(tmp_path) == ["out"]


def test_interrupted_simulation_leaves_nothing(tmp_path):
    (tmp_path / "scene.toml").write_text(SMALL_SCENE)

    def stop(what, fraction):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate(tmp_path / "scene.toml", tmp_path / "out", progress=stop)
    assert os.listdir(tmp_path) == ["scene.toml"]
