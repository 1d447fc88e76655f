# Two commands do everything: `make run` and `make test`. Python >= 3.11 and make are all they need.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: run test lint bench install clean

run: install ## train RIL on MountainCar, 10 seeds
	$(BIN)/ril-run env=mountaincar method=ril

test: install ## the test suite, on every core up to four
	$(BIN)/pytest --numprocesses=auto --maxprocesses=4 --dist=worksteal

lint: install ## style and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: install ## how fast it is, beside others; writes docs/performance.md
	$(BIN)/python scripts/benchmark.py

install: .venv/installed

.venv/installed: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 14))' || \
		{ echo "ril needs Python 3.11 to 3.13; give one as: make PYTHON=/path/to/python3.12"; exit 1; }
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --constraint constraints.txt torch
	$(BIN)/pip install --quiet --constraint constraints.txt --editable '.[dev]'
	touch $@

clean:
	rm -rf .venv
