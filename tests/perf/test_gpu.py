"""The script for a machine with a GPU, as far as it goes without one."""

import subprocess
import sys
from pathlib import Path

import gpu
import pytest
from gpu import table

SCRIPT = Path(gpu.__file__)
MOST_SECONDS = 0.1
"""Of a small case: a processor takes as long."""
LINES = [
    {"case": "machine", "cores": 2},
    {"case": "smart_small", "metric": "wall", "value": 0.5},
    {"case": "smart_small", "metric": "stored_bytes", "value": 1e9},
    {"case": "deform_small", "metric": "wall", "value": 0.25},
    {"case": "train_small", "metric": "wrong", "value": "it does not converge"},
]


def test_table_has_measured_and_predicted_times_and_no_time_of_a_wrong_result():
    rows = table(LINES, 4e9, {"smart_small": 0.125}.get)
    assert [row.split() for row in rows[1:]] == [
        ["smart_small", "0.5000", "s", "0.1250", "s", "0.50"],
        ["deform_small", "0.2500", "s"],
        ["train_small", "wrong:", "it", "does", "not", "converge"],
    ]


@pytest.mark.slow
def test_the_model_predicts_the_cases_that_it_knows():
    times = gpu.predicted_times(["project_small", "deform_small", "footprint_small"])
    assert 0 < times["project_small"] < MOST_SECONDS
    assert 0 < times["deform_small"] < MOST_SECONDS
    assert times["footprint_small"] is None


def test_a_prediction_that_fails_is_none_and_the_others_stay(monkeypatch, tmp_path):
    script = tmp_path / "perf" / "gpu_model.py"
    script.parent.mkdir()
    script.write_text("""print('{"smart_small": 0.125}', flush=True); raise MemoryError""")
    monkeypatch.setattr(gpu, "ROOT", tmp_path)
    assert gpu.predicted_times(["smart_small", "deform_small"]) == {"smart_small": 0.125, "deform_small": None}


def test_without_a_gpu_the_script_says_so_and_writes_nothing(device, tmp_path):
    if device.kind == "cuda":
        pytest.skip("there is a GPU")
    done = subprocess.run([sys.executable, SCRIPT, "--out", tmp_path / "gpu"], capture_output=True, text=True)
    assert done.returncode == 2 and "none is visible" in done.stderr
    assert not (tmp_path / "gpu").exists()
