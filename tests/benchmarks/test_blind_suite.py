"""The blind suite: its integrator against SciPy, its effects, its labels."""

import dataclasses
import importlib
import json
import sys
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg
import scipy.signal

ROOT = Path(__file__).resolve().parents[2]


def _module(name):
    # The benchmarks are not part of the installed package.
    sys.path.insert(0, str(ROOT))
    try:
        return importlib.import_module(f"benchmarks.blind_suite{name}")
    finally:
        sys.path.remove(str(ROOT))


suite, laws, plants, drawing, generator, simulator = (
    _module(name) for name in ("", "._laws", "._plants", "._effects", "._generate", "._simulate")
)
SAMPLES = 150


def runs_of(plant, effects, *, samples=SAMPLES, moving=0.0, kappa=0.0, level=1.0):
    """One motion of the plant under the same excitation, with each row of effects."""
    rng = np.random.default_rng(5)
    motion = plant.draw(rng, False)
    count = len(effects)
    wave = np.repeat(rng.standard_normal((samples // 5, len(plant.inputs))), 5, axis=0)
    shape = (count, samples, len(plant.outputs))
    return simulator.Runs(
        motions=[motion] * count,
        effects=effects,
        excitation=np.broadcast_to(level * np.array(plant.level) * wave, (count, *wave.shape)),
        reference=np.zeros(shape),
        closed=np.zeros(count),
        noise=np.zeros(shape),
        angle=np.full(count, 1.2),
        moving=np.full(count, moving),
        kappa=np.full((count, samples), kappa),
    )


@pytest.mark.parametrize("name", list(plants.PLANTS))
def test_without_effects_it_is_the_linear_system(name):
    plant = plants.PLANTS[name]
    runs = runs_of(plant, [[]])
    signals = simulator.simulate(plant, runs)
    motion = runs.motions[0]
    n = len(motion.damping)
    mass = motion.mass[0]
    if plant.scheduled:
        # Between the nodes, by an interpolation of its own.
        fit = np.polynomial.chebyshev.chebfit(plants.KAPPA_NODES, motion.mass.reshape(9, -1), 8)
        mass = np.polynomial.chebyshev.chebval(np.cos(1.2), fit).reshape(n, n)
    A = np.block(
        [
            [np.zeros((n, n)), np.eye(n)],
            [-np.linalg.solve(mass, motion.stiffness), -np.linalg.solve(mass, motion.damping)],
        ]
    )
    B = np.vstack([np.zeros_like(motion.inputs), np.linalg.solve(mass, motion.inputs)])
    system = scipy.signal.cont2discrete(
        (A, B, motion.outputs, np.zeros((len(motion.outputs), B.shape[1]))), plant.dt
    )
    _, y, _ = scipy.signal.dlsim(system, signals.u[0])
    np.testing.assert_allclose(signals.y[0], y, atol=1e-7 * np.abs(y).max())


def test_dry_friction_stops_a_sliding_mass_and_then_holds_it():
    plant = plants.PLANTS["mass-spring-damper"]
    mass, level = 2.0, 0.5
    motion = plants.Motion(
        np.diag([mass, 1.0])[None], np.zeros((2, 2)), np.zeros((2, 2)), np.eye(2), np.eye(2, 4), {}
    )
    effect = laws.Effect("coulomb", "force", "displacement 1", "", (level,))
    runs = runs_of(plant, [[effect]], samples=100)
    push = np.zeros((1, 100, 2))
    push[0, :10, 0] = 2.0
    push[0, 60:, 0] = 0.9 * level
    runs = dataclasses.replace(runs, motions=[motion], excitation=push)
    q = simulator.simulate(plant, runs).y[0, :, 0]
    # Speeds up under 2 N − 0.5 N for 0.2 s, then slides to rest under 0.5 N.
    speed, pushed = 1.5 / mass * 0.2, 0.5 * 1.5 / mass * 0.2**2
    rest = pushed + speed**2 / (2 * level / mass)
    assert q[10] == pytest.approx(pushed, rel=1e-2)
    np.testing.assert_allclose(q[50:], rest, rtol=1e-2)
    assert np.ptp(q[50:]) < 1e-9


def test_a_pendulum_keeps_its_energy():
    plant = plants.PLANTS["flexible-joint"]
    weight = 3.0
    motion = plants.Motion(
        np.diag([0.1, 1.0])[None],
        np.zeros((2, 2)),
        np.zeros((2, 2)),
        np.array([[1.0], [0.0]]),
        np.eye(2, 4),
        {},
    )
    effect = laws.Effect("gravity", "force", "motor", "", (weight, 0.0))
    runs = runs_of(plant, [[effect]], samples=400)
    push = np.zeros((1, 400, 1))
    push[0, :20, 0] = 2.0
    runs = dataclasses.replace(runs, motions=[motion], excitation=push)
    signals = simulator.simulate(plant, runs)
    q, v = signals.position[0, 20:, 0], signals.velocity[0, 20:, 0]
    energy = 0.5 * 0.1 * v**2 + weight * (1.0 - np.cos(q))
    np.testing.assert_allclose(energy, energy[0], rtol=2e-3)
    assert np.ptp(q) > 0.5


def test_every_effect_changes_the_response():
    every = [name for name in laws.FAMILIES if name not in ("scheduling", "parameter-drift")]
    for structure in ("flexible-joint", "two-link-arm"):
        plant = plants.PLANTS[structure]
        moving = float(plant.scheduled)
        blank = simulator.simulate(plant, runs_of(plant, [[]], moving=moving, kappa=0.5))
        sizes = drawing.sizes_of(plant, blank, 0)
        motion = runs_of(plant, [[]]).motions[0]
        rng = np.random.default_rng(1)
        names = [*every, *drawing.OUTSIDE, "scheduling", "parameter-drift"]
        if structure == "two-link-arm":
            names = ["coulomb", "cubic-stiffness", "scheduling", "parameter-drift", "saturation"]
        effects = []
        for name in names:
            # No output is level there; the law is the same.
            there = plant
            if not plant.level_outputs:
                there = dataclasses.replace(plant, level_outputs=(0, 1))
            effects.append(drawing.draw_effect(name, there, motion, sizes, rng))
        runs = runs_of(plant, [[effect] for effect in effects], moving=moving, kappa=0.5)
        signals = simulator.simulate(plant, runs)
        change = np.sqrt(np.mean((signals.y - blank.y) ** 2, axis=(1, 2)))
        size = np.sqrt(np.mean(blank.y**2))
        assert np.all(np.isfinite(signals.y))
        assert np.all(change > 1e-5 * size), [
            name for name, value in zip(names, change, strict=True) if not value > 1e-5 * size
        ]
        # And in no other record of the batch.
        again = simulator.simulate(plant, runs_of(plant, [[], [effects[0]]], moving=moving))
        alone = simulator.simulate(plant, runs_of(plant, [[]], moving=moving))
        np.testing.assert_allclose(again.y[0], alone.y[0], atol=1e-12 * size)


def test_a_whole_delay_is_a_shift():
    plant = plants.PLANTS["mass-spring-damper"]
    late = [
        laws.Effect("input-delay", "input", channel, "", (1.0,), (3 * plant.dt,))
        for channel in (0, 1)
    ]
    signals = simulator.simulate(plant, runs_of(plant, [[], late]))
    np.testing.assert_allclose(signals.y[1, 3:], signals.y[0, :-3], atol=1e-12)


def test_the_two_link_arm_is_that_of_the_reference():
    ours = plants.two_link_mass((0.6, 0.4), (0.02, 0.008), 1.0, 0.3, 1.2)
    # reference_two_link_arm().mass_matrix([0, 1.2, 0, 0])
    theirs = [
        [0.26852, 0.0523, 0.10454, 0.01279],
        [0.0523, 0.0386, 0.03181, 0.00891],
        [0.10454, 0.03181, 0.04756, 0.0076],
        [0.01279, 0.00891, 0.0076, 0.00262],
    ]
    np.testing.assert_allclose(ours, theirs, atol=6e-6)


def test_the_single_link_arm_has_the_modes_of_the_reference():
    # reference_single_link_arm(modes=2).natural_frequencies(), without any spread.
    class Middle:
        def uniform(self, low, high, size=None):
            return 0.5 * (low + high) * np.ones(size)

    motion = plants.PLANTS["single-link-arm"].draw(Middle(), False)
    squares = scipy.linalg.eigh(motion.stiffness, motion.mass[0], eigvals_only=True)
    np.testing.assert_allclose(np.sqrt(squares[1:]), [59.373403, 145.972197], rtol=1e-6)


@pytest.fixture(scope="module")
def small():
    return suite.generate(7, 5, plants=("mass-spring-damper",), samples=240)


def test_the_seed_decides_everything_and_labels_are_sealed(small, tmp_path):
    records, labels = small
    again, _ = suite.generate(7, 5, plants=("mass-spring-damper",), samples=240)
    other, _ = suite.generate(8, 5, plants=("mass-spring-damper",), samples=240)
    assert all(np.array_equal(a.y, b.y) for a, b in zip(records, again, strict=True))
    assert not np.array_equal(records[0].y, other[0].y)
    suite.save(tmp_path, records, labels)
    loaded = suite.load(tmp_path)
    assert [record.key for record in loaded] == [record.key for record in records]
    np.testing.assert_array_equal(loaded[2].y, records[2].y)
    with np.load(tmp_path / "records.npz") as archive:
        text = str(archive["about"])
    names = [effect["name"] for label in labels.values() for effect in label["effects"]]
    assert names and not any(name in text for name in (*names, "decoy", "outside"))
    truth = json.loads((tmp_path / "labels.json").read_text())
    assert truth.keys() == {record.key for record in records}


def test_noise_and_strength_are_as_labelled(small):
    records, labels = small
    for record in records:
        label = labels[record.key]
        noise = np.array(label["noise_std"])
        ratio = 20 * np.log10(np.std(record.y, axis=0) / noise)
        assert np.all(np.abs(ratio - label["snr"]) < 8.0)
        for effect in label["effects"]:
            assert effect["over_noise"] > 0.0
            family = laws.FAMILIES.get(effect["name"], "outside")
            assert effect["family"] == family
            assert (family == "outside") == (label["case"] == "outside")


def test_shares_of_the_cases():
    dealt = generator.deal(900)
    shares = {case: dealt.count(case) for case in generator.CASES}
    assert shares["one"] >= 200 and shares["none"] + shares["decoy"] >= 300
    assert shares["outside"] >= 180


def test_names_are_those_of_the_library():
    from lpvid.effects import LIBRARY

    known = {law.name: law.family for law in LIBRARY}
    assert known.items() >= laws.FAMILIES.items()
    amplitudes = {law.name: len(law.amplitudes) for law in LIBRARY if len(law.amplitudes) > 1}
    assert {name: laws.AMPLITUDES[name] for name in laws.AMPLITUDES} == amplitudes
    assert {law.name for law in LIBRARY if law.whole} == set(laws.WHOLE)
