"""`npa-envs doctor`: is everything there that the package needs?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import tyro


@dataclass(frozen=True)
class DoctorOptions:
    """Versions, devices, kernel cache, fonts: what to look at first, and for bug reports."""


def main(arguments: Sequence[str]) -> int:
    """Run the command.

    Args:
        arguments: The words after `npa-envs doctor`.

    Returns:
        0 where all is well, 1 where something has to be mended.
    """
    tyro.cli(DoctorOptions, prog="npa-envs doctor", args=arguments)
    from npa_envs.diagnostics import examine

    findings = examine()
    width = max(len(finding.subject) for finding in findings)
    for finding in findings:
        mark = " " if finding.cure is None else "!"
        print(f"{mark} {finding.subject:<{width}}  {finding.text}")
        if finding.cure is not None:
            print(f"  {'':<{width}}  -> {finding.cure}")
    broken = sum(finding.cure is not None for finding in findings)
    print(f"{broken} to mend, marked with !" if broken else "all is well")
    return 1 if broken else 0
