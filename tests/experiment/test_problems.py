"""Messages about values that do not fit: real keys of the file, all that are missing, and all forms of a value."""

import re
from pathlib import Path

import pytest

import lfpiv
from lfpiv.errors import InputError
from lfpiv.experiment.opening import read_experiment
from lfpiv.simulation.scene import open_scene

DEMO_SCENE = (Path(lfpiv.__file__).parent / "cli" / "demo_scene.toml").read_text("utf-8")

EXPERIMENTS = {
    "two keys missing of one form": (
        '[[volume.solid]]\nkind = "box"',
        "volume.solid[0].centre_mm, volume.solid[0].size_mm: these keys are missing. Add them.",
    ),
    "no form": (
        "[[volume.solid]]\ncentre_mm = [0, 0, 0]",
        "volume.solid[0]: expected kind = 'half_space' or 'box', found a table without kind.",
    ),
    "unknown form": (
        '[[volume.solid]]\nkind = "sphere"',
        "volume.solid[0]: expected kind = 'half_space' or 'box', found the text 'sphere'.",
    ),
    "key of another form": (
        '[[volume.solid]]\nkind = "box"\ncentre_mm = [0, 0, 0]\nsize_mm = [1, 1, 1]\nnormal = [0, 0, 1]',
        "volume.solid[0].normal: unknown key. Known here: kind, centre_mm, size_mm.",
    ),
    "neither number nor word": (
        '[smart]\nsubsets = "many"',
        "smart.subsets: expected a whole number or 'auto', found the text 'many'.",
    ),
    "text for a number": (
        '[compute]\nthreads = "two"',
        "compute.threads: expected a whole number, found the text 'two'. Write it without quotes.",
    ),
    "short list in a list": (
        "[correlation]\nwindows = [[8, 8]]",
        "correlation.windows[0][2]: expected more values, found only [8, 8].",
    ),
    "wrong entry of a list": (
        "[correlation]\nwindows = [32, 3]",
        "correlation.windows[1]: expected 4 or more or a list in brackets, found 3.",
    ),
}

FLOWS = {
    "": (
        "flow: expected kind = 'uniform' or 'shear' or 'ring' or 'swirl' or 'swirling_jet' or 'tracers', "
        "found a table without kind."
    ),
    'kind = "swirl"': "flow.peak_mm, flow.core_mm: these keys are missing. Add them.",
    'kind = "ring"\npeak_mm = 0.1': "flow.radius_mm, flow.core_mm: these keys are missing. Add them.",
    'kind = "swirl"\ncore_mm = 1.0': "flow.peak_mm: this key is missing. Add it.",
    'kind = "swirl"\ncore_mm = 1.0\npeak = 1': (
        "flow.peak: unknown key. Did you mean 'peak_mm'? Also look at: flow.peak_mm."
    ),
    'kind = "ring"\nalong = "x"': (
        "flow.along: unknown key. Known here: kind, radius_mm, core_mm, peak_mm, centre_mm. "
        "Also look at: flow.radius_mm, flow.core_mm, flow.peak_mm."
    ),
}


@pytest.mark.parametrize("case", EXPERIMENTS)
def test_a_message_names_the_keys_of_the_experiment_file(tiny_experiment, case):
    lines, message = EXPERIMENTS[case]
    tiny_experiment.write_text(tiny_experiment.read_text() + "\n" + lines + "\n")
    with pytest.raises(InputError) as error:
        read_experiment(tiny_experiment)
    assert str(error.value) == f"{tiny_experiment}: {message}"


@pytest.mark.parametrize("flow", FLOWS)
def test_a_message_names_the_keys_of_a_flow(tmp_path, flow):
    path = tmp_path / "scene.toml"
    scene, count = re.subn(r"(?m)^\[flow\]\n(?:\w.*\n)+", f"[flow]\n{flow}\n", DEMO_SCENE)
    assert count == 1
    path.write_text(scene)
    with pytest.raises(InputError) as error:
        open_scene(path)
    assert str(error.value) == f"{path}: {FLOWS[flow]}"


def test_guard_layers_have_three_forms(tiny_experiment):
    text = tiny_experiment.read_text()
    tiny_experiment.write_text(re.sub("(?m)^voxel_mm", "guard_mm = {x = 1}\nvoxel_mm", text, count=1))
    with pytest.raises(InputError, match=r"volume.guard_mm: expected a number, a list in brackets or 'auto', found \{"):
        read_experiment(tiny_experiment)
