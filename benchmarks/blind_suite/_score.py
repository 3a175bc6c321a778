"""Figures of the blind suite from what a solver answered and from the sealed labels."""

from collections import Counter
from collections.abc import Iterable, Mapping

import numpy as np

from benchmarks.blind_suite._laws import AMPLITUDES, WHOLE

Result = Mapping
Labels = Mapping[str, Mapping]

GOALS = {
    "one effect: exact name": ("≥ 95 %", lambda x: x >= 95.0),
    "one effect: family": ("≥ 99 %", lambda x: x >= 99.0),
    "two effects, both exact": ("≥ 90 %", lambda x: x >= 90.0),
    "no effect: false naming": ("≤ 1 %", lambda x: x <= 1.0),
    "outside the library: flagged, not named": ("≥ 95 %", lambda x: x >= 95.0),
    "truth inside the named set": ("≥ 98 %", lambda x: x >= 98.0),
    "size of the set, mean": ("≤ 1.3", lambda x: x <= 1.3),
    "held-out error over the oracle's, median": ("≤ 1.02", lambda x: x <= 1.02),
    "held-out error over the oracle's, 90th percentile": ("≤ 1.1", lambda x: x <= 1.1),
    "amplitude error %, median": ("≤ 1 %", lambda x: x <= 1.0),
    "amplitude error %, 90th percentile": ("≤ 5 %", lambda x: x <= 5.0),
    "95 % intervals: coverage": ("93–97 %", lambda x: 93.0 <= x <= 97.0),
    "seconds a record, median": ("≤ 15 s", lambda x: x <= 15.0),
}
"""The specification's goals by metric."""


def _named(result: Result) -> list[str]:
    return sorted(effect["name"] for effect in result["effects"])


def _true(label: Mapping) -> list[str]:
    return sorted(effect["name"] for effect in label["effects"])


def _families(effects: Iterable[Mapping]) -> list[str]:
    return sorted(effect["family"] for effect in effects)


def _set_of(effect: Mapping) -> set[str]:
    """An effect's name and the names, without their ports, of what it may be confused with."""
    return {effect["name"], *(other.split(" at ")[0] for other in effect["confusable_with"])}


def _share(hits: list[bool]) -> tuple[float, int]:
    return (100.0 * float(np.mean(hits)) if hits else np.nan), len(hits)


def _quantile(values: list[float], share: float) -> tuple[float, int]:
    finite = [value for value in values if np.isfinite(value)]
    return (float(np.quantile(finite, share)) if finite else np.nan), len(finite)


def scored_numbers(truth: Mapping, found: Mapping) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """True values, estimates and standard errors of what an effect is judged by.

    Its amplitudes; where the law replaces a signal (a delay, a lag) its shape.
    """
    name, numbers = truth["name"], found["parameters"]
    if name in WHOLE:
        true, numbers = truth["shape"][:1], numbers[-1:]
    else:
        true = truth["amplitude"]
        numbers = numbers[: AMPLITUDES.get(name, 1)]
    width = min(len(true), len(numbers))
    return (
        np.array(true[:width], float),
        np.array([number["value"] for number in numbers[:width]], float),
        np.array([number["std"] for number in numbers[:width]], float),
    )


