"""The stages for a machine with a GPU, as far as they go without one."""

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

import gpu
import gpu_measure
import gpu_stages
import pytest

SCRIPT = Path(gpu.__file__)


def run(out, *arguments, **environment):
    command = [sys.executable, str(SCRIPT), "--out", str(out), *arguments]
    return subprocess.run(command, capture_output=True, text=True, env=os.environ | environment)


def test_without_a_gpu_the_script_says_so_and_writes_nothing(device, tmp_path):
    if device.kind == "cuda":
        pytest.skip("there is a GPU")
    done = run(tmp_path / "gpu")
    assert done.returncode == 2 and "no GPU is visible" in done.stderr
    assert not (tmp_path / "gpu").exists()


def test_a_stage_that_passed_is_not_repeated_and_a_failure_is_told(tmp_path, monkeypatch):
    script = tmp_path / "perf" / "gpu_stages.py"
    script.parent.mkdir()
    script.write_text("""
import json, pathlib, sys
stage, folder = sys.argv[1], pathlib.Path(sys.argv[2])
with open(folder / "runs", "a") as file:
    file.write(stage + " ")
if stage == "large":
    raise SystemExit("out of memory")
text = {"status": "failed" if stage == "job" else "passed", "failures": ["wrong"] if stage == "job" else []}
(folder / (stage + ".json")).write_text(json.dumps(text))
""")
    monkeypatch.setattr(gpu, "ROOT", tmp_path)
    given = argparse.Namespace(out=tmp_path, again=False, emulate=True, minutes=1.0, sample=None)
    found = {name: [gpu.run_stage(name, given) for _ in range(2)] for name in ("paper", "job", "large")}
    assert (tmp_path / "runs").read_text().split() == ["paper", "job", "job", "large", "large"]
    assert [one["status"] for one in found["paper"]] == ["passed"] * 2
    assert found["job"][1]["failures"] == ["wrong"]
    assert found["large"][1]["status"] == "broke off" and "out of memory" in found["large"][1]["failures"][0]


@pytest.mark.slow
def test_stages_run_with_emulated_loops_and_write_what_they_find(tmp_path):
    """The pair is reconstructed, correlated, and compared with its true displacement."""
    done = run(tmp_path, "--emulate", "--stage", "paper", "--minutes", "4")
    assert done.returncode == 0, done.stdout
    figures = json.loads((tmp_path / "paper.json").read_text())["figures"]
    copies = figures["copies of two volumes"]
    assert figures["two volumes [s]"] > 0 and copies["byte to host"] > 0 and len(copies["passes"]) == 2


def test_figures_are_written_as_they_are_found(tmp_path):
    found = gpu_measure.Findings(tmp_path / "paper.json", "paper")
    found.add("vectors [s]", 0.09)
    found.require(False, "off by 2 voxel")
    written = json.loads((tmp_path / "paper.json").read_text())
    assert written["status"] == "running" and written["figures"] == {"vectors [s]": 0.09}
    assert written["failures"] == ["off by 2 voxel"]


def test_times_of_kernels_are_sorted_and_counters_read(tmp_path):
    rows = gpu_measure.rows({"forward kernel _sum": [1.0, 3.0], "forward kernel _across": [5.0, 6.0]})
    assert list(rows) == ["forward kernel _across", "forward kernel _sum"]
    assert rows["forward kernel _sum"] == {"count": 2, "total_ms": 4.0, "median_ms": 2.0, "largest_ms": 3.0}
    said = 'noise\n"ID","Metric Name","Metric Unit","Metric Value"\n"0","Duration","ns","12"\n"0","","",""\n'
    assert gpu_stages.counters(said) == {"Duration [ns]": "12"}
    (tmp_path / "paper.json").write_text(json.dumps({"figures": {"activities of two volumes": rows}}))
    assert gpu_stages.slowest_kernels(tmp_path / "paper.json") == ["_across", "_sum"]
