# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A thick tube that is widened to a multiple of its inner radius, and its pressure (Hill 1950).

Of von Mises' law without hardening, nearly incompressible, with no strain along its axis. Once all
of the wall flows, the pressure inside is `2 / sqrt(3) yield_stress ln(B / A)` with the present
radii A and B, and `B^2 - A^2` is what it was. The wall, eight cells at first, is 1.4 cells thick in
the end.
"""

from mpi4py import MPI

import kit
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

parser = kit.Parser("Thick tube under inner pressure, widened by displacement control.")
parser.add_argument("--cells", type=kit.whole, default=8, help="over the wall")
parser.add_argument("--per-cell", type=kit.whole, default=2, help="domains each way in a cell")
parser.add_argument("--offset", type=float, default=0.0, help="of the background, in cells")
parser.add_argument("--widest", type=kit.positive, default=8.5, help="inner radius in the end")
parser.add_argument("--steps", type=kit.whole, default=70, help="from a radius of 1.5 on")
parser.add_f_bar()
parser.add_order()
parser.add_mixed()
parser.set_defaults(degree=2, mixed="pressure")
args = parser.parse()
if args.widest <= 1.5:
    parser.error("argument --widest: more than 1.5 times the first radius")
if not 0.0 <= args.offset <= 1.0:
    parser.error("argument --offset: from 0 to 1 cells")

comm = MPI.COMM_WORLD
a, b, strength = 1.0, 2.0, 0.5
shear, bulk = 3.8e3, 40e3
young = 9.0 * bulk * shear / (3.0 * bulk + shear)
poisson = (3.0 * bulk - 2.0 * shear) / (2.0 * (3.0 * bulk + shear))


def exact(A: float) -> float:
    """Pressure inside where the inner radius is A and all of the wall flows."""
    return float(strength / np.sqrt(3.0) * np.log1p((b**2 - a**2) / A**2))


# A strip of the wall in the (r, z) plane, one cell high.

n, h = args.cells, (b - a) / args.cells
far = args.offset * h
background = mesh.create_rectangle(
    comm,
    [[far, 0.0], [far + np.ceil(args.widest + 1.0), h]],
    [n * int(np.ceil(args.widest + 1.0)), 1],
    mesh.CellType.quadrilateral,
)
body = mesh.create_rectangle(
    comm, [[a, 0.0], [b, h]], [args.per_cell * n, args.per_cell], mesh.CellType.quadrilateral
)
V = fem.functionspace(background, ("Lagrange", args.degree, (2,)))
axial, _ = V.sub(1).collapse()
everywhere = fem.locate_dofs_geometrical((V.sub(1), axial), lambda x: x[0] > -1.0)
inner = mesh.locate_entities_boundary(body, 1, lambda x: np.isclose(x[0], a))
particles = mpm.Particles(body, V, **kit.order(args))
problem = mpm.QuasiStaticProblem(
    mpm.Body(
        particles,
        mpm.materials.VonMises(young, poisson, yield_stress=strength),
        pressures=[(1.0, 1)],
        facet_tags=mesh.meshtags(body, 1, np.sort(inner), np.ones(len(inner), dtype=np.int32)),
        f_bar=args.f_bar if args.mixed == "none" else "none",
    ),
    bcs=[fem.dirichletbc(fem.Function(axial), everywhere, V.sub(1))],
    axisymmetric=True,
    mixed=None if args.mixed == "none" else args.mixed,
    solver=mpm.Solver(petsc_options_prefix="expansion_", stabilisation=kit.stabilisation(args)),
)

# Small steps where the wall begins to flow, then larger ones.

failure = None
widths, pressures = [], []
try:
    for first, goal, steps in ((a, 1.02, 5), (1.02, 1.5, 12), (1.5, args.widest, args.steps)):
        control = mpm.DisplacementControl(particles, goal - a, point=(a, 0.0), direction=(1.0, 0.0))

        def share(step, first=first, goal=goal):
            return (a + step.displacement - first) / (goal - first)

        for _ in kit.progress(problem.steps(steps, control=control), steps, args, share):
            widths.append(a + control.present())
            pressures.append(float(particles.load.value))
except mpm.MPMError as told:
    failure = told

A = np.array(widths)
errors = np.abs(np.array(pressures) / [exact(width) for width in A] - 1.0)
flowing, wide = errors[np.isclose(A, 1.02)], errors[A > 1.5 - 1e-9]
numbers = {
    **kit.outcome(problem.history, failure),
    "radius": A.max(initial=a),
    "error_early": flowing.max() if len(flowing) else None,
    "error": wide.max() if len(wide) else None,
    "particles": particles.num_global,
}
rows = [
    ("particles", f"{particles.num_global}, {n} cells over the wall"),
    ("linear solves", f"{numbers['iterations']} in {len(A)} steps"),
    ("inner radius", f"{numbers['radius']:.3f}"),
]
if len(flowing):
    rows.append(("error at 1.02", f"{numbers['error_early']:.1e}"))
if len(wide):
    rows.append(("largest from 1.5 on", f"{numbers['error']:.1e}"))

if args.plot:
    fig, axes = kit.figure(7.0, 4.5)
    if comm.rank == 0:
        ax, radii = axes["main"], np.linspace(1.02, args.widest, 400)
        ax.plot(radii, [exact(r) for r in radii], color="0.6", lw=3.0)
        ax.plot(A, pressures, ".", color=kit.COLOURS["blue"], ms=4)
        ax.set(xlabel="inner radius over the first one", ylabel="pressure inside", ylim=(0.0, None))
        ax.set_title("Steps, and the pressure while all of the wall flows")
    kit.save(fig, args)

kit.report(args, numbers, rows, failure)

# With the default arguments the numbers are known.

if args.default:
    assert failure is None, failure
    assert numbers["error_early"] < 1e-5 and numbers["error"] < 1e-5
    assert numbers["iterations"] < 800
