"""The plant of 003 and its records, from the benchmark that prints the paper's figures."""

import importlib.util
from pathlib import Path

FILE = Path(__file__).resolve().parents[3] / "benchmarks" / "step_response.py"
_spec = importlib.util.spec_from_file_location("benchmark_step_response", FILE)
assert _spec is not None and _spec.loader is not None
benchmark = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(benchmark)
