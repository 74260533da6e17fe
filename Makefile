# `make` prints what there is. Needs Python 3.11 or newer and make, nothing else.
PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/$(if $(filter Windows_NT,$(OS)),Scripts,bin)
PY     := $(BIN)/python
PIP    := $(PY) -m pip install --quiet --quiet --disable-pip-version-check --constraint constraints.txt

# What `make demo` decomposes.
EXAMPLE ?= examples/red_lacquer.png
PRESET  ?= balanced

.DEFAULT_GOAL := help
.PHONY: help demo test lint format pytest fast bench docs clean

help:
	@echo "make demo    set up, then decompose a real picture in front of you (EXAMPLE=..., PRESET=...)"
	@echo "make test    set up, then every check: lint, types, import contracts, tests"
	@echo "make lint    ruff, mypy and the import contracts only"
	@echo "make format  lay out the code and sort its imports"
	@echo "make fast    the tests without the slow ones"
	@echo "make bench   data sets x methods; writes benchmarks/ (absent data sets are skipped by name)"
	@echo "make docs    regenerate the pages that scripts write, and their pictures"
	@echo "make clean   remove what the above made"

# Two stamps, so that a second run installs nothing: what a user needs, and what a developer needs on top.
$(VENV)/.user: pyproject.toml constraints.txt
	@echo "setting up $(VENV) (once; a minute or two)"
	@$(PYTHON) -c 'import sys; sys.exit("unshade needs Python 3.11 or newer, this is " + sys.version.split()[0] + "; try make PYTHON=python3.12") if sys.version_info < (3, 11) else None'
	@$(PYTHON) -m venv $(VENV)
	@$(PIP) pip setuptools
	@$(PIP) --no-build-isolation --editable '.[exr]'
	@touch $@

$(VENV)/.dev: $(VENV)/.user
	@echo "adding the tools for the checks"
	@$(PIP) --no-build-isolation --editable '.[exr,video,perceptual,mesh,svg,bench,train,export,programs,dev]'
	@touch $@

demo: $(VENV)/.user
	@$(BIN)/unshade decompose $(EXAMPLE) -o out/demo --preset $(PRESET)

test: lint pytest

lint: $(VENV)/.dev
	@$(BIN)/ruff check --quiet src tests scripts
	@$(BIN)/ruff format --check --quiet src tests scripts || { echo "run: make format"; exit 1; }
	@$(BIN)/mypy
	@$(BIN)/lint-imports --no-logo

format: $(VENV)/.dev
	@$(BIN)/ruff check --quiet --fix --select I src tests scripts
	@$(BIN)/ruff format --quiet src tests scripts

pytest: $(VENV)/.dev
	@$(PY) -m pytest -n 2 --dist worksteal

fast: $(VENV)/.dev
	@$(PY) -m pytest -n 2 --dist worksteal -m 'not slow and not browser'

bench: $(VENV)/.dev
	@$(BIN)/unshade bench

docs: $(VENV)/.dev
	@$(PY) scripts/gallery.py
	@$(PY) scripts/dataset_page.py
	@$(PY) scripts/photographs_pictures.py
	@$(PY) scripts/cli_reference.py
	@$(PY) scripts/export_page.py
	@$(PY) scripts/export_gallery.py
	@$(PY) scripts/editing_picture.py
	@$(PY) scripts/readme_picture.py

clean:
	rm -rf $(VENV) build dist out src/*.egg-info .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
