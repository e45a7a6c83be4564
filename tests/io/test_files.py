# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Files that cannot be written whole, and names that are taken by something else than a file."""

import os
import socket
import stat
from pathlib import Path

import programs
import pytest
import scenes
from marks import slow
from scenes import WORLD

import mpm_dolfinx as mpm

TESTS = str(Path(__file__).parents[1])

LIMITED = """
import resource, sys
sys.path.insert(0, {tests!r})
from pathlib import Path
import scenes
import mpm_dolfinx as mpm

path = Path({path!r})
problem = scenes.block()
problem.solve(1)
write = problem.{method}
write(path)
before = {{p.name: p.read_bytes() for p in path.parent.iterdir()}}
problem.particles.load.value = 1.1
problem.step()
resource.setrlimit(resource.RLIMIT_FSIZE, ({limit}, resource.RLIM_INFINITY))
try:
    write(path)
    print("no error")
except mpm.MPMError as error:
    print(error)
resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
after = {{p.name: p.read_bytes() for p in path.parent.iterdir()}}
print({{name: after.get(name) == content for name, content in before.items()}})
print(sorted(set(after) - set(before)))
write(path)
print("and then", sorted(p.name for p in path.parent.iterdir()))
"""


@pytest.mark.skip_in_parallel
@pytest.mark.parametrize(("method", "name"), [("save", "run.ckpt"), ("write", "run.pvd")])
@pytest.mark.parametrize("limit", [*slow(1), 2000])
def test_a_file_that_a_limit_cuts_is_an_error(method, name, limit, tmp_path):
    path = tmp_path / name
    script = LIMITED.format(tests=TESTS, path=str(path), method=method, limit=limit)
    done = programs.run("-W", "ignore", "-c", script, OMP_NUM_THREADS="1")
    assert done.returncode == 0, done.stderr
    told, same, left, then = done.stdout.splitlines()
    assert "cannot be written" in told and str(tmp_path) in told
    assert "File too large" in told or "bytes are on the disk" in told
    assert "False" not in same and left == "[]"
    assert then.endswith("'run_000001.vtu']" if method == "write" else "['run.ckpt']")


def test_special_files_stay_as_they_are(mpi_tmp_path):
    problem = scenes.block()
    problem.solve(1)
    for kind in ("pipe", "socket", "directory"):
        for name in ("run.ckpt", "run.pvd"):
            path = mpi_tmp_path / f"{kind}_{name}"
            bound = None
            if WORLD.rank == 0:
                if kind == "pipe":
                    os.mkfifo(path)
                elif kind == "directory":
                    path.mkdir()
                else:
                    bound = socket.socket(socket.AF_UNIX)
                    bound.bind(os.path.relpath(path))
            WORLD.Barrier()
            before = path.stat()
            write = problem.save if name == "run.ckpt" else problem.write
            with pytest.raises(mpm.MPMError, match=rf"{name}' is a {kind} and stays as it is"):
                write(path)
            WORLD.Barrier()
            after = path.stat()
            assert (after.st_ino, after.st_mode) == (before.st_ino, before.st_mode)
            assert not stat.S_ISREG(after.st_mode)
            if kind == "pipe" and name == "run.ckpt":
                with pytest.raises(mpm.MPMError, match="cannot be read, since it is a pipe"):
                    problem.restore(path)
            WORLD.Barrier()
            if bound is not None:
                bound.close()
    # a link to such a file, and the file of a state
    if WORLD.rank == 0:
        (mpi_tmp_path / "link.ckpt").symlink_to(mpi_tmp_path / "pipe_run.ckpt")
        os.mkfifo(mpi_tmp_path / "state_000000.vtu")
    WORLD.Barrier()
    with pytest.raises(mpm.MPMError, match=r"link\.ckpt' is a pipe"):
        problem.save(mpi_tmp_path / "link.ckpt")
    with pytest.raises(mpm.MPMError, match=r"state_000000\.vtu' is a pipe"):
        problem.write(mpi_tmp_path / "state.pvd")
    WORLD.Barrier()
    assert (mpi_tmp_path / "link.ckpt").is_symlink()
    assert not (mpi_tmp_path / "state.pvd").exists()
    WORLD.Barrier()


def test_names_that_are_none(mpi_tmp_path):
    problem = scenes.block()
    problem.solve(1)
    for name in ("", "."):
        with pytest.raises(mpm.MPMError, match=r"'\.' is a directory"):
            problem.save(name)
