# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Identification, method by method
# One page for every way lpvid has of turning records into a model: subspace methods, their
# refinement to maximum likelihood with honest uncertainty, step responses, and mass, damping and
# stiffness matrices. All plants here are simulated, so that every answer can be checked.

# %%
import os

import jax
import jax.numpy as jnp
import numpy as np

import lpvid as lv

# The test suite runs this page at a smaller size.
small = os.environ.get("LPVID_NOTEBOOK_SIZE") == "small"

# %% [markdown]
# ## Subspace methods
# A flexible single-link arm swings between two angles; four sensors and a motor current. Every
# method is an object; the record and the rest of the call stay the same.

# %%
arm = lv.mechanics.reference_single_link_arm()
record = lv.mechanics.bounded_position_record(
    arm, jax.random.key(0), random_size=True, duration=20.0 if small else 40.0
)
train, test = record.split(0.5)
lv.plot.records(train[:1500])
print(record)

# %%
# The hub turns freely: its pole at one must not come out a hair outside.
settings = {"feedthrough": False, "stabilise": 0.99999}
methods = {
    "ORSE": lv.ORSE(8, 40, **settings),
    "PI-MOESP": lv.PastInputMOESP(8, 40, **settings),
    "PO-MOESP": lv.PastOutputMOESP(8, 40, **settings),
    "N4SID": lv.N4SID(8, 40, **settings),
    "CVA": lv.CVA(8, 40, **settings),
}
poles = arm.linearised().poles()
true_modes = np.sort(np.abs(poles[poles.imag > 1.0])) / (2 * np.pi)
print(f"{'truth':9} modes at", ", ".join(f"{f:.2f}" for f in true_modes), "Hz")
for name, method in methods.items():
    fit = lv.identify(train, method)
    modes = fit.model.modes()
    flexible = (np.asarray(modes.damping) < 0.5) & (np.asarray(modes.poles).imag > 0)
    found = np.asarray(modes.frequency)[flexible] / (2 * np.pi)
    score = np.round(lv.simulation_fit(fit.model, test), 1)
    print(f"{name:9} modes at", ", ".join(f"{f:.2f}" for f in found), f"Hz; fit {score} % unseen")

# %% [markdown]
# Which order? The singular values, and the modes that stay when the order grows:

# %%
fit = lv.identify(train, methods["PO-MOESP"])
lv.plot.scree(fit)
diagram = lv.stabilisation(train, methods["PO-MOESP"], orders=range(4, 21, 2))
lv.plot.stabilisation(diagram, frequencies=(1.0, 100.0))

# %% [markdown]
# ## Refinement
# A subspace model is a start. `refine` moves it to the maximum of the likelihood and tells how
# sure one can be: here a lightly damped plant with two inputs and two outputs.

# %%
frequencies, dampings = 2 * np.pi * np.array([2.0, 5.0]), np.array([0.02, 0.015])
blocks = [
    np.array([[0.0, w], [-w, -2 * z * w]]) for w, z in zip(frequencies, dampings, strict=True)
]
plant = lv.StateSpace(
    A=jax.scipy.linalg.block_diag(*blocks),
    B=jnp.array([[0.0, 0.0], [1.0, 0.5], [0.0, 0.0], [-0.5, 1.0]]),
    C=jnp.array([[1.0, 0.0, 1.0, 0.0], [0.5, 0.0, -1.0, 0.0]]),
)
input_key, noise_key, other_key = jax.random.split(jax.random.key(1), 3)
u = lv.mechanics.prbs(input_key, 3000, 2)
y = lv.mechanics.add_noise(noise_key, plant.simulate(u=u, dt=0.02), 20.0)
shaken = lv.IOData(u=u, y=y, dt=0.02)
fit = lv.identify(shaken, lv.PastOutputMOESP(order=4, block_rows=15))
refined = lv.refine(fit, shaken)
clean = plant.simulate(u=u, dt=0.02)
print("fit to the noise-free output, subspace:", lv.bft(clean, fit.model.simulate(u=u)).round(2))
print(
    "fit to the noise-free output, refined: ", lv.bft(clean, refined.model.simulate(u=u)).round(2)
)

# %% [markdown]
# Its 95 % intervals carry over to whatever is computed from the model: the response, the poles.

# %%
lv.plot.bode({"refined": refined, "truth": lv.c2d(plant, 0.02)})
lv.plot.poles({"refined": refined, "truth": lv.c2d(plant, 0.02)})

# %% [markdown]
# Is there anything left in the residual? White, and not correlated with the inputs: nothing.

# %%
tests = lv.analysis.residual_tests(refined.residual, shaken.u)
lv.plot.residual_tests(tests)
print(tests)

# %% [markdown]
# With noise inside the plant one predicts from past outputs too. The gain K of the innovation
# form comes with the subspace model, and `Innovation()` refines it.

