"""`python -m dart_flight`."""

import sys

from dart_flight.cli import main

sys.exit(main())
