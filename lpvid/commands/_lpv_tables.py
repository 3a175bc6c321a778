"""What `lpvid lpv` prints: the operating points, the degrees, the test records."""

import argparse
from typing import Any

from lpvid._files import plain
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
            "Offsets: taken out of each record as its operating point's fit shows them, of a test "
            "record its means\n(--json lists them). The LPV model is for signals without them."
        )
    refined = content["refined"]
    kept = refined is not None and refined["kept"]
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
                    *([plain(point["fit_refined"][k])] if kept else []),
                    error if first else None,
                    ("yes" if point["stable"] else "NO") if first else "",
                )
            )
    headers = [
        "K",
        "output",
        "local BFT, fitted (%)",
        "LPV BFT, fitted (%)",
        *(["refined, fitted (%)"] if kept else []),
        "H-inf error (%)",
        "stable",
    ]
    print("\n" + text_table(rows, headers))
    print("Fitted: BFT on the records that the local models were identified from.")
    table = [(degree, 100.0 * error) for degree, error in content["leave_one_out"].items()]
    print("\n" + text_table(table, ["degree", "error, points left out (%)"]))
    state = "stable" if content["stable_over_range"] else "UNSTABLE at some K"
    print(f"\nPolynomial of degree {content['degree']} in K; frozen over its range: {state}.")
    if refined is not None:
        _print_refinement(refined)
    if content["test"]:
        rows = []
        for test in content["test"]:
            asked = test["kappa"] if isinstance(test["kappa"], str) else written(test["kappa"])
            for k, output in enumerate(content["outputs"]):
                local = [plain(fit[k]) for fit in test["local"].values()]
                lpv = [
                    plain(test[stage][k]) for stage in (("lpv", "refined") if kept else ("lpv",))
                ]
                rows.append((asked if k == 0 else "", output, *lpv, *local))
        lpv = ["LPV", "LPV refined"] if kept else ["LPV"]
        headers = ["test K", "output", *lpv, *(f"local {name}" for name in names)]
        print("\nBFT (%) on the test records, initial states estimated:\n")
        print(text_table(rows, headers))


def _print_refinement(refined: dict[str, Any]) -> None:
    if refined["kept"]:
        print(
            f"Refined on all records at once: cost {refined['initial_cost']:.6g} to "
            f"{refined['cost']:.6g} in {refined['steps']} steps. {refined['advice']}"
        )
    else:
        print("Refinement FAILED; the model is the interpolated one.")
