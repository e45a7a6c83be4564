# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
# Level: 2.9: Undrained clay, rigid obstacle, with and without friction

# # A pipe is pressed into the seabed
#
# It illustrates how to:
# - create a rigid obstacle and move it along a path,
# - read its reaction and the tractions at contact points,
# - see how friction changes the resistance.
#
# ## Problem
#
# A rigid pipe of diameter $D$ = 1 m is pressed 0.3 m into clay, of which the right
# half is 3 m wide and 2 m deep. The clay is undrained and perfectly plastic (von Mises'), with the
# strength $c$ = 5 kPa, $E = 500\, c$ and $\nu$ = 0.45, at finite strain. Its weight is neglected.
# Contact begins in one point. The pipe is smooth, or has the friction $\mu$ = 0.3.
#
# While the depth $w$ is small, the pipe is much like a strip footing as wide as its chord at the
# level of the ground, for which Prandtl's force is exact:
#
# $$
# V = (2 + \pi)\, c\, B, \qquad B = 2 \sqrt{w\, (D - w)}. \tag{1}
# $$
#
# Deeper, clay that was pushed aside has risen along the pipe, and flows around it.
#
# ## Implementation

from mpi4py import MPI

import matplotlib.pyplot as plt
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

comm = MPI.COMM_WORLD
strength, diameter, depth, h = 5.0, 1.0, 0.3, 1 / 8


def box(lower, upper, size):
    """Quadrilaterals of a size."""
    cells = [round((b - a) / size) for a, b in zip(lower, upper, strict=True)]
    return mesh.create_rectangle(comm, [lower, upper], cells, mesh.CellType.quadrilateral)


# The background reaches above the ground, as room for the heave. The body has two domains each way
# in a cell.

background = box([0.0, -2.0], [3.0, 0.5], h)
V = fem.functionspace(background, ("Lagrange", 1, (2,)))


# The stiffness along the surface of points that stick is in proportion to the shear modulus here,
# which is a tenth of the confined modulus for this $\nu$: Newton's method takes fewer solves.


def pressed(friction):
    """Press the pipe in; return problem, contact, and depth and force."""
    clay = mpm.Particles(box([0.0, -2.0], [3.0, 0.0], h / 2), V, quadrature_degree=2)
    circle = mpm.contact.disc((0.0, diameter / 2), diameter / 2)
    rubs = mpm.contact.Coulomb(friction, stiffness=0.1)
    pipe = mpm.contact.Rigid(clay, circle, rubs)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(
            clay,
            mpm.materials.VonMises(500.0 * strength, 0.45, rho_y=np.sqrt(2.0) * strength),
            f_bar="patch",
        ),
        bcs=[mpm.held(V, 0, x=0.0), mpm.held(V, 0, x=3.0), mpm.held(V, 1, y=-2.0)],
        terms=[pipe],
    )
    path = []
    for step in problem.steps(30, update=lambda t: pipe.move((0.0, -depth * t))):
        path.append((depth * step.load, -2.0 * problem.reaction(pipe)[1]))
    return problem, pipe, np.array(path).T


runs = {friction: pressed(friction) for friction in (0.0, 0.3)}

# ## Result
#
# Forces over $c D$, and those of the smooth pipe over (1) while it is less than a tenth of a
# diameter deep. Points of the clay that slip bear $\mu p$ along the surface, others less.


def prandtl(w):
    """Force (1)."""
    return (2.0 + np.pi) * strength * 2.0 * np.sqrt(w * (diameter - w))


w, force = runs[0.0][2]
shallow = (w > 0.03 * diameter) & (w < 0.105 * diameter)
ratio = float(np.mean(force[shallow] / prandtl(w[shallow])))
_, pipe, _ = runs[0.3]
n = pipe.points - np.array([0.0, diameter / 2 - depth])
n /= np.linalg.norm(n, axis=1)[:, None]
shear = np.linalg.norm(pipe.traction - pipe.pressure[:, None] * n, axis=1)
slips = pipe.touches & ~pipe.sticks
excess = comm.allreduce(float(np.abs(shear - 0.3 * pipe.pressure)[slips].max(initial=0.0)), MPI.MAX)
sliding, touching = (comm.allreduce(int(np.sum(v))) for v in (slips, pipe.touches))
if comm.rank == 0:
    for friction, (problem, _, (_, V_end)) in runs.items():
        solves = problem.history.total_iterations
        end = V_end[-1] / strength / diameter
        told = f"force {end:.2f} c D at the end, {solves} linear solves"
        print(f"friction {friction:.1f}: {told}")
    print(f"smooth pipe at small depth: {ratio:.3f} of Prandtl's force")
    print(f"with friction {sliding} of {touching} points slip at the end")

# The picture: where the clay has flowed, without and with friction, and the forces.

fig, axes = None, dict.fromkeys(("smooth", "rough", "force"))
if comm.rank == 0:
    layout = [["smooth", "rough", "force"]]
    fig, axes = plt.subplot_mosaic(layout, figsize=(14, 4.6), layout="compressed")
for name, friction in (("smooth", 0.0), ("rough", 0.3)):
    look = {"limits": (0.0, 1.0), "background": False, "title": f"friction {friction:.1f}"}
    mpm.plot.scene(runs[friction][0], "plastic_strain", ax=axes[name], **look)
if comm.rank == 0:
    for name in ("smooth", "rough"):
        axes[name].set(xlim=(-0.5, 1.6), ylim=(-1.2, 0.6), xlabel="x, m", ylabel="y, m")
    ax = axes["force"]
    for friction, (_, _, (depths, forces)) in runs.items():
        ax.plot(depths, forces / strength, label=f"friction {friction:.1f}")
    ax.plot(w, prandtl(w) / strength, "k--", lw=1, label="strip of the chord's width")
    ax.set(xlabel="depth over diameter", ylabel="force over $c D$", xlim=0.0, ylim=0.0)
    ax.legend()
    fig.savefig("pipe.png", dpi=110)

assert abs(ratio - 1.0) < 0.05
assert excess < 1e-9 * strength and 0 < sliding < touching

# ## Exercises
#
# 1. Go on to half a diameter. Look at the first domains under the smooth pipe: their facets become
#    chords of the circle, and the clay cannot follow it. What do cells of half the size do?
# 2. Limit friction by half of the strength, `limit=0.5 * strength` of the `mpm.contact.Coulomb`.
# 3. Press in a polygon of your own, with rounded corners, or pull the pipe out again.
