"""The program ``shapespace``: all commands, each of which imports what it needs when it runs."""

from __future__ import annotations

import sys
from contextlib import suppress

from shapespace.command_line import Program, Subcommand, call
from shapespace.commands import COMMANDS
from shapespace.service.__main__ import COMMAND as SERVE

_TRAINING: tuple[Subcommand, ...] = ()
with suppress(ModuleNotFoundError):  # an installation may leave training out
    from shapespace.training.__main__ import COMMANDS as _TRAINING

PROGRAM = Program(
    [*COMMANDS, SERVE, *_TRAINING],
    help="Turn a few numbers into a 3D shape: use a model, train your own, or serve models.",
)


def main() -> int:
    """Run the command line, and return its exit code."""
    return call("shapespace", PROGRAM)


if __name__ == "__main__":
    sys.exit(main())
