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

EPS = np.finfo(float).eps


def rule(cell, degree):
    """Return points and weights of a rule."""
    return [np.asarray(a) for a in basix.make_quadrature(cell, degree)]


class Background:
    """All cells of a background, on every rank, and the basis functions at points."""

    def __init__(self, V):
        domain = V.mesh
        comm, dim = domain.comm, domain.geometry.dim
        count = domain.topology.index_map(domain.topology.dim).size_local
        x = domain.geometry.x[_compat.geometry_dofmap(domain)[:count], :dim]
        nodes = V.dofmap.list[:count]
        nodes = V.dofmap.index_map.local_to_global(nodes.ravel()).reshape(nodes.shape)
        self.x = np.concatenate(comm.allgather(x))
        self.nodes = np.concatenate(comm.allgather(nodes))
        self.index = np.concatenate(comm.allgather(_compat.input_cell_index(domain)))
        self.size = V.dofmap.index_map.size_global
        self.simplex = domain.basix_cell() in (basix.CellType.triangle, basix.CellType.tetrahedron)
        self.map = basix.ufl.element("Lagrange", domain.basix_cell().name, 1).basix_element
        self.basis = V.ufl_element().basix_element
        self.centre = basix.geometry(domain.basix_cell()).mean(axis=0)
        middles = self.x.mean(axis=1)
        self.scale = np.ptp(self.x, axis=1).max()
        self.tree = cKDTree(middles / self.scale)
        self.near = min(len(middles), 16 if dim == 2 else 40)

    def at(self, points):
        """Return nodes and values of the basis at points, and their gradients."""
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
        return self.nodes[chosen], table[0], slopes, best

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
        cell = body.basix_cell()
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
        self.turned = self.fine[2].sum()

    def _at(self, element, points, weights):
        table = element.tabulate(1, points)[:, :, :, 0]
        J = np.einsum("jqk,nki->nqij", table[1:], self.X[self.nodes])
        slopes = np.einsum("jqk,nqji->nqki", table[1:], np.linalg.inv(J))
        return table[0], slopes, weights * np.abs(np.linalg.det(J))

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
            nodes, values, _, outside = background.at(self.X + d)
            return nodes[self.nodes], values[self.nodes], outside.max(initial=0.0)
        F = self.gradient(d)[..., : self.dim, : self.dim]
        F = np.einsum("nq,nqij->nij", self.weights / self.weights.sum(axis=1, keepdims=True), F)
        x = self._mean(self.X[self.nodes] + d[self.nodes])
        arms = np.einsum("nij,nkj->nki", F, self.X[self.nodes] - self.centroid[:, None])
        if method == "cpdi":
            nodes, values, _, outside = background.at((x[:, None] + arms).reshape(-1, self.dim))
            return nodes.reshape(n, k, -1), values.reshape(n, k, -1), outside.max(initial=0.0)
        if method == "mpm":
            nodes, values, slopes, outside = background.at(x)
            whole = values[:, None] + np.einsum("nmi,nki->nkm", slopes, arms)
            return np.repeat(nodes[:, None], k, axis=1), whole, outside.max(initial=0.0)
        return (*self._boxes(background, x, F, arms), 0.0)

    def _boxes(self, background, x, F, arms):
        """Return the rows of contiguous boxes, by products of averaged hat functions."""
        half = 0.5 * np.ptp(self.X[self.nodes], axis=1)
        if self.particles.options()["domain_update"] == "stretch":
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
    if name in ("disc", "cylinder"):
        return np.linalg.norm(arm[:, : 2 if name == "cylinder" else None], axis=1) - size
    if name == "box":
        over = np.abs(arm) - (size - radius)
        inner = np.minimum(over.max(axis=1), 0.0)
        return np.linalg.norm(np.maximum(over, 0.0), axis=1) + inner - radius
    return None


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
        self.background = Background(run.bodies[0].V)
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
            and "contact" not in scene
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
        self.kappa = None

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
            arrays["gap"] = np.where(np.isfinite(touch.gap), touch.gap, 1e300)
            arrays["traction"] = touch.traction
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
            kept = points.converged_state()["gradient"].values
            F[..., :dim, :dim] += kept.reshape(*F.shape[:2], dim, dim)
        sigma = points.cauchy_stress()
        if self.law == "small":
            return F, sigma, sigma, None
        tau = np.linalg.det(F)[..., None, None] * sigma
        return F, np.einsum("...ik,...jk->...ij", tau, np.linalg.inv(F)), tau, None

    def _averaged_points(self, i, F):
        """Return what ``_points`` does where J is averaged over each domain.

        With Jbar = sum w J / sum w and Fbar = (Jbar/J)^(1/dim) F in the plane or in space,
        P : dF = tau : (dF F^-1) + 1/dim tr(tau) (d ln Jbar - tr(dF F^-1)), tau that of Fbar.
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
            sigma = self.run.problem.points[i].cauchy_stress()
            tau = np.linalg.det(bar)[..., None, None] * sigma
        pressure = np.trace(tau[..., :dim, :dim], axis1=-2, axis2=-1) / dim
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
        if self.is_elastic and self._summed:
            before = self.forces
            self.forces = [self._nodal(i)[0] for i in range(len(self.domains))]
            self.work += sum(
                0.5 * float(np.sum((a + b) * (now - then)))
                for a, b, now, then in zip(
                    before, self.forces, self.present, self.previous, strict=True
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
            np.abs(self.background.x).max(), np.abs(domains.X + self.present[i]).max(initial=0)
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
            if self.exact:
                self._check_balance(found, figures)
            if self.run.contact is not None:
                self._check_contact(found, figures)
            if self.run.time is not None:
                self._check_account(found, figures)
            elif (self.whole and not self.exact) or "contrast" in self.scene:
                self._check_total(found, figures)
            # Round-off of stiff stresses does work on whole displacements.
            if self.is_elastic and self._summed and "contrast" not in self.scene:
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

    def _check_balance(self, found, figures):
        """Sum element forces on the background: zero at all free dofs."""
        dim = self.domains[0].dim
        totals = np.zeros((4, self.background.size, dim))
        active = np.zeros(self.background.size)
        for i, domains in enumerate(self.domains):
            nodes, values, _ = domains.rows(self.background, self.previous[i])
            self._nodal(i)
            for total, part in zip(totals, self._by_domain, strict=True):
                carried = np.einsum("nkm,nki->nkmi", values, part)
                np.add.at(total, nodes, carried)
            np.add.at(active, nodes, np.abs(values))
        totals = self.comm.allreduce(totals)
        active = self.comm.allreduce(active)
        internal, outer, floor, absolute = totals
        fixed = np.zeros((self.background.size, dim), dtype=bool)
        for bc in self.run.bcs:
            V = self.run.bodies[0].V
            start = V.dofmap.index_map.local_range[0] * dim
            for own in self.comm.allgather(_compat.own_dofs(bc, V) + start):
                fixed.ravel()[own] = True
        residual = internal - outer
        free = ~fixed & (active > 1e-12)[:, None]
        size = float(np.linalg.norm(residual[free]))
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
            if not gap <= 1e-7 * scale + 30.0 * np.sqrt(self.background.size) * np.linalg.norm(
                floor
            ):
                found.append(f"a reaction differs by {gap / max(scale, 1e-300):.1e}")

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
        if self.run.contact is not None and len(self.run.bodies) == 1:
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
        touch, data = self.run.contact, self.scene["contact"]
        pressure, gap = touch.pressure, touch.gap
        size = np.linalg.norm(touch.traction, axis=1)
        shear = np.sqrt(np.maximum(size**2 - pressure**2, 0.0))
        stiff = self.run.young
        floor = 1e-7 * stiff * max(np.abs(gap[np.isfinite(gap)]).max(initial=0.0), 1e-12)
        moves = self.run.time is not None and self.scene["motion_of"]["scheme"] != "euler"
        if (pressure < -floor).any():
            found.append("a contact pulls")
        if not moves and (pressure[gap > 1e-9] > 0.0).any():
            found.append("a contact acts at a gap")
        most = data["friction"] * pressure + data["cohesion"]
        if moves and data["friction"] == data["cohesion"] == 0.0:
            most = most + size  # (a direction of the whole step)
        # (told is the vector alone: where it is nearly normal, its square loses digits)
        if not moves and (shear > most + floor + 1e-7 * size).any():
            found.append("friction is beyond Coulomb's cone")
        if "obstacle" in data and data["turn"] == 0.0:
            exact = distance(data["obstacle"], touch.points - touch.offset)
            if exact is not None and np.abs(exact - gap).max(initial=0.0) > 1e-9:
                found.append("a gap is wrong")
        figures["depth"] = self.comm.allreduce(float(-gap.min(initial=0.0)), MPI.MAX)
        if not moves and self.run.time is None and len(self.run.bodies) == 2:
            force = self.run.problem.reaction(touch)
            held = [np.asarray(self.run.problem.reaction(bc)) for bc in self.run.bcs]
            scale = max(np.abs(f).max() for f in (force, *held))
            error = max(np.abs(held[1] + force).max(), np.abs(held[0] - force).max())
            if error > 1e-7 * scale + 1e-10 * self.run.young:
                found.append(f"a pair is out of balance by {error / scale:.1e}")

    def _check_account(self, found, figures):
        """Look at the account of energies of a motion: it closes, and nothing is won."""
        energies = self.run.problem.history.energies
        balance = np.array([energy.balance for energy in energies])
        whole = np.array([energy.kinetic + energy.strain for energy in energies])
        figures["account"] = float(np.abs(balance - balance[0]).max() / whole[0])
        figures["won"] = float(whole.max() / whole[0] - 1.0)
        if figures["account"] > 1e-9:
            found.append(f"the account of energies does not close by {figures['account']:.1e}")
        # (midpoint: energy of large strains to second order)
        if figures["won"] > (0.05 if self.scene["motion_of"]["scheme"] == "midpoint" else 1e-7):
            found.append(f"energy is won, {figures['won']:.1e}")

    def _check_energy(self, found, figures):
        """Compare the stored energy with the work of stress along the path.

        The work of a step is that of the mean force, which is exact for a quadratic energy: the
        next term is as much smaller as the step's strain is below one.
        """
        stored, work = self.comm.allreduce(self._stored()), self.comm.allreduce(self.work)
        strain = self.comm.allreduce(self.stretch, MPI.MAX)
        error = abs(stored - work) / self.most if self.most > 0 else 0.0
        figures["energy"] = error
        figures["strain"] = strain
        if error > 1e-6 + 0.5 * strain:
            found.append(f"stored energy and work differ by {error:.1e}")

    def _check_yield(self, found, figures):
        """Evaluate the yield function."""
        data = self.scene["material"]
        worst = -np.inf
        for i, body in enumerate(self.run.bodies):
            alive = ~body.deleted
            _, _, tau, _ = self._points(i)
            dev = tau - np.trace(tau, axis1=-2, axis2=-1)[..., None, None] / 3 * np.eye(3)
            kappa = body._response.plastic_strain()
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
