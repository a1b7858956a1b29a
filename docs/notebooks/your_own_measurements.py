# %% [markdown]
# # Your own measurements
#
# Responses of a plate that you have measured yourself, with your own equipment, become a bank by `import_bank`. It
# reads SOFA, universal files, MATLAB, NumPy, netCDF and folders of WAV files. Here it is a NumPy file of frequency
# response functions, as a modal analysis leaves them: complex, one-sided, noisy, in m/s per V, with the places in a
# table of their own.
#
# Files and pictures go to the folder that the environment variable FOLDER names.

# %%
import json
import os
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import wavefocus as wf

folder = Path(os.environ.get("FOLDER", "your-own-measurements"))
folder.mkdir(parents=True, exist_ok=True)

# %% [markdown]
# ## The data
#
# Put your own file in the place of this cell. Ours comes from the virtual plate: twelve actuators, 77 positions,
# frequencies from 10 to 800 Hz in steps of 2.5 Hz, with a noise of -50 dB. The table of places says for each row
# whether it is a position or an actuator.

# %%
x_mm, y_mm = np.arange(-25.0, 26.0, 5.0), np.arange(-15.0, 16.0, 5.0)
position_mm = np.stack(np.meshgrid(x_mm, y_mm), axis=-1).reshape(-1, 2)
plate = wf.virtual_rig(actuators=12, position_mm=position_mm)
truth = np.stack([plate.truth(position) for position in range(len(position_mm))])

frequency_hz = np.arange(10.0, 800.1, 2.5)
frf = np.fft.rfft(truth, 4000)[:, :, (frequency_hz / 2.5).astype(int)]
random = np.random.default_rng(1)
noise = random.standard_normal((*frf.shape, 2)) @ [1, 1j]
frf += 10 ** (-50 / 20) * np.abs(frf).std() * noise
np.savez(folder / "frf.npz", H=frf, f=frequency_hz)

table = ["role,x_mm,y_mm"]
table += [f"position,{x},{y}" for x, y in position_mm]
table += [f"actuator,{x},{y}" for x, y in plate.actuator_mm]
(folder / "places.csv").write_text("\n".join(table), encoding="utf-8")

# %% [markdown]
# ## Import
#
# What the file does not say must be said: which array holds the responses and which the frequencies, the unit, the
# places. Leave one out, and the error names it. Nothing is guessed.

# %%
try:
    wf.import_bank(folder / "frf.npz", folder / "bank.h5", places=folder / "places.csv")
except wf.InputError as refusal:
    print(refusal)

# %%
(folder / "bank.h5").unlink(missing_ok=True)  # of an earlier run of this notebook: an import replaces no bank
bank = wf.import_bank(
    folder / "frf.npz",
    folder / "bank.h5",
    places=folder / "places.csv",
    names={"green": "H", "frequency_hz": "f"},
    unit="m/s/V",
    sample_rate_hz=5000.0,
    taps=500,
)
report = json.loads(bank.import_report or "{}")
print(report["paragraph"])

# %% [markdown]
# The report stands in the bank, too. Frequency responses say nothing below 10 Hz and above 800 Hz here; the import
# finds the causal impulse response of 500 taps that fits the band, and says how much of it remains unexplained:
# `residual_db`. Compare two numbers of taps, and choose where it no longer falls.
#
# ## Compare
#
# This works only for the virtual plate, whose truth is known.

# %%
middle = int(np.argmin(np.hypot(*position_mm.T)))
true_fir = plate.truth(middle)
within = (frequency_hz >= 30) & (frequency_hz <= 550)
bins = np.exp(-2j * np.pi * np.outer(np.arange(bank.taps) / bank.sample_rate_hz, frequency_hz[within]))
imported, true = (
    bank.green(middle) @ bins,
    truth[middle] @ np.exp(-2j * np.pi * np.outer(np.arange(truth.shape[2]) / 10_000.0, frequency_hz[within])),
)
error = float(np.linalg.norm(imported - true) / np.linalg.norm(true))
print(f"error from 30 to 550 Hz: {100 * error:.2f} %")

figure, axes = plt.subplots(figsize=(7, 3.5), layout="constrained")
axes.plot(frequency_hz, 20 * np.log10(np.abs(frf[middle, 0])), ".", ms=3, label="your file")
axes.plot(frequency_hz[within], 20 * np.log10(np.abs(imported[0])), label="the bank")
axes.set(xlabel="frequency in Hz", ylabel="level in dB re 1 m/s per V", title=f"Position {middle}, actuator 0")
axes.legend()
figure.savefig(folder / "imported.png", dpi=120)

# %% [markdown]
# ## Use it
#
# From here on it is a bank like any other: render a scene, predict its field, look at its foci.

# %%
path = wf.Line((-20.0, 0.0), (20.0, 0.0))
signal = wf.Noise((50.0, 450.0), 0.02, 1)
scene = wf.Scene("stroke", (wf.Source(path, signal, speed_mm_s=100.0, step_mm=5.0, emission="per_point"),))
drive = wf.render(scene, bank)
foci = wf.focus_figures(drive, bank)
wf.write_drive(folder / "drive.h5", drive, force=True)
for time_s, place_mm, width_mm in zip(foci.time_s, foci.at_mm, foci.width_mm, strict=True):
    print(f"{time_s:5.3f} s: ({place_mm[0]:5.1f}, {place_mm[1]:4.1f}) mm, {width_mm:4.1f} mm wide")

# %% [markdown]
# Other programs read the bank, too: `wf.export_bank(bank, "plate.sofa", "sofa")`, or as MATLAB, netCDF, universal
# files.

# %%
wf.export_bank(bank, folder / "bank.mat", "mat", force=True)
bank.close()
