"""`python -m benchmarks`: every comparison with other libraries, one table each.

CPU time after warm-up, first call apart, quality beside time; both sides measured in one run with
one BLAS thread. Quote the ratios, not the seconds.
"""

import argparse
import os

# Before anything loads a BLAS.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from benchmarks import hinf, subspace
from lpvid.report import text_table

COMPARISONS = {
    "subspace": (subspace.run, "One fit and a hundred, against SLICOT (ctrlsys)"),
    "hinf": (hinf.run, "H-infinity norms with gradients, against SLICOT (slycot)"),
}


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("which", nargs="*", choices=[*COMPARISONS, []], help="all by default")
    for name in parser.parse_args().which or COMPARISONS:
        run, title = COMPARISONS[name]
        rows = run()
        headers = list(dict.fromkeys(key for row in rows for key in row))
        print(f"\n{title}")
        print(text_table([[row.get(key, "") for key in headers] for row in rows], headers))


if __name__ == "__main__":
    main()