# %%
kicks = 0.05 * jax.random.normal(other_key, (3000, 4))
sampled = lv.c2d(plant, 0.02)
disturbed = lv.StateSpace(sampled.A, jnp.eye(4), sampled.C, dt=0.02).simulate(u=kicks)
noisy = shaken.replace(y=y + disturbed)
fit = lv.identify(noisy, lv.CVA(order=4, block_rows=15))
predictor = lv.refine(fit, noisy, predictor=lv.Innovation())
errors = lv.analysis.horizon_errors(
    predictor.model, u=noisy.u, y=noisy.y, gain=predictor.innovation_gain
)
lv.plot.horizon_errors(errors, dt=noisy.dt)

# %% [markdown]
# ## Step responses
# Two inputs, two outputs, one step of each: the plant of Kosaka (2004) with measurement noise.
# Final values and their settled windows are found in the records.

# %%
steps_plant = lv.StateSpace(
    [[-2.0, 0.0, 0.0], [0.0, -1.0, 5.0], [0.0, -5.0, -1.0]],
    [[1.0, -1.0], [0.0, 2.0], [1.0, 1.0]],
    [[2.0, 1.0, 0.0], [0.0, 1.0, 1.0]],
)
levels = jnp.array([[1.0, 0.0], [0.0, 2.0]])
inputs = [jnp.tile(level, (2000, 1)) for level in levels]
noise_keys = jax.random.split(jax.random.key(2), 2)
outputs = [
    steps_plant.simulate(u=u, dt=0.01) + 0.01 * jax.random.normal(key, (2000, 2))
    for u, key in zip(inputs, noise_keys, strict=True)
]
steps = lv.IOData(u=inputs, y=outputs, dt=0.01)
stepped = lv.identify_step_response(steps, order=3)
better = lv.refine(stepped.model, steps, initial_state="zero")
for name, model in {
    "truth": steps_plant,
    "identified": stepped.model,
    "refined": better.model,
}.items():
    print(f"{name:10}", ", ".join(f"{s:.3f}" for s in np.sort_complex(model.poles())))
lv.plot.compare(steps.records[0], {"refined": better.model})

# %% [markdown]
# ## Mass, damping and stiffness
# Two masses, forces in, displacements out (Olofsson et al., 2014). The subspace step works on
# filtered signals in continuous time; the matrices come out symmetric and positive definite, and
# are refined in that form.

# %%
masses = lv.mechanics.MassSpringDamper.reference()
force_key, noise_key = jax.random.split(jax.random.key(3))
force = lv.mechanics.random_steps(force_key, 4000 if small else 20_000, 2, dt=5e-3)
moved = masses.state_space().simulate(u=force, dt=5e-3)
moved = moved + 3e-4 * jax.random.normal(noise_key, moved.shape)
pushed = lv.IOData(u=force, y=moved, dt=5e-3)
gray = lv.identify_mechanical(pushed)
physical = lv.refine(gray, pushed)


def matrices(parameters):
    """M, D and K of the refined structure."""
    return jnp.stack(gray.structure.mechanical_matrices(parameters))


values, covariance = lv.analysis.propagate(matrices, physical.parameters, physical.covariance)
spread = 2 * jnp.sqrt(jnp.einsum("aijaij->aij", covariance))
truths = (masses.mass, masses.damping, masses.stiffness)
for name, value, two_sigma, truth in zip("MDK", values, spread, truths, strict=True):
    for row, column in ((0, 0), (0, 1), (1, 1)):
        print(
            f"{name}[{row + 1},{column + 1}] = {value[row, column]:8.4f} "
            f"± {two_sigma[row, column]:.4f}, truth {truth[row, column]:.4f}"
        )

# %% [markdown]
# The modes, with their intervals, relative to the truth:


# %%
def modes(parameters):
    """Frequencies in Hz, then damping ratios."""
    system = lv.mechanics.MassSpringDamper(*gray.structure.mechanical_matrices(parameters))
    found = system.modes()
    return jnp.concatenate([found.frequencies / (2 * jnp.pi), found.damping_ratios])


reference = modes(gray.structure.parameters_of(*truths))
names = ["frequency 1", "frequency 2", "damping 1", "damping 2"]
found = lv.analysis.propagate(modes, physical.parameters, physical.covariance)
lv.plot.parameter_intervals({"refined": found}, reference=reference, names=names)

# %% [markdown]
# ## From the command line
# ```
# lpvid identify run.csv --input u1,u2 --output y1,y2 --time t --method cva --refine
# lpvid step a.csv b.csv --input u1,u2 --output y1,y2 --time t --order 3 --refine
# lpvid gray-box run.csv --input f1,f2 --output d1,d2 --time t
# ```
