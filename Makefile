# Two commands for a new user: `make demo` and `make test`. On a bare machine: Python 3.11 and nothing else.

PYTHON ?= python3.11
VENV   := .venv
BIN    := $(VENV)/bin
PIP     = $(PYTHON) -m pip --python $(BIN)/python install --quiet --disable-pip-version-check

# Real terrain needs a raster library; it is installed only where real data are at hand.
DEMO_STAMPS := $(VENV)/.runtime $(if $(LINNA_DATA),$(VENV)/.terrain)
DEMO_OUT    ?= linna-demo

.PHONY: demo test check bench up install install-dev clean

demo: $(DEMO_STAMPS)
	$(BIN)/linna demo --out $(DEMO_OUT)

test: $(VENV)/.dev
	$(BIN)/python -m pytest

check: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check --diff . >/dev/null || true
	$(BIN)/mypy
	$(BIN)/lint-imports

bench: $(VENV)/.dev
	$(BIN)/python -m benchmarks

up:
	docker compose up --build

install: $(DEMO_STAMPS)
install-dev: $(VENV)/.dev

$(BIN)/python:
	$(PYTHON) -m venv --without-pip $(VENV)

$(VENV)/.runtime: requirements/runtime.txt pyproject.toml | $(BIN)/python
	$(PIP) --no-compile -r requirements/runtime.txt
	$(PIP) --no-deps --editable .
	touch $@

$(VENV)/.terrain: requirements/terrain.txt $(VENV)/.runtime
	$(PIP) --no-compile -r requirements/terrain.txt
	touch $@

$(VENV)/.dev: requirements/dev.txt requirements/train.txt requirements/postgres.txt $(VENV)/.runtime $(VENV)/.terrain
	$(PIP) -r requirements/runtime.txt -r requirements/postgres.txt -r requirements/train.txt -r requirements/dev.txt
	touch $@

clean:
	rm -rf $(VENV) build dist *.egg-info linna-demo
