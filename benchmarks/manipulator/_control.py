"""PDP, PDPC and ILQR control of the single-link arm: sections 4.2 to 4.4 of Sun 2000 (002).

Models for design: ORSE of order 18 on the first half of a closed-loop record with 0.4 A of friction
whose compensation is taken out of the input (type II of 002), reduced by MRM to order 10 and
updated; the linearised arm beside it. ILQR is designed on the linearised arm with 300 g: the model
identified with friction is damped more than the arm without it, whose loop then hardly settles.
Control is tried on the nonlinear arm with that friction, 12 bits over ±10 V, 5 mV of noise and a
limit of 5 A. Its own rule of compensation was chosen on 100 and 300 g at 2 and 4 V, another key
than the one scored, and so were the play of the gear and the level at which unconditional
compensation shakes it. What makes ILQR hunt, more friction at rest than in motion, was looked for
at the payload and set-points that are printed.

Steady error: the set-point less the hub's true angle, mean of the last 2 s of 40 s. A limit cycle,
by a criterion laid down before any run was looked at: over the last 10 s the hub's true angle moves
by more than two quantisation steps and turns back at least twice. Hunting is slower than that: the
last half of two minutes is judged beside it.
"""

import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.signal
from tqdm import tqdm

import lpvid as lv
from benchmarks.manipulator._reduction import DT, reduced, updated
from benchmarks.single_link import BLOCK_ROWS, EXPERIMENTS, SCORED_KEY, STICKY, fitted
from lpvid.control import (
    ILQR,
    PDP,
    PDPC,
    ClosedLoopMotion,
    ControllerDesign,
    design_ilqr,
    design_pdp,
    itae,
    loop_transfer,
    margins,
    simulate_closed_loop,
)
from lpvid.mechanics import (
    ArmEffects,
    Backlash,
    DryFriction,
    Quantisation,
    SampledController,
    reference_single_link_arm,
)
from lpvid.models import StateSpace
from lpvid.reduce import ModalResponseMagnitude
from lpvid.report import text_table

RECORDS = {0.0: "closed, square", 0.2: "closed, 200 g", 0.4: "closed, 400 g"}
PAYLOADS, SET_POINTS = (0.0, 0.2, 0.4), (1.0, 3.0, 5.0)
COLUMNS = [f"{1000 * p:.0f} g {r:.0f} V" for p in PAYLOADS for r in SET_POINTS]
ORIGINAL_ORDER, ORDER = 18, 10
FRICTION, CURRENT = 0.4, 5.0
STEP = Quantisation().step
SECONDS, SETTLED, WATCHED = 40.0, 2.0, 10.0
# The hunting turned out to be slower than the criterion's window; both are printed.
LONG = 120.0
KEY = 3
# 002, table 4-2: bounds and starts are the defaults of `design_pdp`.
PUBLISHED_GAINS, PUBLISHED_TRIAL = (0.594, 4.266, 0.254), (0.5, 3.3, 0.07)
# What 002's friction asks for in V, and what removes 0.4 A at 0.5 A/V.
PUBLISHED_COMPENSATION, MATCHED_COMPENSATION = 0.7, FRICTION / 0.5
# Physically usual: 1.3 to 1.6 times as much at rest as in motion.
BREAKAWAYS = (1.4, 1.6)
# A sample, by trial and error; our ITAE finds about half of it.
PUBLISHED_INTEGRAL = 0.0015
# Of the gear, at the hub, rad; levels over the friction; the locked beam swings at about 1.2 Hz,
# for half a minute and whatever the compensation does: what is faster is the gear's.
PLAY, PLAY_LEVELS, FAST = 0.003, (1.0, 1.125), 5.0
# 002's K_P of 0.77 is sqrt(output weight / input weight).
OUTPUT_WEIGHTS, INPUT_WEIGHT = (1.0, 0.1, 0.1, 0.0), 1.0 / 0.7746**2


def nominal_model(payload: float, order: int) -> StateSpace:
    """Identified, reduced, updated."""
    data = EXPERIMENTS[RECORDS[payload]].data(SCORED_KEY, STICKY)
    first = data.split(0.5)[0]
    fit = fitted(data, ORIGINAL_ORDER, BLOCK_ROWS)
    return updated(reduced(fit, first, order, ModalResponseMagnitude()), first).model


def linearised_model(payload: float) -> StateSpace:
    return reference_single_link_arm(payload_mass=payload).linearised().discretise(DT)


