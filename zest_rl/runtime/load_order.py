"""Import this before mujoco, or else before anything is rendered.

GL's software drivers and Triton (which torch, timm and transformers load) each bring an LLVM; with that of GL loaded
first, Triton finds its functions there, and loading it crashes Python (seen with Mesa 22.3 and Triton 3). So Triton is
loaded first; where a script has rendered already, Triton is told to look for its functions in itself (RTLD_DEEPBIND).
mujoco may load GL when it is imported, and fails there where ``MUJOCO_GL`` is not one of its values or names a library
that is missing: a `ZestError` here. Costs 0.2 s where Triton is installed.
"""

import importlib
import importlib.util
import os
import sys
from pathlib import Path

from zest_rl.errors import ZestError

if importlib.util.find_spec("triton"):
    _maps = Path("/proc/self/maps")
    if "triton" not in sys.modules and _maps.exists() and b"libLLVM" in _maps.read_bytes():
        _flags = sys.getdlopenflags()
        sys.setdlopenflags(_flags | os.RTLD_DEEPBIND)
        try:
            importlib.import_module("triton._C.libtriton")
        finally:
            sys.setdlopenflags(_flags)
    importlib.import_module("triton")
try:
    importlib.import_module("mujoco")
except (AttributeError, ImportError, OSError, RuntimeError) as error:
    if not os.environ.get("MUJOCO_GL"):
        raise
    raise ZestError(
        f"MuJoCo cannot be loaded with MUJOCO_GL={os.environ['MUJOCO_GL']} ({error}); unset it, so that what works is "
        "chosen, or set it to egl (libegl1), osmesa (software, libosmesa6), glfw (a display) or disable (no pictures)"
    ) from error
