# %% [markdown]
# # From a bank to a stimulus
#
# A stimulus is what a fingertip is to feel: a source that moves along a path and emits a signal. In this notebook a
# scene describes it, `render` turns it into the drives of all actuators, and we look at what reaches the skin: where
# the foci are, how wide, how loud, and what the plate does elsewhere. Then it is made ready to be played.
#
# Files and pictures go to the folder that the environment variable FOLDER names.

# %%
import os
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import wavefocus as wf

folder = Path(os.environ.get("FOLDER", "from-bank-to-stimulus"))
folder.mkdir(parents=True, exist_ok=True)

# %% [markdown]
# ## The bank
#
# Take your own: `bank = wf.open_bank("plate.h5")`. Ours is measured by a virtual rig with twelve actuators, around the
# place where the finger rests.

# %%
x_mm, y_mm = np.arange(-25.0, 26.0, 5.0), np.arange(-20.0, 21.0, 5.0)
position_mm = np.stack(np.meshgrid(x_mm, y_mm), axis=-1).reshape(-1, 2)
rig = wf.virtual_rig(actuators=12, position_mm=position_mm)
bank = rig.measure(folder / "plate.h5")

# %% [markdown]
# ## The scene
#
# A scene file says what is to be felt; the window draws one, and `wavefocus render` reads the same file. This source
# goes once round a circle at 80 mm/s. Its signal is noise from 50 to 450 Hz, where the skin is sensitive. Between the
# positions of the bank, Green's functions are interpolated; "kernel" suits a bank as coarse as this one. `amplitude`
# is the response that a single impulse would make at the focus, in the bank's unit; a longer signal makes more. No
# actuator may get more than 2 V.

# %%
(folder / "scene.toml").write_text(
    """
[scene]
name = "circle under the fingertip"

[[source]]
speed_mm_s = 80.0
step_mm = 2.0
amplitude = 0.005
path = { kind = "circle", centre_mm = [0, 0], radius_mm = 10 }
signal = { kind = "noise", band_hz = [50, 450], duration_s = 0.8, seed = 1 }
emission = "continuous"

[output]
interpolation = "kernel"
limit_v = 2.0
""",
    encoding="utf-8",
)
scene = wf.load_scene(folder / "scene.toml")
drive = wf.render(scene, bank)
wf.write_drive(folder / "drive.h5", drive, force=True)
duration_s, peak_v = drive.drive_v.shape[1] / drive.sample_rate_hz, np.abs(drive.drive_v).max()
print(f"{drive.method}: {duration_s:.2f} s, largest drive {peak_v:.3f} V, scaled by {drive.scale:.3g}")

# %% [markdown]
# A scale below 1 means that the limit was reached, and that the response is smaller by that factor: ask for less, or
# hold the loud actuators back (`[regularisation] saturation`).
#
# ## The drives
#
# The drives begin before the scene does: time reversal needs as much lead-in as the plate rings.

# %%
time_s = drive.start_s + np.arange(drive.drive_v.shape[1]) / drive.sample_rate_hz
figure, axes = plt.subplots(figsize=(9, 4), layout="constrained")
for actuator, volts in enumerate(drive.drive_v):
    axes.plot(time_s, actuator + 0.5 * volts / np.abs(drive.drive_v).max(), lw=0.6)
axes.set(xlabel="scene time in s", ylabel="actuator", title="Drives")
axes.axvline(0.0, color="k", lw=0.8)
figure.savefig(folder / "drives.png", dpi=120)

# %% [markdown]
# ## The field
#
# Time reversal adds up all waves at the moving focus. The pictures show the velocity at the loudest instant of the
# 60 ms in which the source passes each of four places, marked by a cross: the wave field is concentrated there, and
# follows the circle.

# %%
field = wf.predict(drive, bank)
rate_hz, turn_s = field.sample_rate_hz, 2 * np.pi * 10.0 / 80.0
figure, columns = plt.subplots(1, 4, figsize=(13, 3.3), layout="constrained")
for turns, axes in zip((0.0, 0.25, 0.5, 0.75), columns, strict=True):
    place_mm = 10 * np.cos(2 * np.pi * turns), 10 * np.sin(2 * np.pi * turns)
    here = int(np.argmin(np.hypot(*(position_mm - place_mm).T)))
    middle = round((turns * turn_s - field.start_s) * rate_hz)
    begin = middle - round(0.03 * rate_hz)
    loudest = begin + int(np.argmax(np.abs(field.field[here, begin : middle + round(0.03 * rate_hz)])))
    values = 1e3 * field.field[:, loudest].reshape(len(y_mm), len(x_mm))
    limit = np.abs(values).max()
    axes.pcolormesh(x_mm, y_mm, values, shading="gouraud", cmap="RdBu_r", vmin=-limit, vmax=limit)
    axes.plot(*place_mm, "k+", ms=12)
    axes.set(title=f"{turns:g} turns: {abs(values.ravel()[here]):.0f} mm/s", xlabel="x in mm", aspect="equal")
figure.savefig(folder / "field.png", dpi=120)

# %% [markdown]
# ## Two fingers
#
# Two taps, the second 50 ms after the first, for two fingers 30 mm apart. The table says how far each focus is from
# its place, how wide it is, and how much reaches the rest of the plate at that instant (`artefact_db`: the largest
# response beyond 15 mm of the focus), the other finger among it. The sources are made in Python this time.

# %%
first = wf.Source(wf.Point((-15.0, 0.0)), wf.Impulse(), start_s=0.0, amplitude=0.005)
second = wf.Source(wf.Point((15.0, 0.0)), wf.Impulse(), start_s=0.05, amplitude=0.005)
figures = wf.focus_figures(wf.render(wf.Scene("two taps", (first, second)), bank), bank)
for source, off_mm, width_mm, artefact_db in zip(
    figures.source, figures.off_mm, figures.width_mm, figures.artefact_db, strict=True
):
    print(f"tap {source}: {off_mm:.1f} mm off, {width_mm:.1f} mm wide, {artefact_db:.1f} dB elsewhere")

# %% [markdown]
# ## Will the plate do it?
#
# The prediction is as good as the bank. On a rig `wavefocus verify` plays the drive, scans the field and compares.
# The virtual plate's true responses are known, so here they take the rig's place: any array of Green's functions
# serves as a bank.

# %%
rows = np.arange(0, bank.positions, 4)
green = np.stack([rig.truth(int(row)) for row in rows])
true = wf.GreenArray(green, position_mm[rows], bank.sample_rate_hz)
played = wf.predict(drive, true).field
error = float(np.linalg.norm(played - field.field[rows]) / np.linalg.norm(played))
print(f"the plate differs from the prediction by {100 * error:.2f} %")

# %% [markdown]
# ## Play it
#
# `wavefocus render scene.toml --bank plate.h5 --out drive.h5 --wav drive.wav` writes the same drives as a sound file,
# a channel per actuator; `wavefocus play drive.h5 --rig rig.toml` plays them.

# %%
bank.close()
