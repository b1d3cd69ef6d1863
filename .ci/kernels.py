"""Build hook of hatchling: the machine code of all kernels goes into the wheel.

Kernels are compiled on all cores in the build environment, which gets the packages below in the versions
that pip would install for the wheel now. `MAPLAB_WHEEL_KERNELS` names the processors, with commas
between; without it they are compiled for this machine's, "none" leaves them out. Editable
installations have none either. `MAPLAB_WHEEL_PLATFORM` names another platform than this machine's for
the name of the wheel; machine code calls nothing but libm and numba's own library.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

_NEEDED = (
    "casadi",
    "numba",
    "numpy",
    "opencv-python-headless",
    "protobuf",
    "pymetis",
    "pyyaml",
    "scipy",
    "threadpoolctl",
)
"""Packages that the compilation of kernels imports."""


class KernelHook(BuildHookInterface):  # type: ignore[type-arg]
    """Compiles the kernels and adds them to the wheel as the folder `maplab_py/_kernels`."""

    _cache: Path | None = None

    def dependencies(self) -> list[str]:
        """Return the requirements of the compilation, as the project states them."""
        if os.environ.get("MAPLAB_WHEEL_KERNELS") == "none":
            return []
        stated = self.metadata.core.dependencies
        return [each for each in stated if re.split(r"[^\w.-]", each)[0].lower() in _NEEDED]

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile, and name the wheel by Python and platform."""
        processors = os.environ.get("MAPLAB_WHEEL_KERNELS", "")
        if version == "editable" or processors == "none":
            return
        self._cache = Path(tempfile.mkdtemp(prefix="maplab-wheel-"))
        for processor in processors.split(","):
            self._compile(processor)
        for path in sorted(self._cache.rglob("*")):
            if path.is_file() and path.suffix in (".nbc", ".py", ".json"):
                inside = Path("maplab_py/_kernels") / path.relative_to(self._cache)
                build_data["force_include"][str(path)] = str(inside)
        platform = os.environ.get("MAPLAB_WHEEL_PLATFORM") or sysconfig.get_platform()
        python = f"{sys.version_info[0]}{sys.version_info[1]}"
        build_data["tag"] = f"cp{python}-none-{re.sub('[.-]', '_', platform)}"
        build_data["pure_python"] = False

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Remove what was compiled; the wheel has it."""
        del version, build_data, artifact_path
        if self._cache is not None:
            shutil.rmtree(self._cache, ignore_errors=True)

    def _compile(self, processor: str) -> None:
        paths = [self.root, str(Path(self.root, "plugins")), os.environ.get("PYTHONPATH", "")]
        environment = {
            **os.environ,
            "MAPLAB_CACHE_DIR": str(self._cache),
            "PYTHONDONTWRITEBYTECODE": "1",
            "PYTHONPATH": os.pathsep.join(filter(None, paths)),
        }
        environment.pop("MAPLAB_NATIVE", None)
        if processor:
            environment |= {"NUMBA_CPU_NAME": processor, "NUMBA_CPU_FEATURES": ""}
        command = [sys.executable, "-m", "maplab_py.warmup", str(self._cache)]
        subprocess.run(command, env=environment, check=True)
