"""Entry of the processes behind a studio page (`engine`); each exits when its input is closed.

Worker processes import this module again, so that it imports the rest only when it is run.
"""

from __future__ import annotations

import os
import sys


def main() -> None:
    from dart_flight.lab.studio.engine_work import serve  # noqa: PLC0415  (slow to import)

    # `cancel` kills this process, and the resource tracker of its workers would complain about that.
    os.environ["PYTHONWARNINGS"] = "ignore::UserWarning:multiprocessing.resource_tracker"
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a library prints must not get among the answers
    try:
        serve(sys.stdin.buffer, answers)
    except BrokenPipeError:  # the page has ended
        os._exit(0)


if __name__ == "__main__":
    main()
