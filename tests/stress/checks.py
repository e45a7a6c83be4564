# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""What a converged state must satisfy, found without the package's own assembly and location.

Given are the displacement of the domains' nodes and, where the law is plastic, the stress at
the points. Element forces are summed here, and carried to the background by basis functions
found here: through the nearest midpoints of cells (a k-d tree) and a Newton iteration.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
from scipy.spatial import cKDTree

import basix
import basix.ufl

from mpm_dolfinx import _compat
from mpm_dolfinx.meshes.cells import input_cell_index

EPS = np.finfo(float).eps


def rule(cell, degree):
    """Return points and weights of a rule."""
    return [np.asarray(a) for a in basix.make_quadrature(cell, degree)]


class Cells:
    """Cells by the places of their corners, and where points are in them.

    Args:
        x: Corners, shape (n, k, dim).
        cell: Their type, of basix.
    """

    def __init__(self, x, cell):
        self.x = x
        self.simplex = cell in (basix.CellType.triangle, basix.CellType.tetrahedron)
        self.map = basix.ufl.element("Lagrange", cell.name, 1).basix_element
        self.centre = basix.geometry(cell).mean(axis=0)
        self.scale = np.ptp(self.x, axis=1).max()
        self.tree = cKDTree(x.mean(axis=1) / self.scale)
        self.near = min(len(x), 16 if x.shape[2] == 2 else 40)

    def on_facets(self, points):
        """Return the cell on whose facets each point is, its place in it, and how far off it is.

        Cells may overlap, as those of methods without common nodes do.
        """
        _, cells = self.tree.query(points / self.scale, k=min(len(self.x), 150))
        best = np.full(len(points), np.inf)
        chosen, where = np.zeros(len(points), dtype=np.int64), np.zeros_like(points)
        for some in np.reshape(cells, (len(points), -1)).T:
            local, outside = self.pull_back(some, points)
            high = 1.0 - (local.sum(axis=1)[:, None] if self.simplex else local)
            off = np.abs(np.minimum(local.min(axis=1), high.min(axis=1)))
            off = np.maximum(off, outside)
            better = off < best
            best[better], chosen[better] = off[better], some[better]
            where[better] = local[better]
        return chosen, where, best

    def pull_back(self, cells, points):
        """Return reference coordinates of points in cells, and how far outside they are."""
        corners = self.x[cells]
        X = np.tile(self.centre, (len(points), 1))
        for _ in range(2 if self.simplex else 12):
            table = self.map.tabulate(1, X)[:, :, :, 0]
            gap = points - np.einsum("pk,pki->pi", table[0], corners)
            J = np.einsum("jpk,pki->pij", table[1:], corners)
            with np.errstate(all="ignore"):
                singular = ~(np.abs(np.linalg.det(J)) > 0.0)
                J[singular] = np.eye(points.shape[1]) * self.scale
                X = np.clip(X + np.linalg.solve(J, gap[..., None])[..., 0], -5.0, 6.0)
        outside = np.maximum(0.0, -X.min(axis=1))
        high = X.sum(axis=1) - 1.0 if self.simplex else X.max(axis=1) - 1.0
        gap = points - np.einsum("pk,pki->pi", self.map.tabulate(0, X)[0, :, :, 0], corners)
        lost = np.abs(gap).max(axis=1) > 1e-9 * self.scale
        return X, np.where(lost, np.inf, np.maximum(outside, high))


class Background(Cells):
    """All cells of a background, on every rank, and the basis functions at points."""

    def __init__(self, V):
        domain = V.mesh
        comm, dim = domain.comm, domain.geometry.dim
        count = domain.topology.index_map(domain.topology.dim).size_local
        x = domain.geometry.x[_compat.geometry_dofmap(domain)[:count], :dim]
        nodes = V.dofmap.list[:count]
        nodes = V.dofmap.index_map.local_to_global(nodes.ravel()).reshape(nodes.shape)
        super().__init__(np.concatenate(comm.allgather(x)), domain.basix_cell())
        self.nodes = np.concatenate(comm.allgather(nodes))
        self.index = np.concatenate(comm.allgather(input_cell_index(domain)))
        self.size = V.dofmap.index_map.size_global
        self.basis = V.ufl_element().basix_element
        corners = self.x.reshape(-1, dim)  # (backgrounds fill boxes, and only inner nodes jitter)
        self.box = corners.min(axis=0), corners.max(axis=0)

    def beyond(self, points):
        """Return in which directions points are off the background."""
        return np.abs(points - np.clip(points, *self.box)) > 1e-10 * self.scale

    def at(self, points):
        """Return nodes and values of the basis at points, and their gradients.

        What has gone through a boundary that is held moves as the nearest place on it does.
        """
        beyond = self.beyond(points)
        points = np.clip(points, *self.box)
        _, cells = self.tree.query(points / self.scale, k=self.near)
        cells = np.reshape(cells, (len(points), -1))
        best = np.full(len(points), np.inf)
        chosen = np.zeros(len(points), dtype=np.int64)
        where = np.zeros_like(points)
        for some in cells.T:
            local, outside = self.pull_back(some, points)
            outside = np.where(outside < 1e-11, 0.0, outside)
            earlier = (outside == best) & (self.index[some] < self.index[chosen])
            better = (outside < best) | earlier
            best[better], chosen[better] = outside[better], some[better]
            where[better] = local[better]
        table = self.basis.tabulate(1, where)[:, :, :, 0]
        J = np.einsum("jpk,pki->pij", self.map.tabulate(1, where)[1:, :, :, 0], self.x[chosen])
        slopes = np.einsum("jpk,pji->pki", table[1:], np.linalg.inv(J))
        return self.nodes[chosen], table[0], np.where(beyond[:, None], 0.0, slopes)


def hats(lines, a, b):
    """Return averages over [a, b] of the hat functions on a line's nodes, and of their slopes.

    Beyond the ends the functions go on linearly.
    """
    lines = np.concatenate([[2 * lines[0] - lines[1]], lines, [2 * lines[-1] - lines[-2]]])

    def folded(values):
        inner = values[:, 1:-1].copy()
        for end, (first, second) in ((0, (0, 1)), (-1, (-1, -2))):
            inner[:, first] += 2 * values[:, end]
            inner[:, second] -= values[:, end]
        return inner

    def primitive(x):
        value = np.zeros((len(x), len(lines)))
        for i, centre in enumerate(lines):
            for j, side in ((i - 1, -1.0), (i + 1, 1.0)):
                if 0 <= j < len(lines):
                    h = abs(lines[j] - centre)
                    s = np.clip(side * (x - centre) / h, 0.0, 1.0)
                    area = h * (s - 0.5 * s**2)
                    value[:, i] += side * area
        return value

    def hat(x):
        value = np.empty((len(x), len(lines)))
        for i in range(len(lines)):
            value[:, i] = np.interp(x, lines, np.eye(len(lines))[i])
        return value

    width = (b - a)[:, None]
    return folded(primitive(b) - primitive(a)) / width, folded(hat(b) - hat(a)) / width


