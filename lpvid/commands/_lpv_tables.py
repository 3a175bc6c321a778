"""What `lpvid lpv` prints: the operating points, the degrees, the test records."""

import argparse
from typing import Any

from lpvid.commands._output import plain
from lpvid.report import text_table


def written(kappa: tuple[float, ...]) -> str:
    """An operating point as it is written in text."""
    return ",".join(f"{value:.6g}" for value in kappa)


def print_all(arguments: argparse.Namespace, content: dict[str, Any], names: list[str]) -> None:
    """All tables, from the content of the JSON file."""
    print(
        f"{len(names)} operating points, order {content['order']}, structure "
        f"{content['structure']}, dt = {content['dt']:g} s"
    )
    if not arguments.keep_offsets:
        print(
            "Offsets: each channel's mean over each record was taken out, of a test record its "
            "own.\nThe LPV model is for signals with these means taken out (--json lists them)."
        )
    rows = []
    for name, point in zip(names, content["points"], strict=True):
        # One error for all outputs together; black boxes are not restructured.
        error = 100.0 * point["relative_error"] if "relative_error" in point else None
        for k, output in enumerate(content["outputs"]):
            first = k == 0
            rows.append(
                (
                    name if first else "",
                    output,
                    plain(point["fit"][k]),
                    plain(point["fit_lpv"][k]),
                    error if first else None,
                    ("yes" if point["stable"] else "NO") if first else "",
                )
            )
    headers = [
        "K",
        "output",
        "local BFT, fitted (%)",
        "LPV BFT, fitted (%)",
        "H-inf error (%)",
        "stable",
    ]
    print("\n" + text_table(rows, headers))
    print("Fitted: BFT on the records that the local models were identified from.")
    table = [(degree, 100.0 * error) for degree, error in content["leave_one_out"].items()]
    print("\n" + text_table(table, ["degree", "error, points left out (%)"]))
    state = "stable" if content["stable_over_range"] else "UNSTABLE at some K"
    print(f"\nPolynomial of degree {content['degree']} in K; frozen over its range: {state}.")
    if content["test"]:
        rows = []
        for test in content["test"]:
            asked = test["kappa"] if isinstance(test["kappa"], str) else written(test["kappa"])
            for k, output in enumerate(content["outputs"]):
                local = [plain(fit[k]) for fit in test["local"].values()]
                rows.append((asked if k == 0 else "", output, plain(test["lpv"][k]), *local))
        headers = ["test K", "output", "LPV", *(f"local {name}" for name in names)]
        print("\nBFT (%) on the test records, initial states estimated:\n")
        print(text_table(rows, headers))
