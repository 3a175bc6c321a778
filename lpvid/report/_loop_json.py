"""What closing the loop found, as JSON."""

import os
from pathlib import Path
from typing import Any

import numpy as np

from lpvid import _files
from lpvid.loop import Errors, EstimatedNumber, FoundEffect, Loop
from lpvid.report._loop_words import floor_bft


def to_json(loop: Loop) -> dict[str, Any]:
    """What was found as text, numbers, lists and mappings; a number that is not finite is `None`.

    `verdict`; `effects`, each with `name`, `family`, `port`, `parameters` (by name: `value`,
    `std`, `unit`), `confusable_with`; `error` with `before`, `after` and `noise_floor`, each with
    `one_step`, `horizon`, `free_run` (RMSE of each output) and `bft` in percent; `held_out`, the
    first and the last sample; `p_value`, `tests_made`, `seconds`; and more for the curious. The
    series of the pictures are left out.

    Args:
        loop: result of `lpvid.loop.close_the_loop`.

    Example:
        >>> to_json(loop)["error"]["after"]["bft"]  # doctest: +SKIP
        [99.2]
    """
    content = {
        "verdict": loop.verdict,
        "advice": loop.advice,
        "effects": [_effect(effect) for effect in loop.effects],
        "error": {
            "before": _errors(loop.before),
            "after": _errors(loop.after),
            # Noise stays what it is however far ahead one looks.
            "noise_floor": _errors(Errors(*[loop.noise_floor] * 3, bft=floor_bft(loop))),
        },
        "noise_floor_from": loop.noise_floor_from,
        "held_out": [int(sample) for sample in loop.held_out],
        "horizon": int(loop.horizon),
        "p_value": loop.p_value,
        "p_value_left": loop.p_value_left,
        "tests_made": int(loop.tests_made),
        "seconds": loop.seconds,
        "structure": loop.structure,
        "model": _numbers(loop.parameters),
        "ladder": loop.ladder._asdict(),
        "rounds": [[candidate._asdict() for candidate in round_] for round_ in loop.rounds],
        "ablation": loop.ablation,
        "residual_tests": loop.residual_tests,
        "outputs": loop.output_names,
        "output_units": loop.output_units,
        "dt": loop.dt,
    }
    return _files.plain(content)


def write_json(loop: Loop, path: str | os.PathLike[str]) -> Path:
    """Write what `to_json` gives, as strict JSON; an interruption leaves the old file.

    Args:
        loop: result of `lpvid.loop.close_the_loop`.
        path: where to.

    Returns:
        The path.

    Raises:
        OSError: the folder is missing or not writable.

    Example:
        >>> write_json(loop, "loop.json").name  # doctest: +SKIP
        'loop.json'
    """
    return _files.write_json(path, to_json(loop))


def _effect(effect: FoundEffect) -> dict[str, Any]:
    return effect._asdict() | {"parameters": _numbers(effect.parameters)}


def _numbers(numbers: tuple[EstimatedNumber, ...]) -> dict[str, Any]:
    return {one.name: {"value": one.value, "std": one.std, "unit": one.unit} for one in numbers}


def _errors(errors: Errors) -> dict[str, np.ndarray]:
    return {name: np.asarray(value, float) for name, value in errors._asdict().items()}
