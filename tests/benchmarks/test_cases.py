# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The cases of the benchmarks: each runs, reports numbers within bounds, and makes a picture."""

import json
import runpy
import sys
from pathlib import Path

import numpy as np
import programs
import pytest
from marks import all_but
from scenes import WORLD

import mpm_dolfinx as mpm

CASES = Path(__file__).parents[2] / "benchmarks" / "cases"
#: Programs that ``make test`` runs, and numbers that it leaves to ``make test-all``.
SHORT = ("compaction",)
LONG = {
    *("sand-damped", "sand-dilates", "notch", "retrogression"),
    *("adjoint", "lshape-adapt", "pile", "softening-turned"),
    *("cone", "cryer", "footing-weight", "wedge", "gradient-degree-2", "footing-friction"),
    *("gradient", "hertz-pair", "weight-recommended", "circle-recommended", "incline", "sand"),
    *("vortex", "disc", "discs", "discs-contact", "column"),
    *("dam-recommended", "embankment-stiff", "embankment-recommended"),
    *("indentation", "cantilever"),
    *(
        "pipe",
        "mandel",
        "consolidation",
        "cylinder",
        "footing-recommended",
        "embankment",
        "softening",
    ),
    *("expansion", "taylor", "ironing", "wall-degree-1", "sphere-coarse", "structures-pull-out"),
    *("footing", "distortion", "ufl", "block-tet", "roller-tri", "free-quad", "free-domain"),
    *(
        "slope",
        "slope-water",
        "vertical-cut",
        "footing-weight-rough",
        "footing-edge",
    ),
    *("finer-footing", "mixed-footing"),
    *("stiff-footing", "sphere", "sphere-penalty", "sphere-tets", "expansion-whole", "pile-deep"),
    *("taylor-whole", "pipe-fine", "pipe-rough", "wedge-fine", "ironing-stiff"),
    *("collapse-patch", "roller-hex", "compaction-tri", "compaction-mpm", "roller-patch"),
}
COMMON = {"completed", "load", "iterations", "cutbacks", "failure"}

