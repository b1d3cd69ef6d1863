"""Entry of the program `maplab`, also as `python -m maplab_py`."""

import gc
import sys

_ALLOCATIONS = 50_000
"""Between two searches for garbage: what imports make stays, and searching it took a tenth of the start."""


def main() -> int:
    """Run the console; where only the version is asked for, print it without loading the console."""
    if sys.argv[1:] == ["--version"] and sys.stdout is not None:
        from importlib.metadata import version

        try:
            sys.stdout.write(f"maplab-py {version('maplab-py')}\n")
            sys.stdout.flush()
            return 0
        except OSError:
            pass  # the console knows how to tell of a full disk or a closed pipe
    gc.set_threshold(_ALLOCATIONS)
    from maplab_py.console.main import main as run_console

    return run_console()


if __name__ == "__main__":
    sys.exit(main())
