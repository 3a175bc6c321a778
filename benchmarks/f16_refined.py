"""F-16: global refinement of the LPV model's coefficients, and why it is not part of `f16`.

Refinement minimises the error at the excited lines of all estimation levels at once, in steady
state. Leaving level 3, then level 5, out of the estimation levels decides between losses, and
whether to refine at all; what it decides is then scored on the test levels.

    python -m benchmarks.f16_refined [--data FOLDER]
"""

import os

# One BLAS thread, before anything loads a BLAS.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import warnings
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import lpvid as lv
from benchmarks.f16 import (
    BAND_HZ,
    ESTIMATION,
    TEST,
    Choices,
    global_model,
    local_models,
    record,
    score,
)

LOSSES = {
    "least squares": lv.refinement.SquaredLoss(),
    "Huber 0.7": lv.refinement.HuberLoss(0.7),
    "Huber 1.345": lv.refinement.HuberLoss(),
    "Huber 2": lv.refinement.HuberLoss(2.0),
}


class SteadyState(eqx.Module):
    """Response of a frozen LPV model at single frequencies.

    The input's columns are real and imaginary part of the force, the frequency in rad/s, and
    whether the imaginary part of the response is wanted.
    """

    lpv: lv.LPVStateSpace

    def simulate(self, *, u, kappa, dt):
        """Real or imaginary part of G U, line by line."""
        del dt
        response = self.lpv.at(kappa[0]).frequency_response(u[:, 2])[:, :, 0]
        response = response * (u[:, 0] + 1j * u[:, 1])[:, None]
        return jnp.where(u[:, 3:] > 0.0, response.imag, response.real)


def lines_of(folder: str | Path, level: int, kappa: float) -> lv.IOData:
    """A level's spectra at the excited lines; all levels weigh the same."""
    data = record(folder, level)
    omega = np.asarray(lv.analysis.band_lines(data, BAND_HZ))
    at = np.rint(omega / (2 * np.pi) * data.n_samples * data.dt).astype(int)
    U, Y = (np.fft.rfft(np.asarray(signal), axis=0)[at] for signal in (data.u, data.y))
    force, size = U[:, 0], np.linalg.norm(Y)
    part = np.repeat([0.0, 1.0], omega.size)
    u = np.stack([*(np.tile(row, 2) for row in (force.real, force.imag)), np.tile(omega, 2), part])
    u[:2] /= size
    y = np.concatenate([Y.real, Y.imag]) / size
    return lv.IOData(u=u.T, y=y, kappa=np.full(part.size, kappa), dt=1.0)


def refined(folder: str | Path, local: dict, choices: Choices, loss) -> tuple:
    """The LPV model before and after, and κ of a level for it."""
    lpv, kappa = global_model(folder, local, choices)
    data = lv.data.join([lines_of(folder, level, kappa(level)) for level in local])
    with warnings.catch_warnings():
        # The phase of a mode's input and output vectors is free.
        warnings.filterwarnings("ignore", message="refine: The records say nothing")
        found = lv.refine(SteadyState(lpv), data, loss=loss, max_steps=400, throw=False)
    return lpv, found.model.lpv, kappa


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    default = os.environ.get("LPVID_DATA", Path(__file__).resolve().parents[2] / "shared" / "data")
    parser.add_argument("--data", default=default, help="folder of the measured records")
    folder = parser.parse_args().data
    choices = Choices()
    local = {level: item.modal for level, item in local_models(folder, choices).items()}
    print("Mean fit in percent. Level 3 from 1, 5, 7 | level 5 from 1, 3, 7 | their mean")
    means = {}
    for name, loss in LOSSES.items():
        fits = []
        for level in (3, 5):
            others = {k: model for k, model in local.items() if k != level}
            *models, kappa = refined(folder, others, choices, loss)
            fits.append([np.mean(score(folder, level, m.at(kappa(level)))) for m in models])
        for row, label in zip(np.transpose(fits), ("not refined", name), strict=True):
            means[label] = float(np.mean(row))
            print(f"{label:<16s}{row[0]:6.2f} {row[1]:6.2f} {means[label]:6.2f}")
    print("\nTest levels")
    for name, loss in LOSSES.items():
        before, after, kappa = refined(folder, local, choices, loss)
        taken = " (best of the above)" if means[name] == max(means.values()) else ""
        for level in TEST:
            old, new = (np.mean(score(folder, level, m.at(kappa(level)))) for m in (before, after))
            print(f"level {level}: not refined {old:.2f}, {name} {new:.2f}{taken}")
    print(f"\nEstimation levels {ESTIMATION}; the test levels decided nothing.")


if __name__ == "__main__":
    main()
