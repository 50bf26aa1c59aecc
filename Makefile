# `make dry-run` flies a simulated mission. `make install` installs the packages for reports, plans and fits.
# `make test` tests every public behaviour, and `make test-all` everything. Each target creates .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
FLYING := $(VENV)/.installed-to-fly
FULL := $(VENV)/.installed-in-full
SITE := $(VENV)/.installed-for-site
MISSION ?= missions/dual_collision.yaml

.PHONY: dry-run install test test-rest test-all bench campaign compiled wheels docs site format clean
.DEFAULT_GOAL := test

$(VENV)/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "dart-flight needs Python 3.11 or newer; set PYTHON=/path/to/python3"; exit 1; }
	@$(PYTHON) -m venv $(VENV) || \
	  { echo "cannot create a virtual environment; on Debian and Pi OS: apt install python3-venv"; exit 1; }

$(STAMP): pyproject.toml constraints.txt | $(VENV)/bin/python
	$(BIN)/python -m pip install --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@touch $@ $(FLYING) $(FULL)

$(FLYING): pyproject.toml constraints.txt | $(VENV)/bin/python
	$(BIN)/python -m pip install --disable-pip-version-check -c constraints.txt -e '.[sim]'
	@touch $@

$(FULL): pyproject.toml constraints.txt | $(VENV)/bin/python
	$(BIN)/python -m pip install --disable-pip-version-check -c constraints.txt -e '.[full]'
	@touch $@ $(FLYING)

$(SITE): pyproject.toml constraints.txt | $(VENV)/bin/python
	$(BIN)/python -m pip install --disable-pip-version-check -c constraints.txt -e '.[site]'
	@touch $@

dry-run: $(FLYING)  # installs only what a dry-run needs
	$(BIN)/dart-flight dry-run $(MISSION)
	@test -e $(FULL) || echo "next: \`make install\` adds the packages for report, plan, export --foxglove and identify"
	@$(BIN)/python -m dart_flight.sim.px4.installation

install: $(FULL)

# Keep bytecode on disk. Otherwise each of the hundreds of test processes would compile the package again.
test test-rest: export PYTHONDONTWRITEBYTECODE :=
test: $(STAMP)
	$(BIN)/python -m tools.run_tests

test-rest: $(STAMP)  # slow tests: real time, PX4, campaigns, recipes, and pages of the manual that fly
	$(BIN)/python -m tools.run_tests --rest

test-all:  # runs the slow tests even if `make test` fails
	@status=0; $(MAKE) test || status=1; $(MAKE) test-rest || status=1; exit $$status

bench: $(STAMP)
	$(BIN)/python -m tools.bench.__main__

campaign: $(STAMP)
	$(BIN)/python -m tools.campaigns.__main__

compiled: $(STAMP)  # needs the network and a C compiler; docs/speed.md
	rm -rf build/compiled build/compiled-wheel
	DART_FLIGHT_COMPILE=1 $(BIN)/python -m pip wheel --quiet --no-deps -w build/compiled-wheel .
	$(BIN)/python -m zipfile -e build/compiled-wheel/*.whl build/compiled

wheels: $(STAMP)  # needs the network
	$(BIN)/python -m tools.check_wheels

docs: $(STAMP)  # regenerates the tables, schemas and figures in docs/
	$(BIN)/python -m tools.docs.generated
	$(BIN)/python -m tools.docs.concept_figures
	$(BIN)/python -m tools.docs.animation
	$(BIN)/python -m tools.docs.both_ways
	$(BIN)/python -m tools.docs.studio_pictures

site: $(SITE)  # the manual as static pages in build/site; needs the network once, for the generator
	$(BIN)/python -m tools.site

format: $(STAMP)
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

clean:
	rm -rf $(VENV) build dist .mypy_cache .ruff_cache .pytest_cache
