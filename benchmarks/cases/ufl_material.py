# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Your own material in UFL: a rubber block is squeezed and turned.

demos/demo_ufl_material.py is its simplest form and has the equations.
"""

from mpi4py import MPI

import kit
import numpy as np

import ufl
from dolfinx import fem, mesh

import mpm_dolfinx as mpm

parser = kit.Parser("Neo-Hookean block in UFL, squeezed and turned, against finite elements.")
parser.add_argument("--elements", type=kit.whole, default=8, help="background cells, length 1")
parser.add_argument("--domain", choices=("quad", "tri"), default="quad", help="particle domains")
parser.add_argument("--young", type=kit.positive, default=1e4, help="Young's modulus")
parser.add_argument("--steps", type=kit.whole, default=40, help="load steps, half of them turn")
parser.add_order()
args = parser.parse()

comm = MPI.COMM_WORLD
young, poisson = args.young, 0.3
mu = young / (2.0 * (1.0 + poisson))
lmbda = young * poisson / ((1.0 + poisson) * (1.0 - 2.0 * poisson))
kappa = 100.0 * young
angle = np.pi / 2.0

# The energy (1), as in any FEniCSx script for hyperelasticity.


def psi(d):
    F = ufl.Identity(2) + ufl.grad(d)
    J = ufl.det(F)
    return mu / 2.0 * (ufl.tr(F.T * F) - 2.0) - mu * ufl.ln(J) + lmbda / 2.0 * ufl.ln(J) ** 2


# The block lies on a background of 3 by 3, off its grid lines, with two by two domains in a
# cell. Quadrilaterals take a rule of 2 by 2 points: one point would not see hourglass modes, and
# finite elements on the same mesh need it too.


def block(elements: int) -> mpm.Particles:
    h = 1.0 / elements
    background = mesh.create_rectangle(
        comm, [[-1.5, -1.5], [1.5, 1.5]], [3 * elements] * 2, mesh.CellType.quadrilateral
    )
    V = fem.functionspace(background, ("Lagrange", args.degree, (2,)))
    corner = np.array([-1.0 + 0.11 * h, -0.5 + 0.23 * h])
    body = mesh.create_rectangle(
        comm,
        [corner, corner + np.array([2.0, 1.0])],
        [4 * elements, 2 * elements],
        mesh.CellType.quadrilateral if args.domain == "quad" else mesh.CellType.triangle,
    )
    order = kit.order(args)
    if args.domain == "quad" and order["degree"] == 1:
        order["quadrature_degree"] = args.quadrature_degree or 3
    return mpm.Particles(body, V, **order)


# A run takes the method and finite elements through the same path. The two differ in one line
# each: where the unknown comes from, and what solves. Both are compared after each step by the
# energies (2) and by the relative difference of displacement
#
# $$
# \mathrm{difference} = \| d - d_{\mathrm{FEM}} \| / \| d_{\mathrm{FEM}} \|. \tag{5}
# $$


def run(elements: int, shortening: float, steps: int):
    particles = block(elements)
    body, dx = particles.mesh, particles.dx
    centre = np.array([0.11, 0.23]) / elements

    # The grips (3) hold the faces with the tag 1; the path sets s and theta to their totals at t.
    glued = mesh.locate_entities_boundary(body, 1, lambda x: np.isclose(abs(x[0] - centre[0]), 1.0))
    tags = mesh.meshtags(body, 1, np.sort(glued), np.ones(len(glued), dtype=np.int32))
    ds = ufl.Measure("ds", domain=body, subdomain_data=tags, metadata={"quadrature_degree": 3})
    s, theta = fem.Constant(body, 0.0), fem.Constant(body, 0.0)
    X, Xc = ufl.SpatialCoordinate(body), ufl.as_vector(centre)
    R = ufl.as_matrix([[ufl.cos(theta), -ufl.sin(theta)], [ufl.sin(theta), ufl.cos(theta)]])
    S = ufl.as_matrix([[1.0 - s, 0.0], [0.0, 1.0]])
    grips = Xc + R * S * (X - Xc) - X

    squeezed = 0.5 if shortening > 0.0 else 0.0  # when the squeeze ends and the turn begins

    def path(t: float) -> None:
        if shortening > 0.0:
            s.value = shortening * min(t / squeezed, 1.0)
        theta.value = angle * max(t - squeezed, 0.0) / (1.0 - squeezed)

    def energy(d):
        return psi(d) * dx + kappa / 2.0 * ufl.inner(d - grips, d - grips) * ds(1)

    # The material point method: the unknown is the particles'.
    d, v = particles.displacement, ufl.TestFunction(particles.W)
    problem = mpm.ParticleProblem(
        ufl.derivative(energy(d), d, v),
        particles,
        solver=mpm.Solver(petsc_options_prefix="rubber_", stabilisation=kit.stabilisation(args)),
    )

    # Finite elements: a Function of the body's mesh.
    W = fem.functionspace(body, ("Lagrange", args.domain_degree or args.degree, (2,)))
    e, w = fem.Function(W), ufl.TestFunction(W)
    fem_problem = kit.NonlinearProblem(
        ufl.derivative(energy(e), e, w),
        e,
        petsc_options_prefix="fem_",
        petsc_options={
            "snes_rtol": 1e-11,
            "snes_error_if_not_converged": False,
            "ksp_error_if_not_converged": False,
            "ksp_type": "preonly",
            "pc_type": "lu",
            "pc_factor_mat_solver_type": "mumps",
        },
    )

    forms = [energy(d), energy(e), ufl.inner(d - e, d - e) * dx, ufl.inner(e, e) * dx]
    forms = [fem.form(form) for form in forms]
    track, states, failure = [], [], None
    try:
        for step in kit.progress(problem.steps(steps, update=path), steps, args):
            fem_problem.solve()
            mine, reference, off, size = (
                comm.allreduce(fem.assemble_scalar(form), MPI.SUM) for form in forms
            )
            if fem_problem.solver.getConvergedReason() <= 0:
                reference = off = np.nan
            track.append((step.load, mine, reference, np.sqrt(off / size)))
            if len(states) < 3 and step.load >= (0.5, 0.75, 1.0)[len(states)]:
                states.append(d.x.array.copy())
    except mpm.MPMError as error:
        failure = error
    return particles, problem.history, np.array(track).reshape(-1, 4), states, failure


# The squeezed and turned block, and its difference from finite elements at the end of the
# squeeze and at the end of the path.

particles, history, track, states, failure = run(args.elements, 0.3, args.steps)
loads, energies, references, differences = track.T
turning = loads >= 0.5
excess = energies / references - 1.0
growth = np.diff(energies[turning]) / energies[turning][:-1]

# Objectivity: the grips turn and do not squeeze. The block must follow as a rigid body, through
# all the cells of the background, without strain: $F^T F = I$.

rigid, rigid_history, _, _, rigid_failure = run(args.elements, 0.0, max(1, args.steps // 2))
F = rigid.deformation_gradient
objectivity = kit.largest(np.abs(np.swapaxes(F, 1, 2) @ F - np.eye(3)))
turned = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
miss = kit.largest(np.abs(F[:, :2, :2] - turned))


def last(values, where=slice(None)):
    return float(values[where][-1]) if len(values[where]) else np.nan


numbers = {
    **kit.outcome(history, failure or rigid_failure),
    "difference": last(differences),
    "difference_squeezed": last(differences, loads <= 0.5),
    "energy": last(energies),
    "energy_excess": last(excess),
    "energy_excess_squeezed": last(excess, loads <= 0.5),
    "objectivity": round(objectivity, 12) + 0.0,
    "particles": particles.num_global,
}
numbers["iterations"] += rigid_history.total_iterations
numbers["cutbacks"] += rigid_history.cutbacks
rows = [
    ("particles", f"{particles.num_global} ({args.domain}), cells of 1/{args.elements}"),
    ("load steps", f"{len(loads)}, load {numbers['load']:g}"),
    ("linear solves", f"{numbers['iterations']}, {numbers['cutbacks']} cutbacks (both runs)"),
    ("", "squeezed  turned"),
    ("difference (5) from FEM", f"{numbers['difference_squeezed']:.1e}   {last(differences):.1e}"),
    ("energy over FEM's", f"{numbers['energy_excess_squeezed']:.1e}   {last(excess):.1e}"),
    ("strain of a rigid turn", f"{objectivity:.0e}"),
]

# The picture: the block's domains, coloured by their change of volume, and by how much the energy
# (2) is above finite elements', for three sizes of cells.

if args.plot:
    layout = [["before", "squeezed", "energy"], ["half", "turned", "energy"]]
    fig, axes = kit.figure(14, 6.9, layout, width_ratios=[1, 1, 1.75])
    titles = {
        "before": "before",
        "squeezed": "squeezed",
        "half": "turned 45°",
        "turned": "turned 90°",
    }
    frames = [np.zeros_like(particles.displacement.x.array), *states]
    for (name, text), frame in zip(titles.items(), frames, strict=False):
        particles.displacement.x.array[:] = frame
        mpm.plot.background(particles.V, ax=axes[name])
        colours = mpm.plot.domains(
            particles,
            100.0 * (particles.volume / particles.initial_volume - 1.0),
            ax=axes[name],
            cmap="viridis",
            vmin=-30.0,
            vmax=0.0,
        )
        if comm.rank == 0:
            axes[name].set(xlim=(-1.25, 1.25), ylim=(-1.1, 1.1))
            axes[name].axis("off")
            axes[name].set_title(text)
    curves = {args.elements: (loads, excess)}
    for elements in (4, 8, 16):
        if elements not in curves:
            other = run(elements, 0.3, args.steps)[2].T
            curves[elements] = other[0], other[1] / other[2] - 1.0
    if comm.rank == 0:
        fig.colorbar(
            colours,
            ax=[axes["half"], axes["turned"]],
            location="bottom",
            shrink=0.7,
            label="change of volume, %",
            extend="both",
        )
        ax = axes["energy"]
        palette = [kit.COLOURS[name] for name in ("orange", "blue", "green", "grey")]
        for (elements, curve), colour in zip(sorted(curves.items()), palette, strict=False):
            ax.semilogy(*curve, "o-", ms=4, color=colour, label=f"cells of 1/{elements}")
        ax.axvspan(0.5, 1.0, color="0.94", zorder=0)
        for x, text in ((0.25, "squeeze"), (0.75, "turn")):
            ax.text(x, 0.98, text, ha="center", va="top", transform=ax.get_xaxis_transform())
        ax.set(xlim=(0.0, 1.0), xlabel="path t", ylabel="energy over that of FEM, relative")
        ax.set_title("Turning relaxes the block towards FEM")
        ax.legend(loc="lower left")
    kit.save(fig, args)

kit.report(args, numbers, rows, failure or rigid_failure)

# What must hold: the energy is above that of finite elements and does not grow while the grips
# turn; a rigid turn makes no strain.

if args.default:
    assert numbers["completed"]
    assert numbers["difference_squeezed"] < 1.5e-2 and numbers["difference"] < 1.5e-4
    assert np.all(excess > -1e-9) and np.all(growth < 1e-9)
    assert objectivity < 1e-8 and miss < 1e-8
