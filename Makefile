# Options: make PYTHON=python3.12 probe: with another Python, 3.11 or newer.
#          make PIP_ARGS="--extra-index-url URL" probe: with options for pip install.
#          make VENV_ARGS=--system-site-packages probe: with the packages that PYTHON has already.

PYTHON ?= python3
PIP_ARGS ?=
VENV_ARGS ?=
VENV := .venv
BIN := $(VENV)/bin
INSTALL = $(BIN)/python -m pip install --quiet $(PIP_ARGS) --constraint $(VENV)/constraints.txt

.PHONY: help probe check lint test test-all docs newest mutants clean

help: ## list the targets
	@sed -n 's/^\([a-z-]*\):.*## /\1\t/p' Makefile | expand -t 10
	@sed -n '/^# Options/,/^$$/s/^# //p' Makefile

probe: $(VENV)/.installed ## set up and run a session
	$(BIN)/python -m runners.probe object=drill method=chsel

check: lint ## linter, types, and tests of what differs from the last commit, in half a minute
	$(BIN)/python -m tests.tools.changed

lint: $(VENV)/.installed-test ## linter, format and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

test: lint ## the checks of every commit
	$(BIN)/python -m pytest -n 3 --dist loadfile --no-loadscope-reorder

newest: $(VENV)-newest/bin/python ## the tests with the newest versions in range, in .venv-newest, before a release
	$(VENV)-newest/bin/python -m pip install --quiet $(PIP_ARGS) --upgrade --upgrade-strategy eager --editable ".[test]"
	@sed 's/ *;.*//' constraints.txt > $(VENV)-newest/constraints.txt
	@echo "newer than in constraints.txt, or not there:"
	@$(VENV)-newest/bin/python -m pip freeze --exclude-editable | grep -vixFf $(VENV)-newest/constraints.txt || true
	$(VENV)-newest/bin/python -m pytest -n 3 --dist loadfile --no-loadscope-reorder

test-all: $(VENV)/.installed-test ## all tests, with those that take long and rarely fail
	$(BIN)/python -m pytest -n 3 --dist loadfile --no-loadscope-reorder -m "slow or not slow"

docs: $(VENV)/constraints.txt ## the documentation as a site with search, build/site/index.html
	$(INSTALL) --editable ".[docs]"
	rm -rf build/pages && mkdir -p build/pages
	cp -r --parents *.md CITATION.cff LICENSE docs examples replay/*.png replay/*.webp build/pages
	$(BIN)/python -m zensical build --strict --clean

mutants: $(VENV)/.installed-test ## how many single mistakes the tests of ROOM=chsel/next_probe notice
	$(INSTALL) --editable ".[mutants]"
	$(BIN)/python -m tests.tools.mutants $(ROOM)

$(VENV)/bin/python $(VENV)-newest/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "$(PYTHON) is older than Python 3.11; pass PYTHON=python3.11 or newer"; exit 2; }
	@$(PYTHON) -m venv $(VENV_ARGS) $(@D:/bin=) || \
		{ rm -rf $(@D:/bin=); echo "no virtual environment: on Debian, apt install python3-venv"; exit 2; }

# A torch that is there stays, whatever its version: it is the largest part by far.
$(VENV)/constraints.txt: constraints.txt | $(VENV)/bin/python
	@if $(BIN)/python -c "import importlib.metadata as m; m.version('torch')" 2>/dev/null; \
		then sed '/^torch==/d' constraints.txt; else cat constraints.txt; fi > $@

$(VENV)/.installed: pyproject.toml $(VENV)/constraints.txt
	$(INSTALL) --editable ".[sim,sensors,evaluate,serve]"  # "all" without torch
	@touch $@

$(VENV)/.installed-test: $(VENV)/.installed
	$(INSTALL) --editable ".[test]"
	@touch $@

clean: ## delete the environment and all that was built
	rm -rf $(VENV) $(VENV)-newest build dist *.egg-info
