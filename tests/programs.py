# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Programs that tests start in processes of their own, and what these find there."""

import contextlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from ffcx.codegeneration import jit

#: How long what hangs is waited for. Compiling many forms on a busy machine takes minutes.
PATIENCE = 500.0


def run(*arguments, cwd=None, **environment):
    """Run this interpreter with this package to its end; return its status and what it wrote."""
    paths = os.pathsep.join(p for p in sys.path if p)
    return subprocess.run(
        [sys.executable, *map(str, arguments)],
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": paths, "PYTHONUTF8": "1", **environment},
        capture_output=True,
        encoding="utf-8",
        timeout=PATIENCE,
        check=False,
    )


@contextlib.contextmanager
def patient_compilers() -> Iterator[None]:
    """Have DOLFINx wait for a form that another process compiles, here and in what is started.

    Its ten seconds are short for several processes with an empty cache on a busy machine. The
    options are read from a file, to which what the user's own file says is added.
    """
    own = Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config")
    name = Path("dolfinx", "dolfinx_jit_options.json")
    options = {"timeout": int(PATIENCE)}
    with contextlib.suppress(OSError):
        options |= json.loads((own / name).read_text("utf-8"))
    before = os.environ.get("XDG_CONFIG_HOME")
    with tempfile.TemporaryDirectory(prefix="mpm_dolfinx_") as folder:
        path = folder / name
        path.parent.mkdir()
        path.write_text(json.dumps(options), "utf-8")
        os.environ["XDG_CONFIG_HOME"] = folder
        try:
            yield
        finally:
            os.environ.pop("XDG_CONFIG_HOME")
            if before is not None:
                os.environ["XDG_CONFIG_HOME"] = before


@contextlib.contextmanager
def remembered_forms() -> Iterator[None]:
    """Have FFCx look for a form once: for each that is made again it lists its whole cache."""
    look, found = jit.get_cached_module, {}

    def remember(module_name, object_names, cache_dir, timeout):
        key = module_name, tuple(object_names), str(cache_dir)
        if key not in found:
            objects, module = look(module_name, object_names, cache_dir, timeout)
            if module is None:  # which the caller compiles now
                return None, None
            found[key] = objects, module
        return found[key]

    jit.get_cached_module = remember
    try:
        yield
    finally:
        jit.get_cached_module = look
