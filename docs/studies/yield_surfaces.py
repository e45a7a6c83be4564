# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Draw the yield surfaces of docs/materials.md: python docs/studies/yield_surfaces.py

Sections of the surfaces, stresses to which trial stresses return, and undrained paths.
"""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from mpm_dolfinx.materials import DruckerPrager, ModifiedCamClay, MohrCoulomb, Tresca, VonMises
from mpm_dolfinx.materials.base import StrainMaterial

IMAGES = Path(__file__).resolve().parents[1] / "images"
COLOURS = ["#000000", "#0072B2", "#D55E00", "#009E73"]
STYLE = {
    "font.size": 11,
    "axes.titlesize": 12,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "savefig.dpi": 150,
}
ELASTIC, COHESION, PHI = (1e4, 0.3), 10.0, 30.0
PRESSURE = 20.0
"""Pressure of the section across the axis, in units of stress."""


def returned(law: StrainMaterial, strains: np.ndarray) -> np.ndarray:
    """Return the principal stresses (n, 3) that a law answers to principal strains (n, 3)."""
    trial = np.zeros((len(strains), 6))
    trial[:, :3] = strains
    state = {name: np.zeros(len(strains)) for name in law.internal_variables}
    return law.integrate(trial, state, False).stress[:, :3]


def across(law: StrainMaterial) -> tuple[np.ndarray, np.ndarray]:
    """Return the section of a surface at a pressure, in coordinates of its plane.

    Along rays from the axis, by bisection of the yield function.
    """
    angles = np.linspace(0.0, 2.0 * np.pi, 721)
    first, second = np.array([2.0, -1.0, -1.0]) / 6**0.5, np.array([0.0, 1.0, -1.0]) / 2**0.5
    rays = np.cos(angles)[:, None] * first + np.sin(angles)[:, None] * second
    low, high = np.zeros(len(angles)), np.full(len(angles), 200.0)
    for _ in range(60):
        middle = 0.5 * (low + high)
        stress = np.zeros((len(angles), 6))
        stress[:, :3] = middle[:, None] * rays - PRESSURE
        beyond = law.yield_function(stress, np.zeros(len(angles))) > 0.0
        low, high = np.where(beyond, low, middle), np.where(beyond, middle, high)
    return low * np.sin(angles), low * np.cos(angles)


def axes_of_stress(ax: Axes) -> None:
    """Draw the three axes of principal stress, seen along the hydrostatic one."""
    for k, angle in enumerate((90.0, 210.0, 330.0), 1):
        end = 38.0 * np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
        ax.annotate(
            "", end, (0.0, 0.0), arrowprops={"arrowstyle": "->", "color": "0.6", "linewidth": 0.8}
        )
        ax.text(*(1.1 * end), rf"$\tau_{k}$", color="0.4", ha="center", va="center")


def deviatoric(ax: Axes, laws: dict[str, StrainMaterial], title: str) -> None:
    """Draw sections across the hydrostatic axis."""
    axes_of_stress(ax)
    for colour, (label, law) in zip(COLOURS, laws.items(), strict=False):
        style = "--" if "plane" in label else "-"
        ax.plot(*across(law), style, color=colour, label=label, linewidth=1.6)
    ax.set_aspect("equal")
    ax.set_xlim(-46, 46)
    ax.set_ylim(-50, 46)
    ax.axis("off")
    ax.set_title(title)
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, 0.0), frameon=False, fontsize=9)


def meridian(ax: Axes) -> None:
    """Draw returns of triaxial trial states to the pyramid, with and without cut-off."""
    law = MohrCoulomb(*ELASTIC, COHESION, PHI, 10.0, tension_cutoff=6.0)
    whole = MohrCoulomb(*ELASTIC, COHESION, PHI)
    pressure = np.linspace(-17.4, 45.0, 400)
    angle = np.radians(PHI)
    line = 6 * (COHESION * np.cos(angle) + pressure * np.sin(angle)) / (3 - np.sin(angle))
    ax.plot(pressure, line, color=COLOURS[1], linewidth=1.6, label=r"shear, $\psi = 0$")
    height = np.linspace(0.0, 60.0, 2001)
    # tau_1 = tau_2 = cut-off in triaxial compression: p = q/3 - cut-off, pressure positive
    cut = height / 3.0 - 6.0
    below = height <= np.interp(cut, pressure, line)
    label = r"cut-off, $\psi = 10°$"
    ax.plot(cut[below], height[below], color=COLOURS[2], linewidth=1.6, label=label)
    trial = np.array([[-25.0, 12.0], [-22.0, 30.0], [-8.0, 42.0], [5.0, 58.0], [25.0, 66.0]])
    bulk, shear = float(law.bulk), float(law.shear)
    strains = np.stack(
        [-p / (3 * bulk) + np.array([1.0, 1.0, -2.0]) * q / (6 * shear) for p, q in trial]
    )
    for colour, material, marker in ((COLOURS[1], whole, "o"), (COLOURS[2], law, "s")):
        stress = returned(material, strains)
        p, q = -stress.mean(axis=1), stress[:, 0] - stress[:, 2]
        for k in range(len(trial)):
            ax.annotate(
                "",
                (p[k], q[k]),
                trial[k],
                arrowprops={"arrowstyle": "->", "color": colour, "linewidth": 0.9, "alpha": 0.8},
            )
        ax.plot(p, q, marker, color=colour, markersize=4)
    ax.plot(*trial.T, "o", color="black", markersize=4, label="trial states")
    ax.axhline(0.0, color="0.6", linewidth=0.8)
    ax.set_xlabel("pressure $p$")
    ax.set_ylabel(r"$q = \tau_1 - \tau_3$")
    ax.set_xlim(-28, 46)
    ax.set_ylim(-2, 72)
    ax.set_title("MohrCoulomb: returns, triaxial compression")
    ax.legend(loc="upper left", frameon=False, fontsize=9)


def clay(ax: Axes) -> None:
    """Draw ellipses of Cam clay and undrained paths of three overconsolidations."""
    start, ratio = 10.0, 1.2
    pressure = np.linspace(0.0, 30.0, 200)
    ax.plot(pressure, ratio * pressure, "--", color="0.5", linewidth=1.0, label="$q = M p$")
    for colour, overconsolidation in zip(COLOURS[1:], (1.0, 1.5, 3.0), strict=True):
        p_c = overconsolidation * start
        p = np.linspace(0.0, p_c, 400)
        ax.plot(p, ratio * np.sqrt(p * (p_c - p)), color=colour, linewidth=1.2)
        law = ModifiedCamClay(0.2, 0.04, ratio, 300.0, p_c, start)
        state, path = law.initial_state(1, 3), [(start, 0.0)]
        for strain in np.linspace(0.0, 0.3, 301)[1:]:
            H = np.diag(np.expm1(strain * np.array([0.5, -1.0, 0.5])))[None]
            state = law.update(H, state, tangent=False).state
            stress = state["stress"][0]
            path.append((-stress[:3].mean(), stress[0] - stress[1]))
        label = f"undrained, $p_c = {overconsolidation:g}\\, p_0$"
        ax.plot(*np.transpose(path), color=colour, linewidth=2.4, label=label)
    ax.plot(start, 0.0, "o", color="black", markersize=4)
    ax.set_xlabel("pressure $p$")
    ax.set_ylabel("$q$")
    ax.set_xlim(0, 31)
    ax.set_ylim(-0.5, 31)
    ax.set_title("ModifiedCamClay")
    ax.legend(loc="upper left", frameon=False, fontsize=9)


def main() -> None:
    mpl.rcParams.update(STYLE)
    figure, ((left, middle), (right, last)) = plt.subplots(
        2, 2, figsize=(9.5, 8.6), layout="constrained"
    )
    cohesive = {
        "VonMises": VonMises(*ELASTIC, yield_stress=2.0 * COHESION),
        "Tresca": Tresca(*ELASTIC, COHESION),
    }
    deviatoric(left, cohesive, "no friction")
    frictional = {
        "MohrCoulomb": MohrCoulomb(*ELASTIC, COHESION, PHI),
        'DruckerPrager "outer"': DruckerPrager(*ELASTIC, COHESION, PHI),
        '"inner"': DruckerPrager(*ELASTIC, COHESION, PHI, match="inner"),
        '"plane_strain"': DruckerPrager(*ELASTIC, COHESION, PHI, match="plane_strain"),
    }
    deviatoric(middle, frictional, r"$\varphi = 30°$, pressure $2 c$")
    meridian(right)
    clay(last)
    figure.savefig(IMAGES / "yield_surfaces.png")


if __name__ == "__main__":
    main()
