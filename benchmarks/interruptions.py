"""Ctrl-C in every command on the Tango map: `python -m benchmarks.interruptions [COMMAND...]`."""

import argparse
import sys
import tempfile
from pathlib import Path

import pexpect

from maplab_py.console.commands.registry import load_registry
from tests.support.data import shared_data
from tests.support.interruptions import Interrupter, Workspace

PROMPT_S = 1.0


def main() -> int:
    """Print one line per command; return 1 when one broke the bar."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("commands", nargs="*", help="default: all")
    parser.add_argument("--at-most", type=float, default=12.0, help="seconds of a long command")
    options = parser.parse_args()
    registry = load_registry()
    names = options.commands or [c.name for c in registry.commands if registry.is_built_in(c)]
    broken = 0
    print(f"{'command':42s} {'prompt after [s]':34s} outcomes")
    with tempfile.TemporaryDirectory() as folder:
        workspace = Workspace(Path(folder), shared_data("maplab_maps/tango_handheld"))
        interrupter = Interrupter(workspace)
        try:
            for name in names:
                try:
                    presses = interrupter.interrupt(name, at_most_s=options.at_most)
                except pexpect.ExceptionPexpect:
                    print(f"{name}: no prompt; the last output is {interrupter.unread[-500:]!r}")
                    broken += 1
                    interrupter.close()
                    interrupter = Interrupter(workspace)
                    continue
                is_broken = any(p.harm or p.prompt_s > PROMPT_S for p in presses)
                broken += is_broken
                times = " ".join(f"{p.prompt_s:.2f}@{p.after_s:.1f}" for p in presses)
                outcomes = " ".join(p.outcome[:4] for p in presses)
                remarks = [p.harm for p in presses if p.harm]
                remarks += sorted({p.outcome for p in presses if p.outcome.startswith("failed")})
                harms = "; ".join(remarks)
                mark = "  BROKEN" if is_broken else ""
                print(f"{name[:42]:42s} {times:34s} {outcomes} {harms}{mark}", flush=True)
        finally:
            interrupter.close()
    print(f"{len(names)} commands, {broken} above {PROMPT_S:g} s or with traces")
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