def metrics(
    results: Mapping[str, Result], labels: Labels, oracle: Mapping[str, Result] | None = None
) -> dict[str, tuple[float, int]]:
    """Every figure and the number of records (or numbers) behind it.

    Args:
        results: by record: "status" ("ok" or what went wrong), "verdict", "effects" (each with
            name, family, port, parameters, confusable_with), "held_out" (error after), "seconds".
            A record that failed counts as one in which nothing was named and nothing flagged.
        labels: the truth by record.
        oracle: results of a solver told the effect.
    """
    by_case = {
        case: [key for key in results if labels[key]["case"] in cases]
        for case, cases in {
            "one": ("one",),
            "two": ("two",),
            "none": ("none", "decoy"),
            "decoy": ("decoy",),
            "outside": ("outside",),
        }.items()
    }
    figures: dict[str, tuple[float, int]] = {}

    def exact(key):
        return _named(results[key]) == _true(labels[key])

    figures["one effect: exact name"] = _share([exact(k) for k in by_case["one"]])
    figures["one effect: family"] = _share(
        [
            _families(results[k]["effects"]) == _families(labels[k]["effects"])
            for k in by_case["one"]
        ]
    )
    figures["one effect: name and port"] = _share(
        [
            exact(k) and results[k]["effects"][0]["port"] == labels[k]["effects"][0]["port"]
            for k in by_case["one"]
        ]
    )
    figures["one effect: truth among those named"] = _share(
        [set(_true(labels[k])) <= set(_named(results[k])) for k in by_case["one"]]
    )
    figures["two effects, both exact"] = _share([exact(k) for k in by_case["two"]])
    figures["two effects: names and ports"] = _share(
        [
            sorted((e["name"], e["port"]) for e in results[k]["effects"])
            == sorted((e["name"], e["port"]) for e in labels[k]["effects"])
            for k in by_case["two"]
        ]
    )
    figures["two effects: at least one"] = _share(
        [bool(set(_true(labels[k])) & set(_named(results[k]))) for k in by_case["two"]]
    )
    figures["no effect: false naming"] = _share(
        [bool(results[k]["effects"]) for k in by_case["none"]]
    )
    figures["no effect: of the decoys"] = _share(
        [bool(results[k]["effects"]) for k in by_case["decoy"]]
    )
    figures["no effect: nothing to add"] = _share(
        [results[k]["verdict"] == "nothing to add" for k in by_case["none"]]
    )
    figures["outside the library: flagged, not named"] = _share(
        [results[k]["verdict"] == "abstain" for k in by_case["outside"]]
    )
    figures["outside the library: flagged, with or without a name"] = _share(
        [results[k]["verdict"] in ("abstain", REMAINDER) for k in by_case["outside"]]
    )

    inside, sizes, errors, covered = [], [], [], []
    for key in by_case["one"] + by_case["two"]:
        found = results[key]["effects"]
        for truth in labels[key]["effects"]:
            inside.append(any(truth["name"] in _set_of(effect) for effect in found))
            same = [effect for effect in found if effect["name"] == truth["name"]]
            # Of two with one name, the one at the right port.
            match = min(same, key=lambda effect: effect["port"] != truth["port"], default=None)
            if match is not None:
                true, value, std = scored_numbers(truth, match)
                if not true.size:
                    continue
                errors.append(100.0 * np.linalg.norm(value - true) / np.linalg.norm(true))
                # An interval without ends says nothing, so it counts as missed.
                covered += list(np.isfinite(std) & (np.abs(value - true) <= 1.96 * std))
        sizes += [float(len(_set_of(effect))) for effect in found]
    figures["truth inside the named set"] = _share(inside)
    figures["size of the set, mean"] = (float(np.mean(sizes)) if sizes else np.nan), len(sizes)
    figures["amplitude error %, median"] = _quantile(errors, 0.5)
    figures["amplitude error %, 90th percentile"] = _quantile(errors, 0.9)
    figures["95 % intervals: coverage"] = _share([bool(hit) for hit in covered])

    ratios = []
    for key in by_case["one"] + by_case["two"]:
        told = (oracle or {}).get(key)
        if told and told["status"] == "ok" and results[key]["status"] == "ok":
            ours, theirs = np.array(results[key]["held_out"]), np.array(told["held_out"])
            ratios.append(float(np.sqrt(np.mean((ours / theirs) ** 2))))
    figures["held-out error over the oracle's, median"] = _quantile(ratios, 0.5)
    figures["held-out error over the oracle's, 90th percentile"] = _quantile(ratios, 0.9)
    times = [float(result["seconds"]) for result in results.values()]
    figures["seconds a record, median"] = _quantile(times, 0.5)
    figures["seconds a record, longest"] = _quantile(times, 1.0)
    failed = [result["status"] != "ok" for result in results.values()]
    figures["records that failed"] = _share(failed)
    return figures


REMAINDER = "named, remainder unknown"


def score_rows(figures: Mapping[str, tuple[float, int]]) -> list[list]:
    """Metric, figure, goal, whether it is met, and of how many."""
    rows = []
    for name, (value, count) in figures.items():
        goal, met = GOALS.get(name, ("", None))
        verdict = "" if met is None or not count else ("yes" if met(value) else "no")
        rows.append([name, f"{value:.4g}" if count else "–", goal, verdict, count])
    return rows


def breakdown_rows(results: Mapping[str, Result], labels: Labels) -> list[list]:
    """The main figures by plant, noise and loop."""
    rows = []
    for field in ("plant", "snr", "loop"):
        for value in sorted({labels[key][field] for key in results}, key=str):
            some = {key: r for key, r in results.items() if labels[key][field] == value}
            figures = metrics(some, labels)
            rows.append([f"{field} {value}", len(some), *(_cell(figures[name]) for name in MAIN)])
    return rows


MAIN = (
    "one effect: exact name",
    "one effect: family",
    "two effects, both exact",
    "no effect: false naming",
    "outside the library: flagged, not named",
    "amplitude error %, median",
    "seconds a record, median",
)


def effect_rows(results: Mapping[str, Result], labels: Labels) -> list[list]:
    """For every effect alone: records, exact, and what else was answered."""
    wrong: dict[str, Counter] = {}
    hits: dict[str, list[bool]] = {}
    for key, result in results.items():
        label = labels[key]
        if label["case"] == "two":
            continue
        details = [effect["detail"] for effect in label["effects"]]
        truth = " + ".join(details) or label["case"]
        answer = " + ".join(_named(result)) or result["verdict"]
        right = {
            "one": _named(result) == _true(label),
            "outside": result["verdict"] == "abstain",
        }.get(label["case"], not result["effects"])
        hits.setdefault(truth, []).append(right)
        if not right:
            answer = answer if result["status"] == "ok" else "failed"
            wrong.setdefault(truth, Counter())[answer] += 1
    return [
        [
            truth,
            len(hits[truth]),
            f"{_share(hits[truth])[0]:.0f}",
            "; ".join(f"{what} ×{n}" for what, n in wrong.get(truth, Counter()).most_common(5)),
        ]
        for truth in sorted(hits, key=lambda name: _share(hits[name])[0])
    ]


def pair_rows(results: Mapping[str, Result], labels: Labels) -> list[list]:
    """Pairs that were not named exactly."""
    return [
        [key, " + ".join(_true(labels[key])), " + ".join(_named(result)) or result["verdict"]]
        for key, result in results.items()
        if labels[key]["case"] == "two" and _named(result) != _true(labels[key])
    ]


def _cell(figure: tuple[float, int]) -> str:
    return f"{figure[0]:.3g}" if figure[1] else "–"
