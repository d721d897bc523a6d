"""Parameters of a task on the command line: `--set KEY=VALUE`."""

from __future__ import annotations

import argparse
import json
from typing import Any


def add_set(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="a parameter of the task; may be given again")


def parameters(given: argparse.Namespace) -> dict[str, Any]:
    """Those that were given: numbers, or else text."""
    found: dict[str, Any] = {}
    for text in given.set:
        key, is_one, value = text.partition("=")
        if not is_one:
            raise ValueError(f"--set: '{text}' is not KEY=VALUE")
        try:
            found[key] = json.loads(value)
        except json.JSONDecodeError:
            found[key] = value
    return found