class Domains:
    """Kinematics of one body, from nodal positions alone."""

    def __init__(self, particles, degree, axisymmetric=False):
        self.particles = particles
        self.axisymmetric = axisymmetric
        body = particles.mesh
        self.dim = body.geometry.dim
        self.nodes = particles.domain_nodes
        self.X = particles.W.tabulate_dof_coordinates()[:, : self.dim].copy()
        element = particles.W.ufl_element().basix_element
        self.cell = cell = body.basix_cell()
        self.shapes, self.slopes, self.weights = self._at(element, *rule(cell, degree))
        self.fine = self._at(element, *rule(cell, 2 * element.degree + 3))
        volumes = self.fine[2].sum(axis=1)
        self.volume = volumes
        self.centroid = self._mean(self.X[self.nodes])
        self.hoop = None
        if axisymmetric:
            r = self.X[self.nodes][:, :, 0]
            radius = np.einsum("qk,nk->nq", self.shapes, r)
            self.weights = self.weights * (2.0 * np.pi * radius)
            self.hoop = self.shapes / radius[:, :, None]
            shapes, slopes, weights = self.fine
            turn = 2.0 * np.pi * np.einsum("qk,nk->nq", shapes, r)
            self.fine = shapes, slopes, weights * turn
            if len(self.shapes) == 1 and len(basix.geometry(cell)) == 4:
                # a quadrilateral's one point has means over the volume around the axis
                whole = self.fine[2].sum(axis=1)
                mean = np.einsum("nq,nqki->nki", self.fine[2], slopes) / whole[:, None, None]
                around = np.einsum("nq,qk->nk", 2.0 * np.pi * weights, shapes) / whole[:, None]
                self.slopes, self.hoop = mean[:, None], around[:, None]
                self.weights = whole[:, None]
        self.turned = self.fine[2].sum()

    def _at(self, element, points, weights):
        table = element.tabulate(1, points)[:, :, :, 0]
        J = np.einsum("jqk,nki->nqij", table[1:], self.X[self.nodes])
        slopes = np.einsum("jqk,nqji->nqki", table[1:], np.linalg.inv(J))
        return table[0], slopes, weights * np.abs(np.linalg.det(J))

    def height(self):
        """Return the largest height of a domain over a facet, by its volume."""
        high, simplex = 0.0, len(basix.geometry(self.cell)) == self.dim + 1
        for facet in basix.topology(self.cell)[-2]:
            x = self.X[self.nodes[:, facet]]
            if self.dim == 2:
                area = np.linalg.norm(x[:, 1] - x[:, 0], axis=1)
            else:  # (of a quadrilateral by its diagonals)
                a, b = (x[:, 3] - x[:, 0], x[:, 2] - x[:, 1]) if len(facet) == 4 else (
                    x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]
                )  # fmt: skip
                area = 0.5 * np.linalg.norm(np.cross(a, b), axis=1)
            high = max(high, float((self.volume / area).max(initial=0.0)))
        return self.dim * high if simplex else high

    def _mean(self, nodal):
        shapes, _, weights = self.fine
        return np.einsum("nq,qk,nki->ni", weights, shapes, nodal) / self.volume[:, None]

    def gradient(self, d):
        """Return F at the points in three dimensions, shape (n, nq, 3, 3)."""
        grad = np.einsum("nki,nqkj->nqij", d[self.nodes], self.slopes)
        F = np.tile(np.eye(3), (*grad.shape[:2], 1, 1))
        F[..., : self.dim, : self.dim] += grad
        if self.hoop is not None:
            F[..., 2, 2] += np.einsum("nqk,nk->nq", self.hoop, d[self.nodes][:, :, 0])
        return F

    def rows(self, background, d):
        """Return the background basis of each domain's nodes: global nodes, values (n, k, m)."""
        method = self.particles.method
        n, k = self.nodes.shape
        if method == "cpdi2":
            nodes, values, _ = background.at(self.X + d)
            return nodes[self.nodes], values[self.nodes]
        F = self.gradient(d)[..., : self.dim, : self.dim]
        F = np.einsum("nq,nqij->nij", self.weights / self.weights.sum(axis=1, keepdims=True), F)
        x = self._mean(self.X[self.nodes] + d[self.nodes])
        arms = np.einsum("nij,nkj->nki", F, self.X[self.nodes] - self.centroid[:, None])
        if method == "cpdi":
            nodes, values, _ = background.at((x[:, None] + arms).reshape(-1, self.dim))
            return nodes.reshape(n, k, -1), values.reshape(n, k, -1)
        if method == "mpm":
            nodes, values, slopes = background.at(x)
            whole = values[:, None] + np.einsum("nmi,nki->nkm", slopes, arms)
            return np.repeat(nodes[:, None], k, axis=1), whole
        return self._boxes(background, x, F, arms)

    def _boxes(self, background, x, F, arms):
        """Return the rows of contiguous boxes, by products of averaged hat functions."""
        half = 0.5 * np.ptp(self.X[self.nodes], axis=1)
        if self.particles.method == "gimp":
            size, turn = np.linalg.eigh(np.einsum("nji,njk->nik", F, F))
            U = np.einsum("nij,nj,nkj->nik", turn, np.sqrt(size), turn)
            half = half * np.diagonal(U, axis1=1, axis2=2)
        points = background.x.reshape(-1, self.dim)
        lines = []
        for axis in points.T:
            line = np.unique(np.round(axis / background.scale, 9)) * background.scale
            lines.append(line)
        averages = [
            hats(line, x[:, i] - half[:, i], x[:, i] + half[:, i]) for i, line in enumerate(lines)
        ]
        (sx, gx), (sy, gy) = averages
        S = np.einsum("na,nb->nab", sx, sy).reshape(len(x), -1)
        G = np.stack(
            [
                np.einsum("na,nb->nab", gx, sy).reshape(len(x), -1),
                np.einsum("na,nb->nab", sx, gy).reshape(len(x), -1),
            ],
            axis=-1,
        )
        number = np.zeros((len(lines[0]), len(lines[1])), dtype=np.int64)
        place = [
            np.argmin(np.abs(points[:, i, None] - line[None]), axis=1)
            for i, line in enumerate(lines)
        ]
        number[tuple(place)] = background.nodes.ravel()
        values = S[:, None] + np.einsum("nmi,nki->nkm", G, arms)
        nodes = np.broadcast_to(number.ravel(), values.shape)
        return nodes, values


