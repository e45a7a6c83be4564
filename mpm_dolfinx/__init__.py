# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Implicit material point method with convected particle domains for DOLFINx."""

from . import _compat

_compat.require_supported()

from . import boundary, contact, materials, plot  # noqa: E402
from .assembly.volume_ratio import AveragedVolumeRatio  # noqa: E402
from .errors import (  # noqa: E402
    ConvergenceError,
    DomainDistortionError,
    MPMError,
    ParticleOutsideError,
)
from .gradients.adjoint import Adjoint  # noqa: E402
from .gradients.sensitivity import Sensitivity  # noqa: E402
from .gradients.tape import taped  # noqa: E402
from .history import Energy, History, Loss, Stage, Statistics, Step  # noqa: E402
from .io.record import Record  # noqa: E402
from .meshes.grid import grid, grid_lines  # noqa: E402
from .meshes.regions import cell_tags, facet_tags, held, region  # noqa: E402
from .particles.field import ParticleField  # noqa: E402
from .particles.particles import Particles  # noqa: E402
from .particles.probe import probe  # noqa: E402
from .particles.sections import SectionForces, section_forces  # noqa: E402
from .problems.body import Body, PoreFluid  # noqa: E402
from .problems.dynamic import DynamicParticleProblem, DynamicProblem  # noqa: E402
from .problems.initial_stress import geostatic  # noqa: E402
from .problems.particle_problem import ParticleProblem  # noqa: E402
from .problems.porous import PorousProblem  # noqa: E402
from .problems.problem import Problem  # noqa: E402
from .problems.quasistatic import QuasiStaticProblem  # noqa: E402
from .problems.solver import Solver  # noqa: E402
from .problems.strength import StrengthReduction, strength_reduction  # noqa: E402
from .problems.water_table import WaterTable  # noqa: E402
from .stepping.displacement_control import DisplacementControl  # noqa: E402
from .structures.bond import Bond  # noqa: E402
from .structures.membrane import Membrane  # noqa: E402
from .structures.truss import Truss  # noqa: E402
from .system.coupling import Tie  # noqa: E402
from .system.damage import Damage  # noqa: E402
from .system.field_equation import FieldEquation  # noqa: E402
from .system.schemes import Kinematics, Rates, Scheme  # noqa: E402
from .system.term import Term  # noqa: E402
from .transfer.weights import Weights  # noqa: E402

__version__ = "0.3.0"

__all__ = [
    "Adjoint",
    "AveragedVolumeRatio",
    "Body",
    "Bond",
    "ConvergenceError",
    "Damage",
    "DisplacementControl",
    "DomainDistortionError",
    "DynamicParticleProblem",
    "DynamicProblem",
    "Energy",
    "FieldEquation",
    "History",
    "Kinematics",
    "Loss",
    "MPMError",
    "Membrane",
    "ParticleField",
    "ParticleOutsideError",
    "ParticleProblem",
    "Particles",
    "PoreFluid",
    "PorousProblem",
    "Problem",
    "QuasiStaticProblem",
    "Rates",
    "Record",
    "Scheme",
    "SectionForces",
    "Sensitivity",
    "Solver",
    "Stage",
    "Statistics",
    "Step",
    "StrengthReduction",
    "Term",
    "Tie",
    "Truss",
    "WaterTable",
    "Weights",
    "__version__",
    "boundary",
    "cell_tags",
    "contact",
    "facet_tags",
    "geostatic",
    "grid",
    "grid_lines",
    "held",
    "materials",
    "plot",
    "probe",
    "region",
    "section_forces",
    "strength_reduction",
    "taped",
]


def __dir__() -> list[str]:
    """Return the public names."""
    return sorted(__all__)
