# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Taylor's bar: a copper rod of 32.4 by 3.2 mm hits a smooth wall with 227 m/s.

It is a body of revolution of von Mises' law with linear hardening, and meets the wall by contact;
`--wall roller` holds it there instead. After 80 us it has come to rest. `length` and `radius` are
then its own in mm, `strain` its largest plastic strain. Codes of finite elements, which hold it on
the wall on meshes of 5 by 50, have 21.4 to 21.5, 7.0 to 7.24 and 2.5 to 3.2. With `--wall roller
--cells 5 --domains-per-cell 1 --steps 640` that is met: shorter steps damp less.

The impact makes waves that steps of 0.5 us do not resolve. By the schemes that keep energy they
ring on, with pressures of 10 times the strength, and lift the rim off the wall; so the scheme is
one of backward differences, of second order, which damps them.
"""

import kit
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

parser = kit.Parser("Taylor's bar: a copper rod hits a wall.")
parser.add_argument("--cells", type=kit.whole, default=4, help="over the radius")
parser.add_argument("--domains-per-cell", type=kit.whole, default=2, help="each way")
parser.add_argument("--wall", choices=("contact", "roller"), default="contact")
SCHEMES = ("bdf2", "midpoint", "conserving", "euler")
parser.add_argument("--scheme", choices=SCHEMES, default="bdf2")
parser.add_argument("--steps", type=kit.whole, help="time steps; of 0.5 us by default")
parser.add_argument("--time", type=kit.positive, default=80.0, help="until when, us")
parser.add_argument("--offset", type=float, default=0.37, help="of the wall from a line, in cells")
parser.add_f_bar("patch")
args = parser.parse()


class BackwardDifferences(mpm.Scheme):
    """Those of second order, as in docs/dynamics-measured.md."""

    name = "bdf2"
    keeps = ("increment", "change of velocity")

    def rates(self, dt: float, last: float) -> mpm.Rates:
        """Return acceleration and velocities; the first step is backward Euler's."""
        ratio = dt / last if last > 0.0 else 0.0
        now, before = (1 + 2 * ratio) / (1 + ratio) / dt, ratio**2 / (1 + ratio) / dt
        increment, begin, last_increment, last_change = np.eye(4)
        velocity = now * increment - before * last_increment
        change = velocity - begin
        acceleration = now * change - before * last_change
        return mpm.Rates(acceleration, velocity, velocity, (increment, change))


# mm, us and mg: a GPa is a mg/(mm us^2).

length, radius, speed = 32.4, 3.2, 0.227
h = radius / args.cells
contact = args.wall == "contact"
base = args.offset * h if contact else 0.0
cells = [int(np.ceil(2.9 * radius / h)), int(np.ceil(length / h)) + 3]
grid = mesh.create_rectangle(
    kit.comm,
    [[0.0, -h], [cells[0] * h, (cells[1] - 1) * h]],
    cells,
    mesh.CellType.quadrilateral,
)
V = fem.functionspace(grid, ("Lagrange", 1, (2,)))
body = mesh.create_rectangle(
    kit.comm,
    [[0.0, base], [radius, base + length]],
    [args.cells * args.domains_per_cell, round(length / h * args.domains_per_cell)],
    mesh.CellType.quadrilateral,
)
few = 2 if args.f_bar == "domain" else None
rod = mpm.Particles(body, V, quadrature_degree=args.quadrature_degree or few)
end, side = mpm.region(y=base), mpm.region(x=radius)
tags = mpm.facet_tags(body, {1: lambda x: end(x) | side(x)})
look = {"facets": (tags, 1), "axisymmetric": True}
wall = mpm.contact.Rigid(rod, mpm.contact.plane((0.0, base), (0.0, 1.0)), **look)
copper = mpm.materials.VonMises(117.0, 0.35, yield_stress=0.4, hardening=0.1)
problem = mpm.DynamicProblem(
    mpm.Body(rod, copper, density=8.93, velocity=(0.0, -speed), f_bar=args.f_bar),
    bcs=[mpm.held(V, 0, x=0.0), *([] if contact else [mpm.held(V, 1, y=0.0)])],
    terms=[wall] if contact else [],
    axisymmetric=True,
    scheme=BackwardDifferences() if args.scheme == "bdf2" else args.scheme,
)
failure, path = None, [(0.0, length)]
steps = args.steps or round(2.0 * args.time)
try:
    for step in kit.progress(problem.steps(time=args.time, dt=args.time / steps), steps, args):
        path.append((step.time, kit.largest(kit.nodes(rod)[:, 1]) - base))
except mpm.MPMError as error:
    failure = error

x, start = kit.nodes(rod), rod.W.tabulate_dof_coordinates()[: len(kit.nodes(rod))]
rim = (np.abs(start[:, 0] - radius) < 1e-9) & (np.abs(start[:, 1] - base) < 1e-9)
energies = problem.history.energies
numbers = {
    **kit.outcome(problem.history, failure),
    "length": path[-1][1],
    "radius": kit.largest(x[:, 0]),
    "strain": kit.largest(rod.plastic_strain),
    "lift": kit.total(x[rim, 1] - base),
    "kinetic_left": energies[-1].kinetic / energies[0].kinetic,
    "particles": rod.num_global,
}
rows = [
    ("rod", f"{rod.num_global} domains, {args.cells} cells over the radius, {args.wall}"),
    ("linear solves", f"{numbers['iterations']}, {numbers['cutbacks']} cutbacks"),
    ("length", f"{numbers['length']:.3f} mm, known 21.4 to 21.5"),
    ("radius", f"{numbers['radius']:.3f} mm, known 7.0 to 7.24"),
    ("largest plastic strain", f"{numbers['strain']:.2f}, known 2.5 to 3.2"),
    ("rim above the wall", f"{numbers['lift']:.3f} mm"),
]
if args.plot:
    fig, axes = kit.figure(9.0, 6.0, [["rod", "path"]])
    mpm.plot.scene(problem, "plastic_strain", ax=axes["rod"], background=False)
    if fig is not None:
        axes["rod"].set(xlabel="r, mm", ylabel="z, mm")
        axes["path"].plot(*np.array(path).T, color=kit.COLOURS["blue"])
        axes["path"].set(xlabel="time, us", ylabel="length, mm")
    kit.save(fig, args)
kit.report(args, numbers, rows, failure)
