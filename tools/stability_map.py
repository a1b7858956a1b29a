"""Draw which time steps of leapfrog are stable on a thin plate, from runs; print the table of the stability page.

python -m tools.stability_map docs/pictures
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from wavefocus.mocks.plates.thin import ImplicitPlate, ThinPlate, explicit_limit_s, leapfrog_growth

PLATE = ThinPlate(0.048, 0.032, 1.566)
"""Glass of 1 mm, small, so that fine grids can be run."""
STEPS, GROWN = 1000, 1e3
PARTS = range(2, 17)
"""Grid spacings are 16 mm over these."""


def stable(spacing_m: float, step_s: float) -> bool:
    """Whether a random shape stays bounded for `STEPS` steps."""
    return leapfrog_growth(PLATE, spacing_m, step_s, STEPS) < GROWN


def longest_stable_s(spacing_m: float) -> float:
    """Longest stable step, by bisection to 0.1 %."""
    limit_s = explicit_limit_s(PLATE, spacing_m)
    low_s, high_s = 0.8 * limit_s, 1.6 * limit_s
    while high_s > 1.001 * low_s:
        middle_s = np.sqrt(low_s * high_s)
        low_s, high_s = (middle_s, high_s) if stable(spacing_m, middle_s) else (low_s, middle_s)
    return float(low_s)


def draw(folder: Path) -> None:
    """Write stability-map.png into a folder."""
    from matplotlib.figure import Figure

    spacing_m = np.array([0.016 / part for part in PARTS])
    step_s = np.geomspace(0.1e-6, 20e-6, 47)
    found = np.array([[stable(h, dt) for dt in step_s] for h in spacing_m.tolist()])
    h, dt = np.meshgrid(1e3 * spacing_m, 1e6 * step_s, indexing="ij")
    figure = Figure(figsize=(7.2, 4.8), layout="constrained")
    axes = figure.subplots()
    axes.loglog(h[found], dt[found], "o", ms=3.5, color="#0b5fa5", label=f"bounded after {STEPS} steps")
    axes.loglog(h[~found], dt[~found], "x", ms=4, color="#b3541e", label="grown 1000 times or more")
    line = np.linspace(spacing_m[-1], spacing_m[0], 50)
    limit_us = [1e6 * explicit_limit_s(PLATE, spacing_m) for spacing_m in line.tolist()]
    axes.loglog(1e3 * line, limit_us, color="#222222", label=r"theory: $h^2 / (4 \kappa)$")
    axes.set(
        title="Leapfrog on 1 mm of glass", xlabel="grid spacing h (mm)", ylabel=r"time step ($\mu$s)",
        xticks=[1, 2, 4, 8], xticklabels=["1", "2", "4", "8"], yticks=[0.1, 1, 10], yticklabels=["0.1", "1", "10"],
    )  # fmt: skip
    axes.minorticks_off()
    figure.legend(*axes.get_legend_handles_labels(), fontsize=8, loc="outside lower center", ncols=3)
    axes.spines[["top", "right"]].set_visible(False)
    folder.mkdir(parents=True, exist_ok=True)
    figure.savefig(folder / "stability-map.png", dpi=110)


def table() -> str:
    """Longest stable steps as measured and as in theory, and Newmark's growth at a hundred times that."""
    lines = [
        "| grid spacing (mm) | longest stable step, measured (us) | h^2 / (4 kappa) (us) "
        "| Newmark at 100 times: growth |",
        "|---|---|---|---|",
    ]
    for millimetres in (8, 4, 2, 1):
        limit_s = explicit_limit_s(PLATE, millimetres / 1e3)
        implicit = ImplicitPlate(PLATE, millimetres / 1e3, 100 * limit_s)
        rough = np.random.default_rng(0).standard_normal(len(implicit.points_m))
        growth = np.linalg.norm(implicit.released(rough, 500), axis=1).max() / np.linalg.norm(rough)
        measured_us = 1e6 * longest_stable_s(millimetres / 1e3)
        lines.append(f"| {millimetres} | {measured_us:.3g} | {1e6 * limit_s:.3g} | {growth:.2f} |")
    return "\n".join(lines)


if __name__ == "__main__":
    draw(Path(sys.argv[1]))
    print(table())