def elastic_stress(law, young, poisson, F):
    """Return the first Piola stress of elastic laws and the stored energy."""
    bulk, shear = young / (3 * (1 - 2 * poisson)), young / (2 * (1 + poisson))
    one = np.eye(3)
    if law == "linear":
        strain = 0.5 * (F + F.swapaxes(-1, -2)) - one
        size = None
    else:
        left = np.einsum("...ik,...jk->...ij", F, F)
        size, axes = np.linalg.eigh(left)
        strain = np.einsum("...ik,...k,...jk->...ij", axes, 0.5 * np.log(size), axes)
    trace = np.trace(strain, axis1=-2, axis2=-1)
    dev = strain - trace[..., None, None] / 3 * one
    bulk, shear = np.asarray(bulk), np.asarray(shear)
    stress = (bulk * trace)[..., None, None] * one + 2 * shear[..., None, None] * dev
    energy = 0.5 * bulk * trace**2 + shear * np.einsum("...ij,...ij->...", dev, dev)
    if size is not None:
        stress = np.einsum("...ik,...jk->...ij", stress, np.linalg.inv(F))
    return stress, energy


def distance(data, y):
    """Return the signed distance of points from an obstacle, or None where it is not known here."""
    name, size, radius = data["shape"], data["size"], data["radius"]
    if name == "plane":
        return (y - np.array(data["point"])) @ np.array(data["normal"])
    arm = y - np.array(data["centre"])
    if name == "cavity":
        return size - np.linalg.norm(arm, axis=1)
    if name == "ellipse":  # (a segment and what is near it)
        along = np.clip(arm[:, 0], -0.4 * size, 0.4 * size)
        return np.hypot(arm[:, 0] - along, arm[:, 1]) - 0.6 * size
    if name in ("disc", "cylinder"):
        return np.linalg.norm(arm[:, : 2 if name == "cylinder" else None], axis=1) - size
    if name == "box":
        over = np.abs(arm) - (size - radius)
        inner = np.minimum(over.max(axis=1), 0.0)
        return np.linalg.norm(np.maximum(over, 0.0), axis=1) + inner - radius
    return None


def rotation(angle):
    """Return the matrix of a rotation by an angle, or by a vector."""
    if len(angle) == 1:
        c, s = np.cos(angle[0]), np.sin(angle[0])
        return np.array([[c, -s], [s, c]])
    size = np.linalg.norm(angle)
    if size == 0.0:
        return np.eye(3)
    x, y, z = angle / size
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(size) * K + (1.0 - np.cos(size)) * K @ K


def moment(arms, forces):
    """Return the sum of moments, (1,) or (3,)."""
    if arms.shape[1] == 3:
        return np.cross(arms, forces).sum(axis=0)
    return np.array([np.sum(arms[:, 0] * forces[:, 1] - arms[:, 1] * forces[:, 0])])


def frictional(data, tau, young):
    """Return the yield function of a soil over its strength, and this strength."""
    sine, cosine = (fun(np.radians(data["friction"])) for fun in (np.sin, np.cos))
    cohesion = data["cohesion"] * young
    if data["law"] == "drucker_prager":  # the cone through the pyramid's outer edges
        p = np.trace(tau, axis1=-2, axis2=-1) / 3.0
        dev = tau - p[..., None, None] * np.eye(3)
        slope = 6.0 / (np.sqrt(3.0) * (3.0 - sine))
        root = np.sqrt(0.5) * np.linalg.norm(dev, axis=(-2, -1))
        strength = slope * cosine * cohesion
        return (root + slope * sine * p) / strength - 1.0, strength
    values = np.linalg.eigvalsh(tau)
    low, high = values[..., 0], values[..., -1]
    strength = cosine * cohesion
    return 0.5 * (high - low + (high + low) * sine) / strength - 1.0, strength


