"""One record through `close_the_loop`, in a process of its own."""

import time
import traceback
from pathlib import Path

import numpy as np

from benchmarks.blind_suite._generate import Record

DENIED = {"status": "", "verdict": "failed", "effects": [], "held_out": [], "seconds": np.nan}


def solve(record: Record, structure: str | None, told: list[str] | None = None) -> dict:
    """One record through `close_the_loop`, as plain numbers; a failure becomes its status.

    Args:
        record: what the solver may see.
        structure: name of the model structure, the record's own by default.
        told: names of the effects, for the oracle.
    """
    start = time.perf_counter()
    try:
        from lpvid.data import IOData
        from lpvid.effects import LIBRARY
        from lpvid.loop import close_the_loop

        data = IOData(
            u=record.u,
            y=record.y,
            dt=record.dt,
            kappa=record.kappa,
            names={"u": record.input_names, "y": record.output_names},
            units={"u": record.input_units, "y": record.output_units},
        )
        laws = LIBRARY if told is None else tuple(law for law in LIBRARY if law.name in told)
        # By name, so that the structure too is made from the estimation data alone.
        loop = close_the_loop(structure or record.structure, data, laws=laws)
    except Exception as error:
        status = "".join(traceback.format_exception_only(error)).strip()
        where = traceback.format_exc(limit=-3)
        seconds = time.perf_counter() - start
        return {"key": record.key, **DENIED, "status": status, "trace": where, "seconds": seconds}
    return {
        "key": record.key,
        "status": "ok",
        "verdict": loop.verdict,
        "effects": [
            {
                "name": effect.name,
                "family": effect.family,
                "port": effect.port,
                "parameters": [number._asdict() for number in effect.parameters],
                "confusable_with": list(effect.confusable_with),
                "gain": float(effect.gain),
                "held_out_gain": float(effect.held_out_gain),
                "p_value": float(effect.p_value),
            }
            for effect in loop.effects
        ],
        "held_out": np.asarray(loop.after.horizon).tolist(),
        "before": np.asarray(loop.before.horizon).tolist(),
        "free_run": np.asarray(loop.after.free_run).tolist(),
        "noise_floor": np.asarray(loop.noise_floor).tolist(),
        "p_value": float(loop.p_value),
        "p_value_left": float(loop.p_value_left),
        "first_round": [
            [c.name, c.port, float(c.gain)] for c in (loop.rounds[0] if loop.rounds else ())[:5]
        ],
        "seconds": time.perf_counter() - start,
    }


_MOST_MAPS = 30_000
"""Pieces of memory from which compiled programs are let go of; Linux gives a process 65 530."""


def answer_job(job: tuple) -> dict:
    """`solve` of one tuple of its arguments."""
    answer = solve(*job)
    maps = Path("/proc/self/maps")
    if maps.exists() and len(maps.read_text().splitlines()) > _MOST_MAPS:
        import jax

        jax.clear_caches()
    return answer
