"""Fuzz readers with atheris: python -m tests.fuzz READER... [--seconds=20] [--corpus=FOLDER].

The corpus of each reader grows in its folder; an input that fails is written beside it as `crash-...`, and
belongs into tests/fuzz/findings/READER once it is mended.
"""

import argparse
import inspect
import os
import random
import sys
import tempfile
from pathlib import Path
from types import ModuleType

import maplab_py
from tests.fuzz.mutations import mutated

_FROM_SEED = 0.3
"""Share of mutations that start from a seed: of the files of one map, which all reach the same lines when
they are valid, libFuzzer keeps one."""
_READING = ("maplab_py.interop.", "maplab_py.storage.")


def _compiled_modules() -> list[str]:
    """Return the modules with functions for numba, which does not compile instrumented ones.

    `instrument_rest` does their other functions.
    """
    root = Path(maplab_py.__file__).parent
    return [
        ".".join(("maplab_py", *path.relative_to(root).with_suffix("").parts))
        for path in root.rglob("*.py")
        if "maplab_py.compilation import" in path.read_text(encoding="utf-8")
    ]


def instrument_rest(module: ModuleType) -> None:
    """Instrument the functions and methods of a module that numba does not compile."""
    import atheris

    scopes = (module, *(value for value in vars(module).values() if inspect.isclass(value)))
    for scope in scopes:
        for value in vars(scope).values():
            if inspect.isfunction(value) and value.__module__ == module.__name__:
                atheris.instrument_func(value)


def main() -> None:
    """Run libFuzzer on one reader after the other, until one fails."""
    import atheris

    compiled = _compiled_modules()
    with atheris.instrument_imports(include=["maplab_py"], exclude=compiled):
        from tests.fuzz.readers import READERS
    for name in compiled:
        if name in sys.modules and name.startswith(_READING):
            instrument_rest(sys.modules[name])

    parser = argparse.ArgumentParser()
    parser.add_argument("readers", nargs="+", choices=sorted(READERS))
    parser.add_argument("--seconds", type=int, default=20, help="each")
    parser.add_argument("--runs", type=int, default=-1, help="at most, from a fixed seed")
    parser.add_argument("--corpus", type=Path)
    options = parser.parse_args()
    for name in options.readers:
        # libFuzzer ends its process; what is imported is instrumented once
        child = os.fork()
        if not child:
            _fuzz(name, options)
        if status := os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]):
            sys.exit(f"{name}: status {status}")


def _fuzz(name: str, options: argparse.Namespace) -> None:
    """Run libFuzzer on a reader; the process ends with its status."""
    import atheris

    from tests.fuzz.readers import READERS, check

    reader = READERS[name]
    home = Path(tempfile.mkdtemp(prefix=f"fuzz_{name}_"))
    corpus = (options.corpus or home) / name
    for folder in (corpus, home / "seeds", home / "work"):
        folder.mkdir(parents=True, exist_ok=True)
    seeds = reader.seeds(home / "seeds")
    for row, seed in enumerate(seeds):
        (corpus / f"seed_{row}").write_bytes(seed)
    longest = 2 * max(path.stat().st_size for path in corpus.iterdir())
    arguments = [
        f"-max_total_time={options.seconds}",
        *((f"-runs={options.runs}", "-seed=1") if options.runs >= 0 else ()),
        f"-max_len={max(longest, 4096)}",
        *("-timeout=30", "-rss_limit_mb=4000", "-print_final_stats=1", "-len_control=0"),
        f"-artifact_prefix={corpus.parent}/",
        str(corpus),
    ]

    def mutate(data: bytes, max_size: int, seed: int) -> bytes:
        rng = random.Random(seed)
        if rng.random() < _FROM_SEED:
            data = rng.choice(seeds)
        if rng.random() < 0.3:
            return bytes(atheris.Mutate(data, max_size))
        for _ in range(rng.choice((1, 1, 2, 4))):
            data = mutated(rng, data)
        return data[:max_size]

    atheris.Setup(
        [sys.argv[0], *arguments],
        lambda data: check(reader, home / "work", data),
        custom_mutator=mutate,
    )
    atheris.Fuzz()


if __name__ == "__main__":
    main()