def margin_rows(models: dict[float, StateSpace], controller: SampledController) -> list[list]:
    """Margins of the loop at the position error, one row a payload."""
    rows = []
    for payload, model in models.items():
        found = margins(loop_transfer(model, controller))
        at_input = margins(loop_transfer(model, controller, at="input"))
        rows.append(
            [
                f"{1000 * payload:.0f} g",
                f"{float(found.gain_margin_decibels):.1f}",
                f"{float(found.phase_margin):.1f}",
                f"{float(found.delay_margin):.2f}",
                f"{float(found.modulus_margin):.2f}",
                "yes" if found.stable else "NO",
                f"{float(at_input.modulus_margin):.2f}",
                f"{1000 * float(at_input.delay_margin):.1f}",
            ]
        )
    return rows


MARGIN_HEADERS = [
    "payload", "GM dB", "PM deg", "delay s", "modulus", "stable", "input: modulus", "delay ms",
]  # fmt: skip


def print_design(title: str, models: dict[float, StateSpace]) -> ControllerDesign:
    start = time.perf_counter()
    design = jax.block_until_ready(design_pdp(list(models.values())))
    seconds = time.perf_counter() - start
    rows = [
        [name, *(f"{g:.4f}" for g in gains), f"{cost:.4f}"]
        for name, gains, cost in zip(
            ("[0.3, 1.0, 0.1]", "[0.594, 4.266, 0.254]", "[0.8, 4.0, 0.5]"),
            np.asarray(design.gains),
            np.asarray(design.costs),
            strict=True,
        )
    ]
    rows.append(["002, all three", "0.594", "4.266", "0.254", "5.810"])
    print(f"\nPDP over 0, 200 and 400 g, {title} ({seconds:.0f} s)")
    print(text_table(rows, ["start", "K_P", "K_d", "K_sg", "J"]))
    spread = np.ptp(np.asarray(design.gains), axis=0) / np.mean(np.asarray(design.gains), axis=0)
    print(f"largest spread of a gain over the starts: {100 * spread.max():.3f} %")
    print(text_table(margin_rows(models, design.controller), MARGIN_HEADERS))
    return design


def effects(friction: float, *, breakaway: float | None = None, gap: float = 0.0) -> ArmEffects:
    """Of the arm; friction in A, the gear's play in rad."""
    return ArmEffects(
        friction=DryFriction(friction, breakaway=breakaway) if friction else None,
        backlash=Backlash(gap) if gap else None,
        current_limit=CURRENT,
        noise=0.005,
        quantisation=Quantisation(),
    )


@eqx.filter_jit
def _runs(arms, references, keys, controller, chosen: ArmEffects, seconds) -> ClosedLoopMotion:
    samples = round(seconds / DT)

    def one(arm, reference, key):
        return simulate_closed_loop(
            arm,
            controller,
            reference=jnp.full(samples, reference),
            dt=DT,
            effects=chosen,
            key=key,
        )

    return eqx.filter_vmap(one)(arms, references, keys)


def runs(
    payloads, set_points, controller, chosen: ArmEffects, seconds: float = SECONDS
) -> ClosedLoopMotion:
    """All payloads at all set-points in one batch, set-points fastest."""
    arms = [reference_single_link_arm(payload_mass=p) for p in payloads for _ in set_points]
    arms = jax.tree.map(lambda *leaves: jnp.stack(leaves), *arms)
    references = jnp.asarray([r for _ in payloads for r in set_points])
    keys = jax.random.split(jax.random.key(KEY), references.size)
    return _runs(arms, references, keys, controller, chosen, seconds)


def hub_volts(motion: ClosedLoopMotion) -> np.ndarray:
    """The hub's true angle (run, time), in V of its sensor."""
    gain = float(reference_single_link_arm().angle_gain)
    return gain * np.asarray(motion.states[..., 0])


def steady_errors(motion: ClosedLoopMotion) -> np.ndarray:
    """In quantisation steps."""
    last = hub_volts(motion)[:, -round(SETTLED / DT) :]
    return (np.asarray(motion.reference)[:, -1, 0] - last.mean(axis=1)) / STEP


def vibration(motion: ClosedLoopMotion) -> np.ndarray:
    """RMS of the base strain about its mean once the arm has arrived, and of its fast part, V."""
    strain = np.asarray(motion.y)[:, -round(WATCHED / DT) :, 1]
    passed = scipy.signal.butter(2, FAST, "high", fs=1.0 / DT, output="sos")
    fast = scipy.signal.sosfiltfilt(passed, strain, axis=1)
    return np.stack([strain.std(axis=1), fast.std(axis=1)])