RUNS = {
    "compaction-quad": ("compaction", "--elements 8", {"error": 1e-2, "error_position": 1e-3}),
    "compaction-degree-2": (
        "compaction",
        "--elements 8 --degree 2 --steps 20",
        {"error": 9.2e-4, "error_position": 2e-4},
    ),
    "cantilever": (
        "cantilever",
        "--degree 2 --offset 0.05 --steps 25",
        {"error": 3e-4, "iterations": 140, "cutbacks": 0},
    ),
    "wall": ("wall", "", {"iterations": 1}),
    "lshape-adapt": (
        "lshape",
        "--cells 8 --offset 0.37 --degree 2 --adapt 0.02",
        {"error": 0.0605, "error_all_free": 0.0585, "unknowns": 2000, "iterations": 4},
    ),
    "wall-degree-1": ("wall", "--degree 1", {"iterations": 1}),
    "structures": ("structures", "", {"error": 5e-4, "iterations": 1}),
    "structures-lining": ("structures", "--case lining", {"error": 1.2e-3}),
    "structures-pull-out": ("structures", "--case pull-out", {"error": 1e-6}),
    "consolidation": (
        "consolidation",
        "--settlement 0.3",
        {"pressure_error": 7.5e-3, "settlement_error": 5e-3, "iterations": 16},
    ),
    "mandel": (
        "mandel_cryer",
        "--case slab --cells 4",
        {"error": 5e-3, "error_force": 4e-3, "iterations": 112, "cutbacks": 0},
    ),
    "cryer": ("mandel_cryer", "--cells 8", {"error": 0.025, "iterations": 112, "cutbacks": 0}),
    "seepage": ("seepage", "--cell 0.25 --depth 0.75", {"error": 0.01, "iterations": 1}),
    "cantilever-mixed": (
        "cantilever",
        "--degree 2 --mixed pressure --poisson 0.4999 --steps 10",
        {"error": 5e-4, "iterations": 50, "cutbacks": 0},
    ),
    "compaction-tri": (
        "compaction",
        "--elements 8 --domain tri",
        {"error": 1.5e-2, "error_position": 2e-3},
    ),
    "roller-quad": (
        "column_roller",
        "--elements 8",
        {"error_syy": 9e-3, "error_sxx": 7e-3, "yield_violation": 1e-8},
    ),
    "roller-tri": (
        "column_roller",
        "--elements 8 --domain tri --steps 20",
        {"error_syy": 1.5e-2, "error_sxx": 1e-2, "yield_violation": 1e-8},
    ),
    "roller-small-strain": (
        "column_roller",
        "--elements 8 --small-strain --young 2e8 --steps 10",
        {"error_syy": 1.05 / 32, "error_sxx": 1.05 / 32, "yield_violation": 1e-8},
    ),
    "free-tri": (
        "column_free",
        "--cell 1 --steps 20 --g0 15e3",
        {"yield_violation": 1e-8, "cutbacks": 2},
    ),
    "free-quad": (
        "column_free",
        "--domain quad --cell 1 --steps 20 --g0 15e3 --on-distortion split",
        {"yield_violation": 1e-8, "cutbacks": 2},
    ),
    "ufl": ("ufl_material", "--elements 4 --steps 12", {"difference": 1e-2}),
    "compaction-gimp": (
        "compaction",
        "--elements 16 --method gimp",
        {"error": 1.02 * 3.659e-3, "iterations": 130},
    ),
    "compaction-mpm": ("compaction", "--elements 16 --method mpm", {"error": 0.1}),
    "roller-hex": (
        "column_roller",
        "--elements 8 --domain hex --steps 10",
        {"error_syy": 9e-3, "yield_violation": 1e-8},
    ),
    "distortion": (
        "domain_distortion",
        "--steps 8",
        {"gap_cpdi2": 1e-12, "overlap_cpdi2": 1e-12, "error_F_cpdi2": 0.2},
    ),
    "cylinder": (
        "cylinder",
        "--elements 8",
        {"error_axisymmetric": 1e-3, "error_plane": 1e-3},
    ),
    "expansion": (
        "expansion",
        # (in fewer steps, and with other offsets, round-off decides whether a step is cut back)
        "--cells 4 --steps 36 --widest 4 --offset 0.25",
        {"error_early": 1e-4, "error": 1e-4, "iterations": 260, "cutbacks": 0},
    ),
    "expansion-whole": ("expansion", "", {"error_early": 1e-5, "error": 1e-5, "iterations": 800}),
    "crossing": ("cell_crossing", "--steps 20", {"scatter_cpdi2": 0.02, "scatter_gimp": 0.025}),
    "block-hex": ("block3d", "--elements 2 --steps 20", {"volume_error": 0.05}),
    "block-tet": (
        "block3d",
        "--elements 2 --steps 20 --domain tet --plates smooth",
        {"volume_error": 1e-9},
    ),
    "collapse": ("collapse", "--cell 2 --particles-per-cell 2 --steps 20", {"u_top": -2.69}),
    "collapse-patch": ("collapse", "--cell 2 --f-bar patch --steps 20", {"u_top": -2.6}),
    "footing": (
        "footing",
        "--cell 0.25 --steps 16",
        {"ratio": 1.04, "plateau": 0.005, "drop": 3e-3},
    ),
    "slope": ("strength", "--case slope --cell 0.2", {"ratio": 1.06}),
    "slope-water": ("strength", "--case slope --water 0.7", {"factor": 1.33}),
    "dam-recommended": (
        "strength",
        "--case dam --water 0.197 --recommended --cell 0.25 --dilation-angle 37",
        {"ratio": 1.0158, "iterations": 200, "cutbacks": 0},  # 0.03 of their factor
    ),
    "vertical-cut": ("strength", "--case vertical_cut --cell 0.125", {"ratio": 1.08}),
    "embankment": (
        "embankment",
        "--lifts 2 --tolerance 0.2",
        {"most_solves": 8, "cutbacks": 0, "factor": 2.4},
    ),
    "embankment-stiff": (
        "embankment",
        "--line 0.4 --stiffness 100",  # 3 % of the 2.04 of its slope
        {"most_solves": 8, "cutbacks": 0, "factor": 2.101},
    ),
    "embankment-recommended": (
        "embankment",
        "--recommended --lifts 2 --stiffness 100 --dilation-angle 32",
        {"most_solves": 16, "cutbacks": 0, "factor": 2.101},
    ),
    "circle-recommended": (
        "strength",
        "--case circle --recommended --halvings 2 --steps 8",
        {"ratio": 1.02, "cutbacks": 0, "iterations": 96},
    ),
    "footing-recommended": (
        "strength",
        "--case footing --recommended --halvings 2 --steps 8",
        {"ratio": 1.02, "cutbacks": 0, "iterations": 96},
    ),
    "weight-recommended": (
        "strength",
        "--case footing_weight --recommended --halvings 2 --steps 20",
        {"ratio": 1.035, "cutbacks": 0, "iterations": 240},
    ),
    "footing-friction": (
        "strength",
        "--case footing --cell 0.25 --degree 2 --steps 10",
        {"ratio": 1.045, "cutbacks": 0},
    ),
    "footing-weight": (
        "strength",
        "--case footing_weight --cell 0.25 --friction-angle 30 --degree 2 --steps 12 --f-bar none "
        "--domains-per-cell 1 --quadrature-degree 3 --stabilisation none",
        {"ratio": 1.025, "cutbacks": 2},
    ),
    "footing-weight-rough": (
        "strength",
        "--case footing_weight --cell 0.25 --friction-angle 30 --degree 2 --steps 12 --f-bar none "
        "--domains-per-cell 1 --quadrature-degree 3 --stabilisation none --rough",
        {"ratio": 1.012, "cutbacks": 3},
    ),
    "footing-edge": (
        "footing",
        "--cell 0.25 --finer 2 --degree 2 --mixed pressure --particles-per-cell 1 "
        "--stabilisation none",
        {"ratio": 1.012, "peak": 1.018, "drop": 2e-3, "most_solves": 8, "cutbacks": 0},
    ),
    "rounded-footing": (
        "penetration",
        "--obstacle footing --cell 0.25 --steps 10",
        {"ratio": 1.17, "cutbacks": 0, "iterations": 50, "penetration": 0.01},
    ),
    "finer-footing": (
        "penetration",
        "--obstacle footing --finer 2 --law nitsche",
        {"ratio": 1.04, "cutbacks": 0, "iterations": 180},
    ),
    "mixed-footing": (
        "penetration",
        "--obstacle footing --degree 2 --domains-per-cell 1 --mixed pressure",
        {"ratio": 1.015, "cutbacks": 0, "iterations": 150},
    ),
    "stiff-footing": (
        "penetration",
        "--obstacle footing --young 5e4 --depth 6e-4 --radius 0.002 --law nitsche",
        {"ratio": 1.03, "cutbacks": 0, "iterations": 260, "penetration": 1e-4},
    ),
    "hertz": ("hertz", "", {"pressure_error": 0.067, "half_width": 1.035, "iterations": 24}),
    "hertz-pair": (
        "hertz",
        "--pair --law nitsche --degree 2 --steps 4",
        {"pressure_error": 0.014, "half_width": 1.0, "force": 1.0, "iterations": 28},
    ),
    "sphere": (
        "sphere",
        "--law nitsche",
        {"error_force": 0.03, "error_radius": 0.03, "error_pressure": 0.08, "iterations": 20},
    ),
    "sphere-penalty": (
        "sphere",
        "",
        {"error_force": 0.03, "error_radius": 0.03, "error_pressure": 0.08, "iterations": 26},
    ),
    "sphere-tets": (
        "sphere",
        "--domain tet",
        {"error_force": 0.03, "error_radius": 0.03, "error_pressure": 0.08, "iterations": 24},
    ),
    "sphere-coarse": (
        "sphere",
        "--cells 3 --law nitsche --penalty 0.5",
        {"error_force": 0.04, "error_radius": 0.01, "error_pressure": 0.08},
    ),
    "incline": (
        "incline",
        "--friction 0.5 --domain tri --tilt 20",
        {"stick_angle": 26.5651, "ratio": 0.5 + 1e-9},
    ),
    "ironing": (
        "ironing",
        "",
        {"cutbacks": 0, "iterations": 140, "scatter": 0.004, "ratio": 0.2995},
    ),
    "ironing-stiff": (
        "ironing",
        "--stiff",
        {"cutbacks": 0, "iterations": 150, "scatter": 0.004, "ratio": 0.299},
    ),
    "cone": (
        "cone",
        "--depth 0.5 --cell 0.5 --steps 12",
        {"cutbacks": 0, "iterations": 85, "factor": 6.2},
    ),
    "pipe": ("pipe", "--steps 6 --cell 0.25", {"ratio": 1.06, "cutbacks": 0, "iterations": 80}),
    "pipe-fine": ("pipe", "--steps 6", {"ratio": 1.03, "cutbacks": 0, "iterations": 120}),
    "pipe-rough": (
        "pipe",
        "--rough --free",
        {"ratio": 1.01, "plateau": 2e-3, "cutbacks": 0, "iterations": 210},
    ),
    "wedge": (
        "penetration",
        "--obstacle wedge --depth 0.5 --cell 0.25",
        {"ratio": 1.085, "cutbacks": 0, "iterations": 380},
    ),
    "wedge-fine": (
        "penetration",
        "--obstacle wedge --depth 0.5",
        {"ratio": 1.045, "cutbacks": 0, "iterations": 500},
    ),
    "pile": (
        "penetration",
        "--obstacle pile --friction 0.5 --depth 0.05 --steps 5 --tangential-penalty 1",
        {"cutbacks": 0, "iterations": 66},
    ),
    "pile-deep": (
        "penetration",
        "--obstacle pile --friction 0.5 --depth 1 --steps 100 --tangential-penalty 1",
        {"cutbacks": 5, "iterations_per_step": 12.0},
    ),
    "disc": ("penetration", "", {"cutbacks": 0, "iterations": 520, "force": 7.0}),
    "snap-through": ("snap_through", "--steps 12", {"error": 5e-3, "cutbacks": 0}),
    "roller-patch": (
        "column_roller",
        "--elements 6 --steps 10 --f-bar patch --particles-per-cell 3",
        {"error_syy": 1.4e-2, "error_sxx": 9e-3},
    ),
    "free-domain": (
        "column_free",
        "--domain quad --cell 1 --particles-per-cell 1 --f-bar domain --steps 20 --g0 15e3",
        {"yield_violation": 1e-8, "cutbacks": 4},
    ),
    "gmsh": (
        "gmsh_body",
        "--size 0.25 --body-size 0.2 --steps 8",
        {"error_reaction": 1e-6, "error_area": 2e-2},
    ),
    "bar": (
        "flying_bar",
        "--steps 100 --out-of-range reflect",
        {"energy_largest": 1e-11, "momentum_error": 1e-12, "balance_error": 1e-12},
    ),
    "block": (
        "spinning_block",
        "--turn 0.8 --cell 0.2",
        {"energy_largest": 1e-11, "angular_momentum_change": 1e-11, "iterations_per_step": 4.0},
    ),
    "discs": (
        "colliding_discs",
        "--steps 10",
        {"energy_largest": 1e-11, "momentum_error": 1e-12, "balance_error": 1e-12},
    ),
    "discs-contact": (
        "colliding_discs",
        "--fields two --cell 0.1 --dt 0.05",
        {
            "energy_largest": 1e-6,
            "momentum_error": 1e-11,
            "angular_momentum_error": 1e-11,
            "force_at_gap": 0.02,
        },
    ),
    "vortex": ("vortex", "", {"displacement_error": 4.6e-2, "velocity_error": 1.26e-1}),
    "sand": (
        "sand_column",
        "--aspect 0.5 --cell 0.1667 --rayleigh 0",
        {"ratio": 1.15, "kinetic_left": 0.05},
    ),
    "retrogression": (
        "retrogression",
        "--cells 5 --crest 8 --length 1 --decay 20 --time 2 --steps 20",
        {"cutbacks": 2},
    ),
    "slope-stands": (  # 45 % stronger than Taylor's chart asks for
        "retrogression",
        "--cells 4 --crest 8 --length 1.3 --peak 25 --time 1 --steps 5",
        {"run_out": 0.02, "retrogression": 0.0},
    ),
    "sand-damped": (
        "sand_column",
        "--aspect 2 --cell 0.1 --rayleigh 1.6e-5",
        {"ratio": 1.15, "kinetic_left": 1e-4, "cutbacks": 35},
    ),
    "sand-dilates": (
        "sand_column",
        "--aspect 2 --cell 0.1 --rayleigh 1e-5 --cohesion 1e3 --dilation-angle 10",
        {"ratio": 1.3, "kinetic_left": 1e-3, "cutbacks": 35},
    ),
    "free-body": (
        "free_body",
        "--scene block --size 3 --steps 2",
        {"difference": 1e-9, "iterations": 12, "cutbacks": 0},
    ),
    "softening": (
        "softening",
        "--cells 10 --length 0.25 --steps 6",
        {"iterations": 260, "cutbacks": 0},
    ),
    "softening-turned": (
        "softening",
        "--case biaxial --cells 5 --length 0.3 --angle 30 --steps 4",
        {"iterations": 120, "cutbacks": 0},
    ),
    "lshape": ("lshape", "--offset 0.37", {"error": 0.21, "estimate": 0.21, "iterations": 1}),
    "gradient": (
        "gradient",
        "--parameters 2 --steps 4",
        {"difference": 1e-6, "trend": 0.02, "cutbacks": 0},
    ),
    "gradient-degree-2": (
        "gradient",
        "--kind elastic --degree 2 --cells 4 --parameters 2 --steps 4",
        {"difference": 1e-6, "trend": 1e-3, "cutbacks": 0},
    ),
    "notch": (
        "notch",
        "--body free --steps 20",
        {"energy": 1.05, "fallen": 1e-10, "iterations": 220, "cutbacks": 0},
    ),
    "indentation": (
        "indentation",
        "--steps 1",
        {"stiffness": 13567 * 1.05, "inverse_runs": 6, "inverse_error": 1e-8, "cutbacks": 0},
    ),
    "adjoint": (
        "gradient",
        "--mode adjoint --parameters 20 --steps 4",
        {"difference": 1e-6, "trend": 0.02, "cutbacks": 0},
    ),
    "taylor": (
        "taylor",
        "--time 10",
        {"length": 30.3, "radius": 5.3, "strain": 1.3, "lift": 0.2, "cutbacks": 0},
    ),
    "taylor-whole": (
        "taylor",
        "--f-bar domain",
        {"length": 21.7, "radius": 7.24, "strain": 3.6, "lift": 0.3, "cutbacks": 0},
    ),
    "column": ("column_dynamic", "--time 0.4", {"cutbacks": 0, "balance_error": 1e-12}),
}
#: Cases that go through time, whose load is that.
IN_TIME = {
    "sand_column",
    "retrogression",
    "flying_bar",
    "spinning_block",
    "consolidation",
    "indentation",
    "mandel_cryer",
    "colliding_discs",
    "column_dynamic",
    "seepage",
    "taylor",
}
#: Cases that end before their whole load.
ENDS = {"snap_through", "expansion", "notch", "incline"}
KEYS = {
    "compaction": {"error", "error_position", "particles"},
    "cantilever": {"shortening", "deflection", "error"},
    "column_roller": {"error_syy", "error_sxx", "top", "particles", "yield_violation"},
    "column_free": {"top", "toe", "y_mean", "yield_violation", "worst_domain", "split_domains"},
    "ufl_material": {"difference"},
    "domain_distortion": {
        f"{what}_{method}"
        for what in ("gap", "overlap", "error_F")
        for method in ("mpm", "gimp", "cpdi", "cpdi2")
    },
    "cylinder": {"error_axisymmetric", "error_plane", "rate"},
    "embankment": {"built", "factor", "reason"},
    "expansion": {"radius", "error_early", "error", "particles"},
    "cell_crossing": {f"scatter_{method}" for method in ("mpm", "gimp", "cpdi", "cpdi2")},
    "block3d": {"height", "barrel", "volume_error", "reaction"},
    "gmsh_body": {"error_reaction", "error_area"},
    "collapse": {"u_top", "u_toe"},
    "footing": {"pressure", "limit", "ratio", "plateau", "drop"},
    "flying_bar": {"energy_change", "displacement_error", "velocity_error", "momentum_error"},
    "spinning_block": {"energy_change", "angular_momentum_change", "iterations_per_step"},
    "colliding_discs": {"energy_change", "rebound", "momentum_error"},
    "vortex": {"displacement_error", "velocity_error"},
    "column_dynamic": {"toe", "top"},
    "taylor": {"length", "radius", "strain", "lift"},
    "sand_column": {"runout", "experiment", "ratio", "outermost", "front", "height_at_wall"},
    "retrogression": {"run_out", "retrogression", "kinetic_left", "alternations"},
    "strength": {"factor", "exact", "ratio", "reason", "plateau", "particles"},
    "consolidation": {"pressure_error", "degree", "settlement_error", "particles"},
    "seepage": {"discharge", "exact", "error"},
    "cone": {"factor", "exact", "rise"},
    "pipe": {"factor", "exact", "ratio", "plateau"},
    "mandel_cryer": {"peak", "exact", "error", "error_force"},
    "penetration": {"force", "depth", "ratio", "iterations_per_step", "penetration"},
    "incline": {"stick_angle", "exact", "ratio"},
    "ironing": {"force", "scatter", "ratio"},
    "hertz": {
        *("pressure_error", "max_pressure", "half_width", "force", "line_search_halvings"),
    },
    "sphere": {"force", "error_force", "error_radius", "error_pressure", "error_most"},
    "free_body": {"difference", "seconds_ratio", "unknowns"},
    "lshape": {"error", "estimate", "unknowns", "error_all_free", "unknowns_carried"},
    "gradient": {"taylor", "difference", "trend", "seconds_ratio"},
    "notch": {"peak", "energy", "crack_length", "alternations", "fallen"},
    "indentation": {"stiffness", "inverse_runs", "inverse_error"},
    "snap_through": {"limit", "valley", "crown", "error"},
    "wall": {"head", "reference", "error", "unknowns", "unknowns_carried"},
    "structures": {"force", "error"},
    "softening": {"peak", "energy", "width", "forces", "alternations"},
}


def run(name, arguments, capfd):
    """Run a case on all ranks, in this process; return status and rank 0's standard output."""
    path = CASES / f"{name}.py"
    argv, hook, search = sys.argv, sys.excepthook, sys.path[:]
    sys.argv = [str(path), *arguments]
    sys.path.insert(0, str(CASES))
    status = 0
    try:
        runpy.run_path(str(path), run_name="__main__")
    except SystemExit as stop:
        status = stop.code or 0
    finally:
        sys.argv, sys.excepthook, sys.path[:] = argv, hook, search
    return status, WORLD.bcast(capfd.readouterr().out)


@pytest.mark.parametrize("case", all_but(RUNS.keys() - LONG, RUNS))
def test_numbers(case, capfd):
    name, arguments, bounds = RUNS[case]
    if name == "gmsh_body":
        pytest.importorskip("gmsh", exc_type=(ImportError, OSError))
    status, out = run(name, [*arguments.split(), "--json"], capfd)
    assert status == 0
    numbers = json.loads(out)
    assert COMMON | KEYS[name] <= numbers.keys()
    timed = {key for key in numbers if "time" in key or "seconds" in key}
    assert timed == ({"seconds_ratio"} if name in ("free_body", "gradient") else set())
    assert numbers["completed"] == 1 and numbers["failure"] is None
    assert numbers["load"] == 1.0 or name in ENDS | IN_TIME
    assert (numbers["iterations"] > 0) == (name != "domain_distortion")  # there all is prescribed
    for key, bound in bounds.items():
        assert numbers[key] <= bound, key
    if case == "compaction-mpm":
        assert numbers["error"] > 6e-2 and numbers["iterations"] <= 170
    if name == "wall":
        degree = 1 if "--degree 1" in arguments else 2
        assert abs(numbers["error"]) < (0.012 if degree == 1 else 1e-3)
        assert degree == 1 or numbers["unknowns"] < 1.25 * numbers["unknowns_carried"]
    if name == "block3d":
        assert abs(numbers["height"] - 1.2) < 1e-3
    if case == "dam-recommended":
        assert numbers["ratio"] > 0.9842 and numbers["reason"] == "flow"
    if name in ("strength", "footing", "penetration") and numbers.get("ratio"):
        assert numbers["ratio"] > 0.9
    if case == "softening":
        assert abs(numbers["width"] / (3.4389 * 0.25) - 1.0) < 0.04  # that of the closed form
        assert 0.9 < numbers["peak"] < 1.0
    if name == "cone":
        assert numbers["factor"] > 5.8 and numbers["rise"] is None  # on so short a way
    if name == "incline":
        assert numbers["stick_angle"] > numbers["exact"] - 0.008 and numbers["ratio"] > 0.499
    if name == "ironing":
        assert numbers["ratio"] > 0.295
    if name == "embankment":
        assert numbers["built"] == 1 and numbers["factor"] > (1.98 if "ness" in arguments else 1.9)
    if name == "gradient":
        assert abs(numbers["taylor"] - 2.0) < 0.05
    if name == "sand_column":
        assert numbers["ratio"] > 0.85
    if case == "retrogression":
        assert numbers["retrogression"] > 1.5 * numbers["run_out"] > 1.5
    if name in ("compaction", "column_roller") and "--elements 8" in arguments:
        each = 2 if "tri" in arguments or "hex" in arguments else 1
        assert numbers["particles"] == 32 * each
    if name == "column_free":
        # Volume is kept but for elasticity: the mean height times the width is that of a slab.
        assert 8.0 < numbers["toe"] < 15.0 and 0.0 < numbers["worst_domain"] <= 1.0 + 1e-9
        assert 1.2 < numbers["y_mean"] < 2.5
    if case == "roller-small-strain":
        assert numbers["error_syy"] > 0.95 / 32


@pytest.mark.slow
def test_a_crack_in_shear_is_that_of_stock_dolfinx(capfd):
    """Force and energies of each step, to beyond the peak, and where the crack is."""
    small = "--case shear --model AT2 --length 0.16 --body free --steps 9 --reach 0.0108 --json"
    found = []
    for solver in ("staggered", "stock"):
        status, out = run("notch", [*small.split(), "--solver", solver], capfd)
        assert status == 0
        found.append(json.loads(out))
    curves = [np.array(one["curve"])[1:] for one in found]
    np.testing.assert_allclose(*curves, rtol=3e-3)
    np.testing.assert_allclose(curves[0][:-1], curves[1][:-1], rtol=5e-4)
    assert curves[0][-1, 1] < 0.9 * curves[0][:, 1].max()
    np.testing.assert_allclose(*[np.array(one["crack"]) for one in found], atol=0.02 * 0.16)


def test_plain_solver_reports_its_end(capfd):
    # It ends in one of our errors or, by luck, completes; the status is 0 either way.
    arguments = "--domain quad --cell 1 --g0 80e3 --steps 10 --plain-solver --json".split()
    status, out = run("column_free", arguments, capfd)
    assert status == 0
    numbers = json.loads(out)
    if numbers["completed"] == 1:
        assert numbers["failure"] is None and numbers["load"] == 1.0
    else:
        assert numbers["completed"] == 0 and numbers["load"] < 1.0
        assert numbers["failure"] in (
            "ConvergenceError",
            "DomainDistortionError",
            "ParticleOutsideError",
        )


def test_column_goes_on_from_its_checkpoint(mpi_tmp_path, capfd, monkeypatch):
    arguments = "--cell 2 --steps 6 --g0 8e3 --json".split()
    _, whole = run("column_free", arguments, capfd)
    arguments += ["--checkpoint", str(mpi_tmp_path / "column.ckpt"), "--resume"]

    saved = []

    def save(problem, *arguments, **options):
        original(problem, *arguments, **options)
        saved.append(problem.history.load[-1])
        if len(saved) == 3:
            raise KeyboardInterrupt

    original = mpm.Problem.save
    with monkeypatch.context() as patch:
        patch.setattr(mpm.Problem, "save", save)
        with pytest.raises(KeyboardInterrupt):
            run("column_free", arguments, capfd)
    capfd.readouterr()
    status, resumed = run("column_free", arguments, capfd)
    assert status == 0 and saved == [1 / 6, 2 / 6, 3 / 6]
    whole, resumed = json.loads(whole), json.loads(resumed)
    for key, value in whole.items():
        close = WORLD.size > 1 and value is not None
        assert resumed[key] == (pytest.approx(value, rel=1e-9) if close else value), key
    assert run("column_free", ["--resume"], capfd)[0] == 2
    assert run("column_free", ["--on-distortion", "split"], capfd)[0] == 2  # of triangles


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        pytest.param(
            "compaction",
            "--elements 4 --steps 10",
            marks=[pytest.mark.skip_in_parallel, pytest.mark.slow],
        ),
        pytest.param("column_roller", "--elements 8 --steps 10", marks=pytest.mark.slow),
        ("column_free", "--cell 1 --steps 10 --g0 10e3"),
        pytest.param(
            "ufl_material",
            "--elements 4 --steps 4",
            marks=[pytest.mark.skip_in_parallel, pytest.mark.slow],
        ),
    ],
)
def test_picture(name, arguments, mpi_tmp_path, capfd):
    picture = mpi_tmp_path / "out" / "picture.png"
    status, out = run(name, [*arguments.split(), "--plot", str(picture)], capfd)
    assert status == 0
    assert out.strip() and not out.lstrip().startswith("{")
    WORLD.Barrier()
    assert picture.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert picture.stat().st_size > 5000


