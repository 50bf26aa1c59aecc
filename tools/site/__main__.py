"""Build the manual as static pages: python -m tools.site [SITE [DOCS]].

The pages of DOCS (default docs/) go to the folder SITE (default build/site).

A warning is an error: a broken link, a missing picture, a page that docs/index.md does not link.
"""

from __future__ import annotations

import sys
from pathlib import Path

from sphinx.cmd.build import build_main

from tools.site.stage import ROOT, stage

DEFAULTS = (ROOT / "build" / "site", ROOT / "docs")


def main(arguments: list[str]) -> int:
    """Build the site and return Sphinx's exit status."""
    site, docs = (Path(given) for given in [*arguments, *map(str, DEFAULTS[len(arguments) :])])
    sources = site.with_name(f"{site.name}-sources")
    stage(sources, docs)
    options = ["--fail-on-warning", "--quiet", "--fresh-env", "--conf-dir", str(ROOT / "tools" / "site")]
    cache = str(site.with_name(f"{site.name}-cache"))
    return int(build_main([*options, "--doctree-dir", cache, str(sources), str(site)]))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
