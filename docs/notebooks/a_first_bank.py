# %% [markdown]
# # A first bank
#
# A plate answers each actuator in its own way at every point. These answers, the Green's functions, are all that is
# needed to focus waves on it. In this notebook a virtual rig measures a small bank of them; we look at one, judge the
# whole, and focus a wave at a point. Nothing but wavefocus is needed, and the same lines work with the bank of a real
# plate.
#
# Files and pictures go to the folder that the environment variable FOLDER names.

# %%
import os
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import wavefocus as wf

folder = Path(os.environ.get("FOLDER", "a-first-bank"))
folder.mkdir(parents=True, exist_ok=True)

# %% [markdown]
# ## Measure
#
# The rig is a soft plate of 250 mm x 150 mm with eight actuators on its rim. A laser vibrometer measures the velocity
# of the surface at 117 positions, 5 mm apart. Each actuator plays a sweep at each position; what the vibrometer
# records becomes a Green's function: the velocity in m/s that one volt makes, tap by tap.

# %%
x_mm, y_mm = np.arange(-30.0, 31.0, 5.0), np.arange(-20.0, 21.0, 5.0)
position_mm = np.stack(np.meshgrid(x_mm, y_mm), axis=-1).reshape(-1, 2)
rig = wf.virtual_rig(actuators=8, position_mm=position_mm)
bank = rig.measure(folder / "plate.h5")
print(f"{bank.positions} positions, {bank.actuators} actuators, {bank.taps} taps at {bank.sample_rate_hz:g} Hz")

# %% [markdown]
# Every position was committed to the disk before the next one counted. Stop the cell and run it again: it goes on
# where it was. `wavefocus status`, `check` and `gui` understand the file, too.
#
# ## Look at one Green's function
#
# The position in the middle is number 58. The wave needs some milliseconds to arrive, and the nearest actuators are
# loudest. The virtual rig knows the truth, which no real rig does: within the sweep's band, 20 to 500 Hz, the
# measured spectrum lies on the true one.

# %%
middle = int(np.argmin(np.hypot(*position_mm.T)))
green, truth = bank.green(middle), rig.truth(middle)
frequency_hz = np.fft.rfftfreq(bank.taps, 1 / bank.sample_rate_hz)
figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.5), layout="constrained")
for actuator in range(3):
    left.plot(1e3 * bank.time_s, 1e3 * green[actuator], label=f"actuator {actuator}")
left.set(xlabel="time in ms", ylabel="response in mm/s per V", xlim=(0, 60), title=f"Position {middle}")
left.legend()
right.plot(frequency_hz, 20 * np.log10(np.abs(np.fft.rfft(truth[0]))), "k", lw=3, alpha=0.3, label="true")
right.plot(frequency_hz, 20 * np.log10(np.abs(np.fft.rfft(green[0]))), label="measured")
right.set(xlabel="frequency in Hz", ylabel="level in dB re 1 m/s per V", xlim=(0, 800), ylim=(-100, None))
right.axvspan(20, 500, color="k", alpha=0.05)
right.legend()
figure.savefig(folder / "one-green-function.png", dpi=120)

band = (frequency_hz >= 20) & (frequency_hz <= 500)
measured, true = np.fft.rfft(green)[:, band], np.fft.rfft(truth)[:, band]
error = float(np.linalg.norm(measured - true) / np.linalg.norm(true))
print(f"error within the band: {100 * error:.2f} %")

# %% [markdown]
# ## Judge the bank
#
# Each position has a status: 1 is valid. Where the signal was poor, the plate rang longer than the taps, or a
# neighbour contradicts, it is not, and the bank says so. `residual_db` is what a fitted Green's function leaves
# unexplained of the recording; it needs no truth.

# %%
print(f"valid: {np.count_nonzero(bank.status == 1)} of {bank.positions}")
quality = bank.quality["residual_db"].max(axis=1)
figure, axes = plt.subplots(figsize=(6, 3.5), layout="constrained")
drawn = axes.scatter(position_mm[:, 0], position_mm[:, 1], c=quality, s=60)
axes.set(xlabel="x in mm", ylabel="y in mm", aspect="equal", title="Largest residual over the actuators")
figure.colorbar(drawn, label="dB")
figure.savefig(folder / "quality.png", dpi=120)

# %% [markdown]
# ## Focus
#
# Time reversal plays each actuator's Green's function backwards: all waves arrive in the middle at one instant, t =
# 0. With normalisation the response there is what the scene asks for. `render` makes the drives, in volts; `predict`
# makes the field that they will produce.

# %%
tap = wf.Scene("tap", (wf.Source(wf.Point((0.0, 0.0)), wf.Impulse(), amplitude=0.01),))
drive = wf.render(tap, bank)
field = wf.predict(drive, bank)
now = round(-field.start_s * field.sample_rate_hz)
figure, columns = plt.subplots(1, 3, figsize=(11, 3), layout="constrained")
for axes, early_s in zip(columns, (0.004, 0.002, 0.0), strict=True):
    values = 1e3 * field.field[:, now - round(early_s * field.sample_rate_hz)].reshape(len(y_mm), len(x_mm))
    drawn = axes.pcolormesh(x_mm, y_mm, values, vmin=-10, vmax=10, cmap="RdBu_r", shading="gouraud")
    axes.set(title=f"t = {0.0 - 1e3 * early_s:g} ms", xlabel="x in mm", aspect="equal")
figure.colorbar(drawn, label="velocity in mm/s")
figure.savefig(folder / "focus.png", dpi=120)

foci = wf.focus_figures(drive, bank)
(at_x_mm, at_y_mm), width_mm = foci.at_mm[0], foci.width_mm[0]
print(f"{1e3 * foci.peak[0]:.1f} mm/s at ({at_x_mm:.1f}, {at_y_mm:.1f}) mm, {width_mm:.1f} mm wide")
wf.write_drive(folder / "tap.h5", drive, force=True)

# %% [markdown]
# The width is about half a wavelength at the band's upper end: no wave makes a smaller spot. More actuators do not
# make it narrower, but quieter around: change `actuators=8` to 3 and to 20, and look at `foci.artefact_db`.
#
# Next: [your own measurements](your_own_measurements.py), or [from a bank to a stimulus](from_bank_to_stimulus.py).

# %%
bank.close()
