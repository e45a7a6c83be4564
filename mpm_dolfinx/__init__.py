# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Implicit material point method with convected particle domains for DOLFINx."""

from . import _compat

_compat.require_supported()

from . import boundary, materials, plot  # noqa: E402
from .displacement_control import DisplacementControl  # noqa: E402
from .errors import (  # noqa: E402
    ConvergenceError,
    DomainDistortionError,
    MPMError,
    ParticleOutsideError,
)
from .history import History, Loss, Statistics, Step  # noqa: E402
from .particles import Particles  # noqa: E402
from .problem import ParticleProblem  # noqa: E402
from .quasistatic import QuasiStaticProblem  # noqa: E402
from .transfer import Weights  # noqa: E402
from .volume_average import AveragedVolumeRatio  # noqa: E402

__version__ = "0.1.0"

__all__ = [
    "AveragedVolumeRatio",
    "ConvergenceError",
    "DisplacementControl",
    "DomainDistortionError",
    "History",
    "Loss",
    "MPMError",
    "ParticleOutsideError",
    "ParticleProblem",
    "Particles",
    "QuasiStaticProblem",
    "Statistics",
    "Step",
    "Weights",
    "__version__",
    "boundary",
    "materials",
    "plot",
]
