# `make run` and `make test` need only make and Python 3.11 to 3.13; .venv sets itself up.
PYTHON ?= python3
BIN := .venv/bin
# A PYTHON that you give replaces a .venv of another version.
ifneq ($(origin PYTHON),file)
ifneq ($(shell $(PYTHON) -V),$(shell $(BIN)/python -V 2>/dev/null))
.PHONY: .venv/installed
endif
endif
PIP := $(BIN)/pip install --quiet --constraint constraints.txt

.PHONY: help run test quick coverage lint bench docs results digits install clean

help: ## list these targets
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "  make %-8s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

run: install ## train RIL on MountainCar, 10 seeds
	$(BIN)/ril-run env=mountaincar method=ril

test: install ## run all tests, on up to four cores
	$(BIN)/pytest --numprocesses=auto --maxprocesses=4 --dist=worksteal

quick: install ## run the most important tests
	$(BIN)/pytest --numprocesses=auto --maxprocesses=4 --dist=worksteal -m quick

coverage: install ## run all tests and list the lines and branches that none of them takes
	$(PIP) pytest-cov
	$(BIN)/pytest --numprocesses=auto --maxprocesses=4 --dist=worksteal --cov --cov-report=term-missing

lint: install ## check style and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: install ## measure speed beside other libraries; write docs/performance.md
	$(BIN)/python scripts/benchmark.py

docs: .venv/docs ## build the documentation in site/
	$(BIN)/mkdocs build --strict

results: install ## write docs/results.md and the README's figure from outputs/reference/
	$(BIN)/ril-report results --outputs outputs/reference --to docs

digits: install ## write tests/run/digits.json, after a change that is meant to change digits
	PYTHONPATH=tests $(BIN)/python -m helpers.digits

install: .venv/installed ## set up .venv; PYTHON=... chooses the interpreter

.venv/installed: pyproject.toml constraints.txt constraints-common.txt
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 14))' || \
		{ echo "ril needs Python 3.11, 3.12 or 3.13: make PYTHON=/path/to/python3.12"; exit 1; }
	$(PYTHON) -m venv --clear .venv
	$(PIP) torch
	$(PIP) --editable '.[dev]'
	touch $@

.venv/docs: .venv/installed
	$(PIP) --editable '.[docs]'
	touch $@

clean: ## remove .venv and site/
	rm -rf .venv site
