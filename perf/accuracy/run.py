"""Measure the effect of optics, choices of method and imperfections, on one page like that of `lfpiv reproduce`.

    python perf/accuracy/run.py [CASE ...] --out DIR [--scale small|paper] [--seed N]

Cases: real optics, choices of method, imperfect experiments. Cameras and seeding: `table`; time series:
`predicted_series`.
All are computed where none is named.
"""

from __future__ import annotations

import argparse
import sys

from lfpiv.errors import InputError
from lfpiv.reproduce.study import SCALES, Study, compute

ACCURACY = Study(
    title="Beyond the paper",
    about="Cases beyond the paper, on rigs with the same main lens and microlenses, smaller volumes and noisy images",
    modules={key: key for key in ("optics", "choices", "imperfections")},
)


def main(arguments: list[str] | None = None) -> int:
    """Run the cases; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", default=["all"], metavar="CASE", help=", ".join(ACCURACY.modules))
    parser.add_argument("--out", default="accuracy", help="folder for the results")
    parser.add_argument("--scale", choices=SCALES, default="small")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    try:
        compute(
            ACCURACY,
            options.cases,
            options.out,
            options.scale,
            seed=options.seed,
            progress=lambda step, fraction: print(f"{100 * fraction:3.0f} % {step}", file=sys.stderr),
        )
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
