"""Record the fingerprints of the benchmark's cases: make each of them, and write lfpiv/benchmark/fingerprints.json.

Run after a change of `cases.toml` or `rig.toml`, which also needs a new version of the benchmark once it is published.

    python perf/benchmark_fingerprints.py [--only CASE ...] [--tracers FILE] [--keep DIR]
"""

import argparse
import json
import shutil
import tempfile
import time
from pathlib import Path

from lfpiv.benchmark import fingerprint
from lfpiv.benchmark.cases import case_list, names
from lfpiv.benchmark.make import make
from lfpiv.benchmark.truth import TRUTH
from lfpiv.files import MIB, write_text
from lfpiv.version import versions

FILE = Path(fingerprint.__file__).with_name(fingerprint.FILE)


def recorded(name, folder, tracers):
    """Make a case and return its fingerprint with size and time."""
    start = time.process_time()
    (made,) = make([name], folder, tracers=tracers)
    seconds = time.process_time() - start
    size = sum(path.stat().st_size for path in made.folder.rglob("*") if path.is_file())
    found = fingerprint.fingerprint_of(made.folder, made.folder / TRUTH)
    print(f"{name}: {made.verdict}, {seconds:.1f} s of CPU, {size / MIB:.0f} MiB", flush=True)
    return found.model_dump() | {"size_mib": round(size / MIB, 1), "make_s": round(seconds, 1)}


def as_text(record):
    """Return the record as JSON, one line for each image and each array of the truth."""
    lines = [f'{{\n"benchmark": {json.dumps(record["benchmark"])},\n"versions": {json.dumps(record["versions"])},']
    lines.append('"cases": {')
    cases = []
    for name, case in record["cases"].items():
        parts = []
        for key, value in case.items():
            if isinstance(value, dict):
                rows = ",\n".join(f"   {json.dumps(item)}: {json.dumps(numbers)}" for item, numbers in value.items())
                parts.append(f"  {json.dumps(key)}: {{\n{rows}\n  }}")
            else:
                parts.append(f"  {json.dumps(key)}: {json.dumps(value)}")
        cases.append(f" {json.dumps(name)}: {{\n" + ",\n".join(parts) + "\n }")
    return "\n".join(lines) + "\n" + ",\n".join(cases) + "\n}\n}\n"


def main():
    """Record the chosen cases; keep the others as they are, if the benchmark has the same version."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=names(), help="cases to record; default: all")
    parser.add_argument("--tracers", help="file of tracers; without it the cases that need one are left out")
    parser.add_argument("--keep", type=Path, help="folder that keeps the made cases")
    options = parser.parse_args()
    old = json.loads(FILE.read_text("utf-8")) if FILE.exists() else {}
    kept = old.get("cases", {}) if old.get("benchmark") == case_list().version else {}
    found = {}
    for case in case_list().case:
        if (options.only and case.name not in options.only) or (case.tracers and options.tracers is None):
            continue
        scratch = Path(tempfile.mkdtemp(dir=options.keep))
        try:
            found[case.name] = recorded(case.name, scratch / "case", options.tracers if case.tracers else None)
            if options.keep:
                shutil.rmtree(options.keep / case.name, ignore_errors=True)
                (scratch / "case").rename(options.keep / case.name)
        finally:
            shutil.rmtree(scratch, ignore_errors=True)
        cases = {name: {**kept, **found}[name] for name in names() if name in {**kept, **found}}
        write_text(as_text({"benchmark": case_list().version, "versions": versions(), "cases": cases}), FILE)


if __name__ == "__main__":
    main()