class Observer:
    """Follows a run step by step and judges what it leaves.

    Args:
        scene: The scene.
        run: Its problem.
    """

    def __init__(self, scene, run):
        self.scene, self.run = scene, run
        self.comm = run.bodies[0].mesh.comm
        self.backgrounds = [Background(run.bodies[0].V)]
        for body in run.bodies[1:]:
            same = body.V is run.bodies[0].V
            self.backgrounds.append(self.backgrounds[0] if same else Background(body.V))
        self.domains = [
            Domains(
                body,
                body.dx.metadata()["quadrature_degree"],
                scene.get("options", {}).get("axisymmetric", False),
            )
            for body in run.bodies
        ]
        self.law = scene["material"]["law"]
        self.is_elastic = self.law in ("hencky", "linear")
        options = scene.get("options", {})
        self.f_bar = options.get("f_bar", "none")
        self._summed = (
            scene.get("outside") != "delete"
            and "motion_of" not in scene
            and self.f_bar in ("none", "domain")
            and scene.get("degree", 1) == 1
            and options.get("stabilisation", "auto") == "auto"
        )
        self.whole = scene.get("outside") != "delete"
        self.steps = 0
        self.previous = self.present = self._displacements()
        self.snapshot = self.state()
        self.work = self.most = self.stretch = 0.0
        self.forces = [np.zeros_like(d) for d in self.present]
        self.path = self._follow()

    @property
    def pair(self):
        """Whether there are two bodies on fields of their own."""
        return "passes" in self.scene.get("contact", {})

    @property
    def exact(self):
        """Whether all forces on each background dof are summed here, so that they balance."""
        return self._summed and self.run.problem.history.statistics["ghost_facets"] == 0

    # -- What is there ---------------------------------------------------------------------

    def _displacements(self):
        return [
            body.displacement.x.array.reshape(-1, body.mesh.geometry.dim).copy()
            for body in self.run.bodies
        ]

    def state(self):
        """Return copies of all that a failed step must leave as it was."""
        arrays = {}
        for i, body in enumerate(self.run.bodies):
            arrays[f"displacement {i}"] = body.displacement.x.array
            arrays[f"F {i}"] = body.deformation_gradient
            arrays[f"volume {i}"] = body.volume
            arrays[f"centroid {i}"] = body.centroid
            arrays[f"stress {i}"] = body.stress
            arrays[f"plastic strain {i}"] = body.plastic_strain
            arrays[f"load {i}"] = np.array(body.load.value)
        for i, bc in enumerate(self.run.bcs):
            arrays[f"reaction {i}"] = self.run.problem.reaction(bc)
        if (touch := self.run.contact) is not None:
            arrays["contact"] = self.run.problem.reaction(touch)
            points = self.run.touch
            arrays["gap"] = np.where(np.isfinite(points.gap), points.gap, 1e300)
            arrays["traction"] = points.traction
            if self.run.rigid is not None:
                for name in ("offset", "angle", "velocity", "spin"):
                    arrays[f"{name} of the rigid body"] = getattr(touch, name)
        return {key: np.array(value) for key, value in arrays.items()}

    def changes(self):
        """Return what differs from the last converged state."""
        now = self.state()
        found = [k for k in now if not np.array_equal(now[k], self.snapshot[k], equal_nan=True)]
        return sorted({name for names in self.comm.allgather(found) for name in names})

    def _points(self, i):
        """Return F, first Piola stress, Kirchhoff stress and energy at the points of a body.

        With F-bar the first Piola stress is the one that works on F.
        """
        domains = self.domains[i]
        F = domains.gradient(self.present[i])
        if self.f_bar == "domain":
            return self._averaged_points(i, F)
        if self.is_elastic:
            young = np.reshape(self.run.youngs[i], (-1, 1))
            P, energy = elastic_stress(self.law, young, self.scene["material"]["poisson"], F)
            return F, P, None, energy
        points = self.run.problem.points[i]
        if self.f_bar != "none":
            F = np.tile(np.eye(3), (*F.shape[:2], 1, 1))
            dim = 3 if domains.axisymmetric else domains.dim
            kept = points.last.columns()["gradient"].values
            F[..., :dim, :dim] += kept.reshape(*F.shape[:2], dim, dim)
        sigma = points.last.cauchy_stress()
        if self.law == "small":
            return F, sigma, sigma, None
        tau = np.linalg.det(F)[..., None, None] * sigma
        return F, np.einsum("...ik,...jk->...ij", tau, np.linalg.inv(F)), tau, None

    def _averaged_points(self, i, F):
        """Return what ``_points`` does where J is averaged over each domain.

        With Jbar = sum w J / sum w and Fbar = (Jbar/J)^(1/dim) F in the plane or in space,
        P : dF = tau : (dF F^-1) + 1/dim tr(tau) (d ln Jbar - tr(dF F^-1)), tau that of Fbar.
        A J that is more than exp(0.2) times its average, or less than exp(-0.2), costs energy:
        3 G (|ln J/Jbar| - 0.2)^3 / 2.4, up to 0.6.
        """
        domains = self.domains[i]
        dim = 3 if domains.axisymmetric else domains.dim
        J, w = np.linalg.det(F), domains.weights
        mean = (w * J).sum(axis=1) / w.sum(axis=1)
        bar = F.copy()
        bar[..., :dim, :dim] *= ((mean[:, None] / J) ** (1.0 / dim))[..., None, None]
        energy = None
        if self.is_elastic:
            poisson = self.scene["material"]["poisson"]
            P, energy = elastic_stress(self.law, self.run.young, poisson, bar)
            tau = np.einsum("...ik,...jk->...ij", P, bar)
        else:
            sigma = self.run.problem.points[i].last.cauchy_stress()
            tau = np.linalg.det(bar)[..., None, None] * sigma
        pressure = np.trace(tau[..., :dim, :dim], axis1=-2, axis2=-1) / dim
        apart = np.log(J / mean[:, None])
        excess = np.maximum(np.abs(apart) - 0.2, 0.0)
        stiff = 1.5 * self.run.young / (1.0 + self.scene["material"]["poisson"])  # 3 G
        pressure = pressure - stiff * np.sign(apart) * excess**2 / 0.8
        if energy is not None:
            energy = energy + stiff * excess**3 / 2.4
        shared = J * (w * pressure).sum(axis=1, keepdims=True) / (w * J).sum(axis=1, keepdims=True)
        acting = tau.copy()
        acting[..., :dim, :dim] += (shared - pressure)[..., None, None] * np.eye(dim)
        return F, np.einsum("...ik,...jk->...ij", acting, np.linalg.inv(F)), tau, energy

    # -- Following -------------------------------------------------------------------------

    def step(self):
        """Take note of a converged step."""
        self.steps += 1
        self.previous, self.present = self.present, self._displacements()
        self.snapshot = self.state()
        if self.path is not None:
            self._follow_on()
        if self.is_elastic and self._summed:
            before, ends = self.forces, self.present
            self.present = [0.5 * (a + b) for a, b in zip(self.previous, ends, strict=True)]
            middle = [self._nodal(i)[0] for i in range(len(self.domains))]
            self.present = ends
            self.forces = [self._nodal(i)[0] for i in range(len(self.domains))]
            self.work += sum(
                float(np.sum((a + 4.0 * b + c) * (now - then))) / 6.0
                for a, b, c, now, then in zip(
                    before, middle, self.forces, ends, self.previous, strict=True
                )
            )
            stored = self.comm.allreduce(self._stored())
            self.most = max(self.most, abs(stored))
            for domains, now, then in zip(self.domains, self.present, self.previous, strict=True):
                new, old = domains.gradient(now), domains.gradient(then)
                strain = new @ np.linalg.inv(old) - np.eye(3)
                self.stretch = max(self.stretch, float(np.abs(strain).max(initial=0.0)))

    def _stored(self):
        """Return this rank's stored energy."""
        return sum(
            float((domains.weights * self._points(i)[3]).sum())
            for i, domains in enumerate(self.domains)
        )

    def _nodal(self, i):
        """Return internal and external forces and the floor of round-off at a body's nodes.

        Owned domains only: what other ranks add to shared nodes is theirs to carry.
        """
        domains = self.domains[i]
        dim = domains.dim
        F, P, _, _ = self._points(i)
        per_domain = np.einsum(
            "nq,nqij,nqkj->nki", domains.weights, P[..., :dim, :dim], domains.slopes
        )
        if domains.hoop is not None:
            per_domain[..., 0] += np.einsum(
                "nq,nq,nqk->nk", domains.weights, P[..., 2, 2], domains.hoop
            )
        shapes, _, weights = domains.fine
        factor = float(self.run.bodies[i].load.value)
        g = factor * self.run.density * self.run.gravity
        outer = np.einsum("nq,qk,i->nki", weights, shapes, g)
        # Round-off in F, as large as that of positions over the size of a domain, in stress.
        poisson = self.scene["material"]["poisson"]
        stiff = self.run.youngs[i] * (1.0 + 1.0 / (1.0 - 2.0 * poisson))
        far = max(
            np.abs(self.backgrounds[i].x).max(), np.abs(domains.X + self.present[i]).max(initial=0)
        )
        span = np.abs(domains.slopes).max(axis=(1, 2, 3), initial=0.0)
        P_size = np.abs(P).max(axis=(1, 2, 3), initial=0.0)
        F_size = np.abs(np.linalg.inv(F)).max(axis=(1, 2, 3), initial=0.0)
        soft = (stiff * F_size**2 + P_size) * far * span
        floor = EPS * np.einsum("n,nq,nqki->nki", soft, domains.weights, np.abs(domains.slopes))
        absolute = np.abs(per_domain) + np.abs(outer)
        sums = []
        for values in (per_domain, outer, floor, absolute):
            nodal = np.zeros_like(self.present[i])
            np.add.at(nodal, domains.nodes, values)
            sums.append(nodal)
        self._by_domain = per_domain, outer, floor, absolute
        return sums

    # -- Judging ---------------------------------------------------------------------------

    def judge(self):
        """Return the complaints about the last converged state, and numbers."""
        found, figures = [], {}
        self._check_numbers(found)
        self._check_mass(found, figures)
        # Of what follows much is collective, and one rank may have found what others have not.
        if self.steps and not any(self.comm.allgather(bool(found))):
            if self.whole and self.scene["method"] == "cpdi2":
                self._check_floor(found)
            if self.exact and self.pair:
                self._check_pair(found, figures)
            elif self.exact:
                self._check_balance(found, figures)
            if self.run.contact is not None:
                self._check_contact(found, figures)
                self._check_gaps(found, figures)
            if self.run.rigid is not None and self.run.time is None:
                self._check_rigid(found, figures)
            if self.path is not None:
                self._check_momentum(found, figures)
            if self.run.time is not None:
                self._check_account(found, figures)
            elif (self.whole and not self.exact) or "contrast" in self.scene:
                self._check_total(found, figures)
            # Round-off of stiff stresses does work on whole displacements.
            # Where bodies are but moved, or a step strains them much, contact does not tell more.
            strained = self.most > 1e-10 * self.run.young and self.stretch < 0.2
            if self.run.contact is not None and not self.comm.allreduce(strained, MPI.LAND):
                pass
            elif self.is_elastic and self._summed and "contrast" not in self.scene:
                self._check_energy(found, figures)
            if not self.is_elastic:
                self._check_yield(found, figures)
        complaints = sorted({c for cs in self.comm.allgather(found) for c in cs})
        return complaints, figures

    def _check_numbers(self, found):
        for name, array in self.snapshot.items():
            if not np.isfinite(array).all():
                found.append(f"{name} is not finite")
        if found:
            return
        for i, domains in enumerate(self.domains):
            alive = ~self.run.bodies[i].deleted
            if not (np.linalg.det(domains.gradient(self.present[i]))[alive] > 0.0).all():
                found.append("J is not positive")

    def _check_mass(self, found, figures):
        for i, domains in enumerate(self.domains):
            body = self.run.bodies[i]
            corners = domains.X[domains.nodes]
            if domains.dim == 2 and body.W.ufl_element().degree == 1:
                around = [0, 1, 2] if corners.shape[1] == 3 else [0, 1, 3, 2]
                x, y = np.moveaxis(corners[:, around] - corners[:, :1], 2, 0)
                own = 0.5 * np.abs(
                    (x * np.roll(y, -1, axis=1) - y * np.roll(x, -1, axis=1)).sum(axis=1)
                )
                span = np.abs(corners).max(axis=(1, 2), initial=0.0) * np.ptp(corners, axis=1).max(
                    axis=1, initial=0.0
                )
            else:
                own = domains.volume
                span = own
            error = np.abs(body.initial_volume - own)
            if (error > 1e-12 * own + 16 * EPS * span).any():
                found.append("a particle's mass is not density times volume")
            plain = self.run.bodies[i].W.ufl_element().degree == 1
            if not plain or self.scene.get("outside") or not self.inside(i):
                continue
            offsets, _, S, _ = body.weights()
            owner = np.repeat(np.arange(len(own)), np.diff(offsets))
            sums = np.bincount(owner, weights=S, minlength=len(own))
            if np.abs(sums - 1.0).max(initial=0.0) > 1e-9:
                found.append("weights of a particle do not add up to 1")

    def inside(self, i):
        """Return whether all of a body's domains are inside the background (collective)."""
        try:
            self.run.bodies[i].locate()
        except RuntimeError:
            return False
        return True

    def _carried(self, i):
        """Return what ``_nodal`` does and the forces of an obstacle, on a body's background.

        Besides it returns how much of each background node the body has.
        """
        domains, background = self.domains[i], self.backgrounds[i]
        nodes, values = domains.rows(background, self.previous[i])
        self._nodal(i)
        parts = [*self._by_domain, self._pushed(i)]
        totals = np.zeros((len(parts), background.size, domains.dim))
        for total, part in zip(totals, parts, strict=True):
            np.add.at(total, nodes, np.einsum("nkm,nki->nkmi", values, part))
        active = np.zeros(background.size)
        np.add.at(active, nodes, np.abs(values))
        return self.comm.allreduce(totals), self.comm.allreduce(active)

    def _pushed(self, i):
        """Return the forces of an obstacle on the nodes of each domain, (n, k, dim).

        What the points tell is shared out by the shape functions of the domain that they are on.
        """
        domains = self.domains[i]
        result = np.zeros((*domains.nodes.shape, domains.dim))
        if self.run.contact is None or self.pair or len(domains.nodes) == 0:
            return result
        touch = self.run.touch
        acts = np.linalg.norm(touch.traction, axis=1) > 0.0
        if not acts.any():
            return result
        x = (domains.X + self.present[i])[domains.nodes]
        cells = Cells(x, domains.cell)
        which, where, off = cells.on_facets(touch.points[acts])
        self.astray = float(off.max())
        shares = cells.map.tabulate(0, where)[0, :, :, 0]
        force = (touch.area[:, None] * touch.traction)[acts]
        np.add.at(result, which, shares[:, :, None] * force[:, None])
        return result

    def _fixed(self, V, bcs, size, dim):
        """Return which dofs of a background have a condition."""
        fixed = np.zeros((size, dim), dtype=bool)
        for bc in bcs:
            start = V.dofmap.index_map.local_range[0] * dim
            for own in self.comm.allgather(_compat.own_dofs(bc, V) + start):
                fixed.ravel()[own] = True
        return fixed

    def _check_floor(self, found):
        """Look that what began the step off its background was held by the boundary."""
        for i, (domains, background) in enumerate(zip(self.domains, self.backgrounds, strict=True)):
            x = domains.X + self.previous[i]
            nodes, values, _ = background.at(x)
            bcs = self.run.bcs[i : i + 1] if self.pair else self.run.bcs
            fixed = self._fixed(self.run.bodies[i].V, bcs, background.size, domains.dim)
            loose = ~fixed[nodes] & background.beyond(x)[:, None]
            if loose[np.abs(values) > 1e-9].any():
                found.append("a run went on with what has left the background")

    def _check_balance(self, found, figures):
        """Sum element forces on the background: zero at all free dofs."""
        dim, background = self.domains[0].dim, self.backgrounds[0]
        self.astray = 0.0
        totals, active = (
            sum(v) for v in zip(*map(self._carried, range(len(self.domains))), strict=True)
        )
        internal, outer, floor, absolute, pushed = totals
        figures["off"] = self.comm.allreduce(self.astray, MPI.MAX)
        if figures["off"] > 1e-6:
            return  # (Newton's iteration from the middle of a warped domain does not find it)
        fixed = self._fixed(self.run.bodies[0].V, self.run.bcs, background.size, dim)
        outer, absolute = outer + pushed, absolute + np.abs(pushed)
        residual = internal - outer
        free = ~fixed & (active > 1e-12)[:, None]
        unbalanced = np.where(free, residual, 0.0)
        if self.run.problem.history.statistics["joint_nodes"]:
            # Nodes of bodies at a joint go with other nodes of the background than those around
            # them: force by force they are not compared here, but as a whole.
            unbalanced = unbalanced.sum(axis=0)
        size = float(np.linalg.norm(unbalanced))
        scale = max(float(np.linalg.norm(outer)), float(np.linalg.norm(residual[fixed])))
        inner = float(np.linalg.norm(absolute))
        figures["balance"] = size / scale if scale > 0 else size
        figures["floor"] = float(np.linalg.norm(floor)) / scale if scale > 0 else 0.0
        bound = 1e-8 * scale + 30.0 * float(np.linalg.norm(floor))
        if scale < 1e-6 * inner:
            bound = max(bound, 1e-8 * inner)
        if not size <= bound:
            found.append(f"forces are out of balance by {size / max(scale, 1e-300):.1e}")
        # The support's force as the package reports it.
        given = [np.asarray(self.run.problem.reaction(bc)) for bc in self.run.bcs]
        if len(given) == 1:
            own = np.where(fixed, residual, 0.0).sum(axis=0)
            gap = np.abs(own - given[0]).max()
            if not gap <= 1e-7 * scale + 30.0 * np.sqrt(background.size) * np.linalg.norm(floor):
                found.append(f"a reaction differs by {gap / max(scale, 1e-300):.1e}")

    def _check_pair(self, found, figures):
        """Sum each body's element forces: zero where it does not touch, and there as told.

        So the force on one body is found from its own stresses, and is minus that on the other.
        """
        force = np.asarray(self.run.problem.reaction(self.run.contact))
        # (of both passes: points of one may press where none of the other does)
        acting = [x[np.abs(f).max(axis=1) > 0.0] for x, f in self.run.touch._forces()]
        points = np.concatenate(self.comm.allgather(np.concatenate(acting)))
        forces, bounds = [], []
        for i, domains in enumerate(self.domains):
            (internal, outer, floor, absolute, _), active = self._carried(i)
            body, background = self.run.bodies[i], self.backgrounds[i]
            fixed = self._fixed(body.V, self.run.bcs[i : i + 1], background.size, domains.dim)
            near = np.zeros(background.size)
            if len(points):
                x = domains.X + self.present[i]
                largest = float(np.ptp(x[domains.nodes], axis=1).max(initial=0.0))
                reach = 2.0 * self.comm.allreduce(largest, MPI.MAX)
                close = cKDTree(points).query(x)[0] < reach
                nodes, values = domains.rows(background, self.previous[i])
                np.add.at(near, nodes, np.abs(values) * close[domains.nodes][:, :, None])
            near = self.comm.allreduce(near) > 0.0
            residual = internal - outer
            free = ~fixed & (active > 1e-12)[:, None]
            scale = max(np.linalg.norm(outer), np.linalg.norm(residual[fixed]), *np.abs(force))
            bound = 1e-8 * scale + 30.0 * float(np.linalg.norm(floor))
            if scale < 1e-6 * np.linalg.norm(absolute):
                bound = max(bound, 1e-8 * float(np.linalg.norm(absolute)))
            away = float(np.linalg.norm(residual[free & ~near[:, None]]))
            if not away <= bound:
                found.append(f"forces away from a contact are out of balance by {away / scale:.1e}")
            if (near[:, None] & fixed).any():
                continue  # (what is held there bears a part)
            forces.append((1.0 if i == 1 else -1.0) * np.where(free, residual, 0.0).sum(axis=0))
            bounds.append(10.0 * bound * np.sqrt(background.size))
        for own, bound in zip(forces, bounds, strict=True):
            figures["pair"] = float(np.abs(own - force).max())
            if not figures["pair"] <= bound:
                found.append(f"a force of contact is not that of the stresses: {own}, {force}")
        figures["sides"] = len(forces)

    def _check_total(self, found, figures):
        """Compare the sum of loads with the supports' forces as the package reports them."""
        dim = self.domains[0].dim
        loads, size = np.zeros(dim), 0.0
        for i, domains in enumerate(self.domains):
            factor = float(self.run.bodies[i].load.value)
            loads += factor * self.run.density * self.run.gravity * domains.turned
            self._nodal(i)
            size += float(np.abs(self._by_domain[0]).sum())
        loads, size = self.comm.allreduce(loads), self.comm.allreduce(size)
        forces = sum((self.run.problem.reaction(bc) for bc in self.run.bcs), np.zeros(dim))
        if self.run.contact is not None and not self.pair:
            forces = forces + self.run.problem.reaction(self.run.contact)
        if self.domains[0].axisymmetric:  # along the axis; hoop stress bears the rest
            loads, forces = loads[1:], forces[1:]
        gap = np.abs(loads + forces).max()
        scale = max(
            np.abs(loads).max(),
            *(np.abs(self.run.problem.reaction(b)).max() for b in self.run.bcs),
            0.0,
        )
        if self.run.contact is not None:  # (bodies that touch nothing are moved by no force)
            size += 1e-3 * self.run.young
        figures["total"] = gap / scale if scale > 0 else 0.0
        if not gap <= 1e-7 * scale + 1e-10 * size:
            found.append(f"loads and supports do not add up to zero by {figures['total']:.1e}")

    def _check_contact(self, found, figures):
        """Look at what each point of a contact tells: gap, pressure and friction."""
        touch, data = self.run.touch, self.scene["contact"]
        pressure, gap = touch.pressure, touch.gap
        size = np.linalg.norm(touch.traction, axis=1)
        shear = np.sqrt(np.maximum(size**2 - pressure**2, 0.0))
        stiff = self.run.young
        floor = 1e-7 * stiff * max(np.abs(gap[np.isfinite(gap)]).max(initial=0.0), 1e-12)
        moves = self.run.time is not None and self.scene["motion_of"]["scheme"] != "euler"
        if (pressure < -floor).any():
            found.append("a contact pulls")
        by_stress = data.get("law") == "nitsche"
        if not moves and not by_stress and (pressure[gap > 1e-9] > 0.0).any():
            found.append("a contact acts at a gap")
        most = data["friction"] * pressure + data["cohesion"] * self._stretches()
        if moves and data["friction"] == data["cohesion"] == 0.0:
            most = most + size  # (a direction of the whole step)
        # (told is the vector alone: where it is nearly normal, its square loses digits)
        if not moves and (shear > most + floor + 1e-7 * size).any():
            found.append("friction is beyond Coulomb's cone")
        if "obstacle" in data:
            exact = distance(data["obstacle"], self._framed(touch.points))
            if exact is not None and np.abs(exact - gap).max(initial=0.0) > 1e-9:
                found.append("a gap is wrong")
        figures["depth"] = self.comm.allreduce(float(-gap.min(initial=0.0)), MPI.MAX)
        if not moves and self.run.time is None and len(self.run.bodies) == 2:
            force = self.run.problem.reaction(touch)
            dead = [
                float(body.load.value) * self.run.density * self.run.gravity * domains.turned
                for body, domains in zip(self.run.bodies, self.domains, strict=True)
            ]
            held = [np.asarray(self.run.problem.reaction(bc)) for bc in self.run.bcs]
            scale = max(np.abs(f).max() for f in (force, *held))
            dead = self.comm.allreduce(np.array(dead))
            error = max(
                np.abs(held[1] + force + dead[1]).max(), np.abs(held[0] - force + dead[0]).max()
            )
            if error > 1e-7 * scale + 1e-10 * self.run.young:
                found.append(f"a pair is out of balance by {error / scale:.1e}")

    def _framed(self, x):
        """Return points in the frame in which an obstacle was made."""
        data, term = self.scene["contact"], self.run.contact
        about = np.array(data["obstacle"].get("centre", data["obstacle"].get("point")))
        return (x - about - term.offset) @ rotation(term.angle) + about

    def _stretches(self, least=False):
        """Return at most how much larger facets are than at the beginning, for each point.

        By the corners of the domains, as a step begins; or how much larger they are at least.
        """
        i = 1 if self.pair else 0
        domains, touch = self.domains[i], self.run.touch
        if len(domains.nodes) == 0 or len(touch.points) == 0:
            return np.ones(len(touch.points))
        cells = Cells((domains.X + self.present[i])[domains.nodes], domains.cell)
        which, _, off = cells.on_facets(touch.points)
        dim = domains.dim
        element = domains.particles.W.ufl_element().basix_element
        slopes = domains._at(element, basix.geometry(domains.cell), 1.0)[1]
        F = np.eye(dim) + np.einsum("nki,nqkj->nqij", self.previous[i][domains.nodes], slopes)
        extreme = np.min if least else np.max
        sizes = np.linalg.svd(F, compute_uv=False)[..., :: -1 if least else 1]
        sizes = sizes[..., : dim - 1].prod(axis=-1)
        return np.where(off < 1e-6, extreme(sizes, axis=1)[which], extreme(sizes))

    def _check_gaps(self, found, figures):
        """Look at how far apart points in contact may be, by the stiffness that holds them.

        With the penalty -g = p h / (gamma M) over the stretch of the facet as the step began, M the
        confined modulus and h the height of the domain over its facet. By Nitsche's method
        p = <s - gamma M / h g>, where the pressure s of the stress behind the facet is carried on
        from the points of the domain.
        """
        data, touch = self.scene["contact"], self.run.touch
        if self.run.time is not None and self.scene["motion_of"]["scheme"] != "euler":
            return  # (means of steps are told)
        poisson = self.scene["material"]["poisson"]
        confined = self.run.young * (1 - poisson) / (1 + poisson) / (1 - 2 * poisson)
        high = max(d.height() for d in self.domains)
        soft = self.comm.allreduce(high, MPI.MAX) / (data["penalty"] * confined)
        pressure, gap = touch.pressure, touch.gap
        if self.pair:
            # two bodies one behind the other, in two passes with a fifth of the stiffness or more
            highest = self.comm.allreduce(float(pressure.max(initial=0.0)), MPI.MAX)
            if (-gap > 10.0 * soft * highest + 1e-9).any():
                found.append("bodies are too deep in each other for what presses them")
        elif data.get("law") != "nitsche":
            soft = soft / self._stretches(least=True)
            if (-gap > soft * pressure * (1.0 + 1e-9) + 1e-9).any():
                found.append("a point is too deep in an obstacle for what presses it")
        else:
            domains = self.domains[0]
            if len(domains.nodes) == 0 or len(gap) == 0:
                return
            P = self._points(0)[1][..., : domains.dim, : domains.dim]
            cells = Cells((domains.X + self.present[0])[domains.nodes], domains.cell)
            which = cells.on_facets(touch.points)[0]
            acting = 3.0 * np.linalg.norm(P, axis=(-2, -1)).max(axis=1)[which]
            figures["farthest"] = float(gap[pressure > 0.0].max(initial=0.0))
            if (gap[pressure > 0.0] > (soft * acting)[pressure > 0.0] + 1e-9).any():
                found.append("a contact acts too far from an obstacle for the stress behind it")
            if (-gap > soft * (pressure + acting) + 1e-9).any():
                found.append("a point is too deep in an obstacle for what presses it")

    def _check_rigid(self, found, figures):
        """Compare what a rigid body carries with what presses it: forces and moment."""
        term, about, touch = self.run.contact, self.run.rigid, self.run.touch
        dim = self.domains[0].dim
        t = float(self.run.bodies[0].load.value)
        weight = about["mass"] * np.array(about["gravity"])
        given = t * np.array(about["force"]) + weight
        centre = np.array(self.scene["contact"]["obstacle"].get("centre", [0.0] * dim))
        if "point" in self.scene["contact"]["obstacle"]:
            centre = np.array(self.scene["contact"]["obstacle"]["point"])
        own = touch.area[:, None] * touch.traction
        force = self.comm.allreduce(own.sum(axis=0))
        turn = self.comm.allreduce(moment(touch.points - centre - term.offset, own))
        size = self.comm.allreduce(float(np.abs(own).sum())) + np.abs(given).max()
        error = given - force
        error[[name in about["fixed"] for name in "xyz"[:dim]]] = 0.0
        figures["carried"] = float(np.abs(error).max() / size)
        if not figures["carried"] <= 1e-8:
            found.append(f"a rigid body carries not what presses it by {figures['carried']:.1e}")
        if "rotation" not in about["fixed"]:
            turn[-1] -= t * about["moment"]
            figures["moment"] = float(np.abs(turn).max() / size)
            if not figures["moment"] <= 1e-8:
                found.append(f"moments on a rigid body differ by {figures['moment']:.1e}")

    def _follow(self):
        """Return what is followed of a motion in which nothing is held: times and places.

        Of each body the mean displacement times mass, of a rigid body besides its own.
        """
        if self.run.time is None or self.run.bcs:
            return None
        about, count = self.scene["motion_of"], len(self.run.bodies)
        dim = self.domains[0].dim
        up, along = about["speed"] * np.eye(dim)[1], 0.1 * about["speed"] * np.eye(dim)[0]
        speeds = [up, *[along] * (count - 1)]
        masses = [self.run.density * self.comm.allreduce(float(d.turned)) for d in self.domains]
        if self.run.rigid is not None:
            speeds.append(np.array(self.run.rigid["velocity"]))
            masses.append(self.run.rigid["mass"])
        momenta = np.array(masses)[:, None] * np.array(speeds)
        self.first, self.aside, self.impulse = momenta, 0.0, 0.0
        self.borne = [self._rigid_energy(momenta)]
        return 0.0, self._middles(), momenta

    def _middles(self):
        """Return mass times mean displacement of all bodies, the rigid one last."""
        found = []
        for domains, d in zip(self.domains, self.present, strict=True):
            shapes, _, weights = domains.fine
            own = np.einsum("nq,qk,nki->i", weights, shapes, d[domains.nodes])
            found.append(self.run.density * self.comm.allreduce(own))
        if self.run.rigid is not None:
            found.append(self.run.rigid["mass"] * self.run.contact.offset)
        return np.array(found)

    def _follow_on(self):
        """Take the momenta on over a step, by the rule of the scheme."""
        before, places, momenta = self.path
        now, there = self.run.problem.history.energies[-1].time, self._middles()
        dt = now - before
        c = 1.0 if self.scene["motion_of"]["scheme"] == "euler" else 2.0
        after = c * (there - places) / dt - (c - 1.0) * momenta
        force = np.asarray(self.run.problem.reaction(self.run.contact))
        which = 1 if self.pair else 0
        error = np.abs(after[which] - momenta[which] - dt * force).max()
        if self.pair or self.run.rigid is not None:
            error = max(error, np.abs(after[-1 - which] - momenta[-1 - which] + dt * force).max())
        self.aside = max(self.aside, float(error))
        self.impulse += dt * float(np.linalg.norm(force))
        self.borne.append(self._rigid_energy(after))
        self.path = now, there, after

    def _rigid_energy(self, momenta):
        """Return the kinetic energy of a rigid body, zero where there is none."""
        about = self.run.rigid
        if about is None:
            return 0.0
        turning = 0.5 * about["inertia"] * float(np.sum(self.run.contact.spin**2))
        return 0.5 * float(momenta[-1] @ momenta[-1]) / about["mass"] + turning

    def _check_momentum(self, found, figures):
        """Look at the momenta of bodies that nothing holds: they change by what contact tells.

        They are found from the displacements alone. What one body gets the other gives.
        """
        size = float(np.abs(self.first).max())
        figures |= {"momentum": self.aside / size, "impulse": self.impulse / size}
        if not figures["momentum"] <= 1e-7:
            found.append(f"momentum changes beside the contact by {figures['momentum']:.1e}")

    def _check_account(self, found, figures):
        """Look at the account of energies of a motion: it closes, and nothing is won."""
        energies = self.run.problem.history.energies
        balance = np.array([energy.balance for energy in energies])
        whole = np.array([energy.kinetic + energy.strain for energy in energies])
        if self.run.rigid is not None:
            whole += np.array(self.borne)
        figures["account"] = float(np.abs(balance - balance[0]).max() / whole[0])
        figures["won"] = float(whole.max() / whole[0] - 1.0)
        if figures["account"] > 1e-9:
            found.append(f"the account of energies does not close by {figures['account']:.1e}")
        # (midpoint: energy of large strains to second order)
        if figures["won"] > (0.05 if self.scene["motion_of"]["scheme"] == "midpoint" else 1e-7):
            found.append(f"energy is won, {figures['won']:.1e}")

    def _check_energy(self, found, figures):
        """Compare the stored energy with the work of stress along the path.

        The work of a step is by Simpson's rule, which is exact for an energy of the fourth degree,
        as that of a thin body that bends: the next term has the step's strain squared. From strains
        of one on, the straight way to the step's end may turn domains inside out, where there is no
        energy. Strains that are found from F are known to round-off of one.
        """
        stored, work = self.comm.allreduce(self._stored()), self.comm.allreduce(self.work)
        strain = self.comm.allreduce(self.stretch, MPI.MAX)
        error = abs(stored - work) / self.most if self.most > 0 else 0.0
        figures["energy"] = error
        figures["strain"] = strain
        unknown = 4.0 * np.finfo(float).eps / strain if strain > 0.0 else 0.0
        if strain < 1.0 and error > 1e-6 + 0.1 * strain**2 + unknown:
            found.append(f"stored energy and work differ by {error:.1e}")

    def _check_yield(self, found, figures):
        """Evaluate the yield function."""
        data = self.scene["material"]
        worst = -np.inf
        for i, body in enumerate(self.run.bodies):
            alive = ~body.deleted
            _, _, tau, _ = self._points(i)
            dev = tau - np.trace(tau, axis1=-2, axis2=-1)[..., None, None] / 3 * np.eye(3)
            kappa = body._response.last.plastic_strain()
            if "cohesion" in data:
                f, strength = frictional(data, tau, self.run.young)
            else:
                hardened = data["rho_y"] + np.sqrt(2 / 3) * data["hardening"] * kappa
                strength = hardened * self.run.young
                f = np.linalg.norm(dev, axis=(-2, -1)) / strength - 1.0
            # Round-off of the pressure, which may be many times the strength.
            floor = EPS * np.abs(tau).max(axis=(-2, -1)) / strength
            worst = max(worst, float((f - 64 * floor)[alive].max(initial=-np.inf)))
            if (kappa < 0.0).any():
                found.append("an accumulated plastic strain is negative")
        figures["yield"] = worst
        if worst > 1e-9:
            found.append(f"a stress is outside the yield surface by {worst:.1e}")
