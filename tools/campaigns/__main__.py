"""`make campaign`: the bulk runs, one after the other; each prints its report or writes it to docs/results.

python -m tools.campaigns.__main__ [NAME ...]      only these, e.g. `faults fuzz`
"""

from __future__ import annotations

import subprocess
import sys

from rich.console import Console

MODULES = {
    "lock": "tools.campaigns.lock",
    "identify": "tools.campaigns.identify",
    "flight-identify": "tools.campaigns.flight_identify",
    "replay": "tools.campaigns.replay",
    "force": "tools.campaigns.force",
    "body": "tools.campaigns.body",
    "felt": "tools.campaigns.felt",
    "walls": "tools.campaigns.walls",
    "touch": "tools.campaigns.touch",
    "faults": "tools.campaigns.faults",
    "fuzz": "tools.campaigns.fuzz",
    "soak": "tools.campaigns.soak",
    "mutants": "tools.campaigns.mutants",
}


def main() -> int:
    """Run the campaigns named on the command line, all of them by default; 1 where one failed."""
    wanted = sys.argv[1:] or list(MODULES)
    unknown = [name for name in wanted if name not in MODULES]
    if unknown:
        sys.stderr.write(f"unknown campaign {unknown[0]}, known: {', '.join(MODULES)}\n")
        return 2
    console = Console(stderr=True)
    failed = []
    for name in wanted:
        console.print(f"[bold]campaign {name}[/]")
        if subprocess.run([sys.executable, "-m", MODULES[name]], check=False).returncode:
            failed.append(name)
    if failed:
        console.print(f"[red]failed: {', '.join(failed)}[/]")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
