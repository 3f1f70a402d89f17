# One target for each check; `make check` runs them all and is what CI runs.
BIN := .venv/bin

.PHONY: check lint types floors test format

check: lint types floors test

lint:
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .

types:
	$(BIN)/mypy

floors:
	$(BIN)/lint-imports

test:
	$(BIN)/pytest -n 2 --dist worksteal

format:
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .
