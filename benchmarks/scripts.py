"""Options that all scripts of this folder have, and the facts that their records begin with."""

from __future__ import annotations

import argparse
import sys
from datetime import date
from pathlib import Path

import torch

from npa_envs.measure.benchmark_records import current_commit, machine


def script_parser(description: str | None) -> argparse.ArgumentParser:
    """Return a parser of the options that all scripts in `benchmarks/` have."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--threads", type=int, default=1, help="CPU threads of torch")
    parser.add_argument("--commit", help="commit that is measured; default: that of the checkout")
    parser.add_argument("--output", type=Path, help="JSON file to write")
    return parser


def script_facts(arguments: argparse.Namespace) -> dict[str, str]:
    """Return what a script's record begins with: command without the path, commit, date, ..."""
    words = ["OUT" if word == str(arguments.output) else word for word in sys.argv]
    return {
        "command": " ".join(["python", *words]),
        "commit": arguments.commit or current_commit(),
        "date": date.today().isoformat(),
        "machine": machine(torch.device(arguments.device)),
        "torch": torch.__version__,
    }
