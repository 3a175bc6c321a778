"""The blind suite's scorer on answers made by hand."""

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def score():
    # The benchmarks are not part of the installed package.
    sys.path.insert(0, str(ROOT))
    try:
        return importlib.import_module("benchmarks.blind_suite._score")
    finally:
        sys.path.remove(str(ROOT))


def found(name, family, numbers=(), confusable=(), port="force at load"):
    numbers = [{"name": "a", "value": v, "std": s, "unit": ""} for v, s in numbers]
    return {
        "name": name,
        "family": family,
        "port": port,
        "parameters": numbers,
        "confusable_with": list(confusable),
    }


def true(name, family, amplitude=(1.0,), shape=(), port="force at load"):
    return {
        "name": name,
        "detail": name,
        "family": family,
        "port": port,
        "amplitude": list(amplitude),
        "shape": list(shape),
    }


def answer(verdict, *effects, held_out=(1.0, 1.0), seconds=2.0, status="ok"):
    return {
        "status": status,
        "verdict": verdict,
        "effects": list(effects),
        "held_out": list(held_out),
        "seconds": seconds,
    }


def label(case, *effects, snr=60.0):
    return {"case": case, "plant": "p", "snr": snr, "loop": "open", "effects": list(effects)}


LABELS = {
    "exact": label("one", true("coulomb", "friction", (2.0,))),
    "family": label("one", true("dahl", "friction", (1.0,))),
    "wrong": label("one", true("gravity", "gravity", (3.0, 4.0))),
    "delay": label("one", true("input-delay", "delay", (1.0,), (0.02,))),
    "both": label("two", true("coulomb", "friction"), true("backlash", "backlash")),
    "half": label("two", true("coulomb", "friction"), true("backlash", "backlash")),
    "clean": label("none"),
    "false": label("decoy"),
    "flagged": label("outside", true("preload", "outside")),
    "named": label("outside", true("preload", "outside"), snr=40.0),
}
RESULTS = {
    "exact": answer("named", found("coulomb", "friction", [(2.02, 0.02)])),
    "family": answer("named", found("coulomb", "friction", [(1.0, 0.1)], ["dahl at load"])),
    "wrong": answer("abstain"),
    "delay": answer("named", found("input-delay", "delay", [(1.0, 0.0), (0.021, 1e-4)])),
    "both": answer(
        "named",
        found("backlash", "backlash", [(1.1, 0.1)], ["cubic-stiffness at twist"]),
        found("coulomb", "friction", [(1.0, 0.1)]),
    ),
    "half": answer("named, remainder unknown", found("coulomb", "friction", [(1.0, 0.1)])),
    "clean": answer("nothing to add", seconds=4.0),
    "false": answer("named", found("coulomb", "friction")),
    "flagged": answer("abstain"),
    "named": answer("named, remainder unknown", found("coulomb", "friction")),
}


def test_every_figure_on_answers_made_by_hand(score):
    figures = score.metrics(
        RESULTS,
        LABELS,
        {"exact": answer("named", held_out=(0.5, 0.5)), "both": answer("named")},
    )
    expected = {
        "one effect: exact name": (50.0, 4),
        "one effect: family": (75.0, 4),
        "two effects, both exact": (50.0, 2),
        "two effects: at least one": (100.0, 2),
        "no effect: false naming": (50.0, 2),
        "no effect: of the decoys": (100.0, 1),
        "outside the library: flagged, not named": (50.0, 2),
        "outside the library: flagged, with or without a name": (100.0, 2),
        # Coulomb; Dahl by its set; delay; both of a pair; one of the other.
        "truth inside the named set": (100.0 * 6 / 8, 8),
        "size of the set, mean": (8 / 6, 6),
        # 1, 5, 10, 0 and 0 percent.
        "amplitude error %, median": (1.0, 5),
        # Within 1.96 standard errors: all but the delay.
        "95 % intervals: coverage": (80.0, 5),
        "held-out error over the oracle's, median": (1.5, 2),
        "seconds a record, median": (2.0, 10),
        "records that failed": (0.0, 10),
    }
    for name, (value, count) in expected.items():
        assert figures[name][1] == count, name
        assert figures[name][0] == pytest.approx(value), name


def test_a_failed_record_names_nothing(score):
    failed = {**RESULTS, "exact": answer("failed", status="ValueError: no", seconds=np.nan)}
    figures = score.metrics(failed, LABELS)
    assert figures["one effect: exact name"][0] == 25.0
    assert figures["records that failed"] == (10.0, 10)
    assert figures["held-out error over the oracle's, median"][1] == 0


def test_tables(score):
    rows = {row[0]: row for row in score.score_rows(score.metrics(RESULTS, LABELS))}
    assert rows["one effect: exact name"][3] == "no"
    assert rows["seconds a record, median"][3] == "yes"
    assert len(score.breakdown_rows(RESULTS, LABELS)) == 4
    confused = {row[0]: row for row in score.effect_rows(RESULTS, LABELS)}
    assert confused["dahl"][1:] == [1, "0", "coulomb ×1"]
    assert confused["preload"][2] == "50"
    assert score.pair_rows(RESULTS, LABELS) == [["half", "backlash + coulomb", "coulomb"]]
