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
# # Close the loop: what does the model lack?
# A model is fitted, and measured data disagree with it. `close_the_loop` finds what is left over,
# looks where in the machine it comes from and which physical effect it is, adds that effect, fits
# everything again, and says whether data that took no part agree. First on an arm whose secret we
# know, then on a measured drive.

# %%
import os
from pathlib import Path

import numpy as np

import lpvid as lv

# The test suite runs this page at a smaller size.
small = os.environ.get("LPVID_NOTEBOOK_SIZE") == "small"

# %% [markdown]
# ## An arm with a secret
# A rigid arm on a joint, J q̈ + c q̇ = u. It follows random angles under a position controller, and
# two things are in it that its model will not have: its weight, and dry friction in the joint. The
# loop below knows nothing of the library: it takes forty small steps a sample.

# %%
inertia, viscous = 0.05, 0.1  # kg m², N m s/rad
weight, friction = 0.25, 0.08  # N m
dt, samples, steps = 0.02, 900, 40


def record(seed):
    rng = np.random.default_rng(seed)
    wanted = np.repeat(rng.uniform(-1.2, 1.2, samples // 15), 15)
    dither = 0.15 * np.repeat(rng.standard_normal(samples // 5), 5)
    q, v, angles, torques = 0.0, 0.0, np.zeros(samples), np.zeros(samples)
    for k in range(samples):
        angles[k] = q + 2e-4 * rng.standard_normal()
        torques[k] = 1.5 * (wanted[k] - angles[k]) - 0.15 * v + dither[k]
        for _ in range(steps):
            hidden = -weight * np.sin(q) - friction * np.tanh(v / 1e-3)
            v += dt / steps * (torques[k] - viscous * v + hidden) / inertia
            q += dt / steps * v
    names, units = {"u": "torque", "y": "joint"}, {"u": "N m", "y": "rad"}
    return lv.IOData(u=torques, y=angles, dt=dt, names=names, units=units)


data = record(1)
lv.plot.records(data[:300])

# %% [markdown]
# ## One call
# The structure, an inertia with viscous friction, takes its start from the data. Two thirds of the
# record estimate, the last third decides.

# %%
train, _ = data.split(2 / 3)
structure = lv.loop.structure_named("servo", train)
found = lv.close_the_loop(structure, data)
print(lv.report.loop_text(found))

# %% [markdown]
# ## What it rests on
# On the left: the held-out record and its simulation before and after, the one-step residuals and
# their spectra. On the right: what the model lacked as a force, against what it depends on, with
# the law drawn in; the error over the horizon; what else was tried.

# %%
figure = lv.plot.loop(found)

# %% [markdown]
# ## Beside the truth

# %%
truth = {"inertia": inertia, "viscous friction": viscous}
for number in found.parameters:
    print(f"{number.name}: {number.value:.4f} ± {2 * number.std:.1g} (truth {truth[number.name]})")
print("hidden: gravity", weight, "N m, dry friction", friction, "N m")
for effect in found.effects:
    for number in effect.parameters:
        print(f"{effect.name}: {number.name} = {number.value:.4f} ± {2 * number.std:.1g}")

# %% [markdown]
# ## A measured drive
# The electro-mechanical positioning system EMPS (Janot, Gautier and Brunot, 2019): a carriage on a
# ball screw, its force in, its position out, under position control. Its authors name dry friction
# and viscous friction that differs by direction; nobody tells the engine. The second is found at a
# slow gain: the likeliest predictor corrects itself so fast that a slow effect hardly shows. The
# record is not part of the repository: `LPVID_DATA` names the folder. It is thinned to 10 ms, each
# new sample's force the mean of those it holds.

# %%
file = Path(os.environ.get("LPVID_DATA", "../../shared/data")) / "emps" / "DATA_EMPS.mat"
if file.exists() and not small:
    from scipy.io import loadmat

    raw = loadmat(file)
    force = (raw["gtau"] * raw["vir"]).ravel()[20:]
    place = raw["qm"].ravel()[20:]
    count = force.size // 10
    carriage = lv.IOData(
        u=force[: 10 * count].reshape(count, 10).mean(axis=1),
        y=place[: 10 * count : 10],
        dt=0.01,
        names={"u": "force", "y": "carriage"},
        units={"u": "N", "y": "m"},
    )
    servo = lv.loop.structure_named("servo", carriage.split(2 / 3)[0])
    measured = lv.close_the_loop(servo, carriage)
    print(lv.report.loop_text(measured))
    for one in measured.rounds[0][:5]:
        print(f"first round: {one.name} ({one.port}), gain {one.gain:.0f}")
    lv.plot.loop(measured)
else:
    print(f"{file} is not here: set LPVID_DATA to the folder of the measured records.")
