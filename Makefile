# One target for each check; `make check` runs them all and is what CI runs.
BIN := .venv/bin
# keep bytecode: the tests start hundreds of processes, each of which would compile the package again
export PYTHONDONTWRITEBYTECODE :=

.PHONY: check lint types floors test nightly docs format

check: lint types floors test

lint:
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .

types:
	$(BIN)/mypy

floors:
	$(BIN)/lint-imports

# four workers on two cores, since many tests wait for a cart
test:
	$(BIN)/pytest -n 4 --dist worksteal --durations=20 --durations-min=5

# what `make test` leaves out: see tests/README.md
nightly:
	$(BIN)/pytest -m nightly -n 2 --dist worksteal

# the site, into build/site; a broken link, a missing page or an unresolved reference is an error
docs:
	$(BIN)/sphinx-build -c docs -b html --fail-on-warning --keep-going --quiet . build/site

format:
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .
