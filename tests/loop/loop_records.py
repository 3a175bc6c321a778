"""Records of closed loops put together by hand: what reports and pictures have to cope with."""

import numpy as np

from lpvid.loop import (
    Candidate,
    Errors,
    EstimatedNumber,
    FoundEffect,
    Ladder,
    Loop,
    Series,
    VirtualForce,
)

DT = 0.01
FRICTION = "coulomb at force at joint"
STIFFNESS = "cubic-stiffness at force at joint"


def _trajectories(count, friction, stiffness):
    """A mass on a damped spring under a random force; with dry friction and a stiffening spring."""
    rng = np.random.default_rng(1)
    force = 3.0 * np.repeat(rng.standard_normal(count // 20 + 1), 20)[:count]
    position, velocity = np.zeros(count + 1), np.zeros(count + 1)
    for k in range(count):
        lacking = -friction * np.tanh(velocity[k] / 0.02) - stiffness * position[k] ** 3
        pull = force[k] - 0.8 * velocity[k] - 6.0 * position[k] + lacking
        velocity[k + 1] = velocity[k] + DT * pull
        position[k + 1] = position[k] + DT * velocity[k + 1]
    return position[:count], velocity[:count]


def named(count=600, verdict="named"):
    """Dry friction and a stiffening spring found in a servo's joint, one output."""
    rng = np.random.default_rng(2)
    noise = 2e-3
    truth, rate = _trajectories(count, 0.7, 4.0)
    linear, _ = _trajectories(count, 0.0, 0.0)
    output = truth + noise * rng.standard_normal(count)
    lacking = -0.7 * np.tanh(rate / 0.02)
    hardening = -4.0 * truth**3
    residual = noise * rng.standard_normal(count)
    before = 4e-3 * (lacking + hardening) + residual
    steps = np.unique(np.geomspace(1, 60, 14).astype(int))
    series = Series(
        time=5.0 + DT * np.arange(count),
        output=output[:, None],
        before=linear[:, None],
        after=truth[:, None],
        residual_before=before[:, None],
        residual_after=residual[:, None],
    )

    def rms(values):
        return np.array([np.sqrt(np.mean(values**2))])

    floor = np.array([noise])
    spread = np.std(output)
    return Loop(
        verdict=verdict,
        advice="Both effects are needed on data that took no part in finding them.",
        structure="servo",
        parameters=(
            EstimatedNumber("inertia", 1.013, 0.004, "kg m²"),
            EstimatedNumber("friction", 0.79, 0.011, "N m s/rad"),
        ),
        effects=(
            FoundEffect(
                name="coulomb",
                family="friction",
                port="force at joint",
                parameters=(
                    EstimatedNumber("level", 0.7034, 0.0061, "N m"),
                    EstimatedNumber("speed", 0.021, np.inf, "rad/s"),
                ),
                confusable_with=("dahl at force at joint", "stribeck at force at joint"),
                gain=912.4,
                held_out_gain=402.7,
                p_value=0.0,
                separating_input="small reversals at low speed, 0.01 rad wide",
            ),
            FoundEffect(
                name="cubic-stiffness",
                family="stiffness",
                port="force at joint",
                parameters=(EstimatedNumber("k3", 4.02, 0.13, "N m/rad³"),),
                confusable_with=(),
                gain=88.1,
                held_out_gain=31.9,
                p_value=3e-5,
                separating_input="",
            ),
        ),
        before=Errors(
            rms(before),
            rms(0.6 * (output - linear)),
            rms(output - linear),
            100.0 * (1.0 - rms(output - linear) / spread),
        ),
        after=Errors(rms(residual), 1.1 * floor, floor, 100.0 * (1.0 - floor / spread)),
        noise_floor=floor,
        noise_floor_from="estimated from the spectrum above the plant's bandwidth",
        held_out=(1200, 1200 + count - 1),
        horizon=50,
        ladder=Ladder(
            steps=steps,
            before=(noise + 0.01 * (1 - np.exp(-steps / 15.0)))[:, None],
            after=(noise * (1.0 + 0.1 * (1 - np.exp(-steps / 5.0))))[:, None],
        ),
        p_value=0.0,
        p_value_left=0.41,
        tests_made=412,
        rounds=(
            (
                Candidate("coulomb", "friction", "force at joint", 912.4, 905.0, 0.0),
                Candidate("dahl", "friction", "force at joint", 903.3, 893.0, 0.0),
                Candidate("stribeck", "friction", "force at joint", 610.0, 600.0, 0.0),
                Candidate("delay", "delay", "input torque", 12.0, 4.0, 0.02),
            ),
            (
                Candidate("cubic-stiffness", "stiffness", "force at joint", 88.1, 82.0, 3e-5),
                Candidate("bias", "bias", "input torque", 1.2, -3.0, 1.0),
            ),
        ),
        ablation={FRICTION: np.array([0.051]), STIFFNESS: np.array([0.0123])},
        residual_tests={"whiteness": 0.31, "independence of the input": 0.62},
        virtual_forces=(
            VirtualForce(
                "coulomb at joint",
                "velocity at joint [rad/s]",
                rate,
                lacking + 0.1 * rng.standard_normal(count),
                lacking,
                "N m",
            ),
            VirtualForce(
                "cubic-stiffness at joint",
                "position at joint [rad]",
                truth,
                hardening + 0.1 * rng.standard_normal(count),
                hardening,
                "N m",
            ),
        ),
        series=series,
        model=None,
        model_before=None,
        output_names=("angle",),
        output_units=("rad",),
        dt=DT,
        seconds=8.2,
    )


def nothing_to_add(count=200):
    """A linear plant of two outputs: no effect, no ablation, no picture of a force."""
    one = named(count)

    def both(values):
        return np.concatenate([values, 10.0 * values], axis=-1)

    errors = Errors(*(both(values) for values in one.after[:3]), np.repeat(one.after.bft, 2))
    series = one.series._replace(before=one.series.after, residual_before=one.series.residual_after)
    return one._replace(
        verdict="nothing to add",
        advice="No effect of the library lowers the error.",
        effects=(),
        before=errors,
        after=errors,
        noise_floor=both(one.noise_floor),
        ladder=one.ladder._replace(before=both(one.ladder.after), after=both(one.ladder.after)),
        p_value=0.63,
        p_value_left=0.63,
        rounds=(one.rounds[1],),
        ablation={},
        virtual_forces=(),
        series=Series(series.time, *(both(values) for values in series[1:])),
        output_names=("angle", "rate"),
        output_units=("rad", ""),
    )


def abstained(count=200):
    """Records that decide nothing: numbers that are not finite in most places."""
    one = named(count)
    unknown = np.full(1, np.nan)
    return one._replace(
        verdict="abstain",
        advice="The simulation runs away; give longer records.",
        parameters=(EstimatedNumber("inertia", 1.0, np.inf, ""),),
        effects=(),
        before=Errors(one.before.one_step, unknown, np.full(1, np.inf), unknown),
        after=Errors(one.before.one_step, unknown, np.full(1, np.inf), unknown),
        noise_floor=unknown,
        noise_floor_from="not found",
        ladder=one.ladder._replace(before=one.ladder.before * np.nan),
        p_value=np.nan,
        p_value_left=np.nan,
        rounds=(),
        ablation={},
        residual_tests={},
        virtual_forces=(),
        series=one.series._replace(before=np.full((count, 1), np.nan)),
    )
