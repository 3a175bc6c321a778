"""The thesis's chain (Sun 2000, 002), its tables beside ours.

    python -m benchmarks.manipulator [reduction] [control] [friction] [scheduling] [--out FOLDER]

`reduction` is chapters 3 and 4.1: orders, updating, validation, PI on models of three types;
`control` is sections 4.2 to 4.4: PDP, PDPC and ILQR. Beyond it, `friction` traces the arm's
friction in a record and follows set-points with it; `scheduling` lets gains follow the posture and
the payload. All by default.
"""

import os

# One BLAS thread, before anything loads a BLAS.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
from pathlib import Path

from benchmarks.manipulator import _control, _friction, _reduction, _scheduling

PARTS = ("reduction", "control", "friction", "scheduling")


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.manipulator", description=__doc__)
    parser.add_argument("which", nargs="*", choices=[*PARTS, []], help="all by default")
    parser.add_argument("--out", type=Path, help="folder for pictures of the control part")
    arguments = parser.parse_args()
    chosen = arguments.which or PARTS
    if "reduction" in chosen:
        _reduction.main()
    if "control" in chosen:
        _control.main(arguments.out)
    if "friction" in chosen:
        _friction.main()
    if "scheduling" in chosen:
        _scheduling.main()


if __name__ == "__main__":
    main()
