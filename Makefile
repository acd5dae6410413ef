# The developer's verbs; `make help` lists them. Each makes the virtual environment it needs.
PYTHON ?= python3
WORKERS ?= 2

BIN := .venv/bin
PYTEST := $(BIN)/python -m pytest --confcutdir=tests
# Work is stolen: each worker has a part of the rooms to itself, so few kernels are compiled in both.
TOGETHER := -n $(WORKERS) --dist worksteal
# In the same run: alone, the few examples would import and compile everything once more.
DOCTESTS := --doctest-modules tests src/sideslip
# Pip's build environments are pinned as well (the second name is pip 25.3's and later).
INSTALL := PIP_CONSTRAINT=constraints.txt PIP_BUILD_CONSTRAINT=constraints.txt \
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt

.DEFAULT_GOAL := help
.NOTPARALLEL:
.DELETE_ON_ERROR:
.PHONY: help bench bench-all bench-full test test-plain test-long test-stock coverage lint types docs wheel clean

help: ## list the targets
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/  make \1\t\2/p' Makefile | expand -t 18

# What every run writes; DATA=folder has downloaded drives, for the suite logs.
WRITTEN := --html report.html --json results.json $(if $(DATA),--data "$(DATA)")

bench: .venv/ready-bench ## compare estimators and controllers on few seeds; writes report.html and results.json
	$(BIN)/sideslip bench estimation control --quick $(WRITTEN)

bench-all: .venv/ready-bench ## every suite on few seeds, half an hour on two cores
	$(BIN)/sideslip bench --quick $(WRITTEN)

bench-full: .venv/ready-bench ## every suite on all seeds, hours on two cores; goes on where it was stopped
	$(BIN)/sideslip bench --keep .bench $(WRITTEN)

test: .venv/ready-all ## the tests and the examples in docstrings
	$(PYTEST) $(TOGETHER) -m "not long" $(DOCTESTS)

test-plain: .venv/ready-all ## the marked tests without compilation
	NUMBA_DISABLE_JIT=1 $(PYTEST) $(TOGETHER) -m "plain and not compiled and not long"

test-long: .venv/ready-all ## the tests that `make test` leaves out
	$(PYTEST) $(TOGETHER) -m long

test-stock: .venv/ready-all ## the smoke tests without our compiler: numba compiles by itself, as its other versions do
	SIDESLIP_STOCK_NUMBA=1 $(PYTEST) $(TOGETHER) -m smoke

coverage: .venv/ready-all ## lines reached by the tests marked plain, without compilation
	NUMBA_DISABLE_JIT=1 $(BIN)/coverage run -m pytest --confcutdir=tests -m "plain and not compiled"
	$(BIN)/coverage report

lint: .venv/ready-all ## style, format, docstrings' sections, direction of imports
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	@# A return that the first sentence names needs no section (DOC201).
	! $(BIN)/pydoclint --quiet envs estimators agents benchmarks 2>&1 | grep -vE '^$$|\.py$$|DOC201'
	$(BIN)/lint-imports

types: .venv/ready-all ## mypy, strict
	$(BIN)/mypy

docs: .venv/ready-all ## the documentation with its examples executed, in docs/_build/html/
	$(BIN)/sphinx-build -W --keep-going -q -b html docs docs/_build/html

wheel: .venv/ready-all ## source distribution and wheel, in dist/
	rm -rf dist
	$(BIN)/python -m build --no-isolation

clean: ## remove the virtual environment and everything made here
	rm -rf .venv .bench dist build docs/_build report.html results.json .coverage .hypothesis .import_linter_cache .mypy_cache .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# One stamp for each set of extras: the benchmark does without torch.
.venv/ready-bench: EXTRAS := design,mpc,report,highway,bench,outside
.venv/ready-all: EXTRAS := all,dev
.venv/ready-bench .venv/ready-all: pyproject.toml constraints.txt | $(BIN)/python
	@echo "Installing sideslip[$(EXTRAS)] into .venv (the first time takes a minute or more)"
	$(INSTALL) -e ".[$(EXTRAS)]"
	@touch $@

# Some distributions ship venv without its copy of pip; then the interpreter's own pip fetches one.
$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "sideslip needs Python 3.11 or newer, this is " + sys.version.split()[0] + ": make PYTHON=python3.11 ...")'
	$(PYTHON) -m venv .venv 2>/dev/null || { \
		$(PYTHON) -m venv --clear --without-pip .venv && \
		$(PYTHON) -m pip --python .venv/bin/python install --quiet pip; } || { rm -rf .venv; exit 1; }