def limit_cycles(angle: np.ndarray, seconds: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """By the criterion above, with the angle's movement in steps and its turns."""
    last = angle[:, -round(seconds / DT) :]
    movement = np.ptp(last, axis=1) / STEP
    turns = np.array([_turns(one) for one in last])
    return (movement > 2.0) & (turns >= 2), movement, turns


def _turns(angle: np.ndarray) -> int:
    """How often the angle turns back by more than a quantisation step."""
    count, direction, extreme = 0, 0, angle[0]
    for value in angle:
        if direction >= 0 and value < extreme - STEP or direction <= 0 and value > extreme + STEP:
            turned = np.sign(value - extreme)
            count += direction not in (0, turned)
            direction, extreme = turned, value
        elif direction and (value - extreme) * direction > 0:
            extreme = value
    return count


def print_pdpc(gains: dict[str, tuple[float, float, float]]) -> None:
    """Steady errors on the arm, by gains, rule and level."""
    variants = {
        "002's law, 0.7 V": ("conditional", PUBLISHED_COMPENSATION),
        "002's law, 0.8 V": ("conditional", MATCHED_COMPENSATION),
        "always, 0.8 V": ("always", MATCHED_COMPENSATION),
        "none": ("conditional", 0.0),
        "precise, 0.8 V": ("precise", MATCHED_COMPENSATION),
        "precise, 5 % less": ("precise", 0.95 * MATCHED_COMPENSATION),
        "precise, 5 % more": ("precise", 1.05 * MATCHED_COMPENSATION),
    }
    rows = []
    for which, name in tqdm([(g, v) for g in gains for v in variants], desc="PDPC on the arm"):
        rule, level = variants[name]
        motion = runs(
            PAYLOADS, SET_POINTS, PDPC(PDP(*gains[which]), level, rule=rule), effects(FRICTION)
        )
        found = steady_errors(motion)
        below = f"{np.sum(np.abs(found) < 1)} of 9"
        rows.append([which, name, *(f"{e:+.1f}" for e in found), below])
    print(
        f"\nPDPC with {FRICTION} A of friction: steady error in quantisation steps of {STEP:.4f} V"
    )
    print(text_table(rows, ["gains", "compensation", *COLUMNS, "below one"]))


def print_play(gains: tuple[float, float, float]) -> None:
    """Vibration of the arm with play in its gear, by rule and level."""
    rows = []
    cases = [(r, f) for r in ("conditional", "precise", "always") for f in PLAY_LEVELS]
    for rule, factor in tqdm(cases, desc="PDPC with play"):
        level = factor * MATCHED_COMPENSATION
        controller = PDPC(PDP(*gains), level, rule=rule)
        motion = runs(PAYLOADS, SET_POINTS, controller, effects(FRICTION, gap=PLAY))
        whole, fast = 1e3 * vibration(motion)
        cells = [f"{w:.0f} {f:.0f}" for w, f in zip(whole, fast, strict=True)]
        rows.append([f"{rule}, {level:.2f} V", *cells, f"{np.median(fast):.0f}"])
    print(
        f"\nPDPC with {1e3 * PLAY:g} mrad of play: RMS of the base strain in the last "
        f"{WATCHED:.0f} s in mV, and its part above {FAST:g} Hz\n(the sensor alone: 5), our "
        "gains; 002's shake the arm with play whatever is added"
    )
    print(text_table(rows, ["compensation", *COLUMNS, "median, fast"]))


def ilqr() -> ILQR:
    """For 300 g, by 002's rules with numbers where it tried by hand.

    The observer has the least noise at the input whose slowest pole is twice as fast as the
    regulator's; K_I is that of least ITAE for 3 V on the design model under a constant disturbance
    worth the friction (figure 4-14).
    """
    model = linearised_model(0.3)
    weighted = model.C.T @ jnp.diag(jnp.asarray(OUTPUT_WEIGHTS)) @ model.C

    def design(noise: float, integral: float) -> ILQR:
        return design_ilqr(
            model,
            state_weight=weighted,
            input_weight=INPUT_WEIGHT,
            state_noise=noise * model.B @ model.B.T,
            output_noise=0.005**2,
            integral=integral,
        )

    def slowest(A) -> float:
        return float(np.min(-np.log(np.abs(np.linalg.eigvals(np.asarray(A)))) / DT))

    def fast_enough(noise: float) -> bool:
        found = design(noise, 0.0)
        regulated = slowest(found.model.A - found.model.B @ found.feedback[None])
        return slowest(found.model.A - found.observer[:, None] @ found.model.C) >= 2.0 * regulated

    noise = next(float(noise) for noise in np.geomspace(1e-6, 1e6, 25) if fast_enough(float(noise)))
    found = design(noise, 0.0)
    # A state that stays at one drives the input by the disturbance.
    push = -MATCHED_COMPENSATION * model.B
    A = jnp.concatenate([model.A, push], axis=1)
    A = jnp.concatenate([A, jnp.eye(1, model.nx + 1, model.nx)])
    B = jnp.concatenate([model.B, jnp.zeros((1, 1))])
    disturbed = StateSpace(A, B, jnp.pad(model.C, ((0, 0), (0, 1))), dt=DT)
    x0 = jnp.zeros(model.nx + 1).at[-1].set(1.0)
    reference = jnp.full(round(10.0 / DT), 3.0)

    def cost(integral: float) -> float:
        motion = simulate_closed_loop(
            disturbed,
            eqx.tree_at(lambda c: c.integral, found, jnp.asarray(integral)),
            reference=reference,
            x0=x0,
        )
        return float(itae(reference - motion.y[:, 0], DT))

    tried = np.geomspace(0.01, 1.0, 21)
    return design(noise, float(tried[np.argmin([cost(float(k)) for k in tried])]))


def print_ilqr() -> None:
    """Hunting: with no friction, with Coulomb's, and with more of it at rest than in motion."""
    designed = ilqr()
    rows = []
    integrals = {"ITAE": float(designed.integral), "002's": PUBLISHED_INTEGRAL / DT}
    frictions = {
        "none": effects(0.0),
        "0.4 A": effects(FRICTION),
        **{
            f"0.4 A, at rest {b * FRICTION:.2f} A": effects(FRICTION, breakaway=b * FRICTION)
            for b in BREAKAWAYS
        },
    }
    cases = [(k, f) for k in integrals for f in frictions]
    for source, friction in tqdm(cases, desc="ILQR on the arm"):
        controller = eqx.tree_at(lambda c: c.integral, designed, jnp.asarray(integrals[source]))
        motion = runs((0.3,), (3.0, 5.0), controller, frictions[friction], LONG)
        angle = hub_volts(motion)
        short = limit_cycles(angle[:, : round(SECONDS / DT)], WATCHED)
        long = limit_cycles(angle, 0.5 * LONG)
        for i, set_point in enumerate((3.0, 5.0)):
            row = [f"{DT * integrals[source]:.5f}, {source}", friction, f"{set_point:.0f} V"]
            row.append(f"{100 * (angle[i].max() / set_point - 1):.1f}")
            for cycles, movement, turns in (short, long):
                row += ["yes" if cycles[i] else "no", f"{movement[i]:.1f}", turns[i]]
            rows.append(row)
    headers = ["K_I a sample", "friction", "set-point", "overshoot %"]
    headers += [f"last {WATCHED:.0f} of {SECONDS:.0f} s: cycle", "movement, steps", "turns"]
    headers += [f"last {LONG / 2:.0f} of {LONG:.0f} s: cycle", "movement, steps", "turns"]
    print(f"\nILQR for 300 g, order 8: K_P {float(designed.feedforward):.4f} (002: 0.7746)")
    print(text_table(rows, headers))
    print("002: a limit cycle at 5 V, none at 3 V, on the apparatus; none in simulation without.")


def draw(folder: Path, models: dict[float, StateSpace], design: ControllerDesign) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    loops = {f"{1000 * p:.0f} g": loop_transfer(m, design.controller) for p, m in models.items()}
    lv.plot.save_figure(lv.plot.loop_bode(loops), folder / "pdp_bode.png")
    lv.plot.save_figure(lv.plot.nyquist(loops), folder / "pdp_nyquist.png")
    motion = runs((0.4,), (5.0,), PDPC(PDP(*PUBLISHED_GAINS)), effects(FRICTION))
    axes = lv.plot.closed_loop_response({"400 g, 5 V": jax.tree.map(lambda x: x[0], motion)})
    lv.plot.save_figure(axes, folder / "pdpc_response.png")


def main(out: Path | None = None) -> None:
    identified = {p: nominal_model(p, ORDER) for p in tqdm(PAYLOADS, desc="identify")}
    design = print_design("identified models", identified)
    print_design("linearised arm", {p: linearised_model(p) for p in PAYLOADS})
    print("\n002's trial gains on the identified models (figure 4-8)")
    print(text_table(margin_rows(identified, PDP(*PUBLISHED_TRIAL)), MARGIN_HEADERS))
    best = design.controller
    assert isinstance(best, PDP)
    found = float(best.proportional), float(best.derivative), float(best.strain)
    print_pdpc({"ours": found, "002's": PUBLISHED_GAINS})
    print_play(found)
    print_ilqr()
    if out:
        draw(out, identified, design)
