# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A cylinder under inner pressure.

demos/demo_pressurised_cylinder.py is its simplest form and has the equations.
"""

from itertools import pairwise

from mpi4py import MPI

import kit
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

try:
    from scipy.integrate import solve_bvp
except ImportError:
    solve_bvp = None

parser = kit.Parser("Thick tube under inner pressure: axisymmetric, and as a quarter ring.")
parser.add_argument("--elements", type=kit.whole, default=16, help="cells over the wall")
parser.add_steps(10)
parser.add_order()
args = parser.parse()
if solve_bvp is None:
    raise mpm.MPMError("The reference of this demo needs SciPy; install it with pip install scipy.")
if args.elements % 4:
    parser.error("argument --elements: three grids need a multiple of 4")

comm = MPI.COMM_WORLD
a, b, pressure = 1.0, 2.0, 80e3  # m, m, Pa
young, poisson = 1e6, 0.3  # Pa, -
K, G = young / (3.0 * (1.0 - 2.0 * poisson)), young / (2.0 * (1.0 + poisson))
INNER = 1

# Newton's method for the radial stretch, vectorised over the points, then (4).


def kirchhoff(radial, hoop):
    """Principal stresses (radial, hoop, axial) of the stretches."""
    strain = np.log([radial, hoop, np.ones_like(hoop)])
    return K * strain.sum(axis=0) + 2.0 * G * (strain - strain.mean(axis=0))


def radial_stretch(P, hoop):
    stretch = np.ones_like(hoop)
    for _ in range(30):
        tau = kirchhoff(stretch, hoop)[0]
        slope = (K + 4.0 * G / 3.0 - tau) / stretch**2
        stretch = stretch - (tau / stretch - P) / slope
    return stretch


def equations(R, y):
    hoop = y[0] / R
    radial = radial_stretch(y[1], hoop)
    return np.vstack([radial, -(y[1] - kirchhoff(radial, hoop)[1] / hoop) / R])


def ends(at_a, at_b):
    return np.array([at_a[1] / pressure + at_a[0] / a, at_b[1] / pressure])


R = np.linspace(a, b, 101)
guess = np.vstack([R + 0.1, -pressure * (b - R) / (b - a)])
reference = solve_bvp(equations, ends, R, guess, tol=1e-10, max_nodes=100000)
assert reference.status == 0, reference.message


def exact_stress(R):
    """Cauchy stress (radial, hoop, axial) at initial radii."""
    r, P = reference.sol(R)
    hoop = r / R
    radial = radial_stretch(P, hoop)
    return kirchhoff(radial, hoop) / (radial * hoop)


# Both are a body, a background, its rollers, and a problem with a pressure on the tagged inner
# facets; they differ in the meshes and in one argument. Two by two particles share a cell.


def rollers(V, component, where):
    facets = mesh.locate_entities_boundary(V.mesh, 1, where)
    dofs = fem.locate_dofs_topological(V.sub(component), 1, facets)
    return fem.dirichletbc(0.0, dofs, V.sub(component))


def inner_facets(body, radius):
    facets = mesh.locate_entities_boundary(body, 1, lambda x: np.isclose(radius(x), a))
    return mesh.meshtags(body, 1, facets, np.full(len(facets), INNER, dtype=np.int32))


def strip(n):
    """Strip of the wall in the (r, z) plane, n cells wide and one high."""
    h = (b - a) / n
    background = mesh.create_rectangle(
        comm, [[0.5, 0.0], [3.0, h]], [round(2.5 / h), 1], mesh.CellType.quadrilateral
    )
    V = fem.functionspace(background, ("Lagrange", args.degree, (2,)))
    body = mesh.create_rectangle(comm, [[a, 0.0], [b, h]], [2 * n, 2], mesh.CellType.quadrilateral)
    bcs = [rollers(V, 1, lambda x: np.isclose(x[1], 0.0) | np.isclose(x[1], h))]
    return mpm.Particles(body, V, **kit.order(args)), bcs, inner_facets(body, lambda x: x[0])


def quarter_ring(n):
    """Quarter of the ring; particles are about as long round it as across it."""
    h = (b - a) / n
    background = mesh.create_rectangle(
        comm, [[0.0, 0.0], [2.5, 2.5]], [round(2.5 / h)] * 2, mesh.CellType.quadrilateral
    )
    V = fem.functionspace(background, ("Lagrange", args.degree, (2,)))

    # A rectangle of radii and angles, then its geometry mapped. Rounding must not push the two
    # straight edges out of the background.

    body = mesh.create_rectangle(
        comm, [[a, 0.0], [b, np.pi / 2.0]], [2 * n, 4 * n], mesh.CellType.quadrilateral
    )
    radius, angle = body.geometry.x[:, 0].copy(), body.geometry.x[:, 1].copy()
    body.geometry.x[:, 0] = np.maximum(radius * np.cos(angle), 0.0)
    body.geometry.x[:, 1] = np.maximum(radius * np.sin(angle), 0.0)

    bcs = [
        rollers(V, 0, lambda x: np.isclose(x[0], 0.0)),
        rollers(V, 1, lambda x: np.isclose(x[1], 0.0)),
    ]
    # The middle of a facet lies on a chord, its ends, which are what is looked at, on the circle.
    return (
        mpm.Particles(body, V, **kit.order(args)),
        bcs,
        inner_facets(body, lambda x: np.hypot(x[0], x[1])),
    )


def solve(scene, n, axisymmetric):
    particles, bcs, tags = scene(n)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(
            particles,
            mpm.materials.Hencky(young, poisson),
            pressures=[(pressure, INNER)],
            facet_tags=tags,
        ),
        bcs=bcs,
        axisymmetric=axisymmetric,
        solver=mpm.Solver(petsc_options_prefix="cylinder_", stabilisation=kit.stabilisation(args)),
    )
    for _ in kit.progress(problem.steps(**kit.chosen(args)), args.steps, args):
        pass
    return particles, problem.history


# The error (5).


def radii(points, axisymmetric):
    return points[:, 0] if axisymmetric else np.hypot(points[:, 0], points[:, 1])


def error(particles, axisymmetric):
    own = particles.W.dofmap.index_map.size_local
    first = radii(particles.W.tabulate_dof_coordinates()[:own], axisymmetric)
    now = radii(kit.nodes(particles), axisymmetric)
    return max(
        abs(kit.mean(now, np.isclose(first, at)) / reference.sol(at)[0] - 1.0) for at in (a, b)
    )


# The error (6): a particle of the ring is turned by its polar angle.


def stress(particles, axisymmetric):
    """Return the initial radius, radial and hoop stress of the particles."""
    sigma, X, x = particles.stress, particles.initial_centroid, particles.centroid
    if axisymmetric:
        return X[:, 0], sigma[:, 0, 0], sigma[:, 2, 2]
    e_r = x / np.linalg.norm(x, axis=1, keepdims=True)
    e_t = np.column_stack([-e_r[:, 1], e_r[:, 0]])
    s_r, s_t = (np.einsum("ni,nij,nj->n", e, sigma[:, :2, :2], e) for e in (e_r, e_t))
    return np.hypot(X[:, 0], X[:, 1]), s_r, s_t


def error_stress(particles, axisymmetric):
    R_p, s_r, s_t = stress(particles, axisymmetric)
    exact = exact_stress(R_p)
    volume = particles.initial_volume * (R_p if axisymmetric else 1.0)
    difference = np.abs(s_r - exact[0]) + np.abs(s_t - exact[1])
    return kit.mean(difference, volume) / (2.0 * pressure)


grids = [args.elements // 4, args.elements // 2, args.elements]
histories, errors, errors_stress, runs = [], {}, {}, {}
failure = None
try:
    for name, scene in (("axisymmetric", strip), ("plane", quarter_ring)):
        for n in grids:
            runs[name], history = solve(scene, n, scene is strip)
            histories.append(history)
            errors[name] = error(runs[name], scene is strip)
            errors_stress.setdefault(name, []).append(error_stress(runs[name], scene is strip))
except mpm.MPMError as stop:
    failure = stop

summary = {
    **kit.outcome(histories[-1] if histories else mpm.History(), failure),
    "iterations": sum(h.total_iterations for h in histories),
    "cutbacks": sum(h.cutbacks for h in histories),
    "inner_radius": reference.sol(a)[0],
    "outer_radius": reference.sol(b)[0],
}
rows = [
    ("reference radii", f"{summary['inner_radius']:.8f} m, {summary['outer_radius']:.8f} m"),
]
if failure is None:
    for name in runs:
        series = errors_stress[name]
        rates = [float(np.log2(c / f)) for c, f in pairwise(series)]
        summary |= {
            f"error_{name}": errors[name],
            f"error_stress_{name}": series,
            f"rates_{name}": rates,
        }
        shown = ", ".join(f"{e:.2e}" for e in series)
        rows += [
            (f"{name}, radii", f"error {errors[name]:.1e}"),
            (f"{name}, stress", f"errors {shown}; rates {rates[0]:.2f}, {rates[1]:.2f}"),
        ]
    summary["rate"] = min(summary[f"rates_{name}"][-1] for name in runs)
rows.append(("linear solves", f"{summary['iterations']}, {summary['cutbacks']} cutbacks"))

# The picture: the ring, coloured by hoop stress, before what it was; and radial and hoop stress of
# the particles of both runs on the exact lines.

if args.plot and failure is None:
    ring, wall = runs["plane"], runs["axisymmetric"]
    shown = {
        "plane strain": [kit.gathered(v) for v in stress(ring, False)],
        "axisymmetric": [kit.gathered(v) for v in stress(wall, True)],
    }
    hoop_stress = stress(ring, False)[2] / 1e3
    fig, axes = kit.figure(12.5, 5.8, [["ring", "stress"]], width_ratios=[1.0, 1.15])
    mpm.plot.background(ring.V, ax=axes["ring"], color="0.9")
    mpm.plot.domains(ring, ax=axes["ring"], warp=0.0, facecolor="0.96", edgecolor="0.88")
    colours = mpm.plot.domains(ring, hoop_stress, ax=axes["ring"], cmap="YlGnBu", linewidth=0.25)
    if comm.rank == 0:
        ax = axes["ring"]
        ax.set(xlim=(0.0, 2.5), ylim=(0.0, 2.5), xlabel="x, m", ylabel="y, m")
        ax.set_title("The ring, blown up, on a square grid")
        fig.colorbar(colours, ax=ax, label="hoop stress, kPa", shrink=0.8)

        ax = axes["stress"]
        exact = exact_stress(R) / 1e3
        styles = {
            "plane strain": {"marker": "+", "ms": 11, "mew": 0.8},
            "axisymmetric": {"marker": "o", "ms": 5.5, "mew": 1.2, "mfc": "white"},
        }
        for i, name in enumerate((r"$\sigma_r$", r"$\sigma_\theta$")):
            colour = kit.COLOURS["orange" if i else "blue"]
            ax.plot(R, exact[i], color=colour, lw=1.6, label=f"{name} exact")
            for label, style in styles.items():
                R_p, values = shown[label][0], shown[label][1 + i] / 1e3
                ax.plot(R_p, values, ls="", color=colour, label=f"{name} {label}", **style)
        ax.axhline(0.0, color="0.8", lw=0.8, zorder=0)
        ax.set(xlim=(a, b), xlabel="initial radius, m", ylabel="Cauchy stress, kPa")
        ax.set_title("Stress in the wall, both ways")
        ax.legend(loc="upper right", ncols=2)
    kit.save(fig, args)

kit.report(args, summary, rows, failure)

# With the default arguments the numbers are known.

if args.default:
    assert summary["error_axisymmetric"] < 1e-5 and summary["error_plane"] < 1e-5
    assert all(series[-1] < 1.3e-3 for series in errors_stress.values())
    assert summary["rate"] > 1.8
