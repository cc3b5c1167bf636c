PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# What is compiled on installing: a change installs anew.
CORE := $(wildcard adapters/mavlink/*.pyx monitor/core/*.pyx monitor/core/*.pxd)

# Four processes for two cores: a third of what the suite takes is waiting for daemons, in real time, and for networks. Files
# of such tests are spread over the others (tests/conftest.py). Another process collects all tests for itself, 3 s.
PYTEST := $(BIN)/python -m pytest -n 4 --dist loadfile --no-loadscope-reorder

# The compiled core in place, for whoever works on it.
.PHONY: core demo console test test-long test-system lint format docs dist clean

core:
	CFLAGS="-O2 -ffp-contract=off" $(BIN)/cythonize --inplace --quiet $(filter %.pyx,$(CORE))

demo: $(VENV)/.app
	$(BIN)/fauio demo

# The same with a recorded flight, in a browser.
console: $(VENV)/.app
	$(BIN)/fauio demo copter --console

# Processes that share the cores gain nothing from threads of their own: in NumPy, and in Clarabel, whose spin.
test test-long test-system: export OPENBLAS_NUM_THREADS = 1
test test-long test-system: export RAYON_NUM_THREADS = 1
# Tests start hundreds of processes; each would compile its modules anew where nothing may keep them.
test test-long test-system: export PYTHONDONTWRITEBYTECODE =

test: $(VENV)/.dev
	$(PYTEST) -m "not long and not system"

# The longest take half a minute each on an idle machine, minutes beside other work.
test-long: $(VENV)/.dev
	$(PYTEST) -m long --timeout 600

# systemd-analyze, zsh, fish, promtool and Chromium with its driver have to be there
test-system: $(VENV)/.dev
	$(BIN)/python -m pytest -m system

lint: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	PATH="$(BIN):$$PATH" cython-lint --max-line-length 120 $(CORE)
	$(BIN)/hadolint Containerfile

format: $(VENV)/.dev
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

docs: $(VENV)/.docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

dist: $(VENV)/.dev
	rm -rf dist
	$(BIN)/python -m build

$(BIN)/python:
	@echo "fauio: making an environment of its own for Python in $(VENV)"
	$(PYTHON) -m venv $(VENV)

$(VENV)/.app: $(BIN)/python pyproject.toml $(CORE)
	@echo "fauio: installing into $(VENV), 1.4 GB with all that it needs; a few minutes, the first time only"
	$(BIN)/python -m pip install --disable-pip-version-check --editable .
	@echo "fauio: installed"
	touch $@

$(VENV)/.dev: $(BIN)/python pyproject.toml $(CORE)
	$(BIN)/python -m pip install --quiet --editable ".[dev]"
	touch $@ $(VENV)/.app

$(VENV)/.docs: $(BIN)/python pyproject.toml $(CORE)
	$(BIN)/python -m pip install --quiet --editable ".[docs]"
	touch $@ $(VENV)/.app

clean:
	rm -rf $(VENV) build dist *.egg-info demo-out site
