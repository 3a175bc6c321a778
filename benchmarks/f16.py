"""F-16 ground vibration test: an LPV model in the excitation level, scored on levels it never saw.

Levels 1, 3, 5, 7 estimate, levels 2, 4, 6 test: `score` alone reads what was measured there. Every
choice below was made by leaving level 3, then level 5, out of the estimation levels; `--choose`
does that again.

    python -m benchmarks.f16 [--data FOLDER] [--choose] [--out FOLDER]
"""

import os

# One BLAS thread, before anything loads a BLAS.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import dataclasses
import functools
import warnings
from pathlib import Path

import jax
import numpy as np

import lpvid as lv

RATE_HZ = 400.0
BAND_HZ = (2.0, 15.0)
ESTIMATION, TEST = (1, 3, 5, 7), (2, 4, 6)
REFERENCE_FORCE = 50.0
# Index, by rising frequency, of the mode at 7.3 Hz: the highest peak, softer at every level.
SOFTENING = 4


@dataclasses.dataclass(frozen=True)
class Choices:
    """What the leave-one-out decided."""

    samples_per_period: int = 640
    block_rows: int = 35
    order: int = 12
    exponent: float = 0.7
    degree: int = 1
    peak_passes: int = 2


TRIED = {
    "samples_per_period": (640, 704, 800, 1024),
    "block_rows": (25, 30, 35, 40),
    "order": (10, 12, 14),
    "exponent": (0.4, 0.5, 0.6, 0.7, 0.8, 1.0),
    "degree": (0, 1, 2),
    "peak_passes": (0, 2),
}


@dataclasses.dataclass(frozen=True)
class Local:
    """One level: what was identified, and the same in modal form."""

    black_box: lv.StateSpace
    modal: lv.Restructured


def data_file(folder: str | Path) -> Path:
    return Path(folder) / "f16gvt" / "f16_full_multisine_averaged.npz"


@functools.lru_cache(maxsize=4)
def record(folder: str | Path, level: int) -> lv.IOData:
    return lv.read_npz(
        data_file(folder), inputs=f"force_{level}", outputs=f"acc_{level}", dt=1 / RATE_HZ
    )


@functools.cache
def force_rms(folder: str | Path, level: int) -> float:
    """RMS force of a level in N; of the record, no more than force and drive voltage are read."""
    drive = lv.read_npz(
        data_file(folder), inputs=f"force_{level}", outputs=f"voltage_{level}", dt=1 / RATE_HZ
    )
    return float(np.sqrt(np.mean(np.asarray(drive.u) ** 2)))


def scheduling(folder: str | Path, level: int, exponent: float) -> float:
    """κ, which grows with the excitation."""
    return (force_rms(folder, level) / REFERENCE_FORCE) ** exponent


def local_models(folder: str | Path, choices: Choices) -> dict[int, Local]:
    """Identify and restructure every estimation level."""
    black_boxes = [_identified(folder, level, choices) for level in ESTIMATION]
    modal = lv.restructure_along(
        black_boxes,
        _structure(choices),
        starts=2,
        key=jax.random.key(0),
        **_matching(folder, choices),
    )
    pairs = zip(ESTIMATION, black_boxes, modal, strict=True)
    return {level: Local(black_box, found) for level, black_box, found in pairs}


def _identified(folder: str | Path, level: int, choices: Choices) -> lv.StateSpace:
    step = lv.data.PeriodicBand(*BAND_HZ, samples_per_period=choices.samples_per_period)
    clean, _ = lv.preprocess(record(folder, level), step)
    method = lv.PastOutputMOESP(order=choices.order, block_rows=choices.block_rows)
    return lv.identify(clean, method).model


