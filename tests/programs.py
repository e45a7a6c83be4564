# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Programs that tests start in processes of their own, and what these find there."""

import contextlib
import fcntl
import functools
import importlib.util
import json
import os
import shlex
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Iterator
from importlib import metadata
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path
from typing import Any

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


#: Where tests keep compiled forms, apart from DOLFINx, where others that were killed meanwhile
#: leave files for which FFCx waits.
OWN = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mpm_dolfinx_tests"
#: What each form includes, which compilers then read once: two fifths of their time.
HEADERS = OWN / "headers.h"
#: How forms of tests are compiled. Meshes have few cells: to optimise takes longer than it wins.
FAST = ["-O0", "-g0"]
#: The end of the name of FFCx's note that a module is ready.
READY = ".c.cached"


@contextlib.contextmanager
def whole_forms(own: Path = OWN) -> Iterator[None]:
    """Keep the forms of tests, without those that a run was killed at; one rank does this.

    Who runs tests holds a lock, which ends with his process. Where nobody else does, forms that are
    begun only are taken away.
    """
    own.mkdir(parents=True, exist_ok=True)
    with (own / "lock").open("a") as lock:
        with contextlib.suppress(BlockingIOError):
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            ready = {note.name.removesuffix(READY) for note in own.glob(f"*{READY}")}
            for module in {file.stem for file in own.glob("*.c")} - ready:
                for file in own.glob(f"{module}.*"):
                    file.unlink()
        fcntl.flock(lock, fcntl.LOCK_SH)
        yield


def read_headers(headers: Path = HEADERS) -> None:
    """Have the compiler keep what forms include as it has read it; one rank does this.

    A compiler that finds nothing that fits its options reads the text.
    """
    headers.write_text("#include <Python.h>\n#include <math.h>\n#include <stdalign.h>\n", "utf-8")
    known = sysconfig.get_config_vars()
    compiler = " ".join([os.environ.get("CC") or known["CC"], known["CFLAGS"], known["CCSHARED"]])
    with contextlib.suppress(OSError), tempfile.TemporaryDirectory(dir=headers.parent) as folder:
        read = Path(folder, "read")
        command = [*shlex.split(compiler), "-I", sysconfig.get_path("include"), "-std=c17", *FAST]
        command += ["-x", "c-header", headers, "-o", read]
        if subprocess.run(command, capture_output=True, check=False).returncode == 0:
            read.replace(f"{headers}.gch")


@contextlib.contextmanager
def patient_compilers() -> Iterator[None]:
    """Have forms compiled fast, and waited for where another process does, also in what is started.

    DOLFINx's ten seconds are short for several processes with an empty cache on a busy machine. The
    options are read from a file, to which what the user's own file says is added.
    """
    own = Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config")
    file = Path("dolfinx", "dolfinx_jit_options.json")
    options: dict[str, Any] = {"timeout": int(PATIENCE)}
    options["cffi_extra_compile_args"] = FAST
    with contextlib.suppress(OSError):
        options |= json.loads((own / file).read_text("utf-8"))
    options["cache_dir"] = str(OWN)
    before = {name: os.environ.get(name) for name in ("XDG_CONFIG_HOME", "CPPFLAGS")}
    include = f"-include {shlex.quote(str(HEADERS))}"
    with tempfile.TemporaryDirectory(prefix="mpm_dolfinx_") as folder:
        path = Path(folder) / file
        path.parent.mkdir()
        path.write_text(json.dumps(options), "utf-8")
        os.environ["XDG_CONFIG_HOME"] = folder
        if HEADERS.exists():
            os.environ["CPPFLAGS"] = f"{before['CPPFLAGS'] or ''} {include}"
        try:
            yield
        finally:
            for name, value in before.items():
                os.environ.pop(name, None)
                if value is not None:
                    os.environ[name] = value


def loaded(module_name, object_names, cache_dir):
    """Return what FFCx compiled under a name, and its module, or twice ``None``."""
    path = Path(cache_dir, module_name + EXTENSION_SUFFIXES[0])
    if not (Path(cache_dir, module_name + READY).exists() and path.exists()):
        return None, None
    spec = importlib.util.spec_from_file_location(module_name, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return [getattr(module.lib, name) for name in object_names], module


@contextlib.contextmanager
def remembered_forms() -> Iterator[None]:
    """Have FFCx look for a form once and by its name: it lists its whole cache each time.

    And setuptools for what is installed once, where it looks seven times for each that is compiled.
    """
    look, found, installed = jit.get_cached_module, {}, metadata.entry_points

    def remember(module_name, object_names, cache_dir, timeout):
        key = module_name, tuple(object_names), str(cache_dir)
        if key not in found:
            objects, module = loaded(module_name, object_names, cache_dir)
            if module is None:
                objects, module = look(module_name, object_names, cache_dir, timeout)
            if module is None:  # which the caller compiles now
                return None, None
            found[key] = objects, module
        return found[key]

    jit.get_cached_module, metadata.entry_points = remember, functools.cache(installed)
    try:
        yield
    finally:
        jit.get_cached_module, metadata.entry_points = look, installed
