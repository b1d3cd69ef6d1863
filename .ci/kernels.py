"""Build hook of hatchling: the machine code of all kernels goes into the wheel.

Kernels are compiled on all cores in the build environment, which gets the packages that this needs in the
versions that pip would install for the wheel now. `MAPLAB_WHEEL_KERNELS` names the processors, with
commas between; without it they are compiled for this machine's, "none" leaves them out. Editable
installations have none either. `MAPLAB_WHEEL_PLATFORM` names another platform than this machine's for
the name of the wheel; machine code calls nothing but libm and numba's own library.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

_NEEDED = re.compile(
    r"(casadi|numba|numpy|opencv-python-headless|protobuf|pymetis|pyyaml|scipy|threadpoolctl)\b"
)
"""Packages that the compilation of kernels imports; with pymetis elimination is ordered by other kernels."""


class KernelHook(BuildHookInterface):  # type: ignore[type-arg]
    """Compiles the kernels and adds them to the wheel as the folder `maplab_py/_kernels`."""

    def dependencies(self) -> list[str]:
        """Return the requirements of the compilation, as the project states them."""
        if os.environ.get("MAPLAB_WHEEL_KERNELS") == "none":
            return []
        return [each for each in self.metadata.core.dependencies if _NEEDED.match(each)]

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile, and name the wheel by Python and platform."""
        processors = os.environ.get("MAPLAB_WHEEL_KERNELS", "")
        if version == "editable" or processors == "none":
            return
        self._compiled = tempfile.TemporaryDirectory(prefix="maplab-wheel-")
        paths = [self.root, str(Path(self.root, "plugins")), os.environ.get("PYTHONPATH", "")]
        environment = {
            **{name: value for name, value in os.environ.items() if name != "MAPLAB_NATIVE"},
            "MAPLAB_CACHE_DIR": self._compiled.name,
            "PYTHONPATH": os.pathsep.join(filter(None, paths)),
        }
        for processor in processors.split(","):
            target = {"NUMBA_CPU_NAME": processor, "NUMBA_CPU_FEATURES": ""} if processor else {}
            command = [sys.executable, "-m", "maplab_py.warmup"]
            subprocess.run(command, env=environment | target, check=True)
        for path in sorted(Path(self._compiled.name).rglob("*.*")):
            if path.suffix in (".nbc", ".py"):
                inside = Path("maplab_py/_kernels") / path.relative_to(self._compiled.name)
                build_data["force_include"][str(path)] = str(inside)
        platform = os.environ.get("MAPLAB_WHEEL_PLATFORM") or sysconfig.get_platform()
        python = f"{sys.version_info[0]}{sys.version_info[1]}"
        build_data["tag"] = f"cp{python}-none-{re.sub('[.-]', '_', platform)}"
        build_data["pure_python"] = False

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Remove what was compiled; the wheel has it."""
        del version, build_data, artifact_path
        if hasattr(self, "_compiled"):
            self._compiled.cleanup()