def _structure(choices: Choices) -> lv.ModalStructure:
    return lv.ModalStructure(n_modes=choices.order // 2, n_inputs=1, n_outputs=3, feedthrough=True)


def _matching(folder: str | Path, choices: Choices) -> dict:
    """The excited lines, which are all that the black boxes know of."""
    lines = lv.analysis.band_lines(record(folder, ESTIMATION[0]), BAND_HZ)
    return {"omega": lines, "method": lv.HinfMatching(passes=choices.peak_passes)}


def global_model(folder: str | Path, local: dict[int, lv.Restructured], choices: Choices):
    """The LPV model through local models, and κ of a level for it."""
    kappas = [scheduling(folder, level, choices.exponent) for level in local]
    lpv = lv.interpolate(list(local.values()), kappas, lv.Polynomial(degree=choices.degree))
    return lpv, lambda level: scheduling(folder, level, choices.exponent)


def score(folder: str | Path, level: int, model: lv.StateSpace) -> np.ndarray:
    """Steady-state fit of each acceleration over the excited lines, in percent."""
    return np.asarray(lv.analysis.band_fit(model, record(folder, level), BAND_HZ))


def modes_hz(model: lv.StateSpace) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies in Hz and dampings in percent of the oscillatory modes, by rising frequency."""
    modes = model.modes()
    upper = np.asarray(modes.poles).imag > 0
    frequency = np.asarray(modes.frequency)[upper] / (2 * np.pi)
    return frequency, 100 * np.asarray(modes.damping)[upper]


def run(folder: str | Path, choices: Choices | None = None) -> dict:
    """Everything the tables and the figures show.

    Keys: `local` (level → `Local`), `lpv`, `kappa` (level → κ), `fits` ((model, level) → percent
    for each acceleration; the models are "LPV", "modal k" and "black box k") and `modes`
    ((model, level) → Hz and percent, for "LPV" at all levels and "modal" at its own).
    """
    choices = choices or Choices()
    local = local_models(folder, choices)
    lpv, kappa = global_model(folder, {k: item.modal for k, item in local.items()}, choices)
    kappas = {level: kappa(level) for level in sorted(ESTIMATION + TEST)}
    frozen = {level: lpv.at(value) for level, value in kappas.items()}
    fits, modes = {}, {}
    for level, model in frozen.items():
        fits["LPV", level] = score(folder, level, model)
        modes["LPV", level] = modes_hz(model)
        for own, item in local.items():
            if level in TEST or level == own:
                fits[f"modal {own}", level] = score(folder, level, item.modal.model)
                fits[f"black box {own}", level] = score(folder, level, item.black_box)
    for own, item in local.items():
        modes["modal", own] = modes_hz(item.modal.model)
    return {"local": local, "lpv": lpv, "kappa": kappas, "fits": fits, "modes": modes}


def choose(folder: str | Path, start: Choices | None = None) -> list[dict]:
    """Mean fit at levels 3 and 5, each from the other three, with one choice changed at a time.

    Here no level's model sees another's: each is restructured alone.
    """
    start = start or Choices()
    rows = []
    for name, values in TRIED.items():
        for value in values:
            trial = dataclasses.replace(start, **{name: value})
            try:
                fits = [_left_out(folder, level, trial) for level in (3, 5)]
            except ValueError as error:
                # Such as a pole that no continuous-time model has.
                rows.append({"choice": name, "value": value, "why": str(error)})
                continue
            means = [float(np.mean(fit)) for fit in fits]
            row = {"level 3": means[0], "level 5": means[1], "mean": float(np.mean(means))}
            rows.append({"choice": name, "value": value, **row})
    return rows


def _left_out(folder: str | Path, level: int, choices: Choices) -> np.ndarray:
    others = {k: _alone(folder, k, _of_local(choices)) for k in ESTIMATION if k != level}
    lpv, kappa = global_model(folder, others, choices)
    return score(folder, level, lpv.at(kappa(level)))


def _of_local(choices: Choices) -> Choices:
    """The choices with those that local models do not depend on at their defaults."""
    return dataclasses.replace(choices, exponent=Choices.exponent, degree=Choices.degree)


@functools.cache
def _alone(folder: str | Path, level: int, choices: Choices) -> lv.Restructured:
    with warnings.catch_warnings():
        # A poor choice may give an unstable model; its score says so.
        warnings.filterwarnings("ignore", message="The identified model is unstable")
        black_box = _identified(folder, level, choices)
    return lv.restructure(
        black_box,
        _structure(choices),
        starts=2,
        key=jax.random.key(level),
        **_matching(folder, choices),
    )


def table(result: dict) -> list[str]:
    """The result in lines of text."""
    fits, modes, kappa = result["fits"], result["modes"], result["kappa"]
    lines = [
        "Fit in percent over 2 to 15 Hz: accelerations 1, 2, 3 | mean",
        "",
        "Estimation levels",
    ]
    for level in ESTIMATION:
        for name in (f"black box {level}", f"modal {level}", "LPV"):
            lines.append(_fit_line(f"level {level}: {name}", fits[name, level]))
    lines += ["", "Test levels"]
    for level in TEST:
        singles = [name for name, at in fits if at == level and name != "LPV"]
        lines.append(_fit_line(f"level {level}: LPV", fits["LPV", level]))
        lines += [_fit_line(f"         {name}", fits[name, level]) for name in singles]
        best = max(float(np.mean(fits[name, level])) for name in singles)
        margin = float(np.mean(fits["LPV", level])) - best
        lines.append(f"         LPV above the best single model by {margin:.2f}")
    lines += ["", "Mode frequency in Hz / damping in percent"]
    for (name, level), (frequency, damping) in modes.items():
        pairs = "  ".join(f"{f:.3f}/{d:.2f}" for f, d in zip(frequency, damping, strict=True))
        lines.append(f"{name:>6s} at level {level} (kappa {kappa[level]:.3f})  {pairs}")
    lines += ["", "Mode at 7.3 Hz"]
    for level in kappa:
        own = (
            f"   local {modes['modal', level][0][SOFTENING]:.3f} Hz" if level in ESTIMATION else ""
        )
        lines.append(f"level {level}: LPV {modes['LPV', level][0][SOFTENING]:.3f} Hz{own}")
    return lines


def _fit_line(name: str, fit: np.ndarray) -> str:
    return f"{name:<28s}{'  '.join(f'{value:6.2f}' for value in fit)} | {np.mean(fit):6.2f}"


def choice_table(rows: list[dict]) -> list[str]:
    lines = ["Leave-one-out, fit in percent: level 3 from 1, 5, 7 | level 5 from 1, 3, 7 | mean"]
    for row in rows:
        taken = "*" if getattr(Choices, row["choice"]) == row["value"] else " "
        label = f"{row['choice']:<19s}{row['value']:>6g} {taken}"
        numbers = (row.get(key) for key in ("level 3", "level 5", "mean"))
        text = row.get("why") or "  ".join(f"{number:6.2f}" for number in numbers)
        lines.append(f"{label}  {text}")
    return [*lines, "(* taken)"]


def draw(folder: str | Path, result: dict, out: str | Path) -> list[Path]:
    """Figures of the modes over the level and of the responses at the test levels."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    files = []
    for name, figure in (
        ("f16_modes.png", _draw_modes(result)),
        ("f16_responses.png", _draw_responses(folder, result)),
    ):
        files.append(out / name)
        figure.savefig(files[-1], dpi=130)
        plt.close(figure)
    return files


def _draw_modes(result: dict):
    import matplotlib.pyplot as plt

    local, kappa = result["local"], result["kappa"]
    figure, panels = plt.subplots(3, 1, figsize=(6.5, 9), sharex=True, layout="constrained")
    lv.plot.mode_frequencies(
        {"LPV model": result["lpv"], "local models": [item.modal for item in local.values()]},
        [kappa[level] for level in local],
        damping=True,
        axes=panels[:2],
    )
    # The relative change, which the plot of the frequencies hides.
    still, _ = modes_hz(result["lpv"].at(kappa[1]))
    grid = np.linspace(kappa[1], kappa[7], 60)
    swept = np.stack([modes_hz(result["lpv"].at(value))[0] for value in grid])
    found = np.stack([result["modes"]["modal", level][0] for level in local])
    for mode, frequency in enumerate(still):
        (line,) = panels[2].plot(grid, 100 * (swept[:, mode] / frequency - 1))
        line.set_label(f"{frequency:.2f} Hz")
        panels[2].plot(
            [kappa[level] for level in local],
            100 * (found[:, mode] / frequency - 1),
            "s",
            ms=4.5,
            color=line.get_color(),
        )
    panels[0].set_ylim(3.0, 10.9)
    panels[1].set_xlabel("")
    panels[2].set_ylabel("frequency change from level 1 (%)")
    panels[2].set_xlabel(f"κ = (RMS force / {REFERENCE_FORCE:g} N)$^{{{Choices.exponent:g}}}$")
    panels[2].legend(fontsize=8, ncols=2)
    panels[2].grid(alpha=0.4)
    above = panels[0].secondary_xaxis("top")
    above.set_xticks(list(kappa.values()), [str(level) for level in kappa])
    above.set_xlabel("F-16 ground vibration test, excitation level (2, 4, 6 not used)")
    return figure


def _draw_responses(folder: str | Path, result: dict):
    """Each test level: one acceleration over the band, then all three about the modes at 7 Hz."""
    import matplotlib.pyplot as plt

    fits = result["fits"]
    omega = np.asarray(lv.analysis.band_lines(record(folder, ESTIMATION[0]), BAND_HZ))
    frequency = omega / (2 * np.pi)
    figure, axes = plt.subplots(len(TEST), 4, figsize=(15, 8.5), layout="constrained")
    for row, level in zip(axes, TEST, strict=True):
        test = record(folder, level)
        lines = np.rint(frequency * test.n_samples * test.dt).astype(int)
        U, Y = (np.fft.rfft(np.asarray(signal), axis=0)[lines] for signal in (test.u, test.y))
        names = [name for name, at in fits if at == level and name.startswith("modal")]
        best = max(names, key=lambda name: np.mean(fits[name, level]))
        single = result["local"][int(best.split()[1])].modal.model
        frozen = result["lpv"].at(result["kappa"][level])
        curves = {
            "measured": (Y / U, {"color": "0.65", "lw": 3}),
            f"best single model (level {best.split()[1]})": (
                np.asarray(single.frequency_response(omega))[:, :, 0],
                {"color": "#D55E00", "lw": 1.2, "ls": "--"},
            ),
            "LPV model": (
                np.asarray(frozen.frequency_response(omega))[:, :, 0],
                {"color": "#0072B2", "lw": 1.4},
            ),
        }
        for panel, output, whole in zip(
            row, (1, 0, 1, 2), (True, False, False, False), strict=True
        ):
            shown = np.full(frequency.size, True) if whole else abs(frequency - 7.1) < 0.9
            for label, (response, look) in curves.items():
                size = 20 * np.log10(np.abs(response[shown, output]))
                panel.plot(frequency[shown], size, label=label, **look)
            both = fits["LPV", level][output], fits[best, level][output]
            panel.set_title(
                f"level {level}, acceleration {output + 1}"
                + ("" if whole else f": {both[0]:.1f} % (single {both[1]:.1f} %)"),
                fontsize=9.5,
            )
            panel.grid(alpha=0.3)
        row[0].set_ylabel("dB (m/s² per N)")
        row[0].legend(fontsize=7.5)
    for panel in axes[-1]:
        panel.set_xlabel("frequency (Hz)")
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    default = os.environ.get("LPVID_DATA", Path(__file__).resolve().parents[2] / "shared" / "data")
    parser.add_argument("--data", default=default, help="folder of the measured records")
    parser.add_argument("--choose", action="store_true", help="do the leave-one-out again")
    parser.add_argument("--out", help="folder for figures")
    arguments = parser.parse_args()
    if arguments.choose:
        print("\n".join(choice_table(choose(arguments.data))))
        return
    result = run(arguments.data)
    print("\n".join(table(result)))
    if arguments.out:
        print(*draw(arguments.data, result, arguments.out), sep="\n")


if __name__ == "__main__":
    main()
