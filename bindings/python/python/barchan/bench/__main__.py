"""The command line of `python -m barchan.bench`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from barchan.bench import learn, tasks
from barchan.errors import BarchanError


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a command, and returns its exit status."""
    parser = argparse.ArgumentParser(prog="python -m barchan.bench", description="Measures and learns Barchan's benchmark tasks.")
    commands = parser.add_subparsers(dest="command", required=True)
    for name, module in (("tasks", tasks), ("learn", learn)):
        command = commands.add_parser(name, help=module.HELP, description=module.HELP, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
        module.add_arguments(command)
        command.set_defaults(run=module.run)
    given = parser.parse_args(arguments)
    try:
        return given.run(given)
    except (BarchanError, ImportError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1


if __name__ == "__main__":
    sys.exit(main())
