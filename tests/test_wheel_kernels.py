"""The build hook: which packages it needs, which wheels get kernels, and what they are called."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.support.data import REPOSITORY

pytest.importorskip("hatchling", reason="needs the build system")


@pytest.fixture
def hook(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    """Return the hook of the wheel; instead of compiling it writes what a compilation leaves."""
    for name in ("MAPLAB_WHEEL_KERNELS", "MAPLAB_WHEEL_PLATFORM"):
        monkeypatch.delenv(name, raising=False)
    spec = importlib.util.spec_from_file_location("hook", REPOSITORY / ".ci" / "kernels.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    processors = []

    def compile_nothing(command: Sequence[str], env: dict[str, str], check: bool) -> None:
        assert check
        assert command[1:3] == ["-m", "maplab_py.warmup"]
        assert env["PYTHONPATH"].split(":")[0] == str(tmp_path)
        processors.append(env.get("NUMBA_CPU_NAME", "this one"))
        folder = Path(command[3], "code")
        folder.mkdir(exist_ok=True)
        (folder / f"{processors[-1]}.nbc").write_text("")
        (folder / "left.lock").write_text("")

    monkeypatch.setattr(subprocess, "run", compile_nothing)
    monkeypatch.delenv("NUMBA_CPU_NAME", raising=False)
    requirements = ["numba>=0.60", "numpy>=1.26", "casadi>=3.6.5", "rich>=13.7", "numbalike"]
    metadata: Any = SimpleNamespace(core=SimpleNamespace(dependencies=requirements))
    made = module.KernelHook(str(tmp_path), {}, None, metadata, str(tmp_path), "wheel")
    made.processors = processors
    return made


def build_data() -> dict[str, Any]:
    return {"force_include": {}, "pure_python": True}


def test_only_what_the_compilation_imports_is_installed_for_a_build(
    hook: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert hook.dependencies() == ["numba>=0.60", "numpy>=1.26", "casadi>=3.6.5"]
    monkeypatch.setenv("MAPLAB_WHEEL_KERNELS", "none")
    assert hook.dependencies() == []


@pytest.mark.parametrize(("version", "kernels"), [("editable", ""), ("standard", "none")])
def test_editable_installations_and_who_wants_none_get_a_pure_wheel(
    hook: Any, monkeypatch: pytest.MonkeyPatch, version: str, kernels: str
) -> None:
    monkeypatch.setenv("MAPLAB_WHEEL_KERNELS", kernels)
    data = build_data()
    hook.initialize(version, data)
    assert data == build_data()


@pytest.mark.parametrize(
    ("kernels", "processors"),
    [("", ["this one"]), ("x86-64-v3,x86-64-v2", ["x86-64-v3", "x86-64-v2"])],
)
def test_the_wheel_gets_the_kernels_and_names_python_and_platform(
    hook: Any, monkeypatch: pytest.MonkeyPatch, kernels: str, processors: list[str]
) -> None:
    monkeypatch.setenv("MAPLAB_WHEEL_KERNELS", kernels)
    monkeypatch.setenv("MAPLAB_WHEEL_PLATFORM", "manylinux_2_28-x86.64")
    data = build_data()
    hook.initialize("standard", data)
    assert hook.processors == processors
    python = f"cp{sys.version_info[0]}{sys.version_info[1]}"
    assert data["tag"] == f"{python}-none-manylinux_2_28_x86_64"
    assert not data["pure_python"]
    inside = sorted(data["force_include"].values())
    assert inside == sorted(f"maplab_py/_kernels/code/{name}.nbc" for name in processors)
    assert all(Path(file).exists() for file in data["force_include"])
    hook.finalize("standard", data, "")
    assert not any(Path(file).exists() for file in data["force_include"])