@pytest.mark.parametrize("name", KEYS)
def test_help_and_unknown_values(name, capfd):
    status, out = run(name, ["--help"], capfd)
    assert status == 0
    for option in ("--json", "--plot", "--steps"):
        assert option in out
    for wrong in (["--steps", "0"], ["--nonsense"], ["--plot", "picture.txt"]):
        assert run(name, wrong, capfd)[0] == 2
    if "--domain" in out:
        assert run(name, ["--domain", "circle"], capfd)[0] == 2


def test_numbers_do_not_depend_on_the_number_of_ranks(capfd):
    # Recorded from a run on one rank.
    _, out = run("compaction", ["--elements", "8", "--json"], capfd)
    numbers = json.loads(out)
    assert abs(numbers["error"] - 0.009023004507322848) < 1e-9
    assert numbers["iterations"] == 85


@pytest.mark.skip_in_parallel
@pytest.mark.parametrize("name", all_but(SHORT, KEYS))
def test_case_is_a_program(name, tmp_path):
    # From another directory, in a process of its own, which leaves nothing behind.
    small = {
        "column_free": "--cell 2 --steps 5 --g0 5e3",
        "cantilever": "--cell 1 --steps 10",
        "domain_distortion": "--steps 4",
        "cell_crossing": "--cells 4 --steps 4",
        "block3d": "--elements 2 --steps 4",
        "collapse": "--cell 2 --particles-per-cell 1 --f-bar domain --steps 4",
        "footing": "--cell 0.5 --steps 4",
        "consolidation": "--cell 0.25 --steps 2",
        "mandel_cryer": "--cells 2",
        "expansion": "--cells 2 --steps 4 --widest 2",
        "strength": "--cell 0.5",
        "embankment": "--lifts 1 --line 2 --tolerance 0.5",
        "gmsh_body": "--size 0.3 --body-size 0.3 --steps 2",
        "snap_through": "--cell 1 --steps 4",
        "flying_bar": "--steps 4",
        "spinning_block": "--cell 0.25 --steps 4",
        "colliding_discs": "--steps 4",
        "vortex": "--steps 8",
        "column_dynamic": "--cell 1 --steps 20",
        "sand_column": "--cell 0.25 --time 0.1 --steps 5",
        "retrogression": "--cells 4 --crest 5 --length 1.3 --time 0.2 --steps 2",
        "hertz": "--cells 2 --steps 2",
        "sphere": "--cells 2 --steps 2",
        "penetration": "--cell 0.25 --depth 0.05 --steps 4",
        "incline": "--steps 5",
        "seepage": "--cell 0.5",
        "cone": "--cell 0.5 --depth 0.1 --steps 2",
        "ironing": "--steps 4",
        "lshape": "--cells 2",
        "free_body": "--size 2 --steps 2",
        "gradient": "--parameters 1 --steps 2",
        "indentation": "--steps 1",
        "wall": "--cell 1",
        "structures": "--cells 4",
        "softening": "--cells 6 --length 0.3 --steps 2",
    }.get(name, "--elements 4 --steps 4")
    done = programs.run(CASES / f"{name}.py", *small.split(), "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "Exception ignored" not in done.stderr and "Traceback" not in done.stderr
    assert COMMON <= json.loads(done.stdout).keys()
    assert not list(tmp_path.iterdir())
