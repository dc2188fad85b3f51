# make setup | lint | test | demo | clean; `make` alone lists them.

PYTHON ?= python3
# The twin network of the parity tests needs torch; any CPU build will do. Where pip would fetch the large CUDA build instead, name
# PyTorch's CPU index: make test PIP_FLAGS='--extra-index-url ...'
TORCH ?= $(if $(filter 3.11,$(PYTHON_VERSION)),torch==2.13.0,torch>=2.5)
PIP_FLAGS ?=
JOBS ?= 2

VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip
PYTHON_VERSION = $(shell $(BIN)/python -c 'import sys; print("%d.%d" % sys.version_info[:2])')
RUN := runs/quickstart

.PHONY: help setup lint test demo clean
.DELETE_ON_ERROR:

help:
	@echo "make setup   create $(VENV) and install everything (PYTHON=$(PYTHON))"
	@echo "make demo    train the quickstart preset, evaluate it, draw pictures (installs only what that needs)"
	@echo "make test    set-up, lint, types and every test"
	@echo "make lint    ruff and pyright"
	@echo "make clean   remove $(VENV) and caches; runs/ and data/ stay"

setup: $(VENV)/.installed-dev

lint: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

test: lint
	$(BIN)/python -m pytest -n $(JOBS) --dist worksteal

# An interrupted training goes on where it stopped; a finished one is only evaluated.
demo: $(VENV)/.installed
	@if [ -f $(RUN)/config.json ]; then resume=--resume; else resume=; fi; \
	echo "train.py quickstart $$resume"; $(BIN)/python train.py quickstart $$resume
	$(BIN)/python evaluate.py $(RUN)
	@echo; echo "Pictures:"; find $(RUN) -name '*.png' | sort | sed 's/^/  /'

clean:
	rm -rf $(VENV) *.egg-info build dist .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(VENV)/.installed: pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	{ echo "cmig_jax needs Python 3.11 or later: '$(PYTHON)' is $$($(PYTHON) --version 2>&1). Name another one: make PYTHON=python3.12 ..." >&2; exit 1; }
	$(PIP) --version >/dev/null 2>&1 || $(PYTHON) -m venv $(VENV)
	$(PIP) install $(PIP_FLAGS) --editable .
	@touch $@

$(VENV)/.installed-dev: $(VENV)/.installed
	$(PIP) install $(PIP_FLAGS) '$(TORCH)'
	$(PIP) install $(PIP_FLAGS) --editable '.[dev,parity]'
	@touch $@
